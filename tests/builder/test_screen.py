import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from ambiguous_wild.builder.checks import focal_length
from ambiguous_wild.builder.collect import collect
from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.builder.screen import (
    drift_warnings,
    exposure_stops,
    photo_warnings,
    screen,
    sharpness,
    thumbnail,
)
from ambiguous_wild.core import AwError
from ambiguous_wild.io.images import read_png_rgb
from tests.builder.capture_maker import texture, write_capture


def run(tmp_path, **kwargs):
    folder = tmp_path / "stage"
    folder.mkdir()
    options = {"strict": False, "jobs": 2, **kwargs}
    return screen(collect(tmp_path / "raw"), folder, bar=Bar(False), **options), folder / "photos"


def test_plain_photos_are_linked_and_others_converted(tmp_path):
    paths = write_capture(tmp_path / "raw", 3)
    gray = cv2.imread(str(paths[1]), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(paths[1]), gray)
    facts, photos = run(tmp_path)
    assert [p["name"] for p in facts["photos"]] == ["p00.png", "p01.png", "p02.png"]
    assert (photos / "p00.png").is_symlink() and not (photos / "p01.png").is_symlink()
    assert (
        np.abs(read_png_rgb(photos / "p01.png")[..., 0].astype(int) - cv2.imread(str(paths[1]), 0)).max() <= 1
    )
    assert any("grey" in w for w in facts["warnings"])


def test_turned_photo_is_upright_and_keeps_its_focal_length(tmp_path):
    from ambiguous_wild.io.safe_pycolmap import pycolmap

    write_capture(tmp_path / "raw", 3)
    spec = oiio.ImageSpec(512, 400, 3, "uint8")
    for name, value in (("Orientation", 6), ("Make", "M"), ("Model", "X")):
        spec.attribute(name, value)
    spec.attribute("Exif:FocalLengthIn35mmFilm", 28)
    spec.attribute("Exif:FocalLength", 4.0)
    target = str(tmp_path / "raw" / "z.jpg")
    out = oiio.ImageOutput.create(target)
    out.open(target, spec)
    out.write_image(np.ascontiguousarray(texture(5)[:400]))
    out.close()
    facts, photos = run(tmp_path)
    fact = facts["photos"][-1]
    assert (fact["width"], fact["height"]) == (400, 512)
    seen = pycolmap.Bitmap.read(str(photos / fact["name"]), True)
    assert (seen.width, seen.height) == (400, 512)
    # COLMAP takes 35 mm equivalents on the diagonal, as we do.
    assert seen.exif_focal_length() == pytest.approx(28 / np.hypot(36, 24) * np.hypot(400, 512), rel=0.02)


def test_bad_photos_are_counted_and_named(tmp_path):
    paths = write_capture(tmp_path / "raw", 4)
    (tmp_path / "raw" / "a.jpg").write_text("no picture")
    paths[0].write_bytes(paths[0].read_bytes()[:3000])
    facts, _ = run(tmp_path)
    assert [s["source"] for s in facts["skipped"]] == ["a.jpg", "p00.jpg"]
    assert "2 of 5 photos skipped: a.jpg (no image" in facts["warnings"][0]
    assert len(facts["photos"]) == 3


def test_strict_refuses_and_too_few_refuses(tmp_path):
    write_capture(tmp_path / "raw", 3)
    (tmp_path / "raw" / "a.jpg").write_bytes(b"")
    with pytest.raises(AwError, match=r"1 of 4 photos cannot be read: a\.jpg \(empty file \(0 bytes\)\)"):
        run(tmp_path, strict=True)
    (tmp_path / "raw" / "p00.jpg").write_bytes(b"")
    (tmp_path / "stage").rename(tmp_path / "old")
    with pytest.raises(AwError, match="only 2 of 4 photos"):
        run(tmp_path)


def test_identical_and_near_duplicates_are_told_apart(tmp_path):
    paths = write_capture(tmp_path / "raw", 4)
    paths[1].write_bytes(paths[0].read_bytes())
    lighter = cv2.convertScaleAbs(cv2.imread(str(paths[2])), alpha=0.97)
    cv2.imwrite(str(paths[3]), lighter)
    facts, photos = run(tmp_path)
    warnings = facts["warnings"]
    assert "1 of 4 photos skipped: p01.jpg (the same file as p00.jpg)" in warnings
    assert facts["photos"][0]["copies"] == ["p01.jpg"]
    assert sorted(p.name for p in photos.iterdir()) == ["p00.png", "p02.png", "p03.png"]
    near = next(w for w in warnings if "near-duplicate" in w)
    assert "p02.jpg = p03.jpg" in near
    assert "p00.jpg = p01.jpg" not in near


