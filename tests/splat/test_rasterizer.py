"""The CPU kernels against the float64 reference, bit for bit across threads, and at the edges."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.splat.cpu.cpu_render import render_cpu
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.reference import render_reference
from ambiguous_wild.splat.rendered import Cotangents

from .scenes import camera, cotangents, doubles, gaussians, given

BACKGROUND = (0.1, 0.5, 0.9)
# float32 rounds at 6e-8; a chain of a few hundred operations per pixel loses a digit or two of that.
TOLERANCE = 1e-5
NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest")


def agree(g: Gaussians, cam: Camera, *, tolerance=TOLERANCE, background=BACKGROUND, **options):
    """Pictures and gradients of both renderers, compared; returns what the CPU gave."""
    rendered = render_cpu(g, cam, background=background, **options)
    parameters = doubles(g)
    truth = render_reference(parameters, cam, background=background, **options)
    scale = truth.depth.abs().max().item() + 1
    for name, unit in (("image", 1.0), ("alpha", 1.0), ("depth", scale)):
        error = (getattr(rendered, name) - getattr(truth, name)).abs().max().item()
        assert error < tolerance * unit, (name, error)
    assert not (truth.visible & ~rendered.visible).any()
    d = cotangents(cam.height, cam.width)
    grads = rendered.backward(given(d))
    main = (truth.image * d["d_image"]).sum() + (truth.alpha * d["d_alpha"]).sum()
    # 0 * screen keeps the graph whole where nothing is drawn
    main = main + (truth.depth * d["d_depth"]).sum() + 0 * truth.screen.sum()
    extra = (truth.image * d["d_image_extra"]).sum() + 0 * truth.screen.sum()
    for name, loss in (("screen", main), ("screen_extra", extra)):
        (expected,) = torch.autograd.grad(loss, truth.screen, retain_graph=True)
        close(name, getattr(grads, name), expected, tolerance)
    (main + extra).backward()
    for name, leaf in parameters.items():
        expected = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        close(name, getattr(grads, name), expected, tolerance)
        assert not getattr(grads, name)[~rendered.visible].any(), name
    return rendered, grads


def close(name, actual, expected, tolerance):
    if expected.numel():
        worst = (actual - expected).abs().max().item()
        assert worst <= tolerance * max(expected.abs().max().item(), 1e-3), (name, worst)


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_pictures_and_every_gradient_equal_the_reference(seed, antialias):
    agree(gaussians(seed), camera(), sh_degree=seed % 4, antialias=antialias)


@pytest.mark.parametrize("logit", [4.0, 4.59, 4.6, 9.0])
def test_both_sides_of_the_alpha_clamp(logit):
    # sigmoid(4.595) is 0.99: below it no pixel is clamped, above it those near the centre are.
    g = gaussians(3, n=12, size=-0.5)
    g.opacity_logits[:] = logit
    agree(g, camera())


def test_the_clamp_stops_opacity_and_shape_but_not_colour():
    g = gaussians(0, n=1)
    g.means[0] = torch.tensor([0.0, 0.0, 3.0])
    g.log_scales[:] = 4.0  # flat over the picture
    g.opacity_logits[:] = 12.0
    cam = Camera(8, 8, 30.0, 30.0, 4.0, 4.0, np.eye(4))
    grads = render_cpu(g, cam).backward(torch.ones(8, 8, 3))
    assert not grads.opacity_logits.any()
    assert not grads.log_scales.any()
    assert not grads.screen.any()
    assert grads.sh0.abs().max() > 0.99 * 64 * 0.28


@pytest.mark.parametrize("factor", [0.999, 1.001])
def test_both_sides_of_the_cut_at_one_255th(factor):
    g = gaussians(1, n=1)
    g.means[0] = torch.tensor([0.0, 0.0, 3.0])
    opacity = factor / 255
    g.opacity_logits[:] = float(np.log(opacity / (1 - opacity)))
    g.log_scales[:] = 1.0
    rendered, grads = agree(g, Camera(9, 9, 30.0, 30.0, 4.5, 4.5, np.eye(4)))
    assert bool(rendered.visible[0]) == (factor > 1)
    assert bool(grads.opacity_logits[0] != 0) == (factor > 1)


@pytest.mark.parametrize(("alpha", "drawn"), [(0.8999, 4), (0.9003, 3), (0.5, 7)])
def test_both_sides_of_the_stop(alpha, drawn):
    # (1 - alpha)^4 is just above, just below and far above 1e-4.
    n = 7
    g = gaussians(2, n=n, rest=0)
    g.means[:] = torch.tensor([0.0, 0.0, 3.0])
    g.means[:, 2] += torch.arange(n) * 0.1
    g.log_scales[:] = 3.0
    g.opacity_logits[:] = float(np.log(alpha / (1 - alpha)))
    g.sh0[:] = 1.0
    rendered, grads = agree(g, Camera(7, 5, 30.0, 30.0, 3.5, 2.5, np.eye(4)), tolerance=1e-4, sh_degree=0)
    assert (grads.sh0.abs().sum(1) > 0).tolist() == [k < drawn for k in range(n)]
    assert (1 - rendered.alpha).min() > 1e-4


def test_the_frustum_clamp_is_constant_beyond_its_edge():
    cam = camera(20, 16, fx=8.0, fy=8.0)  # wide angle: many lie beyond 1.3 of the half angle
    g = gaussians(5, n=80, size=0.3)
    local = g.means.double() @ torch.tensor(cam.cam_from_world[:3, :3]).T + torch.tensor(
        cam.cam_from_world[:3, 3]
    )
    ray = (local[:, 0] / local[:, 2])[local[:, 2] > 0.01]
    limit = (cam.width - cam.cx + 0.15 * cam.width) / cam.fx
    assert (ray > limit).any()
    assert (ray < limit).any()
    agree(g, cam)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (16, 16), (17, 33)])
def test_any_picture_size(size):
    agree(gaussians(4, n=30), camera(*size, cx=size[0] / 2, cy=size[1] / 2))


@pytest.mark.parametrize("offset", [(-100.0, 5.0), (300.0, 300.0)])
def test_principal_point_outside_the_picture(offset):
    agree(gaussians(4, n=40, size=0.0), camera(24, 20, cx=offset[0], cy=offset[1]))


@pytest.mark.parametrize("focal", [1.0, 1e5])
def test_extreme_focal_lengths(focal):
    g = gaussians(6, n=30)
    if focal > 1:
        g.means[:, :2] *= 1e-4
        g.log_scales -= 8
    agree(g, Camera(20, 20, focal, focal, 10.0, 10.0, np.eye(4)), tolerance=1e-4)


def test_nothing_to_draw():
    cam = camera()
    for g in (gaussians(n=0), dataclasses.replace(gaussians(n=3), means=torch.full((3, 3), -50.0))):
        rendered = render_cpu(g, cam, background=BACKGROUND)
        assert torch.equal(rendered.image, torch.tensor(BACKGROUND).expand(cam.height, cam.width, 3))
        assert not rendered.alpha.any()
        grads = rendered.backward(torch.ones_like(rendered.image), frozenset({"absolute"}))
        for f in dataclasses.fields(grads):
            value = getattr(grads, f.name)
            assert not value.any() if isinstance(value, torch.Tensor) else not value


def test_hopeless_gaussians_are_culled_and_harm_nobody():
    good, cam = gaussians(7, n=20), camera()
    bad = gaussians(8, n=14)
    bad.means[0] = torch.from_numpy(cam.center.astype(np.float32))
    forward = torch.from_numpy(cam.cam_from_world[2, :3].astype(np.float32))
    bad.means[1] = bad.means[0] + 0.0099 * forward
    bad.means[2] = bad.means[0] - forward
    bad.means[3] = 1e6 * torch.tensor([1.0, 0.0, 0.0])
    bad.means[4, 0] = float("nan")
    bad.means[5, 1] = float("inf")
    bad.quats[6] = 0.0
    bad.quats[7, 2] = float("nan")
    bad.log_scales[8, 0] = float("nan")
    bad.log_scales[9, 0] = float("inf")
    bad.opacity_logits[10] = -40.0
    bad.opacity_logits[11] = float("nan")
    bad.sh0[12, 1] = float("nan")
    bad.sh_rest[13, 4, 2] = float("inf")
    alone, both = render_cpu(good, cam), render_cpu(good.cat(bad), cam)
    assert torch.equal(both.image, alone.image)
    assert not both.visible[20:].any()
    assert not both.radii[20:].any()
    d = torch.ones_like(alone.image)
    one, two = alone.backward(d), both.backward(d)
    for name in NAMES:
        assert torch.equal(getattr(two, name)[:20], getattr(one, name))
        assert not getattr(two, name)[20:].any(), name


def test_extreme_but_sound_parameters_equal_the_reference():
    g = gaussians(9, n=10, rest=3)
    g.means[:] = torch.tensor([0.2, 0.1, 3.0]) + torch.arange(10)[:, None] * 0.05
    g.log_scales[0] = float(np.log(1e-8))
    g.log_scales[1] = float(np.log(1e4))
    g.log_scales[2] = torch.tensor(np.log([1.0, 1e-6, 1e-6]))  # needle
    g.log_scales[3] = torch.tensor(np.log([1.0, 1.0, 1e-6]))  # pancake
    g.quats[4] *= 1e-12 / g.quats[4].norm()
    g.quats[5] *= 1e6 / g.quats[5].norm()
    g.opacity_logits[6] = 40.0
    g.sh0[7] = torch.tensor([1e4, -1e4, 50.0])
    g.opacity_logits[1] = -4.0
    cam = camera(33, 31)
    rendered = render_cpu(g, cam, sh_degree=1)
    parameters = doubles(g)
    truth = render_reference(parameters, cam, sh_degree=1)
    assert (rendered.image - truth.image).abs().max() < 1e-4 * truth.image.abs().max()
    d = cotangents(cam.height, cam.width)["d_image"]
    grads = rendered.backward(d)
    (truth.image * d).sum().backward()
    for name, leaf in parameters.items():
        actual = getattr(grads, name)
        assert torch.isfinite(actual).all(), name
        # Row by row: magnitudes differ by twenty orders between these Gaussians.
        for i in range(10):
            expected = leaf.grad[i]
            bound = 2e-3 * expected.abs().max() + 1e-3
            assert (actual[i] - expected).abs().max() <= bound, (name, i)


def test_a_stack_of_ten_thousand_on_one_pixel():
    n = 10_000
    g = gaussians(0, n=n, rest=0)
    g.means[:] = torch.tensor([0.0, 0.0, 3.0])
    g.means[:, 2] += torch.linspace(0, 1, n)
    g.log_scales[:] = -4.0
    for logit in (4.5951, -5.3):  # opacity 0.99 and just above 1/255
        g.opacity_logits[:] = logit
        rendered = render_cpu(g, Camera(5, 5, 30.0, 30.0, 2.5, 2.5, np.eye(4)), sh_degree=0)
        assert rendered.alpha.min() >= 0
        assert rendered.alpha.max() <= 1
        grads = rendered.backward(Cotangents(torch.ones(5, 5, 3), alpha=torch.ones(5, 5)))
        for name in NAMES:
            assert torch.isfinite(getattr(grads, name)).all()


_BITS = """
import dataclasses, hashlib
import torch
from ambiguous_wild.splat.cpu import set_threads
from ambiguous_wild.splat.cpu.cpu_render import render_cpu
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import NEEDS
from tests.splat.scenes import camera, cotangents, gaussians, given

