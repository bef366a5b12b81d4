"""Parameters drawn wide: 1e-12 to 1e12 of either sign, denormals, infinities and NaN where they can enter.

What comes out is finite, or an error with a name. Examples are derandomised: the same ones in every run.
"""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.methods.refinesplat.merging import covariances, merge_members, scale_rotation
from ambiguous_wild.methods.refinesplat.recipe import consistency_loss
from ambiguous_wild.methods.refinesplat.threshold import (
    cross_entropy,
    entropy,
    instance_stats,
    kl_divergence,
    t_ent,
    updated_theta,
)
from ambiguous_wild.metrics.image import psnr, ssim, ssim_inria
from ambiguous_wild.metrics.stats import mean, mean_interval, paired_interval, sample_std
from ambiguous_wild.splat.cpu.cpu_render import render_cpu
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.optim import SplatAdam

FEW = settings(max_examples=60, derandomize=True, deadline=None, database=None)

exponents = st.floats(-12, 12)
magnitudes = exponents.map(lambda e: 10.0**e)
wide = st.builds(lambda m, s: m * s, magnitudes, st.sampled_from([-1.0, 1.0])) | st.just(0.0)
denormal = st.sampled_from([1e-40, -1e-44, 1.4e-45])
broken = st.sampled_from([math.inf, -math.inf, math.nan, 3.4e38])
anything = wide | wide | wide | denormal | broken  # weights: mostly sound


def vector(n, elements=anything):
    return st.lists(elements, min_size=n, max_size=n)


@st.composite
def gaussian(draw, elements=anything):
    """One Gaussian; log-scales of 1e-12 to 1e12 units, or broken."""
    scales = draw(vector(3, magnitudes.map(math.log) | st.floats(-5, 0) | broken))
    in_view = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(2, 4)).map(list)
    short = st.floats(-45, -20).map(lambda e: [0.6 * 10**e, 10**e, -0.3 * 10**e, 0.0])
    values = {
        "means": draw(vector(3, elements) | in_view),
        "quats": draw(vector(4, elements) | short),
        "log_scales": scales,
        "opacity_logits": draw(elements | st.floats(-5, 5)),
        "sh0": draw(vector(3, elements)),
        "sh_rest": draw(vector(9, elements)),
    }
    tensors = {name: torch.tensor([value], dtype=torch.float32) for name, value in values.items()}
    tensors["sh_rest"] = tensors["sh_rest"].reshape(1, 3, 3)
    return Gaussians(**tensors)


