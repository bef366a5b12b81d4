import hashlib
import os

import pytest

from ambiguous_wild.builder.collect import collect, identical, natural_key
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
    assert [s.relative for s in capture.sources] == ["img_1.JPG", "IMG_2.jpg", "IMG_10.jpg"]
    assert capture.ignored == ("notes.txt",)
    assert capture.sources[0].sha256 == hashlib.sha256(b"img_1.JPG").hexdigest()
    assert capture.sources[0].work_name == "img_1.jpg"
    assert sorted(["a10", "a9", "a"], key=natural_key) == ["a", "a9", "a10"]


def test_photos_in_images_folder(tmp_path):
    put(tmp_path / "images", "a.jpg", "b.jpg", "c.jpg")
    assert [s.relative for s in collect(tmp_path).sources] == ["images/a.jpg", "images/b.jpg", "images/c.jpg"]


def test_train_and_test_folders_tell_equal_names_apart(tmp_path):
    put(tmp_path / "train", "a.jpg", "b.jpg")
    put(tmp_path / "test", "a.jpg", "c.jpg")
    capture = collect(tmp_path)
    assert capture.has_sides
    assert stems(capture) == ["train_a", "b", "test_a", "c"]
    assert [s.side for s in capture.sources] == ["train", "train", "test", "test"]
    assert identical(capture) == [["train/a.jpg", "test/a.jpg"]]


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


def test_the_folder_that_does_hold_them_is_named(tmp_path):
    put(tmp_path / "DCIM", "a.jpg", "b.jpg", "c.jpg")
    with pytest.raises(AwError, match="DCIM does: give that folder"):
        collect(tmp_path)


def test_one_side_alone_and_no_folder(tmp_path):
    put(tmp_path / "train", "a.jpg", "b.jpg", "c.jpg")
    with pytest.raises(AwError, match="no test/"):
        collect(tmp_path)
    with pytest.raises(AwError, match="does not exist"):
        collect(tmp_path / "nowhere")