for n in (1, 2, 4):
    set_threads(n)
    g, cam = gaussians(11, n=3000, size=-2.5), camera(70, 45, fx=60.0, fy=60.0)
    optimiser = SplatAdam(g, {name: 1e-3 for name, _ in g.items()})
    digest = hashlib.sha256()
    for _ in range(3):
        rendered = render_cpu(g, cam)
        d = cotangents(cam.height, cam.width)
        loss = photometric(rendered.image, d.pop("d_image"), d["d_alpha"].abs())
        grads = rendered.backward(given(d | {"d_image": loss.d_image}), frozenset(NEEDS))
        optimiser.step(grads, rendered.visible)
        parts = [rendered.image, rendered.alpha, rendered.depth, rendered.radii, loss.d_image]
        values = [getattr(grads, f.name) for f in dataclasses.fields(grads)]
        parts += [v for v in values if isinstance(v, torch.Tensor)] + [t for _, t in g.items()]
        for part in parts:
            digest.update(part.numpy().tobytes())
        digest.update(str((loss.value, loss.l1, loss.dssim)).encode())
    print(digest.hexdigest())
"""


def test_same_bits_for_one_two_and_four_threads():
    root = Path(__file__).parents[2]
    environment = os.environ | {"NUMBA_NUM_THREADS": "4", "PYTHONPATH": str(root)}
    done = subprocess.run(
        [sys.executable, "-c", _BITS], env=environment, cwd=root, capture_output=True, text=True, check=True
    )
    digests = done.stdout.split()
    assert len(digests) == 3
    assert len(set(digests)) == 1


def test_screen_abs_sums_magnitudes_over_pixels():
    g, cam = gaussians(13, n=12), camera(20, 18)
    rendered = render_cpu(g, cam)
    d = cotangents(cam.height, cam.width)["d_image"]
    total = torch.zeros(12, 2, dtype=torch.float64)
    for y in range(cam.height):
        for x in range(cam.width):
            one = torch.zeros_like(d)
            one[y, x] = d[y, x]
            total += rendered.backward(one).screen.double().abs()
    grads = rendered.backward(d, frozenset({"absolute"}))
    close("screen_abs", grads.screen_abs, total, 1e-5)
    assert (grads.screen_abs - grads.screen.abs()).min() > -1e-5


def test_results_held_by_the_caller_never_change():
    g, cam = gaussians(14), camera()
    rendered = render_cpu(g, cam)
    grads = rendered.backward(torch.ones_like(rendered.image))
    image, rest = rendered.image.clone(), grads.sh_rest.clone()
    for seed in range(5):
        other = render_cpu(gaussians(seed), cam)
        other.backward(torch.randn_like(other.image))
    assert torch.equal(rendered.image, image)
    assert torch.equal(grads.sh_rest, rest)
    again = rendered.backward(torch.ones_like(rendered.image))
    assert torch.equal(again.sh_rest, rest)


def test_radii_are_the_longest_half_axis_of_the_contour():
    g = gaussians(0, n=1)
    g.means[0] = torch.tensor([0.0, 0.0, 2.0])
    g.log_scales[:] = torch.log(torch.tensor([0.3, 0.1, 0.1]))
    g.quats[0] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    g.opacity_logits[:] = 0.0
    rendered = render_cpu(g, Camera(64, 64, 40.0, 40.0, 32.0, 32.0, np.eye(4)))
    expected = np.sqrt(2 * np.log(255 / 2) * ((0.3 * 20) ** 2 + 0.3))
    assert rendered.radii[0].item() == pytest.approx(expected, rel=1e-5)


def test_wrong_shapes_and_degrees_are_named():
    g, cam = gaussians(rest=3), camera()
    with pytest.raises(AwError, match="sh_degree must be 0 to 1"):
        render_cpu(g, cam, sh_degree=3)
    rendered = render_cpu(g, cam, sh_degree=1)
    with pytest.raises(AwError, match="d_image must be"):
        rendered.backward(torch.zeros(3, 3, 3))
    with pytest.raises(AwError, match="d_depth must be"):
        rendered.backward(Cotangents(depth=torch.zeros(2, 2)))


@pytest.mark.parametrize("far", [1e18, 1e20, 1e30, 1e38])
@pytest.mark.parametrize("log_scale", [0.0, 30.0, 60.0])
def test_gaussians_farther_out_than_any_whole_number_of_pixels_are_culled(far, log_scale):
    good, cam = gaussians(7, n=20), camera()
    bad = gaussians(8, n=5)
    forward = torch.from_numpy(cam.cam_from_world[2, :3].astype(np.float32))
    sideways = torch.from_numpy(cam.cam_from_world[0, :3].astype(np.float32))
    upwards = torch.from_numpy(cam.cam_from_world[1, :3].astype(np.float32))
    for row, way in enumerate((sideways, -sideways, upwards, -upwards, sideways + upwards)):
        bad.means[row] = 4.0 * forward + far * way
    bad.log_scales[:] = log_scale
    rendered = render_cpu(good.cat(bad), cam)
    assert torch.isfinite(rendered.image).all()
    if log_scale == 0.0:
        assert torch.equal(rendered.image, render_cpu(good, cam).image)
