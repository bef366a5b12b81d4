"""The space close before a camera is kept empty."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.core.scene import Points
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import near as near_module
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.effects.near import EVERY, NearSpace
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import Parts
from ambiguous_wild.splat.trainer import Trainer
from tests.tiny_scene import write_tiny_scene


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
    assert near().holds(torch.tensor([place])).tolist() == [held]


def test_every_camera_that_sees_points_says_so():
    inside = torch.tensor([[100.0, 0.0, 1.0]])
    assert near(seen_by=("a", "b")).holds(inside).all()


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
def started(tmp_path, monkeypatch):
    """Makes a trainer whose cameras see all points of the wall; nothing belongs before the wall."""
    monkeypatch.setattr(near_module, "FEW_POINTS", 1)
    monkeypatch.setattr(near_module, "SHARE", 1.0)  # Gaussians that leave the wall are in the way
    every = lambda scene: [np.arange(len(scene.points))] * len(scene.train)  # noqa: E731
    monkeypatch.setattr(near_module, "tracks_of", every)  # the tiny scene has no tracks
    write_tiny_scene(tmp_path / "scene")

    def start(folder, effects=("near",), iterations=260):
        (tmp_path / folder).mkdir(exist_ok=True)
        scene, cpu = load_scene(tmp_path / "scene"), torch.device("cpu")
        train_data = load_train_data(scene, device=cpu, seed=0, cache_dir=tmp_path)
        config = TrainConfig(iterations=iterations, probes=0)
        parts = with_effects(Parts(), list(effects))
        return Trainer(train_data, parts, config, folder=tmp_path / folder)

    return start


def bits(trainer):
    return {name: value.numpy().tobytes() for name, value in trainer.gaussians.items()}


def test_what_is_in_the_way_is_removed_and_a_resumed_run_equals_an_undisturbed_one(started):
    without, whole = started("without", ()), started("whole")
    without.train()
    whole.train()
    assert whole.effects.facts()["near"]["cameras"] > 0
    assert len(whole.gaussians.means) < len(
        without.gaussians.means
    )  # density control took what became transparent
    first = started("parts")
    while first.iteration < EVERY + 75:
        first.step()
    first.save()
    second = started("parts")
    assert second.resume()
    second.train()
    assert bits(second) == bits(whole)
