"""Backward passes as values, on both back ends: pictures of one step, parts of a cotangent, shading."""

from dataclasses import fields, replace

import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.cpu.cpu_render import render_cpu
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.fields import Fields, FieldStart
from ambiguous_wild.splat.gaussians import PARAMETERS
from ambiguous_wild.splat.gpu_render import render_cuda
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.rendered import Cotangents, Gradients, ShadeGradients
from tests.tiny_scene import with_points

from . import fake_gsplat
from .scenes import camera, cotangents, gaussians, given, trainer_for

TOLERANCE = 3e-5  # of float32 sums in another order
OPTIONS = {"sh_degree": 2, "background": (0.1, 0.5, 0.9), "antialias": True}


@pytest.fixture(scope="module")
def scene(scene):
    return with_points(scene, 60)


@pytest.fixture(params=["cpu", "accelerator"])
def back_end(request, monkeypatch):
    if request.param == "cpu":
        yield request.param
    else:
        with fake_gsplat.installed(monkeypatch):
            yield request.param


def shade_of(g, weight):
    """Colours of harmonics, a feature of every Gaussian, its position, and a weight [3] of its own."""

    def shade(base, rows):
        inputs = (base, g.attributes["tint"][rows], g.means[rows], weight)
        leaves = [t.detach().requires_grad_(True) for t in inputs]
        with torch.enable_grad():
            colours = leaves[0] * leaves[3] + leaves[1] + 0.3 * torch.sin(leaves[2]) - 0.4

        def vjp(d_colours):
            found = torch.autograd.grad(colours, leaves, d_colours, retain_graph=True)
            return ShadeGradients(found[0], {"tint": found[1]}, found[2], {"tint": {"weight": found[3]}})

        return colours.detach(), vjp

    return shade


class Tint(Effect):
    """The same as an effect."""

    name = "tint"

    def setup(self, data):
        self.weight = torch.tensor([0.9, 1.0, 0.7], device=data.device)

    def rows(self, gaussians):
        return {"tint": GaussianAttribute(0.1 * gaussians.means.sin(), rate=1e-3)}

    def shade(self, gaussians, rows, base, context):
        return shade_of(gaussians, self.weight)(base, rows)


def tensors(gradients: Gradients) -> dict[str, torch.Tensor]:
    """Everything in it, by name."""
    found = {f.name: getattr(gradients, f.name) for f in fields(gradients)}
    found |= dict(found.pop("attributes"))
    for name, own in found.pop("effect_grads").items():
        found |= {f"{name} {key}": value for key, value in own.items()}
    for name, other in found.pop("fields").items():
        found |= {f"{name} {key}": value for key, value in tensors(other).items()}
    return {name: value for name, value in found.items() if value is not None}


def agree(found: Gradients, expected: Gradients):
    found, expected = tensors(found), tensors(expected)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if value.dtype == torch.bool:
            # gsplat also counts what reaches into the frame and covers no pixel's centre
            differs = found[name] != value
            assert not expected["means"][differs].any() and not found["means"][differs].any(), name
        else:
            assert value.isfinite().all(), name
            error = (found[name] - value).abs().max()
            # of the largest: a screen gradient is what is left of both cotangents less the second one's
            assert error <= TOLERANCE * max(value.abs().max(), 1e-2), (name, float(error))


# -- several pictures -----------------------------------------------------------------------------


def of_parameters(rates):
    return {name: rate for name, rate in rates.items() if name in PARAMETERS}


class Beside(Fields):
    """A second field, added to the picture of its view."""

    def setup(self, data, static, rates):
        other = static.select(torch.arange(0, len(static), 3))
        return {
            "other": FieldStart(
                replace(other, attributes={}), lambda progress: of_parameters(rates(progress))
            )
        }

    def drawn(self, context):
        return ("other",)

    def compose(self, frames, context):
        a, b = frames["static"], frames["other"]
        return replace(a, image=a.image + b.image), lambda c: {"static": c, "other": Cotangents(c.image)}


@pytest.mark.parametrize("beside", [False, True], ids=["one field", "two fields"])
def test_pictures_drawn_before_any_is_pulled_have_the_gradients_of_each_alone(
    scene, tmp_path, back_end, beside
):
    parts = with_effects(
        MethodHooks(fields=Beside() if beside else None), ("exposure", "appearance", "antialias")
    )
    parts = replace(parts, effects=(*parts.effects, Tint()))
    trainer = trainer_for(scene, tmp_path, parts=parts, iterations=30, probes=0)
    for _ in range(3):  # effects and harmonics are no longer neutral
        trainer.timeline.loss(trainer.step())
    trainer.optimiser.flush()
    step = trainer.make_step(20, 1)
    others = trainer.gaussians.select(torch.arange(0, len(trainer.gaussians), 2))
    elsewhere = trainer.data.cameras[4]
    draws = [
        lambda: trainer.make_step(20, 1).rendered,
        lambda: step.draw(elsewhere),
        lambda: step.draw(gaussians=others, without=("antialias",)),  # its filter is of the model's rows
        lambda: step.draw(without=("exposure", "tint")),
        lambda: trainer.make_step(20, 3).rendered,
    ]

    def pulled(rendered, seed):
        d = given(cotangents(rendered.image.shape[0], rendered.image.shape[1], seed))
        return rendered.backward(d, frozenset({"absolute"}))

    alone = [pulled(draw(), seed) for seed, draw in enumerate(draws)]
    drawn = [draw() for draw in draws]
    at_once = [pulled(drawn[seed], seed) for seed in (3, 0, 4, 2, 1)]
    for seed, found in zip((3, 0, 4, 2, 1), at_once, strict=True):
        expected = tensors(alone[seed])
        assert expected["means"].any()
        for name, value in tensors(found).items():
            assert torch.equal(value, expected[name]), (seed, name)
    assert "tint weight" in tensors(alone[0]) and "tint weight" not in tensors(alone[3])
    assert ("other means" in tensors(alone[0])) == beside


