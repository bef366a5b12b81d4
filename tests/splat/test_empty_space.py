"""Gaussians between a camera and everything it sees are removed, if that is asked for."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.config import from_plain, to_plain
from ambiguous_wild.core.scene import Points
from ambiguous_wild.splat.density import DensityConfig, DensityControl, EmptySpace
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.optim import SplatAdam


def data(seen_by=("a",)):
    """Photos a and b at the origin and at x = 100; 40 points 10 in front of a, seen by those named."""
    cameras = []
    for x in (0.0, 100.0):
        pose = np.eye(4)
        pose[0, 3] = -x
        cameras.append(Camera(100, 80, 100.0, 100.0, 50.0, 40.0, pose))
    views = [SimpleNamespace(name=name, split="train") for name in "ab"]
    rows = ["ab".index(name) for name in seen_by]
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-3, 3, (40, 2)), np.full(40, 10.0)])
    count = 40 * len(rows)
    points = Points(
        xyz, np.zeros((40, 3), np.uint8), np.zeros(40), np.arange(41) * len(rows),
        np.tile(np.array(rows, np.int32), 40), np.zeros((count, 2), np.float32),
    )  # fmt: skip
    return SimpleNamespace(scene=SimpleNamespace(points=points, views=views, train=views), cameras=cameras)


@pytest.mark.parametrize(
    ("place", "held"),
    [
        ((0.0, 0.0, 4.9), True),
        ((0.0, 0.0, 5.1), False),  # half of 10 is 5
        ((2.4, 0.0, 4.9), True),
        ((2.6, 0.0, 4.9), False),  # beside the picture
        ((0.0, 1.9, 4.9), True),
        ((0.0, 2.1, 4.9), False),
        ((0.0, 0.0, -1.0), False),  # behind the camera
        ((100.0, 0.0, 1.0), False),  # before b, which sees no points
    ],
)
def test_what_lies_nearer_than_half_the_points(place, held):
    assert EmptySpace(data(), 0.5).holds(torch.tensor([place])).tolist() == [held]


def test_every_camera_that_sees_points_says_so():
    inside = torch.tensor([[100.0, 0.0, 1.0]])
    assert EmptySpace(data(seen_by=("a", "b")), 0.5).holds(inside).all()


@pytest.mark.parametrize("near", [0.0, 0.5])
def test_pruning_removes_them_only_if_asked(near):
    gaussians = Gaussians.from_points(
        np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 9.0], [1.0, 0.0, 10.0], [0.0, 1.0, 10.0]]),
        np.full((4, 3), 128, np.uint8),
    )
    control = DensityControl(DensityConfig(near=near), 10.0, seed=0)
    control.setup(data())
    control.log.begin(1)
    control._match(gaussians)
    left = control._prune(gaussians, SplatAdam(gaussians, {name: 0.0 for name, _ in gaussians.items()}))
    assert len(left) == (3 if near else 4) and bool((left.means[:, 2] < 5).any()) == (not near)


def test_a_share_lies_between_nothing_and_everything():
    for wrong in (-0.1, 1.1):
        with pytest.raises(AwError, match="near"):
            DensityConfig(near=wrong)


def test_runs_from_before_this_option_keep_their_identity():
    assert "near" not in to_plain(DensityConfig())
    assert to_plain(DensityConfig(near=0.3))["near"] == 0.3
    assert from_plain(DensityConfig, to_plain(DensityConfig())) == DensityConfig()
