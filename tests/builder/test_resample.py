"""Undistorting and downsampling: against COLMAP, the textbook filter, and the pixels that went in."""

import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.builder.resample import (
    _TO_LINEAR,
    _TO_SRGB,
    auto_factor,
    downsample_mask,
    downsample_photo,
    downsampled_size,
    resample,
)
from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.imported_photos import resized
from ambiguous_wild.io.colmap_model import read_model, write_model
from ambiguous_wild.io.colmap_records import ModelCamera
from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.lens import make_lens
from ambiguous_wild.io.safe_pycolmap import pycolmap
from tests.builder.capture_maker import render
from tests.io.model_maker import make_model

CAMERA = ModelCamera(1, "SIMPLE_RADIAL", 320, 240, (300.0, 160.0, 120.0, -0.12))


def photo():
    return render(np.array([0.3, 0.0, 0.5]), np.array([0.0, 0.0, 5.0]))


def test_agrees_with_colmap_pixel_by_pixel():
    """pycolmap.undistort_image is the oracle; it is bilinear, so a smooth photo is compared."""
    smooth = cv2.GaussianBlur(photo(), (0, 0), 3)
    theirs_in = pycolmap.Camera(model="SIMPLE_RADIAL", width=320, height=240, params=list(CAMERA.params))
    theirs, flat = pycolmap.undistort_image(
        pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(smooth), theirs_in
    )
    lens = make_lens(CAMERA)
    assert (lens.pinhole.width, lens.pinhole.height) == (flat.width, flat.height)
    assert lens.pinhole.params == pytest.approx(flat.params)
    ours = lens.remap(smooth, nearest=False)
    difference = np.abs(ours.astype(int) - theirs.to_array())[2:-2, 2:-2]
    assert difference.max() <= 3
    assert np.abs(ours[2:238, 2:318].astype(int) - smooth[2:238, 2:318]).mean() > 5  # it did bend


def test_points_and_pixels_go_the_same_way():
    """A dot lands where its observation lands."""
    lens = make_lens(CAMERA)
    for x, y in ((40, 30), (280, 200), (160, 120), (300, 20)):
        image = np.zeros((240, 320), np.uint8)
        image[y - 1 : y + 2, x - 1 : x + 2] = 255
        flat = lens.remap(image, nearest=False).astype(float)
        rows, columns = np.indices(flat.shape)
        seen = np.array([(flat * (columns + 0.5)).sum(), (flat * (rows + 0.5)).sum()]) / flat.sum()
        assert np.allclose(seen, lens.undistort_points(np.array([[x + 0.5, y + 0.5]]))[0], atol=0.05)


