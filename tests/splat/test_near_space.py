"""The space close before a camera is kept empty."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.core.scene import SparsePoints
from ambiguous_wild.splat.effects import near_space, with_effects
from ambiguous_wild.splat.effects.near_space import EVERY, NearSpace
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.training_loop import train
from tests.splat.scenes import trainer_for


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
    points = SparsePoints(
        xyz, np.zeros((40, 3), np.uint8), np.zeros(40), np.arange(41) * len(rows),
        np.tile(np.array(rows, np.int32), 40), np.zeros((count, 2), np.float32),
    )  # fmt: skip
    return SimpleNamespace(scene=SimpleNamespace(points=points, views=views, train=views), cameras=cameras)


def near(seen_by=("a",)) -> NearSpace:
    effect = NearSpace()
    effect.setup(data(seen_by))
    return effect


@pytest.mark.parametrize(
    ("place", "held"),
    [
        ((0.0, 0.0, 5.9), True),
        ((0.0, 0.0, 6.1), False),  # six tenths of 10
        ((2.9, 0.0, 5.9), True),
        ((3.0, 0.0, 5.9), False),  # beside the picture
        ((0.0, 2.3, 5.9), True),
        ((0.0, 2.4, 5.9), False),
        ((0.0, 0.0, -1.0), False),  # behind the camera
        ((100.0, 0.0, 1.0), False),  # before b, which sees no points
    ],
)
def test_what_lies_nearer_than_the_points(place, held):
    assert near().contains(torch.tensor([place])).tolist() == [held]


def test_every_camera_that_sees_points_says_so():
    inside = torch.tensor([[100.0, 0.0, 1.0]])
    assert near(seen_by=("a", "b")).contains(inside).all()


def test_it_becomes_transparent_at_intervals():
    gaussians = Gaussians.from_points(
        np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 9.0], [1.0, 0.0, 10.0], [0.0, 1.0, 10.0]]),
        np.full((4, 3), 128, np.uint8),
    )
    before = gaussians.opacity_logits.clone()
    near().after_step(SimpleNamespace(iteration=EVERY + 1), gaussians)
    assert torch.equal(gaussians.opacity_logits, before)
    near().after_step(SimpleNamespace(iteration=EVERY), gaussians)
    assert float(torch.sigmoid(gaussians.opacity_logits[0])) < 0.001
    assert torch.equal(gaussians.opacity_logits[1:], before[1:])


@pytest.fixture
def started(scene, tmp_path, monkeypatch):
    """Makes a trainer whose cameras see all points of the wall; nothing belongs before the wall."""
    monkeypatch.setattr(near_space, "FEW_POINTS", 1)
    monkeypatch.setattr(near_space, "SHARE", 1.0)  # Gaussians that leave the wall are in the way
    every = lambda scene: [np.arange(len(scene.points))] * len(scene.train)  # noqa: E731
    monkeypatch.setattr(near_space, "point_indices_by_photo", every)  # the tiny scene has no tracks

    def start(folder, effects=("near",), iterations=260):
        parts = with_effects(MethodHooks(), list(effects))
        return trainer_for(scene, tmp_path / folder, parts=parts, iterations=iterations)

    return start


def test_density_control_takes_what_became_transparent(started):
    without, kept_empty = started("without", ()), started("near")
    train(without)
    train(kept_empty)
    assert kept_empty.effects.facts()["near"]["cameras"] > 0
    assert len(kept_empty.gaussians.means) < len(without.gaussians.means)
