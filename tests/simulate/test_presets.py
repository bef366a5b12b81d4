"""The courtyard's presets: each covers the share of a photo that it states, in the way that it states."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.simulate import capture_writer
from ambiguous_wild.simulate.capture_writer import look_at
from ambiguous_wild.simulate.distractors import DistractorPose, distractor_table
from ambiguous_wild.simulate.presets import PRESETS, resized
from ambiguous_wild.simulate.shapes import shape_table
from ambiguous_wild.simulate.spec import VIDEO_WALKS, CaptureSpec, Distractor
from ambiguous_wild.simulate.tracer import trace
from ambiguous_wild.simulate.world import World

# preset: what it says of itself, the mean share of a train photo's pixels that distractors cover
STATED = {
    "courtyard": (0.14, 0.22),
    "courtyard-plain": (0.16, 0.24),
    "sticks": (0.08, 0.14),
    "crowd": (0.45, 0.6),
}
THIN = ("pole", "barrier", "banner")
VIDEOS = [name for name, spec in PRESETS.items() if spec.walk in VIDEO_WALKS]


def small(name: str, views: int = 8, width: int = 128) -> CaptureSpec:
    return replace(resized(PRESETS[name], views=views, width=width), detail_px_per_m=5.0, samples=1)


def masks(spec: CaptureSpec, seed: int) -> np.ndarray:
    """Owner of every pixel of every train photo, [N, H, W]."""
    world, shots = capture_writer.plan_capture(spec, seed)
    static = world.table()
    seen = [
        trace(s.camera, static, distractor_table(spec, s.placements, world), world.atlas, world.light).owner
        for s in shots
        if s.split == "train"
    ]
    return np.stack(seen)


@pytest.mark.parametrize("name", STATED)
def test_distractors_cover_the_stated_share_of_a_photo(name: str) -> None:
    spec = small(name)
    shares = (masks(spec, 2) > 0).mean(axis=(1, 2))
    low, high = STATED[name]
    assert low <= shares.mean() <= high
    assert shares.min() > spec.occlusion[0] - 0.03 and shares.max() < spec.occlusion[1] + 0.03


def test_a_seed_repeats_and_another_does_not() -> None:
    spec = small("sticks", views=3, width=96)
    first, again, other = masks(spec, 2), masks(spec, 2), masks(spec, 3)
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@cache
def empty() -> tuple[CaptureSpec, World]:
    spec = small("still", views=3)
    return spec, capture_writer.plan_capture(spec, 0)[0]


@cache
def only(distractor: Distractor) -> tuple[np.ndarray, float]:
    """Mask of the distractor alone, 2.5 m before a camera that looks at it, and its px a metre."""
    spec, world = empty()
    spec = replace(spec, distractors=(distractor,))
    eye, f = np.array([0.0, -4.5, 1.2]), 400.0
    camera = Camera(560, 560, f, f, 280.0, 280.0, look_at(eye, np.array([0.0, -2.0, 1.2]), 0.0))
    here = distractor_table(spec, (DistractorPose(0, 0.0, -2.0, 0.0, 0.4),), world)
    nothing = shape_table((), world.atlas)
    return trace(camera, nothing, here, world.atlas, world.light).owner > 0, f / 2.5


def width_m(distractor: Distractor) -> float:
    """Mean width of the mask, m: a strip w wide has a mean distance to its edge of w / 4."""
    mask, px_per_m = only(distractor)
    assert mask.sum() > 200
    return float(4 * ndimage.distance_transform_edt(mask)[mask].mean() / px_per_m)


def test_what_is_called_thin_is_thin() -> None:
    thin = PRESETS["sticks"].distractors
    assert {d.kind for d in thin} == {*THIN, "ball"}
    for d in thin:
        limit = 0.1 if d.kind in ("pole", "barrier") else 0.25
        assert width_m(d) < limit, d.name
    for d in PRESETS["courtyard-plain"].distractors:
        assert width_m(d) > 0.25, d.name


def test_a_thin_one_reaches_far_across_the_photo() -> None:
    """Thin, not small: its mask is at least six times as long as it is wide."""
    for d in PRESETS["sticks"].distractors:
        if d.kind in THIN:
            mask, px_per_m = only(d)
            rows, columns = np.nonzero(mask)
            extent = np.hypot(np.ptp(rows), np.ptp(columns)) / px_per_m
            assert extent > 6 * width_m(d) and extent > 1.2, d.name


def test_plain_colours_are_nothing_elses() -> None:
    """In the picture, the visitor's and the ball's pixels lie far from every colour of the courtyard."""
    spec = small("courtyard-plain")
    world, shots = capture_writer.plan_capture(spec, 2)
    static = world.table()
    share = []
    for shot in shots[: spec.train_views]:
        seen = trace(
            shot.camera, static, distractor_table(spec, shot.placements, world), world.atlas, world.light
        )
        for which, channel in ((0, 0), (1, 2)):  # red, blue
            pure = seen.distracted[..., channel] > 2.5 * np.delete(seen.distracted, channel, -1).max(-1)
            there = seen.owner == which + 1
            if there.sum() > 30:
                share.append((pure[there].mean(), pure[seen.owner == 0].mean()))
    inside, outside = np.array(share).T
    assert len(share) > 6 and inside.mean() > 0.6 and outside.mean() < 0.05


@pytest.mark.parametrize("name", VIDEOS)
def test_consecutive_photos_of_a_video_are_close(name: str) -> None:
    """Steps of cameras and people are small and alike, and the next photo shows 75 % of a photo."""
    spec = small(name, views=PRESETS[name].train_views, width=64)
    for seed in range(2):
        world, shots = capture_writer.plan_capture(spec, seed)
        train = [s for s in shots if s.split == "train"]
        assert [s.name for s in train] == sorted(s.name for s in train)
        steps = np.linalg.norm(np.diff([s.camera.center for s in train], axis=0), axis=1)
        assert steps.min() > 0.15 and steps.max() < min(0.4, 1.2 * steps.min())
        for which in range(len(spec.distractors)):
            places = {
                k: np.array([p.x_m, p.y_m])
                for k, s in enumerate(train)
                for p in s.placements
                if p.which == which
            }
            walked = [np.linalg.norm(places[k + 1] - places[k]) for k in places if k + 1 in places]
            assert len(walked) > 20 and max(walked) < 0.55
        nothing = shape_table((), world.atlas)
        for a, b in zip(train[::5], train[1::5]):
            depth = trace(a.camera, world.table(), nothing, world.atlas, world.light).depth_m
            assert seen_by(b.camera, points_of(a.camera, depth)).mean() > 0.75


def points_of(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """World points [N, 3] of the pixels with a depth below 50 m."""
    rows, columns = np.nonzero(depth < 50)
    z = depth[rows, columns]
    local = np.stack([(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy], 1)
    local = np.column_stack([local * z[:, None], z])
    return (local - camera.cam_from_world[:3, 3]) @ camera.cam_from_world[:3, :3]


def seen_by(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Tell which points [N, 3] lie within the camera's picture."""
    local = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    uv = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return (local[:, 2] > 0) & (uv > 0).all(1) & (uv < [camera.width, camera.height]).all(1)


