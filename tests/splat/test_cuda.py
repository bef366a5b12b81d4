"""The accelerator's render call around a stand-in for gsplat: with numbers, and without host reads."""

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.splat import gsplat_calls
from ambiguous_wild.splat.cpu.cpu_render import render_cpu
from ambiguous_wild.splat.gpu_render import on_device
from ambiguous_wild.splat.reference import render_reference
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.rendered import Cotangents
from ambiguous_wild.stress.case import agree

from . import fake_gsplat
from .scenes import camera, cotangents, doubles, gaussians, given

BACKGROUND = (0.1, 0.5, 0.9)
# plain float32 sums in no favourable order, and a determinant that is a difference: two digits of seven
TOLERANCE = 3e-5
NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest")


def judged(g, cam, d, **options):
    """Pictures, and gradients by name, of the float64 reference; keys of `d` say what is asked for."""
    parameters = doubles(g)
    truth = render_reference(parameters, cam, background=BACKGROUND, **options)
    pairs = {"d_image": truth.image, "d_alpha": truth.alpha, "d_depth": truth.depth}
    main = sum((pairs[k] * d[k]).sum() for k in d if k in pairs) + 0 * truth.screen.sum()
    grads = {"screen": torch.autograd.grad(main, truth.screen, retain_graph=True)[0]}
    total = main
    if "d_image_extra" in d:
        extra = (truth.image * d["d_image_extra"]).sum() + 0 * truth.screen.sum()
        grads["screen_extra"] = torch.autograd.grad(extra, truth.screen, retain_graph=True)[0]
        total = main + extra
    found = torch.autograd.grad(total, list(parameters.values()), allow_unused=True)
    for (name, leaf), gradient in zip(parameters.items(), found, strict=True):
        grads[name] = torch.zeros_like(leaf) if gradient is None else gradient
    return truth, grads


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(
    "asked", ["d_image", "d_image d_image_extra", "d_image d_image_extra d_alpha d_depth"]
)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_pictures_and_gradients_are_those_of_the_reference(fake, antialias, asked, degree):
    g, cam = gaussians(3), camera()
    d = {k: v for k, v in cotangents(cam.height, cam.width).items() if k in asked.split()}
    rendered = render(g, cam, background=BACKGROUND, sh_degree=degree, antialias=antialias)
    truth, expected = judged(g, cam, d, sh_degree=degree, antialias=antialias)
    assert (rendered.image - truth.image).abs().max() < TOLERANCE
    assert (rendered.alpha - truth.alpha).abs().max() < TOLERANCE
    assert (rendered.depth - truth.depth).abs().max() < TOLERANCE * (truth.depth.max() + 1)
    assert not (truth.visible & ~rendered.visible).any()
    assert torch.equal(rendered.radii > 0, rendered.visible)
    grads = rendered.backward(given(d))
    assert torch.equal(grads.visible, rendered.visible)
    assert (grads.screen_extra is None) == ("d_image_extra" not in d)
    for name, value in expected.items():
        error = (getattr(grads, name) - value).abs().max()
        assert error <= TOLERANCE * max(value.abs().max(), 1e-3), (name, float(error))


def test_absolute_sums_are_those_of_the_cpu_kernels(fake):
    g, cam = gaussians(4), camera()
    d_image = cotangents(cam.height, cam.width)["d_image"]
    needs = frozenset({"absolute"})
    expected = render_cpu(g, cam).backward(d_image, needs)
    found = render(g, cam).backward(d_image, needs)
    # what the loops drop beyond 1/255 of a row is the same; a pixel on the verge of the cut may differ
    scale = expected.screen_abs.abs().max()
    assert (found.screen_abs - expected.screen_abs).abs().max() < 1e-4 * scale
    assert (found.screen_abs >= found.screen.abs() - 1e-5 * scale).all()
    assert found.screen_abs.max() > 1.5 * found.screen.abs().max()