@FEW
@given(gaussian(), magnitudes | st.just(20.0), st.floats(-1e4, 1e4) | st.just(4.5), st.booleans())
def test_a_gaussian_is_drawn_or_culled_and_what_it_learns_is_finite(g, focal, centre, antialias):
    # a sound one lies in view beside it, so that something is drawn and must not be harmed
    sound = Gaussians(
        torch.tensor([[0.0, 0.0, 3.0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), -1.0),
        torch.zeros(1), torch.zeros(1, 3), torch.zeros(1, 3, 3),
    )  # fmt: skip
    both = g.cat(sound)
    camera = Camera(9, 7, focal, focal, centre, 3.5, np.eye(4))
    rendered = render_cpu(both, camera, sh_degree=1, antialias=antialias)
    for name in ("image", "alpha", "depth", "radii"):
        assert torch.isfinite(getattr(rendered, name)).all(), name
    assert rendered.alpha.min() >= 0
    assert rendered.alpha.max() <= 1
    gradients = rendered.backward(torch.full((7, 9, 3), 1e-3))
    rates = {name: 1e-3 for name, _ in both.items()}
    for name in rates:
        assert torch.isfinite(getattr(gradients, name)).all(), name
    optimiser = SplatAdam(both, rates)
    finite = {name: torch.isfinite(t) for name, t in both.items()}
    optimiser.step(gradients, rendered.visible)
    optimiser.flush()
    for name, tensor in both.items():
        assert torch.isfinite(tensor[finite[name]]).all(), name  # a step breaks nothing that was sound


@FEW
@given(st.lists(vector(4, wide | denormal), min_size=1, max_size=4), st.sampled_from(["sigmoid", "softmax"]))
def test_entropy_lies_in_0_to_1_with_a_finite_gradient(rows, variant):
    logits = torch.tensor(rows, dtype=torch.float32, requires_grad=True)
    h = entropy(logits, variant)
    assert ((h >= 0) & (h <= 1 + 1e-6)).all()
    (gradient,) = torch.autograd.grad(h.sum(), logits)
    assert torch.isfinite(gradient).all()
    other = logits.detach().flip(0)
    assert torch.isfinite(cross_entropy(logits.detach(), other, variant)).all()
    assert (kl_divergence(logits.detach(), other, variant) >= 0).all()


@FEW
@given(
    st.lists(magnitudes | st.sampled_from([0.0, 5e-324, 1e-310]), min_size=1, max_size=12),
    st.floats(0, 1),
    st.sampled_from(["kapur", "literal", "statistics"]),
    st.sampled_from([0.0, 3.0]),
)
def test_a_threshold_is_a_number_and_w2_lies_in_0_to_1(values, w2, form, gate):
    x = np.array(values)
    pool, x = instance_stats(torch.from_numpy(x)), torch.from_numpy(x)
    assert not math.isnan(t_ent(pool, w2, form, gate).threshold)
    theta = torch.zeros((), dtype=torch.float64)
    for _ in range(3):
        theta = updated_theta(theta, pool, x.flip(0), torch.ones_like(x), torch.zeros_like(theta))
    assert 0 < torch.sigmoid(theta) < 1


@FEW
@given(st.lists(gaussian(wide), min_size=2, max_size=4))
def test_merged_gaussians_are_positive_definite(parts):
    members = parts[0]
    for part in parts[1:]:
        members = members.cat(part)
    members.log_scales[:] = torch.nan_to_num(members.log_scales, 0.0, 27.0, -27.0).clamp(-28, 28)
    merged = merge_members(members, torch.zeros(len(members)).long())
    for name, tensor in merged.items():
        assert torch.isfinite(tensor).all(), name
    assert (merged.log_scales.exp() > 0).all()
    assert merged.quats.norm(dim=1).sub(1).abs().max() < 1e-5


@FEW
@given(vector(3, magnitudes), vector(4, st.floats(-1, 1)))
def test_a_covariance_gives_back_its_scales(scales, quat):
    if np.linalg.norm(quat) < 1e-3 or max(scales) / min(scales) > 1e5:
        return  # beyond it the floor of the smallest eigenvalue is at work
    g = Gaussians(
        torch.zeros(1, 3), torch.tensor([quat], dtype=torch.float32),
        torch.tensor([scales], dtype=torch.float64).log().float(),
        torch.zeros(1), torch.zeros(1, 3), torch.zeros(1, 0, 3),
    )  # fmt: skip
    found, _ = scale_rotation(covariances(g))
    exact = np.sort(g.log_scales.double().numpy())
    # eigenvalues are exact to 1e-16 of the largest, so the smallest to 1e-16 times the ratio squared
    assert np.abs(np.sort(found) - exact).max() < 1e-5


@FEW
@given(st.lists(vector(3, wide), min_size=1, max_size=6))
def test_consistency_is_finite_and_equals_the_double_loop(rows):
    logits = torch.tensor(rows, dtype=torch.float64).clamp(-1e4, 1e4).requires_grad_(True)
    loss = consistency_loss(logits, torch.ones(1, len(rows), dtype=torch.float64))
    (gradient,) = torch.autograd.grad(loss, logits)
    assert torch.isfinite(gradient).all()
    log_s, log_r = torch.nn.functional.logsigmoid(logits), torch.nn.functional.logsigmoid(-logits)
    loop = (
        sum(
            (log_s.exp()[p] * (log_s[p] - log_s[q]) + log_r.exp()[p] * (log_r[p] - log_r[q])).sum()
            for p in range(len(rows))
            for q in range(len(rows))
        )
        / len(rows) ** 2
    )
    assert float(loss.detach()) == pytest.approx(float(loop.detach()), rel=1e-9, abs=1e-9)


def pictures(elements):
    return vector(12 * 3, elements).map(lambda v: np.tile(np.array(v).reshape(12, 1, 3), (1, 12, 1)))


@FEW
@given(pictures(st.floats(0, 1) | denormal.map(abs) | anything), pictures(st.floats(0, 1) | st.just(1.0)))
def test_psnr_and_ssim_are_numbers_or_named(a, b):
    for metric in (psnr, ssim, ssim_inria):
        try:
            value = metric(a, b)
        except AwError as error:
            assert "outside [0, 1]" in str(error)
            assert not ((a >= 0) & (a <= 1)).all()
            continue
        assert value == math.inf or (math.isfinite(value) and value > -2)


@FEW
@given(pictures(st.floats(-10, 10) | wide), st.sampled_from(["map", "images"]))
def test_the_loss_of_any_render_is_finite(render, weighting):
    drawn = torch.from_numpy(np.ascontiguousarray(render, np.float32))
    found = photometric(drawn, torch.full((12, 12, 3), 0.5), weighting=weighting)
    assert math.isfinite(found.value)
    assert torch.isfinite(found.d_image).all()


@FEW
@given(st.lists(anything.filter(lambda v: v != 3.4e38) | st.none(), max_size=8))
def test_an_interval_is_ordered_missing_or_named(values):
    try:
        found = mean_interval(values)
    except AwError:
        assert not values
        return
    numbers = [math.nan if v is None else v for v in values]
    if any(map(math.isnan, numbers)):
        assert math.isnan(found.mean)
        assert math.isnan(found.low)
    elif all(map(math.isfinite, numbers)):
        assert math.isfinite(found.mean)
        assert len(values) == 1 or found.low <= found.high
    assert math.isnan(mean(values)) or not any(map(math.isnan, numbers))
    assert not sample_std(values) < 0
    assert paired_interval(values, values).count == len(values)
