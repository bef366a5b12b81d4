"""Gaussians right before a camera go; those at the surface, beside the picture or behind stay."""

import numpy as np
import pytest
import torch

from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.effects.clearance import empty_spaces, held
from tests.methods.baselines import data_of, parts_of, resumed_equals_whole, trainer_of
from tests.tiny_scene import WALL_Z, write_tiny_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("data") / "scene")


def test_what_floats_before_a_camera_and_nothing_else(scene, tmp_path):
    data = data_of(scene, tmp_path / "cache")
    camera = data.cameras[0]
    to_world = np.linalg.inv(camera.cam_from_world)
    local = np.array([
        [0.0, 0.0, 0.1 * WALL_Z],  # before the camera
        [0.0, 0.0, 0.4 * WALL_Z],
        [0.0, 0.0, 0.6 * WALL_Z],  # half way to the wall
        [0.0, 0.0, 1.0 * WALL_Z],
        [9.0, 0.0, 0.1 * WALL_Z],  # beside every picture
        [0.0, 0.0, -0.1 * WALL_Z],  # behind
    ])  # fmt: skip
    world = local @ to_world[:3, :3].T + to_world[:3, 3]
    found = held(empty_spaces(data, 0.5), torch.from_numpy(world.astype(np.float32)))
    assert found.tolist() == [True, True, False, False, False, False]


def clear():
    return with_effects(parts_of("absgs", min_every="10"), ["clearance"])


def test_what_floats_is_drawn_no_more_and_pruned(scene, tmp_path):
    trainer = trainer_of(scene, tmp_path / "run", clear())
    camera = trainer.data.cameras[0]
    forward = torch.from_numpy(camera.cam_from_world[2, :3].astype(np.float32))
    with torch.no_grad():
        trainer.gaussians.means[:3] = (
            torch.from_numpy(camera.center.astype(np.float32)) + 0.2 * WALL_Z * forward
        )
        trainer.gaussians.log_scales[:3] = -3.0
    spaces = empty_spaces(trainer.data, 0.5)
    assert held(spaces, trainer.gaussians.means).sum() == 3
    assert trainer.render(camera).radii[:3].min() > 0
    for _ in range(50):
        trainer.step()
    floating = held(spaces, trainer.gaussians.means)
    assert not trainer.render(camera).visible[floating].any()
    assert trainer.effects.facts()["clearance"]["removed"] >= 3
    for _ in range(20):
        trainer.step()
    assert not held(spaces, trainer.gaussians.means).any()


def test_it_resumes_to_the_same_bits(scene, tmp_path):
    resumed_equals_whole(scene, tmp_path, clear)
