"""A skybox: where it lies, what colour it has, and that density control leaves it alone."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.effects.skybox import (
    COUNT,
    MIN_SPHERE_POINTS,
    Skybox,
    fibonacci_sphere,
    skybox_sphere,
)
from ambiguous_wild.splat.gaussians import PARAMETERS
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import train
from tests.tiny_scene import write_tiny_scene

MANY = 1_000_000


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    scene = load_scene(write_tiny_scene(tmp_path_factory.mktemp("data") / "scene", distractors=False))
    return load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=tmp_path_factory.mktemp("c"))


def painted(data, colours, keeps=None):
    """The capture with photos of one colour each, and masks."""
    photos = [torch.ones_like(p) * torch.tensor(c) for p, c in zip(data.photos, colours)]
    return replace(data, photos=photos, user_keep=keeps or [None] * len(photos))


def shares(camera, xyz):
    """[N] bool: before the camera and in its picture."""
    local = xyz @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    u, v = (
        camera.fx * local[:, 0] / local[:, 2] + camera.cx,
        camera.fy * local[:, 1] / local[:, 2] + camera.cy,
    )
    return (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)


def test_it_lies_far_behind_cameras_and_points_where_photos_look(data):
    xyz, rgb = Skybox().first_points(data, MANY)
    middle, radius = skybox_sphere(data.cameras, data.scene.points.xyz)
    assert xyz.shape == rgb.shape and rgb.dtype == np.uint8 and 0 < len(xyz) < COUNT
    np.testing.assert_allclose(np.linalg.norm(xyz - middle, axis=1), radius)
    for camera in data.cameras:
        centre = -camera.cam_from_world[:3, :3].T @ camera.cam_from_world[:3, 3]
        assert np.linalg.norm(centre - middle) <= radius / 8 * 1.001
    checked_gradients = np.any([shares(camera, xyz) for camera in data.cameras], axis=0)
    assert checked_gradients.all()


def test_directions_are_spread_evenly():
    directions = fibonacci_sphere(1000)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    cosines = directions @ directions.T - 2 * np.eye(1000)
    nearest = np.degrees(np.arccos(cosines.max(axis=1)))
    assert nearest.min() > 0.7 * nearest.max()


def test_its_colour_is_the_median_of_the_photos(data):
    n = len(data.photos)
    _, rgb = Skybox().first_points(painted(data, [(0.2, 0.4, 0.6)] * n), MANY)
    assert (rgb == [51, 102, 153]).all()
    odd = [(0.2, 0.4, 0.6)] * n
    odd[0] = (1.0, 0.0, 0.0)  # a photo of another colour is outvoted wherever three look
    xyz, rgb = Skybox().first_points(painted(data, odd), MANY)
    seen = np.sum([shares(camera, xyz) for camera in data.cameras], axis=0)
    assert (seen >= 3).any() and (rgb[seen >= 3] == [51, 102, 153]).all()


def test_what_the_capture_masks_is_no_background(data):
    n = len(data.photos)
    masked = [torch.zeros(p.shape[:2]) for p in data.photos[:1]] + [None] * (n - 1)
    odd = [(1.0, 0.0, 0.0)] + [(0.2, 0.4, 0.6)] * (n - 1)
    _, rgb = Skybox().first_points(painted(data, odd, masked), MANY)
    assert len(rgb) and (rgb == [51, 102, 153]).all()
    everything = [torch.zeros(p.shape[:2]) for p in data.photos]
    assert len(Skybox().first_points(painted(data, odd, everything), MANY)[0]) == 0


def test_with_little_room_it_is_coarser_and_still_all_around(data):
    whole, _ = Skybox().first_points(data, MANY)
    _, radius = skybox_sphere(data.cameras, data.scene.points.xyz)
    effect = Skybox()
    half, _ = effect.first_points(data, len(whole) - 1)
    assert effect.facts() == {"points": len(half)} and 0.3 * len(whole) < len(half) < len(whole)
    spacing = 3.6 / np.sqrt(COUNT / 2)  # of the coarser lattice, with a margin
    far = (whole[:, None] - half[None]) / radius
    assert np.linalg.norm(far, axis=2).min(axis=1).max() < 2 * spacing
    assert len(Skybox().first_points(data, 0)[0]) == 0
    tiny = Skybox()
    count = len(tiny.first_points(data, 3)[0])
    assert count <= 3 and MIN_SPHERE_POINTS > 0


def trainer_for(data, folder, parts, iterations=140, **config):
    config = TrainConfig(**{"iterations": iterations, "probes": 0} | config)
    return Trainer(data, with_effects(parts, ("skybox",)), config, folder=folder)


def far_rows(trainer):
    return int(trainer.effects.effects[-1].frozen_in_density_control(trainer.gaussians.means).sum())


def test_pup_removes_its_share_of_those_that_are_no_skybox(data, tmp_path):
    method = get_method("pup-3dgs")
    parts = method.build(method.options())
    config = replace(parts.density_config, stop=0.0, prune_at=0.0, rounds=1, share=0.5)
    trainer = trainer_for(data, tmp_path, replace(parts, density_config=config), iterations=20)
    first, others = far_rows(trainer), len(trainer.gaussians) - far_rows(trainer)
    train(trainer)
    assert far_rows(trainer) == first
    assert len(trainer.gaussians) - first == pytest.approx(others / 2, abs=2)


@pytest.mark.parametrize("method", ["mcmc", "nexussplats"])
def test_losses_on_size_and_opacity_leave_it_alone(data, tmp_path, method):
    found = get_method(method)
    trainer = trainer_for(data, tmp_path, found.build(found.options()), iterations=20)
    g = trainer.gaussians
    zeros = (torch.zeros_like(getattr(g, name)) for name in PARAMETERS)
    nothing = Gradients(*zeros, screen=torch.zeros(len(g), 2))
    pulled = trainer.density.before_step(SimpleNamespace(gaussians=g), nothing)
    far = trainer.density.protected(g.means)
    assert far.any() and not pulled.log_scales[far].any() and (pulled.log_scales[~far] > 0).all()
    assert not pulled.opacity_logits[far].any()
    weights = trainer.density.weights(g)
    assert float(weights.sum()) == pytest.approx(1.0, abs=1e-5) and not weights[far].any()


def test_pruning_never_leaves_the_skybox_alone(data, tmp_path):
    trainer = trainer_for(data, tmp_path, MethodHooks(density_config=DensityConfig(**EAGER)))
    trainer.gaussians.opacity_logits.fill_(-8.0)
    trainer.density._match(trainer.gaussians)
    assert len(trainer.density._prune(trainer.gaussians, trainer.optimiser)) == len(trainer.gaussians)
    method = get_method("pup-3dgs")
    parts = method.build(method.options())
    config = replace(parts.density_config, stop=0.0, prune_at=0.0, between=1.0, rounds=3, share=0.999)
    trainer = trainer_for(data, tmp_path / "pup", replace(parts, density_config=config), iterations=20)
    train(trainer)
    assert len(trainer.gaussians) > far_rows(trainer) > 0


def test_a_scene_without_points_is_refused_with_a_skybox_too(data, tmp_path):
    points = data.scene.points
    none = replace(
        points, xyz=points.xyz[:3], rgb=points.rgb[:3], error_px=points.error_px[:3],
        track_offsets=points.track_offsets[:4],
    )  # fmt: skip
    with pytest.raises(AwError, match="cannot start from 3 points"):
        trainer_for(replace(data, scene=replace(data.scene, points=none)), tmp_path, MethodHooks())


def test_without_room_nothing_is_spared(data, tmp_path):
    trainer = trainer_for(data, tmp_path, MethodHooks(density_config=DensityConfig(max_gaussians=100)))
    assert trainer.effects.facts()["skybox"] == {"points": 0}
    assert not trainer.density.protected(torch.full((3, 3), 1e6)).any()


def test_what_is_nowhere_is_removed_with_a_skybox_too(data, tmp_path):
    trainer = trainer_for(data, tmp_path, MethodHooks(density_config=DensityConfig(**EAGER)))
    trainer.gaussians.means[:2] = torch.tensor([[np.inf] * 3, [np.nan] * 3], dtype=torch.float32)
    trainer.density._match(trainer.gaussians)
    kept = trainer.density._prune(trainer.gaussians, trainer.optimiser)
    assert len(kept) == len(trainer.gaussians) - 2 and torch.isfinite(kept.means).all()


EAGER = {"start": 0.0, "stop": 10_000.0, "every": 1.0, "min_every": 20, "grow_grad": 1e-9}


def test_density_control_neither_copies_nor_removes_it(data, tmp_path):
    parts = MethodHooks(density_config=DensityConfig(**EAGER, prune_opacity=0.2))
    trainer = trainer_for(data, tmp_path, parts)
    first, near = far_rows(trainer), len(trainer.gaussians) - far_rows(trainer)
    assert first == trainer.effects.facts()["skybox"]["points"] > 0
    train(trainer)
    assert far_rows(trainer) == first
    assert len(trainer.gaussians) - first != near  # the others changed


@pytest.mark.parametrize("name", ["refinesplat", "mcmc", "pup-3dgs", "spotlesssplats"])
def test_every_kind_of_density_control_leaves_it_alone(data, tmp_path, name):
    method = get_method(name)
    parts = method.build(method.options())
    eager = {k: v for k, v in EAGER.items() if k != "grow_grad" or name != "mcmc"}  # which it refuses
    parts = replace(parts, density_config=replace(parts.density_config, **eager))
    trainer = trainer_for(data, tmp_path, parts, iterations=120)
    first, most = far_rows(trainer), len(trainer.gaussians)
    train(trainer)
    assert far_rows(trainer) == first > 0
    assert len(trainer.gaussians) != most  # it did act


def test_without_points_the_cameras_say_where_the_sphere_is(data):
    middle, radius = skybox_sphere(data.cameras, np.zeros((0, 3)))
    centres = np.array([camera.center for camera in data.cameras])
    np.testing.assert_allclose(middle, np.median(centres, axis=0))
    assert radius > np.linalg.norm(centres - middle, axis=1).max() > 0
