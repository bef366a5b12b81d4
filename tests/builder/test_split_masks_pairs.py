from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from ambiguous_wild.builder.keep_masks import find_masks, mask_warnings, write_colmap_masks
from ambiguous_wild.builder.matched import MatchedPhotos
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.builder.retrieval import sequential_pairs
from ambiguous_wild.builder.settings import BuildSettings, plans
from ambiguous_wild.builder.sfm import DATABASE, StructureFromMotion, camera_groups, choose_camera
from ambiguous_wild.builder.stages import read_test_list, split_photos
from ambiguous_wild.core import AwError
from ambiguous_wild.io.images import read_gray, write_png
from tests.builder.capture_maker import write_capture


def photos_of(count=10, sides=None):
    return [
        ScreenedPhoto(
            f"images/p{i}.jpg", f"p{i}.png", sides[i] if sides else None, width=12, height=8, camera="C",
            exif={"focal_mm": 5.0},
        )
        for i in range(count)
    ]  # fmt: skip


ALL = {f"p{i}.png" for i in range(10)}


def test_every_eighth_warns_that_it_measures_distractors_too():
    split = split_photos(photos_of(), ALL, None)
    assert (split.how, split.test, len(split.train)) == ("every-8", ["p0.png", "p8.png"], 8)
    assert "distractors" in split.warnings[0]


def test_folders_split_and_a_lost_test_photo_is_said():
    sides = ["test"] * 3 + ["train"] * 7
    split = split_photos(photos_of(sides=sides), ALL - {"p1.png", "p9.png"}, None)
    assert (split.how, split.test) == ("folders", ["p0.png", "p2.png"])
    assert split.train == [f"p{i}.png" for i in range(3, 9)]
    assert split.warnings == ["1 of 3 test photos are lost: scores cover 2"]


def test_all_photos_are_trained_on_request():
    split = split_photos(photos_of(sides=["test"] * 3 + ["train"] * 7), ALL, set())
    assert (split.how, split.test, len(split.train), split.warnings) == ("none", [], 10, [])


def test_all_test_photos_lost_is_an_error():
    sides = ["test"] * 3 + ["train"] * 7
    with pytest.raises(AwError, match="none of the 3 test photos"):
        split_photos(photos_of(sides=sides), ALL - {"p0.png", "p1.png", "p2.png"}, None)
    with pytest.raises(AwError, match="only 0 training"):
        split_photos(photos_of(sides=["test"] * 10), ALL, None)


def test_list_names_photos_in_any_of_its_ways(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("images/p1.jpg\np2.jpg\np3\np4.png\n\n")
    tests = read_test_list(path, photos_of())
    assert tests == {f"p{i}.png" for i in range(1, 5)}
    assert split_photos(photos_of(), ALL, tests).test == ["p1.png", "p2.png", "p3.png", "p4.png"]


def test_a_test_list_names_the_folder_where_two_photos_have_one_name(tmp_path):
    names = {"back/0.jpg": "back_0.png", "front/0.jpg": "front_0.png", "front/1.jpg": "front_1.png"}
    photos = [ScreenedPhoto(source, name) for source, name in names.items()]
    listed = tmp_path / "list.txt"
    for name, expected in (
        ("front/0.jpg", "front_0.png"),
        ("back/0", "back_0.png"),
        ("1.jpg", "front_1.png"),
    ):
        listed.write_text(name)
        assert read_test_list(listed, photos) == {expected}
    listed.write_text("0.jpg")
    with pytest.raises(AwError, match=r"'0\.jpg' is the name of several photos \(back_0, front_0\)"):
        read_test_list(listed, photos)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("p99.jpg", r"'p99.jpg' \(did you mean 'images/p9.jpg'"),
        ("", "is empty"),
        ("x\np77.jpg", r"names 2 photos not in the capture: 'x', 'p77.jpg' \(did you mean 'images/p7.jpg'"),
        ("\n".join(f"p{i}" for i in range(10)), "no training photo would be left"),
    ],
)
def test_list_that_cannot_be(tmp_path, text, message):
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(AwError, match=message):
        read_test_list(tmp_path / "t.txt", photos_of())
    with pytest.raises(AwError, match="cannot read the test list"):
        read_test_list(tmp_path / "none.txt", photos_of())


