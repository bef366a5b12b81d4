"""Effects written as a forward in torch: gradients, resume, the fit of a test photo."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects.autograd_effect import (
    AutogradEffect,
    Leaf,
    VisibleGaussians,
    mlp,
    mlp_leaves,
)
from ambiguous_wild.splat.effects.base import rate_for_run_length
from ambiguous_wild.splat.effects.effect_pipeline import FIT_STEPS, EffectPipeline
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.step import ViewContext
from ambiguous_wild.splat.training_loop import train
from tests.splat.scenes import camera, gaussians
from tests.splat.scenes import trainer_for as trainer_of


class Everything(AutogradEffect):
    """Acts in all three places: colours per photo and Gaussian, opacities per photo, a tone."""

    name = "everything"

    def leaves(self, data, rng):
        rows = torch.tensor(0.1 * rng.normal(size=(len(data.photos), 3)), dtype=torch.float32)
        return {
            "tint": Leaf(rows, rate=0.01, per_photo=True, fit_rate=0.05),
            "fade": Leaf(torch.full((len(data.photos), 1), 0.2), rate=0.01, per_photo=True),
            "glow": Leaf(torch.tensor([0.1, 0.2, 0.3]), rate=0.01),
            **mlp_leaves("net", (6, 4, 3), rng, 1e-3),
        }

    def rows(self, gaussians):
        return {"code": GaussianAttribute(0.1 * torch.ones(len(gaussians), 3), rate=0.01)}

    def forward(self, visible: VisibleGaussians, leaf: Mapping[str, torch.Tensor], context: ViewContext):
        inputs = torch.cat([visible.base, visible.attributes["code"] * leaf["tint"]], dim=1)
        return visible.base * (1 + leaf["tint"]) + 0.1 * mlp(inputs, leaf, "net") + 0.01 * visible.means

    def change(self, gaussians, leaf, context):
        return {"opacity_logits": gaussians.opacity_logits + leaf["fade"] * gaussians.means[:, 0]}

    def tone(self, image, alpha, leaf, context):
        return image + (1 - alpha)[..., None] * leaf["glow"]


def drawn_with(effect, g, values=None):
    """The picture of photo 1 with some leaves or rows replaced."""
    chain = EffectPipeline.__new__(EffectPipeline)
    chain.effects, chain.views = (effect,), effect.photos
    kept = {name: adam.values.clone() for name, adam in effect._adam.items()}
    for name, value in (values or {}).items():
        if name in effect._adam:
            effect._adam[name].values[1 if effect._leaves[name].per_photo else 0] = value
        elif name in g.attributes:
            g = replace(g, attributes={**g.attributes, name: value})
        else:
            g = replace(g, **{name: value})
    context = ViewContext(iteration=1, nominal=1e4, view=1, camera=camera())
    rendered = chain.render(g, context, lambda g, s, shade: render(g, s.camera, shade=shade))
    for name, value in kept.items():
        effect._adam[name].values.copy_(value)
    return rendered


def test_all_three_places_against_finite_differences(scene, tmp_path):
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=tmp_path)
    effect = Everything()
    effect.setup(data)
    g = gaussians(4, n=25, size=-0.5)
    g.opacity_logits.clamp_(-1.5, 1.5)
    g = g.with_attributes(
        {"code": torch.tensor(np.random.default_rng(1).normal(size=(25, 3)), dtype=torch.float32)}
    )
    weight = torch.tensor(np.random.default_rng(2).normal(size=(29, 37, 3)), dtype=torch.float32)
    rendered = drawn_with(effect, g)
    found = rendered.backward(weight)
    own = found.effect_grads["everything"]
    assert set(own) == {"tint", "fade", "glow", "net_weight0", "net_bias0", "net_weight1", "net_bias1"}

    def loss(name, value):
        return float((drawn_with(effect, g, {name: value}).image.double() * weight.double()).sum())

    rng = np.random.default_rng(3)
    context = ViewContext(iteration=1, nominal=0, view=1, camera=camera())
    starts = {name: (effect._row(name, context), own[name]) for name in own}
    starts |= {"code": (g.attributes["code"], found.attributes["code"])}
    starts |= {name: (getattr(g, name), getattr(found, name)) for name in ("means", "opacity_logits", "sh0")}
    for name, (start, gradient) in starts.items():
        direction = torch.tensor(rng.normal(size=tuple(start.shape)), dtype=torch.float32)
        step = 2e-3
        slope = (loss(name, start + step * direction) - loss(name, start - step * direction)) / (2 * step)
        expected = float((gradient * direction).sum())
        # float32 pictures; Gaussians that come and go at 1/255 make small steps in the loss
        assert slope == pytest.approx(expected, rel=0.03, abs=0.05), name


def trainer_for(scene, folder, effect):
    growth = DensityConfig(start=0, every=1, min_every=20, grow_grad=1e-9, min_reset_spacing=10**9)
    parts = MethodHooks(effects=(effect,), density_config=growth)
    return trainer_of(scene, folder, parts=parts, max_gaussians=600)


def test_a_photo_that_was_not_trained_on(scene, tmp_path):
    effect = Everything()
    trainer = trainer_for(scene, tmp_path, effect)
    train(trainer)
    seen = trainer.data.cameras[0]
    neutral = ViewContext(iteration=0, nominal=0, view=None, camera=seen)
    assert not effect._leaf(neutral)["tint"].any()
    effect.unseen = "mean"
    rows = effect._adam["tint"].values
    assert torch.equal(effect._leaf(neutral)["tint"], rows[:-1].mean(dim=0))
    shared = {name: adam.values[: effect.photos].clone() for name, adam in effect._adam.items()}
    before = {name: tensor.clone() for name, tensor in trainer.gaussians.named_tensors()}
    photo = (trainer.render(seen).image * torch.tensor([1.3, 1.0, 0.7])).clamp(0, 1).detach()
    left = torch.zeros(photo.shape[:2])
    left[:, :32] = 1.0
    hidden = photo.clone()
    hidden[:, 32:] = float("nan")  # a fit must not look there
    fitted = trainer.render_fitted(seen, hidden, left)
    error = [
        (picture[:, 32:] - photo[:, 32:]).abs().mean() for picture in (fitted, trainer.render(seen).image)
    ]
    assert error[0] < 0.7 * error[1]
    assert all(torch.equal(adam.values[: effect.photos], shared[name]) for name, adam in effect._adam.items())
    assert all(torch.equal(tensor, before[name]) for name, tensor in trainer.gaussians.named_tensors())


class Gains(AutogradEffect):
    """A gain per photo; with `redraw` it also acts on the Gaussians' colours, without changing them."""

    name = "gains"

    def __init__(self, redraw: bool) -> None:
        self.redraw = redraw

    def acts(self, hook):
        return super().acts(hook) or (hook == "shade" and self.redraw)

    def leaves(self, data, rng):
        return {"gain": Leaf(torch.zeros(len(data.photos), 3), rate=0.01, per_photo=True, fit_rate=0.02)}

    def tone(self, image, alpha, leaf, context):
        return image * (1 + leaf["gain"])


