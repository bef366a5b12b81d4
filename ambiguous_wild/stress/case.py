"""A stress test: a measured error, its tolerance, its reason; and renders against the float64 reference.

Changing every parameter by one unit of float32 rounding changes the float64 result by `condition` units. No
float32 renderer can be more accurate. A stable one adds a constant times the number of its operations
(Higham, Accuracy and Stability of Numerical Algorithms, ch. 1): about 16 from parameters to a pixel's
exponent, three for each Gaussian that covers it, as many again for gradients, and the sums over a tile.

On a GPU gsplat is compiled with `-use_fast_math`: an exponential is accurate to 2 + |1.2 x| units, 8 down to
the cut at 1/255, a quotient to 2. It also inverts the blurred covariance by its determinant, a difference
that keeps only (a c - b^2) / (a c) of the digits. Both factors widen its bound. The reference then
uses gsplat's alpha clamp (`Backend.max_alpha`).
"""

from __future__ import annotations

import math
import re
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.config import Facts
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.reference import render_reference
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.rendered import Cotangents

UNIT = 2.0**-24  # relative rounding error of one float32 operation (Higham's u)
REGISTERED: list[Case] = []  # in the order of the files
_DRAWS = 2  # number of random roundings; the largest change is used
FAST_MATH = 8  # largest error of a GPU's exponential, in units


@dataclass(frozen=True)
class CaseResult:
    """The result of one case."""

    error: float  # worst relative error against float64, or the number of failed checks
    tolerance: float
    why: str  # reason for the tolerance
    expected: str  # the correct result
    condition: float | None = None  # condition number: relative change of the result over that of the input


_NOTHING = CaseResult(math.nan, 0.0, "", "")  # of a case that raised an error


@dataclass(frozen=True)
class Case:
    """One case of the table."""

    group: int  # number of the cases of one topic
    name: str
    measure: Callable[[str], CaseResult]  # argument: the device
    devices: tuple[str, ...]  # devices that the case applies to

    @property
    def key(self) -> str:
        return f"{self.group:02d}-{re.sub(r'[^a-z0-9.]+', '-', self.name.lower()).strip('-')}"


@dataclass(frozen=True, kw_only=True)
class StressLine(CaseResult):
    """One line of `aw stress`."""

    key: str
    device: str
    failure: str = ""  # the error, if the case raised one

    @property
    def passed(self) -> bool:
        return not self.failure and self.error <= self.tolerance  # false for NaN

    def plain(self) -> Facts:
        """Return plain data for JSON, with None for NaN and infinity."""
        measured = {field.name: getattr(self, field.name) for field in fields(CaseResult)}
        facts = {"key": self.key, "device": self.device, **measured}
        facts |= {"passed": self.passed, "failure": self.failure}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in facts.items()}


def case(
    group: int, name: str, *, devices: tuple[str, ...] = ("cpu",)
) -> Callable[[Callable[[str], CaseResult]], Case]:
    """Decorate a measuring function: makes a case of it and registers it."""

    def register(measure: Callable[[str], CaseResult]) -> Case:
        REGISTERED.append(Case(group, name, measure, devices))
        return REGISTERED[-1]

    return register


def run(chosen: Case, device: str) -> StressLine:
    """Measure a case; an exception counts as its failure."""
    try:
        return StressLine(**vars(chosen.measure(device)), key=chosen.key, device=device)
    except Exception as error:
        text = str(error) if isinstance(error, AwError) else traceback.format_exc(limit=-2)
        return StressLine(**vars(_NOTHING), key=chosen.key, device=device, failure=text)


def failed_checks(checks: Mapping[str, object], expected: str) -> CaseResult:
    """A case of exact checks: the error is the number of checks that fail; the tolerance is 0."""
    bad = [name for name, holds in checks.items() if not holds]
    why = "exact" + (f"; wrong: {', '.join(bad)}" if bad else f", {len(checks)} checks")
    return CaseResult(float(len(bad)), 0.0, why, expected)


def worst(parts: Iterable[CaseResult]) -> CaseResult:
    """The result with the largest ratio of error to tolerance."""

    def share(m: CaseResult) -> float:
        if m.error != m.error:
            return float("inf")
        return m.error / m.tolerance if m.tolerance > 0 else float("inf") if m.error > 0 else 0.0

    return max(parts, key=share)


def device_result(
    g: Gaussians,
    camera: Camera,
    device: str,
    d_image: Tensor,
    d_alpha: Tensor | None = None,
    d_depth: Tensor | None = None,
    **options: Any,
) -> dict[str, Tensor]:
    """Images and gradients of all parameters from the renderer of `device`, as float64 on the CPU."""
    rendered = render(g.to(device), camera, **options)
    cotangents = Cotangents(
        d_image.to(device),
        alpha=None if d_alpha is None else d_alpha.to(device),
        depth=None if d_depth is None else d_depth.to(device),
    )
    grads = rendered.backward(cotangents)
    results = {f"d_{name}": getattr(grads, name) for name, _ in g.items()}
    results |= {"image": rendered.image, "alpha": rendered.alpha, "depth": rendered.depth}
    return {name: tensor.detach().cpu().double() for name, tensor in results.items()}