def test_masks_are_found_under_both_names(tmp_path):
    white = np.full((8, 12), 200, np.uint8)
    write_png(tmp_path / "m" / "p0.png", white)
    write_png(tmp_path / "m" / "p1.jpg.png", white)
    write_png(tmp_path / "m" / "images" / "p2.png", np.zeros((8, 12), np.uint8))
    found = find_masks(tmp_path / "m", photos_of(3), "error")
    assert sorted(found) == ["p0", "p1", "p2"]
    (tmp_path / "out").mkdir()
    shares = write_colmap_masks(tmp_path / "out", found, photos_of(3), tmp_path)["kept_share"]
    assert shares == {"p0": 1.0, "p1": 1.0, "p2": 0.0}
    assert read_gray(tmp_path / "out" / "masks" / "p0.png.png").min() == 255  # 200 counts as white


def test_a_mask_is_turned_by_its_own_exif_as_viewers_show_it(tmp_path):
    keep = np.full((8, 12), 255, np.uint8)
    keep[:, :4] = 0
    exif = Image.Exif()
    exif[0x0112] = 3
    (tmp_path / "m").mkdir()
    Image.fromarray(keep).rotate(180).save(tmp_path / "m" / "p0.png", exif=exif)
    write_colmap_masks(tmp_path, find_masks(tmp_path / "m", photos_of(1), "error"), photos_of(1), tmp_path)
    assert np.array_equal(read_gray(tmp_path / "masks" / "p0.png.png"), keep)


def test_missing_masks_are_named_or_the_photo_is_kept_whole(tmp_path):
    write_png(tmp_path / "m" / "p0.png", np.zeros((8, 12), np.uint8))
    with pytest.raises(AwError, match=r"2 of 3 photos have no mask: images/p1\.jpg, images/p2\.jpg"):
        find_masks(tmp_path / "m", photos_of(3), "error")
    (tmp_path / "m" / "p0.png").rename(tmp_path / "m" / "other.png")
    with pytest.raises(AwError, match=r"a mask of a\.jpg is called") as error:
        find_masks(tmp_path / "m", photos_of(3), "keep")
    assert "--masks-missing" not in str(error.value)
    (tmp_path / "m" / "other.png").rename(tmp_path / "m" / "p0.png")
    found = find_masks(tmp_path / "m", photos_of(3), "keep")
    (tmp_path / "out").mkdir()
    write_colmap_masks(tmp_path / "out", found, photos_of(3), tmp_path)
    assert read_gray(tmp_path / "out" / "masks" / "p2.png.png").min() == 255


def test_masks_of_the_wrong_size_are_named(tmp_path):
    for i in range(3):
        write_png(tmp_path / "m" / f"p{i}.png", np.zeros((8, 12 if i else 13), np.uint8))
    with pytest.raises(AwError, match=r"1 of 3 masks .* p0\.png is 13x8 but its photo 12x8"):
        find_masks(tmp_path / "m", photos_of(3), "error")
    with pytest.raises(AwError, match="does not exist"):
        find_masks(tmp_path / "none", photos_of(3), "error")


def test_a_test_photo_meets_every_training_photo():
    names = [f"w{i}" for i in range(60)] + ["t0", "t1"]
    pairs = sequential_pairs(names, {"t0", "t1"})
    assert len(pairs) == len({frozenset(p) for p in pairs})
    joined = {frozenset(p) for p in pairs}
    # photos of the test set are no part of the walk: their partners come from retrieval
    assert not any("t0" in pair or "t1" in pair for pair in joined)
    assert frozenset(("w0", "w10")) in joined
    assert frozenset(("w0", "w32")) in joined
    assert frozenset(("w0", "w11")) not in joined
    assert len(pairs) < 60 * 59 / 2


@pytest.mark.parametrize("start", ["a b ", "#"])
def test_names_that_a_list_of_pairs_cannot_hold_are_matched_too(start, tmp_path):
    photos = [
        ScreenedPhoto(source=path.name, name=path.name) for path in write_capture(tmp_path / "raw", 3, start)
    ]
    settings = BuildSettings(matcher="sequential")
    job = StructureFromMotion(
        photos, tmp_path / "raw", settings, plans(photos, settings)[0], 1, Bar(enabled=False)
    )
    for stage in ("features", "matches"):
        (tmp_path / stage).mkdir()
    job.extract_features(tmp_path / "features", "single")
    assert job.match(tmp_path / "matches", tmp_path / "features", posed=True)["pairs"] == 3
    matched = MatchedPhotos.read(tmp_path / "matches" / DATABASE)
    assert matched.names == [photo.name for photo in photos] and len(matched.matches) == 3


