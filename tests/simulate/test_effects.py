"""Each effect against what it says of itself."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.simulate import image_effects as fx
from ambiguous_wild.simulate import spec as settings
from ambiguous_wild.simulate.image_effects import PhotoRandom
from ambiguous_wild.simulate.kernels import BOX
from ambiguous_wild.simulate.shapes import Shape
from ambiguous_wild.simulate.tracer import Light

GREY = np.full((40, 60, 3), 0.2, np.float32)
MOMENT = PhotoRandom(7, 3, 0.25)
CAMERA = Camera(64, 36, 60.0, 60.0, 32.0, 18.0, np.eye(4))


def test_a_stop_doubles_the_light() -> None:
    assert fx.exposure_drift(GREY, 1.0) == pytest.approx(0.4)
    drawn = [
        fx.draw_exposure_drift(settings.ExposureDrift(0.7), PhotoRandom(1, k, k / 29)) for k in range(30)
    ]
    assert max(np.abs(drawn)) <= 0.7 and np.ptp(drawn) > 0.7
    assert np.abs(np.diff(drawn)).max() < 0.5  # it wanders, it does not jump


def test_white_balance_keeps_the_luminance_of_white() -> None:
    for k in range(20):
        gains = fx.draw_white_balance(settings.WhiteBalance(), PhotoRandom(1, k, k / 19))
        white = fx.white_balance(np.ones((1, 1, 3), np.float32), gains)[0, 0]
        assert white @ [0.2126, 0.7152, 0.0722] == pytest.approx(1.0, abs=1e-6)
        assert abs(np.log2(gains[0] / gains[2])) <= 0.5 + 1e-9


def test_noise_has_the_stated_variance_and_no_bias() -> None:
    flat = np.full((300, 300, 3), 0.3, np.float32)
    noisy = fx.iso_noise(flat, fx.normal_noise(MOMENT, 300, 300), 1600.0)
    expected = 1.2e-4 * 16 * 0.3 + (5e-4 * 16) ** 2
    assert noisy.var() == pytest.approx(expected, rel=0.02) and noisy.mean() == pytest.approx(0.3, abs=3e-4)


def test_vignetting_takes_the_stated_share_in_the_corners_and_nothing_in_the_middle() -> None:
    flat = np.ones((541, 961, 3), np.float32)
    dark = fx.vignetting(flat, 0.4)
    assert dark[270, 480, 0] == pytest.approx(1.0, abs=1e-4) and dark[0, 0, 0] == pytest.approx(0.6, abs=2e-3)
    assert (np.diff(dark[270, 480:, 0]) <= 0).all()


@pytest.mark.parametrize(("k1", "k2"), [(-0.12, 0.0), (0.1, 0.02), (-0.2, 0.05)])
def test_lens_distortion_is_undone_by_the_formula_of_colmap(k1: float, k2: float) -> None:
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (500, 2))
    points = points[np.linalg.norm(points, axis=1) < 0.75]
    r2 = (points**2).sum(1, keepdims=True)
    distorted = points * (1 + k1 * r2 + k2 * r2**2)
    assert fx.lens_distortion(distorted, k1, k2) == pytest.approx(points, abs=1e-9)


def test_the_shutter_turns_with_the_hand() -> None:
    velocity = fx.camera_angular_velocity(MOMENT, 12.0)
    assert np.deg2rad(3.6) <= np.linalg.norm(velocity) <= np.deg2rad(12.0)
    rows = fx.camera_rotations(velocity, 0.025, 1080)
    assert rows.mean(0) == pytest.approx(0, abs=1e-12)
    assert rows[-1] - rows[0] == pytest.approx(velocity * 0.025 * 1079 / 1080)
    instants = fx.camera_rotations(velocity, 0.016, 8)
    assert instants.sum(0) == pytest.approx(0, abs=1e-12) and len(instants) == 8
    assert instants[-1] - instants[0] == pytest.approx(velocity * 0.016 * 7 / 8)


def test_a_turned_pixel_sees_what_the_turned_ray_sees() -> None:
    """Yaw by a: the middle pixel looks at x / z = tan(a)."""
    points = fx.subpixel_points(CAMERA, 1)
    turns = np.tile([0.0, 0.02, 0.0], (36, 1))
    seen = fx.rotated_points(points, turns)
    assert seen[..., 0] == pytest.approx(np.tan(np.arctan(points[..., 0]) + 0.02), abs=1e-12)


def test_resampling_without_a_move_is_the_mean_of_the_fine_pixels() -> None:
    image = np.random.default_rng(0).random((40 * 2, 68 * 2, 3), dtype=np.float32)
    source = fx.to_pixels(fx.subpixel_points(CAMERA, 2), CAMERA)
    large, border = fx.supersampled_camera(CAMERA, [source], 2)
    assert (large.width, large.height, border) == (66 * 2, 38 * 2, 1)
    same = fx.resample(image[: 38 * 2, : 66 * 2], [source], border, 2)
    inner = image[2 : 2 + 72, 2 : 2 + 128].reshape(36, 2, 64, 2, 3).mean((1, 3))
    assert same == pytest.approx(inner, abs=1e-6)


def test_defocus_spreads_a_point_over_a_disc_and_loses_no_light() -> None:
    kernel = fx.disc_kernel(3.0)
    point = np.zeros((31, 31), np.float32)
    point[15, 15] = 1
    spread = fx.defocus(point, kernel)
    rows, columns = np.nonzero(spread > 1e-7)
    assert np.hypot(rows - 15, columns - 15).max() <= 3 + 0.75
    assert spread.sum() == pytest.approx(1.0, abs=1e-5) and spread[15, 15] == pytest.approx(
        1 / (9 * np.pi), rel=0.1
    )
    shares = [fx.draw_defocus(settings.Defocus(share=0.4), PhotoRandom(0, k, 0)) > 0 for k in range(200)]
    assert 0.3 < np.mean(shares) < 0.5


def test_jpeg_hurts_more_the_lower_its_quality() -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    pixels = cv2.GaussianBlur(pixels, (0, 0), 1.5)
    errors = [np.abs(fx.jpeg(pixels, q).astype(float) - pixels).mean() for q in (20, 50, 90)]
    assert errors[0] > errors[1] > errors[2] > 0


def test_noon_is_the_neutral_light_and_the_evening_is_warmer() -> None:
    light = Light(np.array([[0.6, 0.0, 0.8]]), np.ones(3), np.ones(3), np.ones(3))
    noon, sky = fx.time_of_day(light, 0.0, 1.0, 30.0)
    assert np.array_equal(noon.sun, light.sun) and np.array_equal(noon.sun_colour, light.sun_colour)
    assert np.array_equal(sky, np.ones(3))
    evening, _ = fx.time_of_day(light, 1.0, 1.0, 30.0)
    morning, _ = fx.time_of_day(light, -1.0, 1.0, 30.0)
    warmth = [x.sun_colour[0] / x.sun_colour[2] for x in (morning, noon, evening)]
    assert warmth[0] < warmth[1] < warmth[2]
    turned = np.rad2deg(np.arctan2(evening.sun[0, 1], evening.sun[0, 0]))
    assert turned == pytest.approx(30.0) and evening.sun[0, 2] == pytest.approx(0.8)


def test_what_throws_the_shadow_stands_between_it_and_the_sun() -> None:
    sun = np.array([0.36, 0.48, 0.8])
    shapes = fx.moving_shadow(((1.0, 2.0, 0.5),), sun)
    center = np.array(shapes[0].center)
    assert center - sun * center[2] / sun[2] == pytest.approx([1.0, 2.0, 0.0])
    assert shapes[0].owner < 0 and center[2] > 4


def test_polish_is_for_the_named_textures_alone() -> None:
    shapes = [Shape(BOX, (0, 0, 0), (1, 1, 1), name) for name in ("stone", "brick")]
    gloss = [s.gloss for s in fx.specular(shapes, ("stone",), 0.5, 40.0)]
    assert gloss == [(0.5, 40.0), (0.0, 0.0)]


def test_streams_of_effects_are_independent_and_repeat() -> None:
    def numbers(moment: PhotoRandom) -> list[float]:
        return [float(moment.rng(name).random()) for name in ("jpeg", "iso_noise", "hand")]

    assert numbers(PhotoRandom(1, 2, 0.0)) == numbers(PhotoRandom(1, 2, 0.9))
    drawn = [
        *numbers(PhotoRandom(1, 2, 0.0)),
        *numbers(PhotoRandom(1, 3, 0.0)),
        *numbers(PhotoRandom(2, 2, 0.0)),
    ]
    assert len(set(drawn)) == 9
