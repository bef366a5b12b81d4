"""What methods may rely on: vjps are values, state travels with a Gaussian, statistics are asked for."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.cpu.cpu_render import render_cpu
from ambiguous_wild.splat.density import DensityConfig, DensityControl
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.smoothing import SmoothingFilter
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.fields import Fields, FieldStart
from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.reference import render_reference
from ambiguous_wild.splat.rendered import Cotangents, Gradients, ShadeGradients, with_visible
from tests.splat.scenes import camera, cotangents, doubles, gaussians, given, trained, trainer_for


def test_a_render_of_which_fewer_rows_count_is_another_value():
    g, cam = gaussians(3), camera()
    rendered = render_cpu(g, cam)
    drawn, none = rendered.visible.clone(), torch.zeros(len(g), dtype=torch.bool)
    changed = with_visible(rendered, none)
    assert torch.equal(rendered.visible, drawn) and drawn.any() and not changed.visible.any()
    assert changed.image is rendered.image and torch.equal(changed.radii, rendered.radii)
    d = given(cotangents(cam.height, cam.width))
    assert torch.equal(changed.backward(d).means.clone(), rendered.backward(d).means)


def same(a: Gradients, b: Gradients) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in (*PARAMETERS, "screen"))


# -- the backward pass as a value -----------------------------------------------------------------


def test_gradients_of_two_losses_add():
    g, cam = gaussians(3), camera()
    d = cotangents(cam.height, cam.width)
    rendered = render_cpu(g, cam)
    both = rendered.backward(given(d))
    first = rendered.backward(Cotangents(d["d_image"], alpha=d["d_alpha"]))
    summed = first + rendered.backward(Cotangents(extra=d["d_image_extra"], depth=d["d_depth"]))
    for name in PARAMETERS:
        torch.testing.assert_close(getattr(summed, name), getattr(both, name), rtol=1e-4, atol=1e-4)
    assert torch.equal(summed.visible, rendered.visible)
    with_effect_grads = first.with_effect_grads("a", {"x": torch.ones(2)}) + first.with_effect_grads(
        "a", {"x": torch.ones(2)}
    )
    assert torch.equal(with_effect_grads.effect_grads["a"]["x"], torch.full((2,), 2.0))


class OwnPicture(MaskPolicy):
    """A loss on another picture of the step: the gradient of the step's own, once more."""

    def gradients(self, step, keep):
        raw = step.draw()
        return raw.backward(raw.image - step.photo)


def test_a_policy_may_learn_from_pictures_of_its_own(scene, tmp_path):
    plain, more = (
        trainer_for(scene, tmp_path / "a", parts=MethodHooks()),
        trainer_for(scene, tmp_path / "b", parts=MethodHooks(mask=OwnPicture())),
    )
    plain.step()
    more.step()
    assert not torch.equal(plain.gaussians.sh0, more.gaussians.sh0)


# -- state that travels with a Gaussian ---------------------------------------------------------------


class Number(Effect):
    """Every Gaussian knows which point it comes from."""

    name = "number"

    def rows(self, gaussians):
        n = torch.arange(len(gaussians), dtype=torch.float32)
        return {
            "number": GaussianAttribute(n[:, None].repeat(1, 2)),
            "weight": GaussianAttribute(torch.zeros(len(gaussians)), rate=0.1),
        }


EARLY = DensityConfig(start=0, every=1, min_every=20, grow_grad=1e-9, min_reset_spacing=10**9)


def test_density_control_carries_what_a_gaussian_has(scene, tmp_path):
    parts = MethodHooks(effects=(Number(),), density_config=EARLY)
    trainer = trainer_for(scene, tmp_path, parts=parts, max_gaussians=900)
    start = trainer.gaussians
    while trainer.iteration < 45:
        trainer.step()
    after = trainer.gaussians
    assert len(after) > len(start) and set(after.attributes) == {"number", "weight"}
    numbers = after.attributes["number"][:, 0].long()
    assert torch.equal(after.attributes["number"][:, 0], after.attributes["number"][:, 1])
    assert len(numbers.unique()) > 10 and int(numbers.max()) < len(start)
    # a child lies near the point that its number names, nearer than near a random one
    near = (after.means - start.means[numbers]).norm(dim=1).median()
    far = (after.means - start.means[numbers.roll(7)]).norm(dim=1).median()
    assert near < 0.5 * far
    trainer.save()
    again = trainer_for(
        scene, tmp_path, parts=MethodHooks(effects=(Number(),), density_config=EARLY), max_gaussians=900
    )
    assert again.resume()
    assert torch.equal(again.gaussians.attributes["number"], after.attributes["number"])


