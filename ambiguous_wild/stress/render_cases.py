"""Render cases: projection, blending and their gradients."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians
from ambiguous_wild.splat.reference import render_reference
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.rendered import Cotangents
from ambiguous_wild.stress.case import (
    FAST_MATH,
    UNIT,
    CaseResult,
    agree,
    camera,
    case,
    cloud,
    device_result,
    failed_checks,
    float64_result,
    stacked_gaussians,
    worst,
)

BOTH = ("cpu", "cuda")


def _others_unchanged(bad: Gaussians, device: str) -> CaseResult:
    """Check that 20 valid Gaussians have the same image and gradients with and without the invalid ones.

    They must agree bit for bit; on a GPU up to rounding, since its sums have no fixed order.
    """
    good, cam = cloud(20, 7), camera()
    bad = dataclasses.replace(bad, sh_rest=torch.zeros(len(bad), good.sh_rest.shape[1], 3))
    d_image = torch.ones(cam.height, cam.width, 3)
    alone = device_result(good, cam, device, d_image, sh_degree=1)
    both = device_result(good.cat(bad), cam, device, d_image, sh_degree=1)
    checks = {"picture": torch.equal(alone["image"], both["image"])}
    for name in PARAMETERS:
        gradient = both[f"d_{name}"]
        checks[f"{name} of the valid"] = _same(gradient[:20], alone[f"d_{name}"], device)
        checks[f"{name} of the culled is 0"] = not bool(gradient[20:].any())
    return failed_checks(checks, "culled, zero gradient, others unchanged")


def _same(a: torch.Tensor, b: torch.Tensor, device: str) -> bool:
    if backend_of(device).same_bits:
        return torch.equal(a, b)
    # sums over up to 21 x 17 pixels in another order
    return bool(((a - b).abs() <= 21 * 17 * UNIT * b.abs().max()).all())


@case(1, "at or behind the near plane, at the camera, at 1e6", devices=BOTH)
def near_plane(device: str) -> CaseResult:
    bad = stacked_gaussians(4)
    bad.means[0] = torch.tensor([0.0, 0.0, 0.0099])
    bad.means[1] = torch.tensor([0.0, 0.0, -3.0])
    bad.means[2] = torch.tensor([1e6, 0.0, 1.0])
    bad.means[3] = 0.0
    return _others_unchanged(bad, device)


@case(1, "just in front of the near plane", devices=BOTH)
def in_front_of_near_plane(device: str) -> CaseResult:
    g = stacked_gaussians(1, depth=0.0101)
    g.means[0, :2] = torch.tensor([1e-4, -1e-4])
    g.log_scales[:] = torch.log(torch.tensor([1e-3, 7e-4, 5e-4]))
    return agree(g, camera(), device, "drawn as in float64", sh_degree=0)


@case(1, "parameters that are no numbers")
def not_finite(device: str) -> CaseResult:
    bad = stacked_gaussians(9)
    bad.means[0, 0], bad.means[1, 1] = math.nan, math.inf
    bad.quats[2], bad.quats[3, 2] = 0.0, math.nan
    bad.log_scales[4, 0], bad.log_scales[5, 0] = math.nan, math.inf
    bad.opacity_logits[6], bad.sh0[7, 1], bad.sh0[8, 2] = math.nan, math.nan, math.inf
    return _others_unchanged(bad, device)


def _each_alone(device: str, expected: str, *changes: dict[str, object]) -> CaseResult:
    """Apply each change to a single Gaussian, so that no other Gaussian hides its error."""
    parts = []
    for change in changes:
        g = stacked_gaussians()
        for name, value in change.items():
            getattr(g, name)[0] = torch.as_tensor(value, dtype=torch.float32)
        parts.append(agree(g, camera(), device, expected, sh_degree=0))
    return worst(parts)


@case(2, "scales of 1e-8 and 1e4", devices=BOTH)
def scales(device: str) -> CaseResult:
    small, large = [math.log(1e-8)] * 3, [math.log(1e4)] * 3
    faint = -4.0  # at scale 1e4 it covers every pixel
    return _each_alone(
        device,
        "conic finite and positive, as in float64",
        {"log_scales": small},
        {"log_scales": large, "opacity_logits": faint},
    )


@case(2, "needle and pancake of aspect 1e6")
def aspect(device: str) -> CaseResult:
    needle = np.log([1.0, 1e-6, 1e-6])
    pancake = np.log([1.0, 1.0, 1e-6])
    return _each_alone(
        device,
        "conic finite and positive, as in float64",
        {"log_scales": needle},
        {"log_scales": pancake},
        {"log_scales": np.log([1e3, 1e-3, 1e-3]), "means": [0.4, 0.2, 4.0]},
    )


@case(3, "quaternions of norm 1e-12 and 1e6", devices=BOTH)
def quaternions(device: str) -> CaseResult:
    q = np.array([0.8, 0.3, -0.4, 0.2])
    long = {"log_scales": np.log([0.5, 0.05, 0.2])}
    return _each_alone(
        device,
        "the image does not depend on the norm",
        {"quats": 1e-12 * q, **long},
        {"quats": 1e6 * q, **long},
    )


@case(3, "a quaternion so short that its gradient would overflow")
def quaternion_denormal(device: str) -> CaseResult:
    bad = stacked_gaussians(2)
    bad.quats[0] *= 1e-31
    bad.quats[1] *= 1e-42  # denormal
    return _others_unchanged(bad, device)


@case(3, "logits of 40 either way, colours far outside 0 to 1", devices=BOTH)
def logits_and_colours(device: str) -> CaseResult:
    return _each_alone(
        device,
        "as in float64; colours below 0 become 0, with gradient 0",
        {"opacity_logits": -40.0},
        {"sh0": [1e4, -1e4, 50.0]},
        {"sh0": [-1e6, 1e6, 0.0]},
    )


@case(3, "a logit of 40 meets the alpha clamp", devices=BOTH)
def logit_clamped(device: str) -> CaseResult:
    clamp = backend_of(device).max_alpha(device)
    return _each_alone(device, f"alpha {clamp}, no gradient where clamped", {"opacity_logits": 40.0})


@case(4, "10 000 on one pixel", devices=BOTH)
def stack(device: str) -> CaseResult:
    n = 10_000
    g = stacked_gaussians(n)
    g.means[:, 2] = 3.0 + torch.linspace(0, 1, n)
    g.log_scales[:] = -4.0
    checks = {}
    for logit in (4.5951, -5.3):  # opacity 0.99, and just above 1/255
        g.opacity_logits[:] = logit
        cam = Camera(5, 5, 30.0, 30.0, 2.5, 2.5, np.eye(4))
        rendered = render(g.to(device), cam, sh_degree=0)
        grads = rendered.backward(
            Cotangents(torch.ones(5, 5, 3, device=device), alpha=torch.ones(5, 5, device=device))
        )
        checks[f"alpha in [0, 1] at {logit}"] = bool(((rendered.alpha >= 0) & (rendered.alpha <= 1)).all())
        for name in PARAMETERS:
            finite = torch.isfinite(getattr(grads, name)).all()
            checks[f"{name} at {logit}"] = bool(finite)
    return failed_checks(checks, "transmittance never negative, gradients finite")


@case(4, "opacity 0.99 stacked 1000 deep", devices=BOTH)
def opaque_stack(device: str) -> CaseResult:
    g = stacked_gaussians(1000)
    g.means[:, 2] = 3.0 + 0.001 * torch.arange(1000)
    g.opacity_logits[:] = math.log(0.99 / 0.01) - 1e-3  # just below the clamp
    g.log_scales[:] = 2.0
    # two layers at the clamp leave a transmittance of 1e-4, where a pixel stops: at most three are drawn
    expected = "as in float64, though backward divides by 1 - alpha"
    return agree(g, camera(2, 2), device, expected, layers=3, sh_degree=0)


@case(5, "pictures of 1x1, 1xN, no multiple of the tile", devices=BOTH)
def sizes(device: str) -> CaseResult:
    shapes = ((1, 1), (1, 40), (40, 1), (16, 16), (17, 33))
    parts = [
        agree(cloud(12, 4), camera(*shape), device, "as in float64", sh_degree=1, background=(0.1, 0.5, 0.9))
        for shape in shapes
    ]
    return worst(parts)


@case(5, "nothing to draw, and one over all", devices=BOTH)
def nothing(device: str) -> CaseResult:
    cam, background = camera(), (0.1, 0.5, 0.9)
    plain = torch.tensor(background).expand(cam.height, cam.width, 3)
    behind = stacked_gaussians(3)
    behind.means[:, 2] = -5.0
    checks = {}
    for name, g in (
        ("no Gaussian", stacked_gaussians(3).select(torch.zeros(3, dtype=torch.bool))),
        ("none seen", behind),
    ):
        rendered = render(g.to(device), cam, sh_degree=0, background=background)
        checks[f"{name}: background"] = torch.equal(rendered.image.cpu(), plain)
        grads = rendered.backward(torch.ones_like(rendered.image))
        checks[f"{name}: no gradient"] = not any(bool(getattr(grads, k).any()) for k, _ in g.items())
    whole = stacked_gaussians()
    whole.log_scales[:], whole.opacity_logits[:] = 5.0, 2.0
    alpha = render(whole.to(device), cam, sh_degree=0).alpha
    checks["one over all"] = bool((alpha - torch.sigmoid(torch.tensor(2.0))).abs().max() < 1e-3)
    return failed_checks(
        checks, "the background and no gradient; or the opacity of the one Gaussian everywhere"
    )


@case(6, "principal point outside, focal lengths of 1 and 1e5 px, the frustum clamp", devices=BOTH)
def cameras(device: str) -> CaseResult:
    parts = []
    for cx, cy in ((-100.0, 5.0), (300.0, 300.0)):
        g = cloud(20, 4)
        g.log_scales += 1.5
        parts.append(agree(g, Camera(24, 20, 30.0, 33.0, cx, cy, np.eye(4)), device, "", sh_degree=1))
    wide = cloud(30, 5)
    parts.append(agree(wide, Camera(20, 16, 8.0, 8.0, 10.0, 8.0, np.eye(4)), device, "", sh_degree=1))
    parts.append(agree(wide, Camera(20, 20, 1.0, 1.0, 10.0, 10.0, np.eye(4)), device, "", sh_degree=1))
    tele = cloud(20, 6)
    tele.means[:, :2] *= 1e-4
    tele.log_scales -= 8
    parts.append(agree(tele, Camera(20, 20, 1e5, 1e5, 10.0, 10.0, np.eye(4)), device, "", sh_degree=1))
    return dataclasses.replace(worst(parts), expected="as in float64")


@case(7, "gradients against finite differences, on both sides of clamp, cut and stop", devices=BOTH)
def finite_differences(device: str) -> CaseResult:
    """Central differences of the float64 image, so that no implemented derivative is trusted."""
    parts = []
    for opacity in (0.9899, 0.9901, 0.9989, 0.9991, 0.999 / 255, 1.001 / 255, 0.8999, 0.9003, 0.5):
        g = stacked_gaussians(4, rest=3)
        g.log_scales[:] = torch.tensor([1.0, 1.2, 0.9])
        g.opacity_logits[:] = math.log(opacity / (1 - opacity))
        g.sh_rest[:] = 0.05
        parts.append(_against_differences(g, Camera(4, 3, 30.0, 33.0, 2.2, 1.4, np.eye(4)), device))
    return worst(parts)


def _against_differences(g: Gaussians, cam: Camera, device: str) -> CaseResult:
    rng, step = np.random.default_rng(0), 1e-6
    d_image = torch.from_numpy(rng.normal(size=(cam.height, cam.width, 3)).astype(np.float32))
    parameters = {name: tensor.double() for name, tensor in g.items()}
    clamp = backend_of(device).max_alpha(device)
    actual = device_result(g, cam, device, d_image, sh_degree=1)
    exact = float64_result(parameters, cam, d_image, sh_degree=1, max_alpha=clamp)
    worst_error, scale = 0.0, max(float(exact[f"d_{name}"].abs().max()) for name in parameters) + 1e-3
    for name, tensor in parameters.items():
        direction = torch.from_numpy(rng.normal(size=tensor.shape))
        sides = []
        for sign in (1.0, -1.0):
            moved = parameters | {name: tensor + sign * step * direction}
            image = render_reference(moved, cam, sh_degree=1, max_alpha=clamp).image
            sides.append(float((image * d_image.double()).sum()))
        numeric = (sides[0] - sides[1]) / (2 * step)
        worst_error = max(worst_error, abs(float((actual[f"d_{name}"] * direction).sum()) - numeric) / scale)
    terms = sum(t.numel() for t in parameters.values())
    # 96 + 6 N roundings of float32, times the terms of a directional derivative; h^2 and 1e-16 / h vanish
    tolerance = (96 + 6 * len(g)) * terms * UNIT * FAST_MATH
    return CaseResult(worst_error, tolerance, "roundings x terms of a derivative", "the same slope", None)