# -- parts of a cotangent -------------------------------------------------------------------------


@pytest.mark.parametrize("asked", ["d_alpha", "d_depth", "d_image_extra", "d_image_extra d_alpha", ""])
@pytest.mark.parametrize("needs", [(), ("absolute",)], ids=["signed", "absolute"])
def test_any_cotangent_may_be_missing(fake, asked, needs):
    g, cam = gaussians(3), camera()
    d = given({k: v for k, v in cotangents(cam.height, cam.width).items() if k in asked.split()})
    pictures = [draw(g, cam, **OPTIONS) for draw in (render_cuda, render_cpu)]
    found, expected = (picture.backward(d, frozenset(needs)) for picture in pictures)
    if needs and "d_depth" in asked:  # the one sum that gsplat does not make
        assert expected.screen_abs.any() and not found.screen_abs.any()
        expected.screen_abs = found.screen_abs
    agree(found, expected)


def test_a_second_backward_pass_of_a_picture_is_refused(fake):
    rendered = render_cuda(gaussians(3), camera(), **OPTIONS)
    rendered.backward(torch.ones_like(rendered.image))
    with pytest.raises(RuntimeError, match="draw it again"):
        rendered.backward(torch.ones_like(rendered.image))


# -- filter and colours ---------------------------------------------------------------------------


@pytest.mark.parametrize("blur", [0.1, 0.3, 1.0])
def test_the_filter_is_that_of_the_cpu(fake, blur):
    g, cam = gaussians(3), camera()
    there, cpu = (draw(g, cam, **OPTIONS, blur=blur) for draw in (render_cuda, render_cpu))
    assert (there.image - cpu.image).abs().max() < TOLERANCE
    d = given(cotangents(cam.height, cam.width))
    agree(there.backward(d), cpu.backward(d))


@pytest.mark.parametrize("degree", [0, 2])
def test_shaded_colours_and_their_gradients_are_those_of_the_cpu(fake, degree):
    g, cam = gaussians(3), camera()
    g = g.with_attributes({"tint": torch.randn(len(g), 3, generator=torch.Generator().manual_seed(0))})
    shade = shade_of(g, torch.tensor([0.9, 1.0, 0.7]))
    options = OPTIONS | {"sh_degree": degree, "shade": shade}
    there, cpu = (draw(g, cam, **options) for draw in (render_cuda, render_cpu))
    plain = render_cpu(g, cam, **(options | {"shade": None}))
    assert (plain.image - cpu.image).abs().max() > 0.1
    assert (there.image - cpu.image).abs().max() < TOLERANCE
    d = given(cotangents(cam.height, cam.width))
    found, expected = there.backward(d), cpu.backward(d)
    agree(found, expected)
    assert found.effect_grads["tint"]["weight"].any() and found.attributes["tint"].any()
    assert (found.attributes["tint"] == 0).any(dim=1)[there.visible].any()  # some were clamped at 0


def test_a_net_sees_nothing_of_rows_that_gsplat_leaves_out(fake, monkeypatch):
    """It computes no harmonics for them: what lies there may be NaN."""
    harmonics = fake_gsplat.spherical_harmonics

    def leaves_out(degrees, dirs, coeffs, masks=None):
        return torch.where(masks[:, None], harmonics(degrees, dirs, coeffs, masks), torch.nan)

    import gsplat

    monkeypatch.setattr(gsplat, "spherical_harmonics", leaves_out)
    g, cam = gaussians(3), camera()
    g = g.with_attributes({"tint": torch.zeros(len(g), 3)})
    rendered = render_cuda(g, cam, **OPTIONS, shade=shade_of(g, torch.ones(3)))
    assert not rendered.visible.all()
    for name, value in tensors(rendered.backward(torch.ones_like(rendered.image))).items():
        assert value.isfinite().all(), name


def test_a_shading_function_must_give_one_colour_a_row(fake):
    with pytest.raises(AwError, match=r"must give colours \[60, 3\], got \[60, 4\]"):
        render_cuda(gaussians(3), camera(), **OPTIONS, shade=lambda base, rows: (torch.ones(60, 4), None))


# -- what gsplat does not offer -------------------------------------------------------------------


class Squares(DensityControl):
    needs = frozenset({"squared"})


class Counted(Beside):
    def setup(self, data, static, rates):
        density = DensityControl(MethodHooks().density_config, 1.0, 0)
        density.needs = frozenset({"count"})
        return {"other": FieldStart(static.clone(), rates, density)}


@pytest.mark.parametrize(
    "parts", [MethodHooks(density=Squares), MethodHooks(fields=Counted())], ids=["static", "other"]
)
def test_statistics_that_gsplat_does_not_sum_are_refused_before_training(scene, tmp_path, monkeypatch, parts):
    trainer_for(scene, tmp_path, parts=parts)  # the CPU has them
    with fake_gsplat.installed(monkeypatch):
        with pytest.raises(
            AwError, match=r"'(squared|count)'.*not offered by gsplat.*--device cpu"
        ) as caught:
            trainer_for(scene, tmp_path, parts=parts)
        rendered = render_cuda(gaussians(3), camera(), **OPTIONS)
        with pytest.raises(AwError, match="not offered by gsplat"):
            rendered.backward(torch.ones_like(rendered.image), frozenset({"count"}))
    assert "\n" not in str(caught.value)