class Carried(Effect):
    """A learnt row that the colour reads."""

    name = "carried"

    def rows(self, gaussians):
        return {"gain": GaussianAttribute(torch.zeros(len(gaussians), 1), rate=0.01)}

    def shade(self, gaussians, rows, base, context):
        gain = gaussians.attributes["gain"][rows]

        def vjp(d):
            return ShadeGradients((1 + gain) * d, {"gain": (d * base).sum(dim=1, keepdim=True)})

        return (1 + gain) * base, vjp


def test_a_learnt_row_learns(scene, tmp_path):
    parts = MethodHooks(effects=(Carried(),), density_config=EARLY)
    trainer = trained(scene, tmp_path, parts=parts, max_gaussians=700)
    assert trainer.gaussians.attributes["gain"].abs().max() > 0.01


def test_rows_are_checked():
    g = gaussians(0, n=4)
    with pytest.raises(AwError, match="under a name of its own"):
        g.with_attributes({"means": torch.zeros(4, 3)})
    with pytest.raises(AwError, match="must be \\[4"):
        g.with_attributes({"more": torch.zeros(3, 3)})
    with pytest.raises(AwError, match=r"only one side has the attributes .*more"):
        g.with_attributes({"more": torch.zeros(4)}).cat(g)


# -- shading, blur, statistics ----------------------------------------------------------------------


def shaded(base, rows):
    return base * base - 0.1, lambda d: ShadeGradients(2 * base * d)


@pytest.mark.parametrize("degree", [0, 3])
def test_shaded_colours_and_their_gradients_against_the_reference(degree):
    g, cam = gaussians(5), camera()
    d = cotangents(cam.height, cam.width)
    rendered = render_cpu(g, cam, sh_degree=degree, shade=shaded)
    grads = rendered.backward(given(d))
    parameters = doubles(g)
    truth = render_reference(parameters, cam, sh_degree=degree, shade=lambda base: base * base - 0.1)
    torch.testing.assert_close(rendered.image.double(), truth.image, rtol=1e-4, atol=1e-5)
    loss = (truth.image * (d["d_image"] + d["d_image_extra"])).sum()
    (loss + (truth.alpha * d["d_alpha"]).sum() + (truth.depth * d["d_depth"]).sum()).backward()
    for name, leaf in parameters.items():
        expected = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        scale = expected.abs().max().item()
        torch.testing.assert_close(
            getattr(grads, name).double(), expected, rtol=1e-3, atol=2e-5 * max(scale, 1)
        )


def test_a_shading_function_sees_visible_rows_alone():
    g, cam = gaussians(6), camera()
    seen = []
    render_cpu(g, cam, shade=lambda base, rows: (seen.append(rows), shaded(base, rows))[1])
    visible = render_cpu(g, cam).visible
    assert torch.equal(seen[0].sort().values, visible.nonzero().squeeze(1))
    with pytest.raises(AwError, match=r"must give colours \[\d+, 3\]"):
        render_cpu(g, cam, shade=lambda base, rows: (base[:, :2], None))


