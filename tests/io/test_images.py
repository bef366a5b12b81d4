import io
import re

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ambiguous_wild.core import AwError
from ambiguous_wild.io.images import (
    image_size,
    load_image_float,
    read_gray,
    read_keep_map,
    read_mask,
    read_png_rgb,
    write_png,
)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_png_gives_back_every_pixel(tmp_path_factory, width, height, seed):
    path = tmp_path_factory.mktemp("png") / "фото é.png"
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    for compressed in (False, True):
        write_png(path, image, compressed)
        assert np.array_equal(read_png_rgb(path), image)
    assert image_size(path) == (width, height)
    assert np.array_equal(load_image_float(path), image.astype(np.float32) / np.float32(255))
    first = path.read_bytes()
    write_png(path, image)
    assert path.read_bytes() == first  # the same pixels, the same bytes


def test_colours_are_rgb_and_not_bgr(tmp_path):
    write_png(tmp_path / "red.png", np.full((2, 2, 3), (250, 10, 20), np.uint8))
    assert read_png_rgb(tmp_path / "red.png")[0, 0].tolist() == [250, 10, 20]
    assert load_image_float(tmp_path / "red.png")[0, 0, 0] == np.float32(250 / 255)


def test_sixteen_bits_keep_their_precision(tmp_path):
    image = np.array([[[1, 256, 65535]]], np.uint16)
    write_png(tmp_path / "deep.png", image)
    assert np.allclose(load_image_float(tmp_path / "deep.png"), image / 65535, atol=1e-7)


def test_grey_file_reads_as_rgb_and_as_mask(tmp_path):
    gray = np.array([[0, 127, 128, 255]], np.uint8)
    write_png(tmp_path / "m.png", gray)
    assert np.array_equal(read_png_rgb(tmp_path / "m.png"), np.repeat(gray[..., None], 3, 2))
    assert np.array_equal(read_gray(tmp_path / "m.png"), gray)
    assert read_keep_map(tmp_path / "m.png").tolist() == [[0.0, 0.0, 1.0, 1.0]]


def test_orientation_tag_is_ignored_for_scene_files(tmp_path):
    # A scene's files are upright already; the model was made for the pixels as stored.
    image = np.zeros((4, 6, 3), np.uint8)
    _, data = cv2.imencode(".jpg", image)
    exif = bytes.fromhex("ffe1002245786966000049492a00080000000100120103000100000006000000000000000000")[:36]
    (tmp_path / "o.jpg").write_bytes(data.tobytes()[:2] + exif + data.tobytes()[2:])
    assert read_png_rgb(tmp_path / "o.jpg").shape == (4, 6, 3)


CUT = cv2.imencode(".png", np.zeros((9, 9), np.uint8))[1].tobytes()[:45]


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG\r\n\x1a\n" + b"\0" * 40, CUT])
def test_unreadable_file_names_itself(tmp_path, capfd, content):
    (tmp_path / "bad.png").write_bytes(content)
    with pytest.raises(AwError, match=r"bad\.png"):
        read_png_rgb(tmp_path / "bad.png")
    assert capfd.readouterr().err == ""  # the error is one line


def test_missing_file_names_itself(tmp_path):
    with pytest.raises(AwError, match=r"none\.png: No such file"):
        load_image_float(tmp_path / "none.png")


@pytest.mark.parametrize(
    "bad", [np.zeros((2, 2, 3)), np.zeros((2, 2, 2), np.uint8), np.zeros((0, 2), np.uint8)]
)
def test_what_is_no_image_is_refused(tmp_path, bad):
    with pytest.raises(AwError, match="PNG"):
        write_png(tmp_path / "x.png", bad)
    assert not (tmp_path / "x.png").exists()


LEFT = np.arange(64)[None].repeat(48, 0) < 20  # what every mask below leaves out


def _mask(values, **options):
    return cv2.imencode(options.get("suffix", ".png"), values, options.get("flags", []))[1].tobytes()


def _rgba(colour, alpha):
    colour = np.broadcast_to(np.asarray(colour)[..., None], (48, 64, 3)).astype(np.uint8)
    return np.dstack([colour, np.where(LEFT, 0, alpha).astype(np.uint8)])


def _palette():
    picture = Image.fromarray(np.where(LEFT, 0, 1).astype(np.uint8), "P")
    picture.putpalette([0, 0, 0, 255, 255, 255])
    picture.save(data := io.BytesIO(), "PNG")
    return data.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        _mask(np.where(LEFT, 0, 255).astype(np.uint8)),
        _mask(np.where(LEFT, 0, 1).astype(np.uint8)),
        _mask(np.where(LEFT, 0, 1).astype(np.uint16)),
        _mask(np.where(LEFT, 0, 65535).astype(np.uint16)),
        _mask(np.where(LEFT, 0, 1).astype(np.float32), suffix=".tiff"),
        _mask(np.where(LEFT, 0, 1).astype(np.uint8)[..., None].repeat(3, 2)),
        _mask(np.where(LEFT, 0, 255).astype(np.uint8), suffix=".jpg", flags=[cv2.IMWRITE_JPEG_QUALITY, 60]),
        _mask(cv2.GaussianBlur(np.where(LEFT, 0, 255).astype(np.uint8), (3, 3), 0)),
        _mask(_rgba(np.where(LEFT, 0, 255), 255)),
        _mask(np.dstack([np.where(LEFT, 0, 255)] * 3 + [np.where(LEFT, 250, 255)]).astype(np.uint8)),
        _mask(_rgba(255, 255)),
        _mask(_rgba(np.random.default_rng(0).integers(0, 256, (48, 64)), 255)),
        _mask(np.where(LEFT[..., None], [0, 0, 0, 7], [255, 255, 255, 7]).astype(np.uint8)),
        _palette(),
    ],
)  # fmt: skip
def test_a_mask_is_read_by_its_values(data, tmp_path):
    (tmp_path / "m").write_bytes(data)
    assert np.array_equal(read_mask(tmp_path / "m"), np.where(LEFT, 0, 255))


@pytest.mark.parametrize(
    ("values", "seen"),
    [
        (np.where(LEFT, 0, 3), "2 values, 3 (69 %), 0 (31 %)"),
        (np.where(LEFT, 0, 7) + (np.arange(48) > 40)[:, None], "8 "),
        (np.where(LEFT, 0, 255) - 155 * (np.arange(48) > 44)[:, None] * ~LEFT, "100 ("),
        (np.random.default_rng(0).integers(0, 256, (48, 64)), "256 values"),
        (np.where(LEFT[..., None], 0, [0, 0, 255]), "[0, 0, 255] (69 %)"),
        (_rgba(np.where(LEFT, 255, 0), 255), "two different masks"),
    ],
    ids=["label", "labels", "label-and-white", "photo", "red", "colours-against-alpha"],
)
def test_what_is_no_mask_is_refused_with_its_values(values, seen, tmp_path):
    (tmp_path / "m.png").write_bytes(_mask(values.astype(np.uint8)))
    with pytest.raises(AwError, match=re.escape(seen)):
        read_mask(tmp_path / "m.png")