def test_copies_in_train_are_left_out_and_those_in_test_refused(tmp_path):
    paths = write_capture(tmp_path / "raw" / "train", 4)
    (tmp_path / "raw" / "test").mkdir()
    (tmp_path / "raw" / "train" / "z.jpg").write_bytes(paths[1].read_bytes())
    facts = run(tmp_path)[0]
    assert "1 of 5 photos skipped: train/z.jpg (the same file as train/p01.jpg)" in facts["warnings"]
    (tmp_path / "raw" / "test" / "t.jpg").write_bytes(paths[0].read_bytes())
    with pytest.raises(AwError, match=r"test photos are training photos \(test/t.jpg is train/p00.jpg\)"):
        build_scene(tmp_path / "raw", tmp_path / "scene")


def test_sharpness_falls_with_blur_and_not_with_resolution():
    image = cv2.resize(texture(1), (2048, 2048), interpolation=cv2.INTER_CUBIC)
    soft = cv2.GaussianBlur(image, (0, 0), 8)
    assert sharpness(soft) < 0.2 * sharpness(image)
    half = cv2.resize(image, (1024, 1024), interpolation=cv2.INTER_AREA)
    assert sharpness(image) == pytest.approx(sharpness(half), rel=0.05)


def test_thumbnail_ignores_brightness_and_contrast():
    image = texture(1)
    other = (image * 0.5 + 40).astype(np.uint8)
    assert thumbnail(image) @ thumbnail(other) > 0.999
    assert thumbnail(image) @ thumbnail(texture(2)) < 0.5
    assert np.isfinite(thumbnail(np.full((40, 40, 3), 7, np.uint8))).all()


def photo(i, sharpness=100.0, width=10, **exif):
    words = {"width": width, "height": 8, "camera": "C", "exif": exif}
    return ScreenedPhoto(f"{i}.jpg", f"{i}.png", sharpness=sharpness, **words)


def test_drift_is_reported_with_its_number():
    quiet = [photo(i, exposure_s=0.01, f_number=4.0, iso=100.0, focal_mm=5.0) for i in range(4)]
    assert drift_warnings(quiet) == []
    loud = [*quiet, photo(9, 5.0, exposure_s=0.04, f_number=4.0, iso=100.0, focal_mm=9.0, white_balance=1),
            photo(10, white_balance=0)]  # fmt: skip
    text = " | ".join(drift_warnings(loud))
    for part in ("1 photos are blurred", "9.jpg", "white balance", "5.0 to 9.0 mm"):
        assert part in text
    assert "exposure" not in text  # 2 stops by EXIF; 'aw screen' and 'aw plan' ask whether surfaces differ


def test_photos_of_the_shape_of_panoramas_are_named():
    wide = [photo(0, width=16), photo(1, width=16), photo(2)]
    for found in (drift_warnings(wide)[-1], focal_length(wide).finding):
        assert "2 photos are 2:1, as 360 degree photos are (0.jpg, 1.jpg): 'aw capture" in found


def test_exposure_is_in_stops():
    base = {"exposure_s": 0.01, "f_number": 4.0, "iso": 100.0}
    assert exposure_stops({**base, "iso": 200.0}) - exposure_stops(base) == pytest.approx(1.0)
    assert exposure_stops({**base, "f_number": 8.0}) - exposure_stops(base) == pytest.approx(-2.0)
    assert exposure_stops({"iso": 100.0}) is None


def test_what_most_photos_share_is_said_once(tmp_path):
    write_capture(tmp_path / "raw", 5)
    for index, path in enumerate(sorted((tmp_path / "raw").iterdir())):
        pixels = read_png_rgb(path)
        pixels[-20:] = 0
        cv2.imwrite(str(path), pixels[..., ::-1] if index else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))
    facts, _ = run(tmp_path)
    told = "\n".join(photo_warnings([ScreenedPhoto(**photo) for photo in facts["photos"]]))
    assert "px of one colour at the bottom" in told and "at the top" not in told
    assert "1 of 5 photos are grey" in told


def test_a_note_of_many_photos_is_one_line():
    photos = [ScreenedPhoto(f"{k}.jpg", f"{k}.png", notes=["turned"]) for k in range(5)]
    (line,) = photo_warnings(photos)
    assert line.startswith("5 photos: turned: 0.jpg, 1.jpg, 2.jpg")
