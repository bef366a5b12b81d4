import struct

import cv2
import numpy as np
import pytest

from ambiguous_wild.io.photos import MAX_PIXELS, UnreadablePhoto, read_photo
from tests.io.photo_maker import announce, save


def picture(width=80, height=60, seed=0):
    small = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)


def test_plain_jpeg_equals_opencv(tmp_path):
    path = save(tmp_path / "a.jpg", picture())
    photo, pixels = read_photo(path)
    assert photo.plain
    assert photo.notes == ()
    assert (photo.width, photo.height, photo.format) == (80, 60, "jpeg")
    reference = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    assert np.abs(pixels.astype(int) - reference).max() <= 1


@pytest.mark.parametrize("orientation", range(2, 9))
def test_exif_orientation_is_applied_as_opencv_does(tmp_path, orientation):
    path = save(tmp_path / "a.jpg", picture(), Orientation=orientation)
    photo, pixels = read_photo(path)
    reference = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)  # OpenCV turns by the tag
    assert pixels.shape == reference.shape == (photo.height, photo.width, 3)
    assert np.abs(pixels.astype(int) - reference).max() <= 1
    assert not photo.plain and photo.orientation == orientation
    assert "upright" in photo.notes[0]


def half_transparent():
    pixels = np.dstack([np.full((20, 30, 3), 200, np.uint8), np.zeros((20, 30), np.uint8)])
    pixels[:, 15:, 3] = 255
    return pixels


@pytest.mark.parametrize(
    ("stored", "fmt", "shown", "note"),
    [
        (picture().astype(np.uint16) * 257, "uint16", picture(), "16 bits reduced to 8"),
        (picture()[..., :1], "uint8", picture()[..., :1].repeat(3, axis=2), "grey"),
        (np.dstack([picture(), np.full((60, 80), 255, np.uint8)]), "uint8", picture(), "opaque"),
        (
            half_transparent(),
            "uint8",
            half_transparent()[..., 3:].repeat(3, axis=2) // 255 * 200,
            "transparency",
        ),
    ],
    ids=["16 bits", "grey", "opaque", "transparent"],
)
def test_other_pixels_are_converted_and_said(tmp_path, stored, fmt, shown, note):
    if note == "transparency":  # OpenImageIO would write colours that are multiplied already
        cv2.imwrite(str(tmp_path / "a.png"), stored)
    else:
        save(tmp_path / "a.png", stored, fmt)
    photo, pixels = read_photo(tmp_path / "a.png")
    assert np.array_equal(pixels, shown)
    assert len(photo.notes) == 1 and note in photo.notes[0]


def test_cmyk_jpeg_becomes_rgb(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow writes the CMYK file")
    image.fromarray(picture()).convert("CMYK").save(tmp_path / "a.jpg", quality=95)
    photo, rgb = read_photo(tmp_path / "a.jpg")
    assert np.abs(rgb.astype(int) - picture()).mean() < 3
    assert "CMYK" in photo.notes[0]


def test_another_format_under_jpg_is_read_and_said(tmp_path):
    save(tmp_path / "a.tif", picture())
    (tmp_path / "a.tif").rename(tmp_path / "a.jpg")
    photo, rgb = read_photo(tmp_path / "a.jpg")
    assert np.array_equal(rgb, picture())
    assert photo.notes == ("tiff data under the name .jpg",)


def test_non_ascii_and_long_names(tmp_path):
    for name in ("снимок é 1.png", "x" * 240 + ".png"):
        assert np.array_equal(read_photo(save(tmp_path / name, picture()))[1], picture())


def test_exif_is_read(tmp_path):
    path = save(
        tmp_path / "a.jpg", picture(), Make="Maker", Model="M1", ExposureTime=0.01, FNumber=4.0,
        Exif__FocalLength=5.0, Exif__FocalLengthIn35mmFilm=28, Exif__PhotographicSensitivity=200,
    )  # fmt: skip
    exif = read_photo(path)[0].exif
    assert exif.camera == "Maker M1"
    assert (exif.focal_mm, exif.focal_35mm, exif.iso) == (5.0, 28.0, 200.0)
    assert exif.exposure_s == pytest.approx(0.01, rel=1e-3)
    assert exif.orientation == 1


def test_without_exif_nothing_is_invented(tmp_path):
    exif = read_photo(save(tmp_path / "a.png", picture()))[0].exif
    assert exif.camera is None
    assert exif.focal_mm is None


def cut(data, share):
    return data[: int(len(data) * share)]


@pytest.mark.parametrize("share", [0.3, 0.7, 0.95])
def test_cut_jpeg_is_refused_not_filled_with_grey(tmp_path, share):
    whole = save(tmp_path / "a.jpg", picture(400, 300)).read_bytes()
    (tmp_path / "a.jpg").write_bytes(cut(whole, share))
    with pytest.raises(UnreadablePhoto, match="cut JPEG"):
        read_photo(tmp_path / "a.jpg")


def test_cut_jpeg_with_a_whole_thumbnail_is_still_cut(tmp_path):
    thumbnail = save(tmp_path / "t.jpg", picture(32, 24)).read_bytes()
    whole = save(tmp_path / "a.jpg", picture(400, 300)).read_bytes()
    segment = b"\xff\xed" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    (tmp_path / "a.jpg").write_bytes(whole[:2] + segment + whole[2:-400])
    with pytest.raises(UnreadablePhoto, match="cut JPEG"):
        read_photo(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").write_bytes(whole[:2] + segment + whole[2:])
    assert read_photo(tmp_path / "a.jpg")[1].shape == (300, 400, 3)


def test_cut_and_damaged_png(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    whole = save(tmp_path / "a.png", noise).read_bytes()
    (tmp_path / "a.png").write_bytes(cut(whole, 0.5))
    with pytest.raises(UnreadablePhoto, match="cut PNG"):
        read_photo(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(cut(whole, 0.5) + whole[-12:])
    with pytest.raises(UnreadablePhoto, match="damaged or cut png"):
        read_photo(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"", "0 bytes"), (b"just some text, no picture", "no image"), (b"\xff\xd8\xff\xe0", "cut JPEG")],
)
def test_what_is_no_photo_says_what_it_is(tmp_path, content, reason):
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(UnreadablePhoto, match=reason) as caught:
        read_photo(tmp_path / "a.jpg")
    assert "a.jpg" not in caught.value.reason


@pytest.mark.parametrize(
    ("name", "pixels", "fmt", "reason"),
    [
        ("a.png", picture(1, 1), "uint8", "1x1 px is too small"),
        ("a.tif", picture().astype(np.float32), "float", "float"),
    ],
)
def test_pixels_that_are_no_photo_are_refused(tmp_path, name, pixels, fmt, reason):
    with pytest.raises(UnreadablePhoto, match=reason):
        read_photo(save(tmp_path / name, pixels, fmt))


def test_a_huge_header_costs_nothing(tmp_path):
    """200 megapixels announced by a small file: refused before memory is taken."""
    data = bytearray(save(tmp_path / "a.jpg", picture()).read_bytes())
    at = data.find(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", 10000, 20000)
    (tmp_path / "a.jpg").write_bytes(data)
    assert MAX_PIXELS < 20000 * 10000
    with pytest.raises(UnreadablePhoto, match="200 megapixels"):
        read_photo(tmp_path / "a.jpg")
    announce(save(tmp_path / "a.png", picture()), 20000, 10000)
    with pytest.raises(UnreadablePhoto, match=r"200 megapixels|1144 MB"):
        read_photo(tmp_path / "a.png")