def test_an_effect_on_the_picture_is_fitted_to_one_render(scene, tmp_path):
    fits = []
    for redraw in (True, False):
        trainer = trainer_for(scene, tmp_path, Gains(redraw))
        seen, draws = trainer.data.cameras[0], []

        def draw(gaussians, context, shade, draws=draws):
            draws.append(context)
            return render(gaussians, context.camera, shade=shade)

        photo = (trainer.render(seen).image * torch.tensor([1.3, 1.0, 0.7])).clamp(0, 1).detach()
        context = trainer.context(seen, fitting=True)
        keep = torch.ones(photo.shape[:2])
        fits.append(trainer.effects.fit_view(trainer.gaussians, context, photo, keep, draw))
        assert len(draws) == (1 + FIT_STEPS if redraw else 1)
    assert torch.equal(*fits)
    assert (fits[0] - photo).abs().mean() < 0.2 * (trainer.render(seen).image - photo).abs().mean()


def test_names_are_told_apart(scene, tmp_path):
    class Twice(Everything):
        def leaves(self, data, rng):
            return {**super().leaves(data, rng), "code": Leaf(torch.zeros(1), rate=0.1)}

    with pytest.raises(AwError, match="'code' names two inputs"):
        trainer_for(scene, tmp_path, Twice()).step()


@pytest.mark.parametrize(
    ("length", "factor"), [(700, 10.0), (17_500, 2.0), (70_000, 1.0), (140_000, 1.0), (50, 10.0)]
)
def test_rates_rise_with_the_root_of_how_much_shorter_a_run_is(length, factor):
    for iteration in (1, length // 2, length):
        context = ViewContext(
            iteration=iteration, nominal=iteration / length * 30_000, view=0, camera=camera()
        )
        assert rate_for_run_length(0.002, 70_000, context) == pytest.approx(0.002 * factor)
    assert (
        rate_for_run_length(0.002, 70_000, ViewContext(iteration=1, nominal=0.0, view=0, camera=camera()))
        == 0.002
    )
