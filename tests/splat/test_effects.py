"""Effects: gradients against float64 finite differences, exact resumes, nothing where none is asked."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError, Scene, SparsePoints, View
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import ALL, EFFECTS, check_effects, dense, with_effects
from ambiguous_wild.splat.effects.base import Effect, RowAdam
from ambiguous_wild.splat.effects.colour import AffineExposure, AppearanceEmbedding
from ambiguous_wild.splat.effects.effect_pipeline import EffectPipeline
from ambiguous_wild.splat.effects.poses import PoseRefinement
from ambiguous_wild.splat.effects.smoothing import SmoothingFilter, filter_sizes
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import START_SHARE, MethodHooks
from ambiguous_wild.splat.reference import render_reference
from ambiguous_wild.splat.rendered import Cotangents, Frame, Gradients
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import train
from tests.splat.scenes import bits, disturbed, shot_of
from tests.splat.scenes import camera as make_camera
from tests.splat.scenes import gaussians as random_gaussians
from tests.splat.scenes import trainer_for as trainer_of


def trainer_for(scene, folder, names=(), **config) -> Trainer:
    return trainer_of(scene, folder, parts=with_effects(MethodHooks(), names), **config)


# -- nothing where none is asked ------------------------------------------------------------------


def test_a_run_without_effects_never_calls_one_and_has_the_same_bits(scene, tmp_path, monkeypatch):
    plain = trainer_for(scene, tmp_path / "plain")
    train(plain)
    calls = []
    for cls in (Effect, AffineExposure, AppearanceEmbedding, SmoothingFilter, PoseRefinement, RowAdam):
        for name, value in list(vars(cls).items()):
            if callable(value):
                monkeypatch.setattr(cls, name, lambda *a, _n=f"{cls.__name__}.{name}", **k: calls.append(_n))
    asked = trainer_for(scene, tmp_path / "asked", ())
    train(asked)
    assert calls == []
    assert not asked.effects.effects and "effects" not in asked.clock.parts_s
    assert bits(asked) == bits(plain)
    EffectPipeline((AffineExposure(),), plain.data)  # the counters do count
    assert calls


def test_an_effect_that_does_nothing_leaves_the_bits_alone(scene, tmp_path):
    plain = trainer_for(scene, tmp_path / "plain")
    train(plain)
    idle = trainer_of(scene, tmp_path / "idle", parts=MethodHooks(effects=(Effect(),)))
    train(idle)
    assert bits(idle) == bits(plain)


def test_only_overridden_hooks_are_called(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path, ("exposure",))
    chain = trainer.effects
    acting = [hook for hook in ("camera", "model", "shade", "pose", "image") if chain._with(hook)]
    assert acting == ["image"]
    assert chain._with("image", without=("exposure",)) == ()


def test_an_effect_that_the_method_brings_is_applied_once():
    parts = MethodHooks(effects=(AffineExposure(),))
    assert with_effects(parts, ("exposure",)).effects == parts.effects
    assert [e.name for e in with_effects(parts, ("exposure", "poses")).effects] == ["exposure", "poses"]


def test_two_effects_of_one_name_are_refused(scene, tmp_path):
    """A checkpoint holds effects by name: one would replace the other."""
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=tmp_path)
    with pytest.raises(AwError, match="effect exposure is listed twice"):
        EffectPipeline((AffineExposure(), AffineExposure()), data)


def test_names():
    assert check_effects(["poses", "exposure", "poses"]) == ("exposure", "poses")
    with pytest.raises(AwError, match="did you mean 'exposure'"):
        check_effects(["exposur"])
    with pytest.raises(AwError, match="exclude each other"):
        check_effects(["sh0", "sh2"])
    parts = MethodHooks()
    assert with_effects(parts, ()) is parts
    assert with_effects(parts, ("sh1",)).sh_degree == 1 and with_effects(parts, ("sh1",)).effects == ()
    assert with_effects(parts, ("antialias",)).antialias
    assert set(ALL) == set(EFFECTS)


def test_a_dense_start_leaves_room_to_grow(scene, tmp_path, monkeypatch):
    asked = []

    def points(cameras, photo, sparse, tracks, keep, most):
        asked.append(most)
        rng = np.random.default_rng(0)
        return rng.normal(4.0, 1.0, (most, 3)), np.full((most, 3), 200, np.uint8)

    monkeypatch.setattr(dense, "dense_points", points)
    sparse = len(scene.points)
    plain = trainer_for(scene, tmp_path / "plain")
    first = trainer_for(scene, tmp_path / "first", ("dense",), max_gaussians=3 * sparse)
    assert len(plain.gaussians.means) == sparse and len(first.gaussians.means) == 2 * sparse
    assert torch.equal(first.gaussians.means[:sparse], plain.gaussians.means)
    assert first.effects.facts() == {"dense": {"points": sparse}}
    # without a limit, the photos' pixels set it in a short run
    pixels = float(np.median([p.shape[0] * p.shape[1] for p in plain.data.photos]))
    free = trainer_for(scene, tmp_path / "free", ("dense",))
    assert len(free.gaussians.means) <= START_SHARE * pixels
    assert free.run_schedule.max_gaussians == plain.run_schedule.max_gaussians
    full = trainer_for(scene, tmp_path / "full", ("dense",), max_gaussians=sparse)
    assert len(full.gaussians.means) == sparse and len(asked) == 2  # no room


# -- state ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [ALL, ("sh1",), ("skybox", "dense", "near")], ids="+".join)
def test_a_resumed_run_equals_an_undisturbed_one(scene, tmp_path, names):
    whole = trainer_for(scene, tmp_path / "whole", names, iterations=20)
    train(whole)
    first = trainer_for(scene, tmp_path / "parts", names, iterations=20)
    while first.iteration < 11:
        first.step()
    first.save()
    second = trainer_for(scene, tmp_path / "parts", names, iterations=20)
    assert second.resume()
    train(second)
    assert bits(second) == bits(whole)
    assert str(second.effects.state_dict()) == str(whole.effects.state_dict())
    assert all(np.isfinite(v) for facts in whole.effects.facts().values() for v in facts.values())


def test_a_render_between_steps_changes_nothing(scene, tmp_path):
    plain, probed = (trainer_for(scene, tmp_path / n, ALL, iterations=20) for n in ("plain", "probed"))
    train(plain)
    train(probed, tick=lambda t: (t.picture(t.data.cameras[0]), t.make_step(t.iteration, 1)))
    assert bits(probed) == bits(plain)


def test_a_checkpoint_of_other_effects_is_refused(scene, tmp_path):
    trainer_for(scene, tmp_path, ("exposure",)).save()
    with pytest.raises(AwError, match="has the effects exposure, this run poses"):
        trainer_for(scene, tmp_path, ("poses",)).resume()


# -- gradients ------------------------------------------------------------------------------------


def tiny_data(cameras, points=None):
    xyz = np.random.default_rng(0).normal([0, 0, 3], 1.0, (40, 3)) if points is None else points
    empty = SparsePoints(
        xyz, np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz)), np.zeros(len(xyz) + 1, int),
        np.zeros(0, np.int32), np.zeros((0, 2), np.float32),
    )  # fmt: skip
    views = tuple(View(f"{i}.png", None, c, "train") for i, c in enumerate(cameras))
    photos = [torch.zeros(c.height, c.width, 3) for c in cameras]
    return TrainData(
        Scene(None, "s", views, empty), photos, list(cameras), [None] * len(cameras),
        torch.device("cpu"), 0, None,
    )  # fmt: skip


def numeric(function, x, step=1e-5):
    """Central differences of a scalar function at x, float64."""
    out = torch.zeros_like(x)
    for index in np.ndindex(tuple(x.shape)):
        values = []
        for sign in (1, -1):
            moved_x = x.clone()
            moved_x[index] += sign * step
            values.append(float(function(moved_x)))
        out[index] = (values[0] - values[1]) / (2 * step)
    return out


def test_exposure_gradients_and_closure():
    effect = AffineExposure()
    effect.setup(tiny_data([make_camera()] * 3))
    rng = np.random.default_rng(0)
    effect.adam = RowAdam(torch.from_numpy(rng.normal(size=(4, 3, 4)) * 0.1))
    effect._close()
    assert effect.adam.values[:3].sum(dim=0).abs().max() < 1e-12
    image, weight = (torch.from_numpy(rng.normal(size=(3, 4, 3))) for _ in range(2))
    frame = Frame(image, torch.ones(3, 4), lambda: torch.ones(3, 4))
    assert effect.image(frame, shot_of(None))[0] is frame

    def toned(x):
        return effect.image(replace(frame, image=x), shot_of(1))[0].image

    _, vjp = effect.image(frame, shot_of(1))
    effect.image(replace(frame, image=2 * image), shot_of(0))  # another picture in between changes nothing
    found = vjp(Cotangents(weight, extra=2 * weight))
    torch.testing.assert_close(found.image, numeric(lambda x: (toned(x) * weight).sum(), image))
    torch.testing.assert_close(found.extra, 2 * found.image)  # and effects learn from the image's alone
    row = effect.adam.values[1].clone()

    def of_row(values):
        effect.adam.values[1] = values
        return (toned(image) * weight).sum()

    torch.testing.assert_close(found.effect_grads["exposure"]["affine"], numeric(of_row, row))
    effect.adam.values[1] = row
    effect.step(found.effect_grads["exposure"], shot_of(1))
    assert effect.adam.values[:3].sum(dim=0).abs().max() < 1e-12


def as_gradients(g, weights) -> Gradients:
    """Gradients of sum(weights * parameters): what a linear loss on the drawn Gaussians hands back."""
    return Gradients(**weights, screen=torch.zeros(len(g), 2))


def doubled(g: Gaussians) -> Gaussians:
    return Gaussians(**{name: tensor.double() for name, tensor in g.items()})


def linear(drawn, weights):
    return sum(float((tensor * weights[name]).sum()) for name, tensor in drawn.items())


@pytest.mark.parametrize("kind", ["antialias", "appearance"])
def test_gradients_of_the_model_effects(kind):
    g = doubled(random_gaussians(3, n=7))
    cameras = [make_camera(), make_camera(fx=60.0, fy=60.0)]
    effect = {"antialias": SmoothingFilter, "appearance": AppearanceEmbedding}[kind]()
    effect.setup(tiny_data(cameras))
    rng = np.random.default_rng(1)
    if kind == "appearance":
        effect.rows_of_photos = RowAdam(torch.from_numpy(rng.normal(size=(3, 4))))
        effect.net = {name: w.double() for name, w in effect.net.items()}
        effect.unit.centre, effect.unit.spread = effect.unit.centre.double(), effect.unit.spread.double()
    weights = {name: torch.from_numpy(rng.normal(size=tuple(t.shape))) for name, t in g.items()}
    _, vjp = effect.model(g, shot_of(1))
    effect.model(g, shot_of(0))  # another picture in between changes nothing
    found = vjp(as_gradients(g, weights))
    for name in ("log_scales", "opacity_logits") if kind == "antialias" else ("sh0",):

        def of(values, name=name):
            return linear(effect.model(replace(g, **{name: values}), shot_of(1))[0], weights)

        torch.testing.assert_close(getattr(found, name), numeric(of, getattr(g, name)), rtol=1e-5, atol=1e-7)
    if kind == "appearance":
        row = effect.rows_of_photos.values[1].clone()

        def of_row(values):
            effect.rows_of_photos.values[1] = values
            return linear(effect.model(g, shot_of(1))[0], weights)

        torch.testing.assert_close(found.effect_grads["appearance"]["row"], numeric(of_row, row))
        effect.rows_of_photos.values[1] = row
        last = effect.net["last"]

        def of_net(column):
            changed = last.clone()
            changed[:, 0] = column
            effect.net["last"] = changed
            return linear(effect.model(g, shot_of(1))[0], weights)

        gradient = found.effect_grads["appearance"]["last"][:, 0]
        torch.testing.assert_close(gradient, numeric(of_net, last[:, 0].clone()))


def test_the_filter_is_mip_splattings():
    # one Gaussian 4 away from the nearer of two cameras, longest focal length 60 px: f = sqrt(0.2) 4 / 60
    near, far = np.eye(4), np.eye(4)
    near[2, 3], far[2, 3] = 1.0, 5.0
    cameras = [replace(make_camera(), cam_from_world=far), replace(make_camera(fx=60.0), cam_from_world=near)]
    size = filter_sizes(torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, -9.0]]), cameras)
    assert size[0] == pytest.approx(0.2**0.5 * 4 / 60)
    assert size[1] == size[0]  # seen by no camera: the largest of those seen
    effect = SmoothingFilter()
    effect.setup(tiny_data(cameras))
    g = random_gaussians(0, n=1)
    g.means[0] = torch.tensor([0.0, 0.0, 3.0])
    drawn, _ = effect.model(g, shot_of(0))
    s2, f2 = (2 * g.log_scales[0]).exp(), float(size[0]) ** 2
    torch.testing.assert_close((2 * drawn.log_scales[0]).exp(), s2 + f2)
    expected = torch.sigmoid(g.opacity_logits[0]) * (s2 / (s2 + f2)).prod().sqrt()
    torch.testing.assert_close(torch.sigmoid(drawn.opacity_logits[0]), expected)


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("started", [False, True])
def test_the_cameras_gradient_against_finite_differences_of_the_reference(degree, started):
    g = doubled(random_gaussians(21, n=6, size=-0.7))
    g.means[:] = g.means * torch.tensor([0.4, 0.4, 0.4]) + torch.tensor([-1.0, 0.0, 3.0])
    g.opacity_logits[:] = torch.linspace(-1, 1, 6).double()
    cam = make_camera(24, 20, fx=20.0, fy=22.0)
    rng = np.random.default_rng(0)
    weight = torch.from_numpy(rng.normal(size=(20, 24, 3)))
    effect = PoseRefinement()
    effect.setup(tiny_data([cam]))
    if started:
        effect.adam.values[0] = torch.tensor([0.05, -0.04, 0.03, 0.01, -0.02, 0.015])
        effect.adam.steps[0] = 1
    parameters = {name: tensor.clone().requires_grad_(True) for name, tensor in g.items()}
    r = render_reference(parameters, effect.camera(shot_of(0, cam)), sh_degree=degree)
    (r.image * weight).sum().backward()
    gradients = Gradients(
        **{n: torch.zeros_like(p) if p.grad is None else p.grad for n, p in parameters.items()},
        screen=torch.zeros(6, 2),
    )
    own = effect.pose(g, gradients, shot_of(0, effect.camera(shot_of(0, cam))))

    def loss(delta):
        pose = disturbed(cam, delta[:3].numpy(), effect.depth * delta[3:].numpy())
        frozen = {name: tensor.detach() for name, tensor in parameters.items()}
        return (
            render_reference(frozen, replace(cam, cam_from_world=pose), sh_degree=degree).image * weight
        ).sum()

    expected = numeric(loss, effect.adam.values[0].clone(), step=1e-6)
    assert expected.abs().min() > 1e-2
    torch.testing.assert_close(own["motion"], expected, rtol=1e-4, atol=1e-4)
