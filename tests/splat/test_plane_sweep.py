"""Dense points: the sweep against surfaces of known depth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.effects.dense import dense_points

H, W, F = 60, 80, 80.0
WALL, BOX = 5.0, 3.5  # depths of the back wall and of a box before it
SQUARE = (-0.8, 0.8, -0.6, 0.6)  # of the box, world x and y


def texture(seed: int) -> np.ndarray:
    """A picture [512, 512] in [0, 1] without repetition, 64 texels a world unit."""
    rng = np.random.default_rng(seed)
    fine, coarse = rng.uniform(size=(512, 512)), rng.uniform(size=(128, 128))
    both = 0.5 * cv2.GaussianBlur(fine, (0, 0), 3) + 0.5 * cv2.resize(coarse, (512, 512))
    return (both - both.min()) / (both.max() - both.min())


def camera(x: float, y: float = 0.0) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = [-x, -y, 0.0]
    return Camera(W, H, F, F, W / 2, H / 2, pose)


def on_texture(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    u, v = ((64 * c + 256).astype(np.float32) for c in (x, y))
    return cv2.remap(texture(seed).astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def photo(view: Camera) -> np.ndarray:
    """[H, W, 3] of a wall and a box before it."""
    x, y = np.meshgrid((np.arange(W) + 0.5 - W / 2) / F, (np.arange(H) + 0.5 - H / 2) / F)
    centre = view.center
    wall = on_texture(centre[0] + WALL * x, centre[1] + WALL * y, 1)
    bx, by = centre[0] + BOX * x, centre[1] + BOX * y
    inside = (bx > SQUARE[0]) & (bx < SQUARE[1]) & (by > SQUARE[2]) & (by < SQUARE[3])
    grey = np.where(inside, on_texture(bx, by, 2), wall)
    return np.repeat(grey[..., None], 3, axis=2).astype(np.float32)


def sparse() -> np.ndarray:
    rng = np.random.default_rng(3)
    xy = rng.uniform(-1.5, 1.5, (60, 2))
    box = (xy[:, 0] > SQUARE[0]) & (xy[:, 0] < SQUARE[1]) & (xy[:, 1] > SQUARE[2]) & (xy[:, 1] < SQUARE[3])
    return np.column_stack([xy, np.where(box, BOX, WALL)])


VIEWS = [camera(x, y) for x, y in ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0.5, 0.5), (-0.5, -0.5))]


def found(photos=None, keep=None, most=5000, points=None):
    points = sparse() if points is None else points
    photos = photos if photos is not None else [photo(v) for v in VIEWS]
    tracks = [np.arange(len(points))] * len(photos)
    keep = keep or [None] * len(photos)
    views = VIEWS[: len(photos)]
    return dense_points(views, photos.__getitem__, points, tracks, keep, most)


def off_surface(xyz: np.ndarray) -> np.ndarray:
    """Relative distance in depth from the nearer of the two surfaces, [M]."""
    return np.minimum(np.abs(xyz[:, 2] - WALL) / WALL, np.abs(xyz[:, 2] - BOX) / BOX)


def test_points_lie_on_both_surfaces():
    xyz, rgb = found()
    assert len(xyz) > 300 and rgb.dtype == np.uint8 and rgb.shape == (len(xyz), 3)
    assert np.mean(off_surface(xyz) < 0.02) > 0.97
    on_box = np.abs(xyz[:, 2] - BOX) < 0.1
    assert 30 < on_box.sum() < len(xyz) / 2
    assert np.abs(xyz[on_box, 0]).max() < 0.95 and np.abs(xyz[on_box, 1]).max() < 0.75
    # in the colour of their surface
    wanted = on_texture(xyz[on_box, 0], xyz[on_box, 1], 2).ravel()
    assert np.median(np.abs(rgb[on_box, 0] / 255.0 - wanted)) < 0.05


def test_exposure_changes_nothing():
    photos = [photo(v) for v in VIEWS]
    darker = [p * (0.6 + 0.08 * k) + 0.02 for k, p in enumerate(photos)]
    plain, changed = found(photos)[0], found(darker)[0]
    assert len(changed) > 0.9 * len(plain) and np.mean(off_surface(changed) < 0.02) > 0.97


def test_what_moves_has_no_points():
    photos = [photo(v) for v in VIEWS]
    moving = texture(7)[:24, :24, None].astype(np.float32)
    for k, p in enumerate(photos):
        p[20:44, 8 + 9 * k : 32 + 9 * k] = moving  # another place in every photo, at no fixed depth
    xyz, _ = found(photos)
    assert len(xyz) > 100 and np.mean(off_surface(xyz) < 0.02) > 0.97


def test_masked_pixels_give_no_points():
    keep = [np.ones((H, W), np.float32) for _ in VIEWS]
    for view, mask in zip(VIEWS, keep):
        x = np.broadcast_to((np.arange(W) + 0.5 - W / 2) / F, (H, W))
        mask[(view.center[0] + BOX * x > -1.0) & (view.center[0] + BOX * x < 1.0)] = 0.0
    xyz, _ = found(keep=keep)
    assert len(xyz) > 50 and np.abs(xyz[:, 2] - BOX).min() > 0.3


@pytest.mark.parametrize("most", [400, 50, 1])
def test_never_more_than_asked_for_and_spread_over_the_scene(most):
    xyz, rgb = found(most=most)
    assert 0 < len(xyz) <= most and len(rgb) == len(xyz)
    if most == 400:
        assert np.ptp(xyz[:, 0]) > 3.0 and np.ptp(xyz[:, 1]) > 2.0


def test_nothing_where_nothing_agrees():
    rng = np.random.default_rng(0)
    noise = [rng.uniform(size=(H, W, 3)).astype(np.float32) for _ in VIEWS]
    assert len(found(noise)[0]) < 5
    flat = [np.full((H, W, 3), 0.5, np.float32) for _ in VIEWS]
    assert len(found(flat)[0]) == 0


@pytest.mark.parametrize(("photos", "some"), [(1, False), (2, False), (3, True)])
def test_three_photos_must_agree(photos, some):
    xyz, _ = found([photo(v) for v in VIEWS[:photos]])
    assert (len(xyz) > 100) == some


def test_photos_from_one_place_are_one_witness():
    twice = [VIEWS[0], VIEWS[0], VIEWS[1], VIEWS[1]]
    photos = [photo(v) for v in twice]
    xyz, _ = dense_points(twice, photos.__getitem__, sparse(), [np.arange(60)] * 4, [None] * 4, 5000)
    lonely, _ = dense_points(
        [VIEWS[0]] * 3, (lambda view: photos[0]), sparse(), [np.arange(60)] * 3, [None] * 3, 5000
    )
    assert len(lonely) == 0 and np.mean(off_surface(xyz) < 0.02) > 0.95


def test_a_few_wrong_points_change_little():
    near = np.random.default_rng(0).normal(0, 0.02, (2, 3)) + np.array([0, 0, 0.1])
    points = np.concatenate([sparse(), near])
    plain, changed = found()[0], found(points=points)[0]
    assert len(changed) > 0.8 * len(plain) and np.mean(off_surface(changed) < 0.02) > 0.95


def test_no_points_asked_for_or_no_photos():
    assert len(found(most=0)[0]) == 0
    assert len(dense_points([], [].__getitem__, sparse(), [], [], 10)[0]) == 0


def test_a_model_without_tracks_and_photos_of_other_sizes():
    photos = [photo(v) for v in VIEWS]
    none = [np.zeros(0, np.int64)] * len(photos)
    xyz, _ = dense_points(VIEWS, photos.__getitem__, sparse(), none, [None] * len(photos), 5000)
    assert len(xyz) > 300 and np.mean(off_surface(xyz) < 0.02) > 0.97
    cameras = [v.resized(2 * W, 2 * H) if k % 2 else v for k, v in enumerate(VIEWS)]
    photos = [cv2.resize(p, (2 * W, 2 * H)) if k % 2 else p for k, p in enumerate(photos)]
    xyz, _ = dense_points(cameras, photos.__getitem__, sparse(), none, [None] * len(photos), 5000)
    assert len(xyz) > 300 and np.mean(off_surface(xyz) < 0.025) > 0.9


def test_the_same_points_again():
    for a, b in zip(found(), found()):
        np.testing.assert_array_equal(a, b)