@pytest.mark.parametrize(
    ("model", "more"),
    [
        ("SIMPLE_DIVISION", (0.1,)),
        ("DIVISION", (0.1,)),
        ("SIMPLE_FISHEYE", ()),
        ("FISHEYE", ()),
        ("EUCM", (0.5, 1.0)),
        ("RAD_TAN_THIN_PRISM_FISHEYE", (0.0,) * 12),
    ],
)
def test_lenses_of_colmap_4_are_read_and_bent_back(model, more, tmp_path):
    """Oracle: pycolmap projects a ray through both cameras; the map joins the two pixels."""
    focal = (150.0,) if model.startswith("SIMPLE") else (150.0, 150.0)
    camera = ModelCamera(1, model, 320, 240, (*focal, 160.0, 120.0, *more))
    known = make_model(["a.jpg"], 3)
    write_model(tmp_path, dataclasses.replace(known, cameras={1: camera, **known.cameras}))
    assert read_model(tmp_path).cameras[1] == camera
    lens = make_lens(camera)
    ray = np.array([[0.3, -0.2, 1.0]])
    fx, fy, cx, cy = lens.pinhole.pinhole()
    column, row = int(fx * 0.3 + cx), int(fy * -0.2 + cy)
    ray = np.array([[(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1.0]])
    seen = np.asarray(lens.camera.img_from_cam(ray))[0]
    assert [m[row, column] + 0.5 for m in lens.map_xy] == pytest.approx(seen, abs=1e-3)
    small = resized(camera, 160, 120)
    assert small.params[: len(focal) + 2] == pytest.approx([v / 2 for v in camera.params[: len(focal) + 2]])


def test_what_undistortion_leaves_is_measured_and_nonsense_refused():
    """A fisheye of 171 degrees: the pinhole camera keeps the middle."""
    wide = make_lens(ModelCamera(1, "FISHEYE", 320, 320, (107.0, 107.0, 160.0, 160.0)))
    seen = np.stack(wide.map_xy).reshape(2, -1)
    whole = (np.ptp(seen[0]) + 1) * (np.ptp(seen[1]) + 1) / 320**2  # of its bounding box: an upper limit
    assert 0.1 < wide.share <= whole < 1
    assert make_lens(CAMERA).share > 0.8
    for k in (1e6, -1e6, -10.0):
        with pytest.raises(
            AwError, match=r"camera 1 .SIMPLE_RADIAL, .* % of its photo: check the parameters"
        ):
            make_lens(ModelCamera(1, "SIMPLE_RADIAL", 320, 240, (300.0, 160.0, 120.0, k)))


def test_without_distortion_nothing_moves():
    lens = make_lens(dataclasses.replace(CAMERA, params=(300.0, 160.0, 120.0, 1e-6)))
    assert lens.pinhole.params == (300.0, 300.0, 160.0, 120.0)
    assert np.array_equal(lens.remap(photo(), nearest=False), photo())
    xys = np.array([[3.0, 4.0], [200.0, 100.0]])
    assert np.allclose(lens.undistort_points(xys), xys, atol=1e-3)


def stage(tmp_path, truth=None, masks=None, factor=1):
    names = ["a.png", "b.png"]
    model = make_model(names, camera="SIMPLE_RADIAL")
    photos = [ScreenedPhoto(f"train/{n[0]}.jpg", n, width=64, height=48) for n in names]
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    for name in names:
        write_png(tmp_path / "photos" / name, pixels)
    done = resample(
        tmp_path / "out", model, photos, tmp_path / "photos", masks, truth, factor, jobs=2, bar=Bar(False)
    )
    return model, done


def test_the_model_becomes_pinhole_of_the_images_written(tmp_path):
    model, _ = stage(tmp_path)
    flat = read_model(tmp_path / "out" / "sparse" / "0")
    assert [c.model for c in flat.cameras.values()] == ["PINHOLE"]
    camera = flat.cameras[7]
    for image in flat.images.values():
        assert read_png_rgb(tmp_path / "out" / "images" / image.name).shape[:2] == (
            camera.height,
            camera.width,
        )
        assert np.array_equal(image.point_ids, model.images[image.image_id].point_ids)
        # Both models see the same rays.
        fx, fy, cx, cy = camera.pinhole()
        lens = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=64, height=48, params=list(model.cameras[7].params)
        )
        rays = np.asarray(lens.cam_from_img(model.images[image.image_id].xys))
        assert np.allclose((image.xys - [cx, cy]) / [fx, fy], rays)


def test_masks_stay_black_and_white_and_truth_follows(tmp_path):
    rng = np.random.default_rng(1)
    for name in ("a", "b"):
        write_png(tmp_path / "masks" / f"{name}.png.png", rng.integers(0, 2, (48, 64), dtype=np.uint8) * 255)
    write_png(tmp_path / "truth" / "distractor" / "a.png", np.full((48, 64), 255, np.uint8))
    write_png(tmp_path / "truth" / "clean" / "b.png", np.full((48, 64, 3), 77, np.uint8))
    for part in ("shadow", "instances"):
        shown = rng.integers(0, 2, (48, 64), dtype=np.uint8) * (255 if part == "shadow" else 7)
        for name in ("a", "b"):
            write_png(tmp_path / "truth" / part / f"{name}.png", shown)
    _, found = stage(tmp_path, tmp_path / "truth", tmp_path / "masks")
    counts = {"distractor": 1, "shadow": 2, "instances": 2, "objects": 0, "clean": 1}
    assert found == {"factor": 1, "truth": counts}
    assert set(np.unique(read_gray(tmp_path / "out" / "truth" / "shadow" / "b.png"))) == {0, 255}
    assert set(np.unique(read_gray(tmp_path / "out" / "truth" / "instances" / "a.png"))) == {0, 7}
    assert set(np.unique(read_gray(tmp_path / "out" / "masks" / "a.png"))) == {0, 255}
    assert read_gray(tmp_path / "out" / "truth" / "distractor" / "a.png").min() == 255
    assert set(np.unique(read_png_rgb(tmp_path / "out" / "truth" / "clean" / "b.png"))) == {77}


