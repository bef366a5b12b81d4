"""Votes of optical flow on a textured wall before which a square stands, moves or keeps its place."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder.residual_flow import UNFIT_PX, flow_votes
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera, ModelImage, points_without_tracks

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
WALL_M, SQUARE_M, SIDE_M, STEP_M = 6.0, 4.0, 1.0, 0.12
FRAMES = 8
Square = Callable[[int], tuple[float, float]]  # frame -> centre, m


def texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return sum(
        weight * cv2.resize(rng.random((n, n), np.float32), (1024, 1024), interpolation=cv2.INTER_CUBIC)
        for n, weight in ((16, 0.3), (64, 0.4), (200, 0.4))
    )


def seen(pattern: np.ndarray, depth: float, k: int, centre: tuple[float, float]) -> np.ndarray:
    """A plane with this pattern as photo k shows it."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    x, y = u / FOCAL * depth + k * STEP_M - centre[0], v / FOCAL * depth - centre[1]
    at = (90 * x + 400).astype(np.float32), (90 * y + 400).astype(np.float32)
    return cv2.remap(pattern, *at, cv2.INTER_LINEAR)


def frames(square: Square) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Photos of a camera that moves sideways, and where the square is."""
    wall, cloth = texture(1), texture(2)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    photos, masks = {}, {}
    for k in range(FRAMES):
        x, y = square(k)
        inside = np.abs(u / FOCAL * SQUARE_M + k * STEP_M - x) < SIDE_M / 2
        inside &= np.abs(v / FOCAL * SQUARE_M - y) < SIDE_M / 2
        name = f"f{k}.png"
        photo = np.where(inside, seen(cloth, SQUARE_M, k, (x, y)), seen(wall, WALL_M, k, (0.0, 0.0)))
        photos[name], masks[name] = np.clip(photo * 220, 0, 255).astype(np.uint8), inside
    return photos, masks


def model(poses: list[float] | None = None) -> ColmapModel:
    """Cameras at these places along x, and points of the wall, which every photo sees."""
    x, y = np.meshgrid(np.linspace(-4, 5, 40), np.linspace(-3, 3, 30))
    points = points_without_tracks(
        np.column_stack([x.ravel(), y.ravel(), np.full(x.size, WALL_M)]), np.zeros((x.size, 3))
    )
    camera = ModelCamera(1, "PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    images = {
        k + 1: ModelImage(
            k + 1,
            np.array([1.0, 0, 0, 0]),
            np.array([-at, 0, 0]),
            1,
            f"f{k}.png",
            np.zeros((x.size, 2)),
            points.ids,
        )
        for k, at in enumerate(poses or [k * STEP_M for k in range(FRAMES)])
    }
    return ColmapModel({1: camera}, images, points)


def votes(
    square: Square, poses: list[float] | None = None, threads: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Share of the square and of the rest, for which most votes say that they [stay, move]."""
    photos, masks = frames(square)
    on, off = [], []
    for name, found in flow_votes(model(poses), photos.__getitem__, sorted(photos), threads):
        counts = found.votes
        assert found.residual_px < 0.5
        assert counts.dtype == np.uint8 and counts.shape[0] == 2 and counts.sum(0).max() <= 4
        inside = (
            cv2.resize(masks[name].astype(np.uint8), counts.shape[:0:-1], interpolation=cv2.INTER_AREA) > 0
        )
        said = np.stack([counts[0] > counts[1], counts[1] > counts[0]])
        core = cv2.erode(inside.astype(np.uint8), np.ones((5, 5))) > 0
        around = cv2.dilate(inside.astype(np.uint8), np.ones((13, 13))) > 0
        on.append(said[:, core].mean(axis=1))
        off.append(said[:, ~around].mean(axis=1))
    assert len(on) == FRAMES
    return np.mean(on, axis=0), np.mean(off, axis=0)


@pytest.mark.parametrize(
    "square",
    [
        pytest.param(lambda k: (0.3, -0.5 + 0.06 * k), id="across the epipolar lines"),
        pytest.param(lambda k: (0.3 + 0.1 * (k % 2), 0.0), id="along them, to and fro"),
    ],
)
def test_what_moves_is_told_from_the_wall(square: Square) -> None:
    on, off = votes(square)
    assert on[1] > 0.9 and on[0] < 0.05
    assert off[0] > 0.85 and off[1] < 0.01


def test_a_static_square_before_the_wall_does_not_move() -> None:
    on, off = votes(lambda k: (0.3, 0.0))
    assert on[1] < 0.02 and off[0] > 0.85 and off[1] < 0.01


@pytest.mark.parametrize("step", [-0.06, STEP_M], ids=["nearer", "far, in the same place of every photo"])
def test_motion_that_looks_like_another_depth_is_unknown(step: float) -> None:
    on, _ = votes(lambda k: (0.4 + step * k, 0.0))
    assert on.max() < 0.1


def test_poses_that_do_not_fit_have_no_votes() -> None:
    with_turns = [STEP_M * k if k % 2 else -STEP_M * k for k in range(FRAMES)]
    photos, _ = frames(lambda k: (0.3, -0.5 + 0.06 * k))
    tilted = model(with_turns)
    for image in tilted.images.values():
        image.qvec[:] = [1.0, 0.05 * (image.image_id % 2), 0.0, 0.0]
    counts = dict(flow_votes(tilted, photos.__getitem__, sorted(photos), 1))
    assert sum(int(c.votes.sum()) for c in counts.values()) == 0
    assert min(c.residual_px for c in counts.values()) > UNFIT_PX


def test_photos_that_do_not_follow_each_other_have_no_votes() -> None:
    photos, _ = frames(lambda k: (0.3, 0.0))
    other = [np.roll(photo, 90 * k, axis=k % 2) for k, photo in enumerate(photos.values())]
    apart = dict(zip(photos, other))
    assert not dict(flow_votes(model(), apart.__getitem__, sorted(apart), 1))
    few = sorted(photos)[:5]
    assert not dict(flow_votes(model(), photos.__getitem__, few, 1))


def test_threads_do_not_change_votes() -> None:
    photos, _ = frames(lambda k: (0.3, -0.5 + 0.06 * k))
    one, three = (dict(flow_votes(model(), photos.__getitem__, sorted(photos), n)) for n in (1, 3))
    assert list(one) == list(three) == sorted(photos)
    for name in one:
        np.testing.assert_array_equal(one[name].votes, three[name].votes)


def test_a_camera_that_turns_quickly_still_knows_the_static_scene() -> None:
    """The scene moves by 42 px from photo to photo; what leaves the next photo must find no match in it."""
    photos, tilted = {}, model([0.0] * FRAMES)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    for k, image in enumerate(tilted.images.values()):
        angle = np.deg2rad(8.0) * (k - FRAMES / 2)
        image.qvec[:] = [np.cos(angle / 2), 0.0, -np.sin(angle / 2), 0.0]
        x, y = 300 * (np.arctan2(u, FOCAL) + angle) + 512, 300 * v / np.hypot(u, FOCAL) + 512  # a cylinder
        pixels = cv2.remap(texture(1), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        photos[image.name] = np.clip(pixels * 220, 0, 255).astype(np.uint8)
    counts = {k: f.votes for k, f in flow_votes(tilted, photos.__getitem__, sorted(photos), 1)}
    assert len(counts) == FRAMES
    assert max(np.mean(c[1] > c[0]) for c in counts.values()) < 0.01
    assert np.mean([c[0] > 0 for c in counts.values()]) > 0.6