@pytest.mark.parametrize("name", VIDEOS)
def test_most_photos_of_a_video_show_its_people(name: str) -> None:
    owner = masks(small(name, views=PRESETS[name].train_views, width=96), 0)
    shares = (owner > 0).mean(axis=(1, 2))
    assert 0.04 < shares.mean() < 0.25 and shares.max() < 0.3 and (shares > 0.01).mean() > 0.65
    assert np.quantile(np.abs(np.diff(shares)), 0.9) < 0.13  # furniture hides the one who is followed
    still = (owner > 0).mean(0)  # share of the photos in which a pixel is covered
    assert still.max() < 0.8 or name == "followed"
    if name == "followed":  # the person keeps its place
        middles = np.array([np.nonzero(mask)[1].mean() if mask.any() else np.nan for mask in owner])
        assert np.nanmax(middles) - np.nanmin(middles) < 0.3 * 96
        assert np.nanmax(np.abs(np.diff(middles))) < 0.1 * 96


def test_photos_of_a_video_have_no_time(tmp_path: Path) -> None:
    spec = replace(small("passer-by", views=3, width=64), test_views=1)
    capture_writer.simulate(spec, tmp_path / "raw")
    tags = Image.open(tmp_path / "raw/train/IMG_0001.jpg").getexif()
    assert 0x0132 not in tags and 0x9003 not in tags.get_ifd(0x8769) and 0x920A in tags.get_ifd(0x8769)