def float64_result(
    parameters: dict[str, Tensor],
    camera: Camera,
    d_image: Tensor,
    d_alpha: Tensor | None = None,
    d_depth: Tensor | None = None,
    **options: Any,
) -> dict[str, Tensor]:
    """Return what `device_result` does, from the float64 reference and autograd."""
    leaves = {name: tensor.clone().requires_grad_(True) for name, tensor in parameters.items()}
    truth = render_reference(leaves, camera, **options)
    loss = (truth.image * d_image.double()).sum() + 0.0 * truth.screen.sum()
    for picture, cotangent in ((truth.alpha, d_alpha), (truth.depth, d_depth)):
        if cotangent is not None:
            loss = loss + (picture * cotangent.double()).sum()
    derivatives = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    gradients = {
        f"d_{name}": torch.zeros_like(leaf) if gradient is None else gradient
        for (name, leaf), gradient in zip(leaves.items(), derivatives)
    }
    pictures = {"image": truth.image, "alpha": truth.alpha, "depth": truth.depth}
    return gradients | {name: picture.detach() for name, picture in pictures.items()}


def agree(
    g: Gaussians,
    camera: Camera,
    device: str,
    expected: str,
    *,
    layers: int | None = None,  # most Gaussians over one pixel; None = all
    **options: Any,  # passed to `render`
) -> CaseResult:
    """Return the worst error of images and gradients, relative to their largest values, and its bound."""
    rng = np.random.default_rng(0)
    shapes = [(camera.height, camera.width, 3), (camera.height, camera.width), (camera.height, camera.width)]
    d_image, d_alpha, d_depth = (
        torch.from_numpy(rng.normal(size=shape).astype(np.float32)) for shape in shapes
    )
    parameters = {name: tensor.double() for name, tensor in g.items()}
    clamp = backend_of(device).max_alpha(device)
    truth = float64_result(parameters, camera, d_image, d_alpha, d_depth, max_alpha=clamp, **options)
    condition = 1.0
    for _ in range(_DRAWS):
        moved = {
            name: t * (1 + UNIT * torch.from_numpy(rng.choice([-1.0, 1.0], size=t.shape)))
            for name, t in parameters.items()
        }
        again = float64_result(moved, camera, d_image, d_alpha, d_depth, max_alpha=clamp, **options)
        condition = max(condition, _distance(again, truth) / UNIT)
    error = _distance(device_result(g, camera, device, d_image, d_alpha, d_depth, **options), truth)
    steps = 96 + 6 * (len(g) if layers is None else layers)
    bound, why = steps * condition * UNIT, f"{steps} roundings x condition"
    if not backend_of(device).kernels:
        lost = _lost_by_determinants(parameters, camera, **options)
        bound, why = bound * FAST_MATH * lost, f"{why} x {FAST_MATH} x determinant {lost:.1e}"
    return CaseResult(error, bound, why, expected, condition)


def _lost_by_determinants(parameters: dict[str, Tensor], camera: Camera, **options: Any) -> float:
    """Largest a c / (a c - b^2) of the blurred covariances that are drawn; 1 if all are axis-aligned."""
    truth = render_reference(parameters, camera, **options)
    conic = truth.conic[truth.visible]
    if not len(conic):
        return 1.0
    product = conic[:, 0, 0] * conic[:, 1, 1]
    return max(float((product / torch.linalg.det(conic)).max()), 1.0)


def _distance(a: dict[str, Tensor], b: dict[str, Tensor]) -> float:
    worst = 0.0
    slopes = [truth for name, truth in b.items() if truth.numel() and name.startswith("d_")]
    steepest = max(float(slope.abs().max()) for slope in slopes)
    for name, truth in b.items():
        if truth.numel():
            # a gradient of exactly 0 has no relative error: use a millionth of the largest one
            scale = max(float(truth.abs().max()), 1e-6 * steepest, 1e-30)
            difference = float((a[name] - truth).abs().max()) / scale
            worst = max(worst, difference if difference == difference else float("inf"))
    return worst


def stacked_gaussians(n: int = 1, *, depth: float = 3.0, rest: int = 0) -> Gaussians:
    """n Gaussians of scales 0.37, 0.3 and 0.22 near the axis of `camera`, 0.1 apart in depth."""
    means = torch.zeros(n, 3)
    means[:, 0], means[:, 1] = 0.05, -0.08
    means[:, 2] = depth + 0.1 * torch.arange(n)
    quats = torch.tensor([[0.8, 0.3, -0.4, 0.2]]).repeat(n, 1)
    colours = torch.linspace(0.3, 1.2, 3 * n).reshape(n, 3)
    log_scales = torch.tensor([[-1.0, -1.2, -1.5]]).repeat(n, 1)
    return Gaussians(means, quats, log_scales, torch.full((n,), 0.5), colours, torch.zeros(n, rest, 3))


def camera(width: int = 21, height: int = 17, focal: float = 30.0) -> Camera:
    """A camera at the origin, looking along z."""
    return Camera(width, height, focal, 1.1 * focal, width / 2 + 0.3, height / 2 - 0.2, np.eye(4))


def cloud(n: int, seed: int = 0, *, rest: int = 3) -> Gaussians:
    """Random Gaussians: in view, outside and behind it, opaque and faint, colours above and below 0."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> Tensor:
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    return Gaussians(
        means=normal(n, 3) * torch.tensor([1.5, 1.0, 1.0]) + torch.tensor([0.0, 0.0, 3.0]),
        quats=normal(n, 4),
        log_scales=normal(n, 3) * 0.7 - 1.5,
        opacity_logits=normal(n) * 2,
        sh0=normal(n, 3),
        sh_rest=normal(n, rest, 3) * 0.2,
    )