@pytest.mark.parametrize("blur", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("antialias", [False, True])
def test_blur_against_the_reference(blur, antialias):
    g, cam = gaussians(7, size=-3.0), camera()
    d = cotangents(cam.height, cam.width)["d_image"]
    rendered = render_cpu(g, cam, blur=blur, antialias=antialias)
    grads = rendered.backward(d)
    parameters = doubles(g)
    truth = render_reference(parameters, cam, blur=blur, antialias=antialias)
    torch.testing.assert_close(rendered.image.double(), truth.image, rtol=1e-4, atol=1e-5)
    (truth.image * d).sum().backward()
    for name in ("means", "log_scales", "quats", "opacity_logits"):
        expected = parameters[name].grad
        atol = 2e-5 * max(expected.abs().max().item(), 1)
        torch.testing.assert_close(getattr(grads, name).double(), expected, rtol=1e-3, atol=atol)


def test_squared_sums_and_pixel_counts_over_single_pixels():
    g, cam = gaussians(13, n=12), camera(20, 18)
    rendered = render_cpu(g, cam)
    d = cotangents(cam.height, cam.width)["d_image"]
    squares, pixels = torch.zeros(12, dtype=torch.float64), torch.zeros(12)
    for y in range(cam.height):
        for x in range(cam.width):
            one = torch.zeros_like(d)
            one[y, x] = d[y, x]
            squares += rendered.backward(one).screen.double().square().sum(dim=1)
            colour = torch.zeros_like(d)
            colour[y, x] = 1.0
            # the constant harmonic has a gradient in exactly the pixels in which a Gaussian is drawn
            g_lit = replace(g, sh0=torch.ones_like(g.sh0), sh_rest=torch.zeros_like(g.sh_rest))
            pixels += (render_cpu(g_lit, cam).backward(colour).sh0[:, 0] > 0).float()
    grads = rendered.backward(d, frozenset({"squared", "count"}))
    torch.testing.assert_close(grads.squared.double(), squares, rtol=1e-4, atol=1e-9)
    assert torch.equal(grads.count, pixels)
    plain = rendered.backward(d)
    assert plain.squared is None and plain.count is None and plain.screen_abs is None
    assert same(plain, grads)
    with pytest.raises(AwError, match="did you mean 'squared'"):
        rendered.backward(d, frozenset({"square"}))


class Wants(DensityControl):
    needs = frozenset({"absolute", "squared"})
    seen: list = []  # noqa: RUF012 - of the class: the trainer makes the object

    def setup(self, data):
        Wants.seen = [len(data.photos)]

    def before_step(self, step, gradients):
        Wants.seen.append((gradients.screen_abs is not None, gradients.squared is not None, gradients.count))
        return replace(gradients, opacity_logits=torch.ones_like(gradients.opacity_logits))


def test_density_control_gets_what_it_needs_and_may_change_gradients(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path, parts=MethodHooks(density=Wants))
    before = trainer.gaussians.opacity_logits.clone()
    trainer.step()
    assert Wants.seen == [len(trainer.data.photos), (True, True, None)]
    torch.testing.assert_close(trainer.gaussians.opacity_logits, before - 0.05)  # Adam's first step


def test_a_start_of_ones_own(scene, tmp_path):
    def start(data):
        xyz = data.scene.points.xyz[:9]
        return Gaussians.from_points(xyz, np.zeros((9, 3), np.uint8), opacity=0.5)

    trainer = trainer_for(scene, tmp_path, parts=MethodHooks(start=start))
    assert len(trainer.gaussians) == 9 and float(torch.sigmoid(trainer.gaussians.opacity_logits[0])) == 0.5


def test_other_gaussians_may_be_drawn_under_the_smoothing_filter(scene, tmp_path):
    parts = MethodHooks(effects=(SmoothingFilter(),)).with_effect(SmoothingFilter())
    trainer = trainer_for(scene, tmp_path, parts=parts)
    while trainer.iteration < 5:
        trainer.step()
    step = trainer.make_step(6, 0)
    size = trainer.effects.effects[0].size.clone()
    few = step.draw(gaussians=step.gaussians.select(torch.arange(7)))
    assert few.visible.shape == (7,)
    assert torch.equal(trainer.effects.effects[0].size, size)
    assert torch.equal(step.draw().image, step.rendered.image)


class SecondField(Fields):
    """A field that learns at the static one's rates."""

    def setup(self, data, static, rates):
        return {"second": FieldStart(static.select(torch.arange(9)), rates)}


def test_another_field_may_learn_at_the_static_ones_rates(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path, parts=MethodHooks(effects=(Carried(),), fields=SecondField()))
    trainer.step()
    assert set(trainer.drawing.others["second"].optimiser.rates) >= set(PARAMETERS)