def test_one_camera_only_where_everything_agrees():
    assert choose_camera(photos_of(3), "auto") == "single"
    assert choose_camera(photos_of(3), "per-image") == "per-image"
    for change in ({"width": 13}, {"camera": "D"}, {"exif": {"focal_mm": 6.0}}):
        mixed = photos_of(3)
        mixed[1] = replace(mixed[1], **change)
        assert choose_camera(mixed, "auto") == "per-device"
        assert camera_groups(mixed) == [[0, 2], [1]]
        assert choose_camera(mixed, "single") == "single"


def test_photos_without_exif_never_share_a_camera_with_others():
    internet = [replace(p, width=100 + i % 2, camera=None, exif={}) for i, p in enumerate(photos_of(4))]
    assert choose_camera(internet, "auto") == "per-image"
    assert camera_groups(internet) == [[0], [1], [2], [3]]
    for k in (1, 3):
        internet[k] = replace(internet[k], camera="C", exif={"focal_mm": 5.0})
    assert choose_camera(internet, "auto") == "per-device"
    assert camera_groups(internet) == [[0], [1, 3], [2]]


def test_folders_have_cameras_of_their_own_unless_exif_says_that_they_are_one():
    rig = [
        replace(p, source=f"{'front' if i % 2 else 'back'}/{i // 2}.jpg") for i, p in enumerate(photos_of(6))
    ]
    assert choose_camera(rig, "auto") == "single"
    assert camera_groups(rig, "per-folder") == [[0, 2, 4], [1, 3, 5]]
    rig = [replace(photo, camera=None, exif={}) for photo in rig]
    assert choose_camera(rig, "auto") == "per-device"
    assert camera_groups(rig) == [[0, 2, 4], [1, 3, 5]]


def test_fast_comes_before_thorough_and_each_may_be_asked_for():
    wanted = ("auto", "fast", "thorough")
    names = {w: [p.name for p in plans(photos_of(40), BuildSettings(sfm=w))] for w in wanted}
    careful = ["thorough", "covariant"]
    assert names == {"auto": ["fast", "wider", *careful], "fast": ["fast"], "thorough": careful}
    few = plans(photos_of(25), BuildSettings())  # all pairs are matched at once: there are no more
    assert [p.name for p in few] == ["fast", *careful]
    assert [plan.below for plan in few] == [1.0, 1.0, 0.9]
    tolerances = [plans(photos_of(k), BuildSettings())[0].ba_global_tolerance for k in (100, 101)]
    assert tolerances[0] == 0 < tolerances[1]


@pytest.mark.parametrize(
    ("count", "wanted", "expected"),
    [
        (25, "auto", ["exhaustive", "exhaustive"]),
        (26, "auto", ["retrieval", "exhaustive"]),
        (200, "auto", ["retrieval", "exhaustive"]),
        (201, "auto", ["retrieval", "retrieval"]),
        (500, "exhaustive", ["exhaustive", "exhaustive"]),
    ],
)
def test_matcher_by_count(count, wanted, expected):
    found = [
        p.matcher
        for p in plans(photos_of(count), BuildSettings(matcher=wanted))
        if p.name in ("fast", "thorough")
    ]
    assert found == expected


def test_a_copy_in_a_test_list_stands_for_the_photo_that_is_used(tmp_path):
    (tmp_path / "t.txt").write_text("copy.jpg\n")
    photos = photos_of()
    photos[3] = replace(photos[3], copies=["copy.jpg"])
    assert read_test_list(tmp_path / "t.txt", photos) == {"p3.png"}


def test_masks_that_keep_little_are_suspected_to_be_inverted():
    assert mask_warnings(None) == []
    assert mask_warnings({"kept_share": {}}) == []
    assert mask_warnings({"kept_share": {"a": 0.9, "b": 0.1, "c": 0.31}}) == []
    (warning,) = mask_warnings({"kept_share": {"a": 0.9, "b": 0.1, "c": 0.2}})
    assert "20 % of a photo" in warning and "inverted" in warning
