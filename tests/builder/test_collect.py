import hashlib
import os

import pytest

from ambiguous_wild.builder.collect import collect, natural_key
from ambiguous_wild.core import AwError


def put(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(name.encode(errors="surrogateescape"))


def stems(capture):
    return [s.stem for s in capture.sources]


def test_natural_order_and_hashes(tmp_path):
    put(tmp_path, "IMG_10.jpg", "IMG_2.jpg", "img_1.JPG", "notes.txt", ".hidden.jpg")
    capture = collect(tmp_path)
    assert [s.source for s in capture.sources] == ["img_1.JPG", "IMG_2.jpg", "IMG_10.jpg"]
    assert capture.ignored == ("notes.txt",)
    assert capture.sources[0].sha256 == hashlib.sha256(b"img_1.JPG").hexdigest()
    assert capture.sources[0].name == "img_1.png"
    assert sorted(["a10", "a9", "a"], key=natural_key) == ["a", "a9", "a10"]


def test_photos_in_images_folder(tmp_path):
    put(tmp_path / "images", "a.jpg", "b.jpg", "c.jpg")
    assert [s.source for s in collect(tmp_path).sources] == ["images/a.jpg", "images/b.jpg", "images/c.jpg"]


def test_train_and_test_folders_tell_equal_names_apart(tmp_path):
    put(tmp_path / "train", "a.jpg", "b.jpg")
    put(tmp_path / "test", "a.jpg", "c.jpg")
    capture = collect(tmp_path)
    assert capture.has_sides
    assert stems(capture) == ["train_a", "b", "test_a", "c"]
    assert [s.side for s in capture.sources] == ["train", "train", "test", "test"]


def test_duplicate_stems_and_case_stay_apart_on_any_file_system(tmp_path):
    put(tmp_path, "a.jpg", "a.png", "B.jpg", "b.jpg", "a_png.jpg")
    found = stems(collect(tmp_path))
    assert len({s.casefold() for s in found}) == 5


def test_names_lose_white_space_and_length_but_not_letters(tmp_path):
    put(tmp_path, "мой дом.jpg", "x" * 240 + ".jpg", "x" * 239 + "y.jpg", "tab\there.jpg")
    found = stems(collect(tmp_path))
    assert "мой_дом" in found
    assert "tab_here" in found
    assert len(set(found)) == 4
    assert max(len(s.encode()) for s in found) <= 120


def test_nothing_is_changed(tmp_path):
    put(tmp_path, "a.jpg", "b.jpg", "c.jpg")
    before = {p.name: os.stat(p).st_mtime_ns for p in tmp_path.iterdir()}
    collect(tmp_path)
    assert {p.name: os.stat(p).st_mtime_ns for p in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("names", "message"),
    [((), "holds no photos"), (("a.jpg",), "holds one photo"), (("a.jpg", "b.jpg"), "2 photos; at least 3"),
     (("clip.mp4",), "holds no photos.*it holds clip.mp4")],
)  # fmt: skip
def test_too_few(tmp_path, names, message):
    put(tmp_path / "raw", *names)
    with pytest.raises(AwError, match=message):
        collect(tmp_path / "raw")


@pytest.mark.parametrize(
    ("files", "raw", "expected"),
    [
        (["DCIM/a.jpg", "DCIM/b.jpg", "DCIM/c.jpg"], ".", ["a", "b", "c"]),
        (["front/0.jpg", "front/1.jpg", "back/0.jpg", "masks/back/0.png", "Truth/0.png"], ".",
         ["back_0", "front_0", "front_1"]),
        (["images/l/0.jpg", "images/r/0.jpg", "images/r/1.jpg"], ".", ["l_0", "r_0", "r_1"]),
        (["1/l/0.jpg", "1/r/0.jpg", "2/l/0.jpg"], ".", ["1_l_0", "1_r_0", "2_l_0"]),
        (["1/images/0.jpg", "2/images/0.jpg", "2/images/1.jpg"], ".", ["1_0", "2_0", "2_1"]),
        (["a/0.jpg", "a/1.jpg", "b/0.jpg", "c/0.jpg"], ["b", "a"], ["b_0", "a_0", "a_1"]),
        (["x/raw/0.jpg", "x/raw/1.jpg", "y/raw/0.jpg"],
         ["x/raw", "y/raw"], ["x_raw_0", "x_raw_1", "y_raw_0"]),
        (["train/l/0.jpg", "train/r/0.jpg", "test/l/0.jpg"], ".", ["train_l_0", "r_0", "test_l_0"]),
    ],
)  # fmt: skip
def test_several_folders_are_one_capture_and_equal_names_stay_apart(tmp_path, files, raw, expected):
    for name in files:
        put((tmp_path / name).parent, (tmp_path / name).name)
    capture = collect(tmp_path if raw == "." else [tmp_path / r for r in raw])
    assert stems(capture) == expected
    assert len({s.path for s in capture.sources}) == len(expected)
    assert all((capture.root / s.source) == s.path for s in capture.sources)


def test_folders_that_are_left_out_are_named_and_none_is_read_twice(tmp_path):
    put(tmp_path, "a.jpg", "b.jpg", "c.jpg")
    put(tmp_path / "rejected", "d.jpg")
    assert "its folders rejected are left out" in collect(tmp_path).notes[0]
    with pytest.raises(AwError, match="give each once"):
        collect([tmp_path, tmp_path / "rejected"])


@pytest.mark.parametrize("name", ["masks", "MASKS"])
def test_masks_beside_the_photos_are_no_photos_and_their_option_is_named(tmp_path, name):
    put(tmp_path / "photos", "a.jpg", "b.jpg", "c.jpg")
    put(tmp_path / name, "a.png", "b.png", "c.png")
    capture = collect(tmp_path)
    assert stems(capture) == ["a", "b", "c"]
    (note,) = capture.notes
    assert f"--keep-masks '{tmp_path / name}'" in note
    assert collect(tmp_path, masks=tmp_path / name).notes == ()


def test_one_side_alone_and_no_folder(tmp_path):
    put(tmp_path / "train", "a.jpg", "b.jpg", "c.jpg")
    with pytest.raises(AwError, match="no test/"):
        collect(tmp_path)
    with pytest.raises(AwError, match="does not exist"):
        collect(tmp_path / "nowhere")


def test_jpegs_under_any_name_are_photos_and_what_is_not_read_is_counted(tmp_path):
    put(tmp_path, "a.jpg", "b.jfif", "c.jpe", "d.avif", "e.cr2", "f.cr2", "notes.txt")
    for name in ("saved", "a.jpg_original", "GX01.THM"):
        (tmp_path / name).write_bytes(b"\xff\xd8\xff rest")
    capture = collect(tmp_path)
    assert [s.source for s in capture.sources] == ["a.jpg", "b.jfif", "c.jpe", "d.avif", "saved"]
    assert any("2 pictures of formats that are not read, left out: .cr2 (2)" in n for n in capture.notes)


@pytest.mark.parametrize("mask", ["a.jpg.mask.png", "a.mask.png", "a_mask.png", "mask_a.png"])
def test_masks_among_the_photos_are_no_photos(tmp_path, mask):
    put(tmp_path, "a.jpg", "b.jpg", "c.jpg", mask)
    capture = collect(tmp_path)
    assert stems(capture) == ["a", "b", "c"]
    assert any(f"1 mask beside photos, as {mask}" in n and "--keep-masks" in n for n in capture.notes)
    assert collect(tmp_path, masks=tmp_path).notes == ()
