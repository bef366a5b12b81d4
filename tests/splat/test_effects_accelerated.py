"""Effects on an accelerator: the CPU's numbers, poses on the device, steps that are skipped."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ambiguous_wild.core import Scene, SparsePoints, View
from ambiguous_wild.splat.data import shrink_camera
from ambiguous_wild.splat.effects import ALL, with_effects
from ambiguous_wild.splat.effects.base import RowAdam
from ambiguous_wild.splat.effects.device_cameras import PosedCamera
from ambiguous_wild.splat.effects.effect_pipeline import EffectPipeline
from ambiguous_wild.splat.effects.poses import PoseRefinement, left_jacobian, so3_exp
from ambiguous_wild.splat.effects.smoothing import filter_sizes
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.rendered import NO_STATISTICS, Gradients, as_cotangents
from ambiguous_wild.splat.step import TrainData, ViewContext
from tests.host_reads import READ, moved, on_accelerator
from tests.splat.scenes import camera as make_camera
from tests.splat.scenes import disturbed
from tests.splat.scenes import gaussians as random_gaussians

SIZE = 24, 18


def data_of(views=3):
    cameras = [make_camera(*SIZE, angle=0.1 * k, fx=20.0 + k, fy=21.0) for k in range(views)]
    xyz = np.random.default_rng(0).normal([0, 0, 3], 1.0, (40, 3))
    points = SparsePoints(xyz, np.zeros((40, 3), np.uint8), np.zeros(40), np.zeros(41, int),
                    np.zeros(0, np.int32), np.zeros((0, 2), np.float32))  # fmt: skip
    scene = Scene(None, "s", tuple(View(f"{i}.png", None, c, "train") for i, c in enumerate(cameras)), points)
    photos = [torch.full((c.height, c.width, 3), 0.5) for c in cameras]
    return TrainData(scene, photos, cameras, [None] * views, torch.device("cpu"), 0, None)


def chain_of(data, names=ALL):
    return EffectPipeline(with_effects(MethodHooks(), names).effects, data)


class Painted:
    """Stands in for a renderer: every parameter is in the picture, and so is the pose."""

    def __init__(self, gaussians, camera):
        pose, centre = getattr(camera, "pose", None), getattr(camera, "centre", None)
        if pose is None:
            pose, centre = (torch.tensor(np.array(x)) for x in (camera.cam_from_world, camera.center))
            pose, centre = pose.to(gaussians.device), centre.to(gaussians.device)
        self.leaves = {name: t.detach().requires_grad_(True) for name, t in gaussians.items()}
        with torch.enable_grad():
            local = self.leaves["means"] @ pose[:3, :3].T.to(gaussians.means) + pose[:3, 3].to(
                gaussians.means
            )
            shade = torch.tanh(self.leaves["sh_rest"].sum(dim=1) + (self.leaves["means"] - centre.float()))
            colour = shade + self.leaves["sh0"] + self.leaves["quats"][:, 1:]
            weight = torch.sigmoid(self.leaves["opacity_logits"]) * self.leaves["log_scales"].exp().sum(dim=1)
            rows = torch.linspace(-1, 1, camera.height, device=gaussians.device)[:, None, None]
            columns = torch.linspace(-1, 1, camera.width, device=gaussians.device)[None, :, None]
            wave = torch.sin(local[:, 0] * columns + local[:, 1] * rows)  # [H, W, N]
            self.drawn = 0.5 + 0.1 * (wave * weight.tanh()) @ colour / len(gaussians)
        self.image = self.drawn.detach()
        self.alpha = self.depth = self.image[..., 0]
        self.visible, self.radii = gaussians.means[:, 0] > -9.0, gaussians.means[:, 0]

    def backward(self, cotangents, needs=NO_STATISTICS):
        given = as_cotangents(cotangents)
        found = torch.autograd.grad(self.drawn, list(self.leaves.values()), given.image)
        leaves = dict(zip(self.leaves, found))
        return Gradients(**leaves, screen=found[0][:, :2], effect_grads=given.effect_grads)


def paint(gaussians, context, shade):
    return Painted(gaussians, context.camera)


def shot_of(camera, view=None, iteration=0, progress=0.5):
    return ViewContext(
        iteration=iteration, nominal=30_000 * progress, progress=progress, view=view, camera=camera
    )


def visit(chain, data, gaussians, iteration, divisor=1, skip_step=None, targets=None):
    """One step of training, but for the Gaussians."""
    view = iteration % len(data.photos)
    context = shot_of(shrink_camera(data.cameras[view], divisor), view, iteration, 0.1 + 0.01 * iteration)
    context = replace(context, camera=chain.camera(context))
    rendered = chain.render(gaussians, context, paint)
    target = 0.2 if targets is None else targets[view]
    gradients = rendered.backward((rendered.image - target) / rendered.image.numel())
    chain.step(gradients, context, skip_step)
    if iteration % 3 == 0:
        chain.rows_changed()
    return rendered.image, gradients


def tensors(state):
    """Leaves of nested dicts and lists, by path."""
    if isinstance(state, dict):
        return {f"{k}/{path}": t for k, v in state.items() for path, t in tensors(v).items()}
    return {"": torch.as_tensor(state)}


def same(one, other, **tolerance):
    one, other = tensors(one), tensors(other)
    assert one.keys() == other.keys()
    for path in one:
        where = lambda text, path=path: f"{path}: {text}"  # noqa: E731
        torch.testing.assert_close(one[path], other[path], msg=where, **tolerance)


# -- the same numbers -----------------------------------------------------------------------------


@pytest.mark.parametrize("names", [*((name,) for name in ALL), ALL], ids="+".join)
def test_effects_learn_what_they_learn_on_the_cpu(monkeypatch, names):
    runs = []
    for yes in (False, True):
        on_accelerator(monkeypatch, yes)
        data = data_of()
        chain, g = chain_of(data, names), random_gaussians(3, n=30)
        seen = [visit(chain, data, g, iteration, 1 + iteration % 2) for iteration in range(12)]
        runs.append((chain, seen))
    (cpu, seen), (there, seen_there) = runs
    start = chain_of(data_of(), names).state_dict()
    assert str(start) != str(cpu.state_dict())  # something was learnt
    # the sums of the poses' gradients run over all Gaussians instead of those that learnt, in float64, of
    # float32 gradients; the other effects do the same arithmetic
    tolerance = {"rtol": 1e-5, "atol": 1e-7} if "poses" in names else {"rtol": 0, "atol": 0}
    same(there.state_dict(), cpu.state_dict(), **tolerance)
    for (image, gradients), (image_there, gradients_there) in zip(seen, seen_there):
        torch.testing.assert_close(image_there, image, rtol=1e-5, atol=1e-6)
        for name in ("means", "log_scales", "opacity_logits", "sh0"):
            torch.testing.assert_close(
                getattr(gradients_there, name), getattr(gradients, name), rtol=1e-4, atol=1e-8
            )
    facts, facts_there = cpu.facts(), there.facts()
    for name in names:
        assert facts_there[name] == pytest.approx(facts[name], rel=1e-4)


def test_a_learnt_pose_is_turned_then_shifted():
    data, rng = data_of(), np.random.default_rng(1)
    effect = PoseRefinement()
    effect.setup(data)
    assert effect.camera(shot_of(data.cameras[0], 0)) is data.cameras[0]  # never moved
    effect.adam.values[:] = torch.from_numpy(rng.normal(size=(3, 6)) * 0.05)
    effect.adam.values[2] = 0.0
    effect.adam.steps = [4, 1, 1]
    for view, delta in enumerate(effect.adam.values.numpy()):
        for divisor in (1, 2):
            camera = shrink_camera(data.cameras[view], divisor)
            like = replace(camera, cam_from_world=disturbed(camera, delta[:3], effect.depth * delta[3:]))
            found = effect.camera(shot_of(camera, view))
            assert isinstance(found, PosedCamera) and (found.width, found.height) == SIZE_OF[divisor]
            for one, expected in ((found, like), (found.resized(12, 6), like.resized(12, 6))):
                np.testing.assert_allclose(one.cam_from_world, expected.cam_from_world, rtol=0, atol=1e-14)
                np.testing.assert_allclose(one.pose.numpy(), expected.cam_from_world, rtol=0, atol=1e-14)
                np.testing.assert_allclose(one.centre.numpy(), expected.center, rtol=0, atol=1e-14)
                np.testing.assert_allclose(one.center, expected.center, rtol=0, atol=1e-14)
                np.testing.assert_allclose(one.intrinsics_there.numpy(), expected.intrinsics, rtol=1e-14)
                np.testing.assert_allclose(one.intrinsics, expected.intrinsics, rtol=1e-14)


SIZE_OF = {1: SIZE, 2: (SIZE[0] // 2, SIZE[1] // 2)}


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.0099, 0.0101, 0.5, 3.0])
def test_rotations_and_their_jacobian(angle):
    axis = np.array([0.48, -0.6, 0.64])
    w = torch.from_numpy(angle * axis)
    np.testing.assert_allclose(so3_exp(w), Rotation.from_rotvec(angle * axis).as_matrix(), rtol=0, atol=1e-15)
    if angle:
        h = 1e-6
        for k, unit in enumerate(torch.eye(3, dtype=torch.float64)):
            change = so3_exp(w + h * unit) @ so3_exp(w - h * unit).T / (2 * h)
            change = 0.5 * (change - change.T)
            column = torch.stack([change[2, 1], change[0, 2], change[1, 0]])
            torch.testing.assert_close(left_jacobian(w)[:, k], column, rtol=0, atol=1e-8)


def test_filter_sizes_with_nothing_in_sight():
    cameras = data_of().cameras
    behind = torch.tensor([[0.0, 0.0, -9.0], [0.0, 0.0, -8.0]])
    assert filter_sizes(behind, cameras).tolist() == [0.0, 0.0]
    assert filter_sizes(behind[:0], cameras).shape == (0,)


def test_a_step_that_is_called_off_changes_nothing():
    generator = torch.Generator().manual_seed(0)
    off, on = torch.ones(1), torch.zeros(1)
    plain, told = (RowAdam(torch.zeros(2, 3, dtype=torch.float64)) for _ in range(2))
    for _ in range(5):
        gradient = torch.randn(3, generator=generator, dtype=torch.float64)
        plain.step(1, gradient, 0.1)
        told.step(1, gradient, 0.1, on)
    same(told.state_dict(), plain.state_dict(), rtol=1e-6, atol=0)
    before = {name: t.clone() for name, t in tensors(told.state_dict()).items() if name != "steps/"}
    told.step(1, torch.tensor([np.nan, np.inf, 1.0], dtype=torch.float64), 0.1, off)
    for name, tensor in before.items():
        assert torch.equal(tensors(told.state_dict())[name], tensor)


def test_a_run_that_is_called_off_stays_where_it_is(monkeypatch):
    on_accelerator(monkeypatch)
    data = data_of()
    chain, g = chain_of(data, ("exposure", "appearance", "poses")), random_gaussians(3, n=30)
    for iteration in range(6):
        visit(chain, data, g, iteration)
    before = {k: t.clone() for k, t in tensors(chain.state_dict()).items() if "steps" not in k}
    nan = [torch.full((SIZE[1], SIZE[0], 3), torch.nan)] * 3
    for iteration in (6, 7, 8):
        visit(chain, data, g, iteration, skip_step=torch.ones(1), targets=nan)
    after = tensors(chain.state_dict())
    for name, tensor in before.items():  # the rows' sum is brought back to zero, which is rounding
        torch.testing.assert_close(after[name], tensor, rtol=0, atol=1e-9)
    assert any(not torch.equal(tensor, torch.zeros_like(tensor)) for tensor in before.values())


# -- state ----------------------------------------------------------------------------------------


def test_a_state_from_the_cpu_lands_where_the_run_is():
    chain = chain_of(data_of())
    visit(chain, data_of(), random_gaussians(3, n=30), 0)
    state = chain.state_dict()
    there = moved(chain_of(data_of()))
    there.load_state_dict(state)
    held = [e for e in tensors(there.state_dict()).items() if not e[0].endswith(("steps/", "at/", "stale/"))]
    assert held and all(t.device.type == "meta" for _, t in held)


def test_the_pose_for_anybody_else_is_read_when_asked_for():
    camera = replace(make_camera(*SIZE))
    posed = PosedCamera(camera, torch.eye(4, dtype=torch.float64).to("meta"), torch.eye(3).to("meta"))
    assert posed.resized(12, 9).width == 12
    with pytest.raises((RuntimeError, NotImplementedError, TypeError), match=READ):
        _ = posed.cam_from_world