@pytest.mark.parametrize("clamp", [0.999, 0.99])
def test_the_clamp_is_measured(fake, monkeypatch, clamp):
    """Sources after the release have another one and the same version number."""
    monkeypatch.setattr(fake_gsplat, "MAX_ALPHA", clamp)
    g, cam = gaussians(5), camera()
    g.opacity_logits[:] = 9.0
    assert gsplat_calls.max_alpha("cpu") == clamp
    image = render(g, cam, sh_degree=0).image
    truth, other = (
        render_reference(doubles(g), cam, sh_degree=0, max_alpha=m).image for m in (clamp, 0.9945)
    )
    assert (image - truth).abs().max() < TOLERANCE
    assert (other - truth).abs().max() > 1e-3  # the clamp tells, or this test shows nothing


def test_without_a_graph_there_is_no_backward_pass_and_the_same_picture(fake):
    g, cam = gaussians(6), camera()
    with torch.no_grad():
        rendered = render(g, cam)
    assert torch.equal(rendered.image, render(g, cam).image)
    assert not rendered.image.requires_grad
    with pytest.raises(RuntimeError, match="no_grad"):
        rendered.backward(torch.ones_like(rendered.image))


def test_pictures_carry_no_graph_and_gaussians_are_left_alone(fake):
    g, cam = gaussians(7), camera()
    before = g.clone()
    rendered = render(g, cam)
    rendered.backward(torch.ones_like(rendered.image))
    assert not rendered.image.requires_grad and not rendered.depth.requires_grad
    for name, tensor in g.items():
        assert torch.equal(tensor, getattr(before, name)) and not tensor.requires_grad


def test_a_second_cotangent_comes_back_once_more_through_the_pixels_alone(fake, monkeypatch):
    calls = {"project": 0, "blend": 0}
    for name in calls:
        original = getattr(gsplat_calls, name)

        def counted(*a, _name=name, _original=original, **k):
            calls[_name] += 1
            return _original(*a, **k)

        monkeypatch.setattr(gsplat_calls, name, counted)
    g, cam = gaussians(8), camera()
    d = cotangents(cam.height, cam.width)
    rendered = render(g, cam)
    rendered.backward(Cotangents(d["d_image"], d["d_image_extra"]))
    assert calls == {"project": 1, "blend": 1}  # no depth, no second drawing unless asked for
    assert rendered.depth.shape == (cam.height, cam.width)
    assert calls == {"project": 1, "blend": 2}
    assert rendered.depth is rendered.depth


def test_nothing_to_draw(fake):
    cam = camera()
    none = gaussians(0).select(torch.zeros(60, dtype=torch.bool))
    rendered = render(none, cam, background=BACKGROUND)
    assert torch.equal(rendered.image, torch.tensor(BACKGROUND).expand_as(rendered.image))
    assert rendered.backward(torch.ones_like(rendered.image)).means.shape == (0, 3)


@pytest.mark.parametrize("seed", range(3))
def test_the_adapter_passes_the_bound_that_follows_from_the_problem(fake, seed):
    from ambiguous_wild.stress.case import camera as front_camera
    from ambiguous_wild.stress.case import cloud

    measured = agree(cloud(30, seed), front_camera(), "cpu", "", sh_degree=1)
    assert measured.error <= measured.tolerance


def test_a_cameras_matrices_are_copied_once_and_are_its_own():
    a, b = camera(), camera(angle=0.7)
    first = on_device(a, torch.device("cpu"))
    assert on_device(a, torch.device("cpu")) is first
    other = on_device(b, torch.device("cpu"))
    assert not torch.equal(other.viewmat, first.viewmat)
    np.testing.assert_allclose(first.centre.numpy(), a.center, rtol=1e-6)


def test_without_gsplat_the_error_names_the_command(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "gsplat", None)
    gsplat_calls.gsplat.cache_clear()
    with pytest.raises(AwError, match=r"gsplat is not installed: .*pip install .*cuda"):
        render(gaussians(0).to("meta"), camera())
