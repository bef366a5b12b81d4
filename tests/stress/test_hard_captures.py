"""One capture that holds every defect: each file is used or refused by itself; and one of two photos."""

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder.collect import collect
from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.screen import screen
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.core import AwError
from ambiguous_wild.io.images import image_size, load_image_float, read_gray, read_png_rgb
from tests.builder.capture_maker import write_capture
from tests.io.photo_maker import announce, save

LONG = "x" * 240 + ".jpg"


def picture(seed, width=96, height=72, channels=3):
    small = np.random.default_rng(seed).integers(0, 256, (9, 12, channels), dtype=np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC).reshape(height, width, channels)


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    raw = tmp_path_factory.mktemp("hard") / "raw"
    raw.mkdir()
    save(raw / "plain.jpg", picture(0))
    save(raw / "no focal.jpg", picture(1), Make="M", Model="X")
    save(raw / "focal.jpg", picture(2), Make="M", Model="X", Exif__FocalLengthIn35mmFilm=28)
    save(raw / "turned.jpg", picture(3), Orientation=6)
    save(raw / "deep.png", picture(4).astype(np.uint16) * 257, "uint16")
    save(raw / "grey.png", picture(5, channels=1))
    cv2.imwrite(str(raw / "alpha.png"), np.dstack([picture(6), np.full((72, 96), 100, np.uint8)]))
    save(raw / "wrong.tif", picture(7)).rename(raw / "wrong.jpg")
    save(raw / "снимок é.png", picture(8))
    save(raw / LONG, picture(9))
    save(raw / "same.jpg", picture(10))
    save(raw / "same.png", picture(11))
    whole = save(raw / "cut.jpg", picture(12)).read_bytes()
    (raw / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (raw / "empty.jpg").write_bytes(b"")
    save(raw / "pixel.png", picture(13, 1, 1))
    announce(save(raw / "huge.png", picture(14)), 20000, 10000)
    try:
        from PIL import Image

        Image.fromarray(picture(15)).convert("CMYK").save(raw / "ink.jpg", quality=95)
    except ImportError:
        pass
    return raw


@pytest.fixture(scope="module")
def facts(raw, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stage")
    before = {p.name: p.read_bytes() for p in raw.iterdir()}
    found = screen(collect(raw), folder, strict=False, jobs=1, bar=Bar(False))
    assert {p.name: p.read_bytes() for p in raw.iterdir()} == before  # the user's files are as they were
    found["folder"] = folder / "photos"
    return found


def by_source(facts):
    return {p["source"]: p for p in facts["photos"]}


def test_what_cannot_be_used_is_left_out_with_its_reason(facts):
    reasons = {s["source"]: s["skipped"] for s in facts["skipped"]}
    assert reasons.keys() == {"cut.jpg", "empty.jpg", "pixel.png", "huge.png"}
    assert "cut JPEG" in reasons["cut.jpg"]
    assert "0 bytes" in reasons["empty.jpg"]
    assert "1x1 px is too small" in reasons["pixel.png"]
    assert "200 megapixels" in reasons["huge.png"] or "1144 MB" in reasons["huge.png"]


def test_what_was_converted_is_said(facts):
    notes = {name: " ".join(p["notes"]) for name, p in by_source(facts).items()}
    assert "16 bits" in notes["deep.png"]
    assert "grey" in notes["grey.png"]
    assert "transparency" in notes["alpha.png"]
    assert "tiff data under the name .jpg" in notes["wrong.jpg"]
    assert "orientation 6" in notes["turned.jpg"]
    assert notes["plain.jpg"] == notes["focal.jpg"] == ""


def test_the_pixels_structure_from_motion_sees_are_those_of_the_photo(facts):
    seen = {name: read_png_rgb(facts["folder"] / p["name"]) for name, p in by_source(facts).items()}
    assert np.array_equal(seen["deep.png"], picture(4))
    assert np.array_equal(seen["grey.png"], np.repeat(picture(5, channels=1), 3, axis=2))
    assert np.array_equal(seen["wrong.jpg"], picture(7))
    assert np.array_equal(seen["снимок é.png"], picture(8))
    assert np.abs(seen["turned.jpg"].astype(int) - np.rot90(picture(3), -1)).mean() < 8
    if "ink.jpg" in seen:
        assert np.abs(seen["ink.jpg"].astype(int) - picture(15)).mean() < 8


def test_focal_length_is_what_the_file_says_or_absent(facts):
    photos = by_source(facts)
    assert photos["focal.jpg"]["exif"]["focal_35mm"] == 28
    assert not {"focal_mm", "focal_35mm"} & photos["no focal.jpg"]["exif"].keys()


def test_every_photo_has_a_name_of_its_own_that_any_file_system_holds(facts):
    stems = [p["name"].removesuffix(".png") for p in facts["photos"]]
    assert len({s.casefold() for s in stems}) == len(stems) == len(facts["photos"])
    assert max(len(s.encode()) for s in stems) <= 120
    photos = by_source(facts)
    assert photos["same.jpg"]["name"] != photos["same.png"]["name"]
    assert photos["снимок é.png"]["name"] == "снимок_é.png"


def test_strict_refuses_the_capture_and_names_the_photos(raw, tmp_path):
    with pytest.raises(AwError, match=r"cut\.jpg"):
        screen(collect(raw), tmp_path, strict=True, jobs=1, bar=Bar(False))


@pytest.mark.parametrize("read", [read_png_rgb, read_gray, load_image_float])
def test_a_scene_photo_of_200_megapixels_is_refused_before_memory_is_taken(raw, read):
    with pytest.raises(AwError, match="20000x10000 px"):
        read(raw / "huge.png")


@pytest.mark.parametrize("name", ["cut.jpg", "empty.jpg"])
@pytest.mark.parametrize("read", [read_png_rgb, load_image_float, image_size])
def test_a_damaged_scene_photo_is_refused_not_filled_with_grey(raw, name, read):
    with pytest.raises(AwError, match=name):
        read(raw / name)


def test_two_photos_are_refused_with_how_many_are_needed_or_make_a_scene(tmp_path):
    write_capture(tmp_path / "raw", 2)
    try:
        build_scene(tmp_path / "raw", tmp_path / "scene", BuildSettings(max_features=500))
    except AwError as error:
        assert "2 photos" in str(error) or "of 2" in str(error)
        assert [p.name for p in tmp_path.iterdir()] == ["raw"]  # nothing half-made beside it
    else:
        assert (tmp_path / "scene/scene.json").is_file()
