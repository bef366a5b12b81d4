"""The courtyard's presets: each covers the share of a photo that it states, in the way that it states."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.simulate import capture_writer
from ambiguous_wild.simulate.capture_writer import look_at
from ambiguous_wild.simulate.distractors import DistractorPose, movers
from ambiguous_wild.simulate.presets import PRESETS, resized
from ambiguous_wild.simulate.shapes import shape_table
from ambiguous_wild.simulate.spec import CaptureSpec, Distractor
from ambiguous_wild.simulate.tracer import trace
from ambiguous_wild.simulate.world import World

# preset: what it says of itself, the mean share of a train photo's pixels that distractors cover
STATED = {
    "courtyard": (0.14, 0.22),
    "courtyard-plain": (0.16, 0.24),
    "courtyard-thin": (0.04, 0.09),
    "courtyard-sparse": (0.035, 0.065),
    "courtyard-crowd": (0.41, 0.49),
}
THIN = ("pole", "barrier", "banner")


def small(name: str, views: int = 8, width: int = 128) -> CaptureSpec:
    return replace(resized(PRESETS[name], views=views, width=width), detail_px_per_m=5.0, samples=1)


def masks(spec: CaptureSpec, seed: int) -> np.ndarray:
    """Owner of every pixel of every train photo, [N, H, W]."""
    world, shots = capture_writer.plan(spec, seed)
    static = world.table()
    seen = [
        trace(s.camera, static, movers(spec, s.placements, world), world.atlas, world.light).owner
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
    spec = small("courtyard-thin", views=3, width=96)
    first, again, other = masks(spec, 2), masks(spec, 2), masks(spec, 3)
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@cache
def empty() -> tuple[CaptureSpec, World]:
    spec = small("courtyard-clean", views=3)
    return spec, capture_writer.plan(spec, 0)[0]


@cache
def only(distractor: Distractor) -> tuple[np.ndarray, float]:
    """Mask of the distractor alone, 2.5 m before a camera that looks at it, and its px a metre."""
    spec, world = empty()
    spec = replace(spec, distractors=(distractor,))
    eye, f = np.array([0.0, -4.5, 1.2]), 400.0
    camera = Camera(560, 560, f, f, 280.0, 280.0, look_at(eye, np.array([0.0, -2.0, 1.2]), 0.0))
    here = movers(spec, (DistractorPose(0, 0.0, -2.0, 0.0, 0.4),), world)
    nothing = shape_table((), world.atlas)
    return trace(camera, nothing, here, world.atlas, world.light).owner > 0, f / 2.5


def width_m(distractor: Distractor) -> float:
    """Mean width of the mask, m: a strip w wide has a mean distance to its edge of w / 4."""
    mask, px_per_m = only(distractor)
    assert mask.sum() > 200
    return float(4 * ndimage.distance_transform_edt(mask)[mask].mean() / px_per_m)


def test_what_is_called_thin_is_thin() -> None:
    thin = PRESETS["courtyard-thin"].distractors
    assert {d.kind for d in thin} == {*THIN, "ball"}
    for d in thin:
        limit = 0.1 if d.kind in ("pole", "barrier") else 0.25
        assert width_m(d) < limit, d.name
    for d in PRESETS["courtyard-plain"].distractors:
        assert width_m(d) > 0.25, d.name


def test_a_thin_one_reaches_far_across_the_photo() -> None:
    """Thin, not small: its mask is at least six times as long as it is wide."""
    for d in PRESETS["courtyard-thin"].distractors:
        if d.kind in THIN:
            mask, px_per_m = only(d)
            rows, columns = np.nonzero(mask)
            extent = np.hypot(np.ptp(rows), np.ptp(columns)) / px_per_m
            assert extent > 6 * width_m(d) and extent > 1.2, d.name


def test_plain_colours_are_nothing_elses() -> None:
    """In the picture, the visitor's and the ball's pixels lie far from every colour of the courtyard."""
    spec = small("courtyard-plain")
    world, shots = capture_writer.plan(spec, 2)
    static = world.table()
    share = []
    for shot in shots[: spec.train_views]:
        seen = trace(shot.camera, static, movers(spec, shot.placements, world), world.atlas, world.light)
        for which, channel in ((0, 0), (1, 2)):  # red, blue
            pure = seen.distracted[..., channel] > 2.5 * np.delete(seen.distracted, channel, -1).max(-1)
            there = seen.owner == which + 1
            if there.sum() > 30:
                share.append((pure[there].mean(), pure[seen.owner == 0].mean()))
    inside, outside = np.array(share).T
    assert len(share) > 6 and inside.mean() > 0.6 and outside.mean() < 0.05