def test_smaller_copies_are_those_of_the_undistorted_photos(tmp_path):
    for name in ("a", "b"):
        write_png(tmp_path / "masks" / f"{name}.png.png", np.full((48, 64), 255, np.uint8))
    write_png(tmp_path / "truth" / "clean" / "a.png", np.full((48, 64, 3), 77, np.uint8))
    stage(tmp_path, tmp_path / "truth", tmp_path / "masks", factor=2)
    large = read_png_rgb(tmp_path / "out" / "images" / "a.png")
    width, height = downsampled_size(large.shape[1], large.shape[0], 2)
    small = read_png_rgb(tmp_path / "out" / "images_2" / "a.png")
    assert np.array_equal(small, downsample_photo(large, width, height))
    assert read_gray(tmp_path / "out" / "masks" / "a.png").shape == (height, width)
    assert read_png_rgb(tmp_path / "out" / "truth" / "clean" / "a.png").shape == (height, width, 3)


def test_truth_of_another_size_is_refused(tmp_path):
    write_png(tmp_path / "truth" / "clean" / "a.png", np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(AwError, match="belongs to another capture"):
        stage(tmp_path, tmp_path / "truth")


def test_tables_invert_each_other():
    values = np.arange(256)
    assert np.array_equal(_TO_SRGB[np.round(_TO_LINEAR * 65535).astype(int)], values)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 255), st.integers(9, 40), st.integers(9, 40))
def test_a_flat_photo_stays_flat(value, width, height):
    flat = np.full((height, width, 3), value, np.uint8)
    small = downsample_photo(flat, max(1, width // 3), max(1, height // 3))
    assert np.abs(small.astype(int) - value).max() <= 1


def test_masks_go_by_area():
    mask = np.zeros((40, 40), np.uint8)
    mask[:, :18] = 255  # columns 0-3 white, column 4 half white
    assert np.array_equal(downsample_mask(mask, 10, 10)[0], [255] * 5 + [0] * 5)
    assert set(np.unique(downsample_mask(mask, 7, 9))) == {0, 255}


def catmull_rom(source: int, target: int) -> np.ndarray:
    """[target, source] weights of the textbook cubic (a = -1/2), stretched by the scale; rows sum to 1."""
    scale = source / target
    x = np.abs((np.arange(source) + 0.5 - (np.arange(target)[:, None] + 0.5) * scale) / scale)
    near, far = 1.5 * x**3 - 2.5 * x**2 + 1, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    weights = np.where(x < 1, near, np.where(x < 2, far, 0.0))
    return weights / weights.sum(axis=1, keepdims=True)


@pytest.mark.parametrize(("width", "height"), [(53, 41), (160, 120), (40, 30)])
def test_it_is_the_antialiased_cubic_in_linear_light(width, height):
    """Oracle: the textbook filter as matrices, with its edges and without aliasing; borders are left out."""
    rng = np.random.default_rng(0)
    photo = cv2.GaussianBlur(rng.integers(0, 256, (240, 320, 3), dtype=np.uint8), (0, 0), 1.0)
    light = _TO_LINEAR[photo].astype(np.float64)
    expected = 255 * np.einsum(
        "hr,rcx,wc->hwx", catmull_rom(240, height), light, catmull_rom(320, width), optimize=True
    )
    found = 255 * _TO_LINEAR[downsample_photo(photo, width, height)]
    assert np.abs(found - expected)[4:-4, 4:-4].max() < 1.5  # of 255, the rounding to 8-bit sRGB


def test_sizes_and_factors():
    assert downsampled_size(4032, 3024, 8) == (504, 378)
    assert downsampled_size(3, 3, 8) == (1, 1)
    assert [auto_factor([(w, 9)]) for w in (300, 480, 959, 960, 1920, 4032, 12000)] == [1, 1, 1, 2, 4, 8, 8]
