"""HEIC, photos in two formats, bursts, live photos, several devices."""

import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder.collect import collect
from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.builder.screen import screen
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.io.photos import UnreadablePhoto, read_photo
from tests.builder.capture_maker import write_capture

SETTINGS = BuildSettings(factor=2, max_features=800)
HEIC = Path(__file__).parent / "quadrants.heic"  # 64x48, EXIF, rotated by the file: red top left when upright
EXIF_SECOND = "2026:11:23 10:00:00"


def with_exif(path, *, make="Phone", model="A", focal=5.0, taken=EXIF_SECOND):
    """Write EXIF into a JPEG."""
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    with Image.open(path) as image:
        exif = image.getexif()
        exif[271], exif[272] = make, model
        exif.get_ifd(34665).update({37386: IFDRational(round(1000 * focal), 1000), 36867: taken})
        pixels = image.copy()
    pixels.save(path, "JPEG", quality=97, exif=exif)


def test_a_heic_photo_is_read_upright_with_its_exif():
    pytest.importorskip("pi_heif", reason="pi-heif is not installed")
    photo, pixels = read_photo(HEIC)
    assert photo.format == "heic" and (photo.width, photo.height) == (48, 64)
    assert photo.exif.camera == "Apple iPhone 12 Pro" and photo.exif.focal_35mm == 26.0
    assert photo.exif.latitude_deg == pytest.approx(-33.5)
    assert photo.exif.orientation == 1
    corner = pixels[4:28, 4:20].reshape(-1, 3).mean(axis=0)
    assert corner[0] > 200 and corner[1:].max() < 60
    assert not photo.plain


def test_without_the_decoder_the_extra_is_named(monkeypatch):
    for name in ("pi_heif", "pillow_heif"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UnreadablePhoto, match=r"\[heic\]"):
        read_photo(HEIC)


@pytest.mark.parametrize("cut", [20, 200, -40])
def test_a_cut_heic_is_one_reason(cut, tmp_path):
    pytest.importorskip("pi_heif", reason="pi-heif is not installed")
    path = tmp_path / "a.heic"
    path.write_bytes(HEIC.read_bytes()[:cut])
    with pytest.raises(UnreadablePhoto, match="damaged or cut HEIC"):
        read_photo(path)


def test_a_dng_is_not_read_as_its_preview(tmp_path):
    import OpenImageIO as oiio

    if "raw" in str(oiio.get_string_attribute("format_list")).split(","):
        pytest.skip("this OpenImageIO has LibRaw")
    data = cv2.imencode(".tif", np.zeros((32, 32, 3), np.uint8))[1]
    (tmp_path / "a.dng").write_bytes(data.tobytes())
    with pytest.raises(UnreadablePhoto, match="no raw photos"):
        read_photo(tmp_path / "a.dng")


def test_one_photo_in_two_formats_counts_once_and_bursts_are_told(tmp_path):
    paths = write_capture(tmp_path / "raw", 6)
    for i, path in enumerate(paths):
        with_exif(path, taken=f"2026:11:23 10:00:{i:02d}")
    small = cv2.resize(cv2.imread(str(paths[2])), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(paths[2].with_suffix(".png")), small)
    other = cv2.imread(str(paths[5]))
    cv2.imwrite(str(paths[0].with_suffix(".webp")), other)  # the same name, another photo
    (tmp_path / "raw" / "p01.MOV").write_bytes(b"video")
    twin = tmp_path / "raw" / "p03b.jpg"
    twin.write_bytes(paths[3].read_bytes())
    with_exif(twin, taken="2026:11:23 10:00:03")
    info = screen(collect(tmp_path / "raw"), tmp_path, strict=False, jobs=2, bar=Bar(False))
    assert info["skipped"] == [
        {"source": "p02.png", "skipped": "the same photo in another format as p02.jpg"}
    ]
    assert any("1 videos of live photos are left out: p01.MOV" in w for w in info["warnings"])
    assert any(
        "1 bursts of near-identical photos" in w and "p03.jpg and 1 more" in w for w in info["warnings"]
    )
    kept = [ScreenedPhoto(**fields).name for fields in info["photos"]]
    assert len(kept) == 8 and sorted(p.name for p in (tmp_path / "photos").iterdir()) == sorted(kept)


def test_one_camera_a_device(tmp_path):
    """Two phones, three photos each: COLMAP refines two cameras, not six."""
    paths = write_capture(tmp_path / "raw", 6)
    for i, path in enumerate(paths):
        with_exif(path, model="A" if i % 2 else "B", taken=f"2026:11:23 10:00:{i:02d}")
    done = build_scene(tmp_path / "raw", tmp_path / "scene", SETTINGS, jobs=2, keep_work=True)
    assert done.info["chosen"]["camera"] == "per-device"
    assert done.info["counts"]["registered"] == 6 and done.info["counts"]["cameras"] == 2
    database = next((tmp_path / ".scene.build").glob("features-*/database.db"))
    with closing(sqlite3.connect(database)) as db:
        cameras = dict(db.execute("SELECT name, camera_id FROM images").fetchall())
    assert len({cameras[f"p{i:02d}.png"] for i in (0, 2, 4)}) == 1
    assert cameras["p00.png"] != cameras["p01.png"]


def test_heic_photos_build(tmp_path):
    encoder = pytest.importorskip("pillow_heif", reason="pillow-heif, which can write HEIC, is not installed")
    from PIL import Image

    encoder.register_heif_opener()
    for path in write_capture(tmp_path / "jpeg", 6):
        (tmp_path / "heic").mkdir(exist_ok=True)
        Image.open(path).save(tmp_path / "heic" / f"{path.stem}.heic", quality=95, chroma=444)
    info = build_scene(tmp_path / "heic", tmp_path / "scene", SETTINGS, jobs=2).info
    assert info["counts"]["registered"] == 6


def test_pixels_are_those_of_the_picture_at_any_width(tmp_path):
    encoder = pytest.importorskip("pillow_heif", reason="pillow-heif, which can write HEIC, is not installed")
    from PIL import Image

    encoder.register_heif_opener()
    rows, columns = np.mgrid[:45, :61]
    wanted = np.stack([4 * columns, 5 * rows, 255 - 4 * columns], axis=2).astype(np.uint8)
    for _ in range(3):
        Image.fromarray(wanted).save(tmp_path / "a.heic", quality=95, chroma=444)
        _, pixels = read_photo(tmp_path / "a.heic")
        assert pixels.shape == wanted.shape
        assert np.abs(pixels.astype(int) - wanted).max() <= 8


def test_ten_bits_are_reduced_and_said(tmp_path):
    encoder = pytest.importorskip("pillow_heif", reason="pillow-heif, which can write HEIC, is not installed")
    ramp = np.repeat(np.linspace(0, 65535, 64).astype(np.uint16)[None, :, None], 48, axis=0).repeat(3, axis=2)
    with open(tmp_path / "a.heic", "wb") as f:
        encoder.encode("RGB;16", (64, 48), ramp.tobytes(), f, quality=-1)
    photo, pixels = read_photo(tmp_path / "a.heic")
    assert any(note.endswith("bits reduced to 8") for note in photo.notes)
    assert abs(int(pixels[0, -1, 0]) - 255) <= 2 and abs(int(pixels[0, 32, 0]) - 129) <= 4
