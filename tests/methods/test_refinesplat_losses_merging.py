"""Consistency, identity loss and merging: rows 17 and 19 to 21 of the hard cases."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from ambiguous_wild.core import AwError
from ambiguous_wild.methods.refinesplat.merging import (
    MergeConfig,
    clusters,
    covariances,
    merge_members,
    merge_pairs,
    overlap,
)
from ambiguous_wild.methods.refinesplat.recipe import consistency_loss, identity_loss, instance_matrix
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians


def double_loop(logits: torch.Tensor, variant: str) -> float:
    """mean over pairs of KL, written as printed."""
    if variant == "sigmoid":
        s, log_s, log_r = torch.sigmoid(logits), F.logsigmoid(logits), F.logsigmoid(-logits)
        one = (s[:, None] * (log_s[:, None] - log_s[None])).sum(2)
        two = ((1 - s)[:, None] * (log_r[:, None] - log_r[None])).sum(2)
        return float((one + two).mean())
    p, log_p = torch.softmax(logits, 1), F.log_softmax(logits, 1)
    return float((p[:, None] * (log_p[:, None] - log_p[None])).sum(2).mean())


@pytest.mark.parametrize("variant", ["sigmoid", "softmax"])
@pytest.mark.parametrize("n", [1, 2, 500])
def test_closed_form_equals_the_double_loop(n, variant):
    logits = 3 * torch.randn(n, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(n))
    value = float(consistency_loss(logits, torch.ones(1, n, dtype=torch.float64), variant))
    assert value == pytest.approx(double_loop(logits, variant), rel=1e-6, abs=1e-12)


def test_consistency_is_a_mean_over_instances_that_have_cells():
    logits = torch.randn(9, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    labels = torch.tensor([1, 1, 1, 1, 3, 3, 3, 0, 0])
    member = instance_matrix(labels, 4).double()
    expected = (double_loop(logits[:4], "sigmoid") + double_loop(logits[4:7], "sigmoid")) / 2
    assert float(consistency_loss(logits, member)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("variant", ["sigmoid", "softmax"])
def test_consistency_of_saturated_logits_is_finite(variant):
    logits = torch.tensor([[1e4, -1e4], [-1e4, 1e4], [1e30, 0.0]], requires_grad=True)
    loss = consistency_loss(logits, torch.ones(1, 3), variant)
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(logits.grad).all()
    nothing = consistency_loss(logits, torch.zeros(2, 3), variant)
    assert float(nothing.detach()) == 0.0


@pytest.mark.parametrize("variant", ["sigmoid", "softmax"])
def test_identity_loss_against_torch(variant):
    logits = torch.randn(12, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ids = torch.tensor([0, 1, 2, 3, 4, 5, 1, 1, 0, 5, 2, 3])
    keep = torch.tensor([1, 1, 0, 1, 1, 1, 1, 0, 1, 1, 1, 1.0], dtype=torch.float64)
    used = (ids > 0) & (keep > 0)
    if variant == "sigmoid":
        target = F.one_hot(ids[used] - 1, 5).double()
        expected = F.binary_cross_entropy_with_logits(logits[used], target, reduction="none").sum(1).mean()
    else:
        expected = F.cross_entropy(logits[used], ids[used] - 1)
    assert float(identity_loss(logits, ids, keep, variant)) == pytest.approx(float(expected), rel=1e-9)
    assert float(identity_loss(logits, ids, torch.zeros(12).double(), variant)) == 0.0


# -- merging ------------------------------------------------------------------------------------------


def cloud(n: int, seed: int, spread: float = 1.0, scale: float = 0.3) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=g) * spread,
        quats=torch.randn(n, 4, generator=g),
        log_scales=torch.randn(n, 3, generator=g) * 0.5 + float(np.log(scale)),
        opacity_logits=torch.randn(n, generator=g),
        sh0=torch.randn(n, 3, generator=g) * 0.05,
        sh_rest=torch.randn(n, 3, 3, generator=g) * 0.01,
    )


def scaled(g: Gaussians, factor: float) -> Gaussians:
    out = g.clone()
    out.means *= factor
    out.log_scales += float(np.log(factor))
    return out


def line(positions, sigma: float = 1.0) -> Gaussians:
    n = len(positions)
    means = torch.zeros(n, 3)
    means[:, 0] = torch.tensor(positions)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        log_scales=torch.full((n, 3), float(np.log(sigma))),
        opacity_logits=torch.zeros(n),
        sh0=torch.zeros(n, 3),
        sh_rest=torch.zeros(n, 0, 3),
    )


def test_overlap_of_identical_gaussians_is_one_and_of_others_less():
    g = cloud(40, 0)
    cov = covariances(g)
    assert torch.allclose(overlap(torch.zeros(40, 3).double(), cov, cov), torch.ones(40).double())
    delta = g.means.double() - g.means.double().flip(0)
    other = overlap(delta, cov, cov.flip(0))
    assert ((other >= 0) & (other <= 1)).all()
    # against the integral it stands for, sqrt(N_i N_j) up to the covariances' sum: by quadrature in 1-D form
    expected = np.exp(-0.5 * 4.0 / 2.0)
    unit = torch.eye(3, dtype=torch.float64)[None]
    assert float(overlap(torch.tensor([[2.0, 0, 0]]).double(), unit, unit)) == pytest.approx(expected)


def test_the_printed_overlap_depends_on_the_scale_of_the_scene():
    unit, d = torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64)
    assert overlap(d, unit, unit, "literal")[0] < 0.3 < overlap(d, unit * 1e-6, unit * 1e-6, "literal")[0]
    assert float(overlap(d, unit * 1e-6, unit * 1e-6)) == pytest.approx(1.0)
    with pytest.raises(AwError, match="normalised"):
        overlap(d, unit, unit, "normal")  # type: ignore[arg-type]


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_clusters_do_not_depend_on_the_scale_of_the_scene(factor):
    g = cloud(300, 3, spread=0.7)
    config = MergeConfig(colour=1.0)
    everyone = torch.ones(300, dtype=torch.bool)
    here = {tuple(p) for p in merge_pairs(g, everyone, config).tolist()}
    there = {tuple(p) for p in merge_pairs(scaled(g, factor), everyone, config).tolist()}
    assert len(here) > 20
    assert here == there


def test_merged_moments_are_those_of_the_mixture():
    g = cloud(9, 5)
    cluster = np.array([7, 7, 2, 2, 2, 9, 9, 9, 9])
    merged = merge_members(g, torch.from_numpy(cluster))
    cov, alpha = covariances(g).numpy(), torch.sigmoid(g.opacity_logits).double().numpy()
    means = g.means.double().numpy()
    for row, name in enumerate((2, 7, 9)):
        rows = cluster == name
        w = alpha[rows] / alpha[rows].sum()
        mu = (w[:, None] * means[rows]).sum(0)
        # second moment about the origin, minus the mean's: an order of sums other than the code's
        second = np.einsum("n,nij->ij", w, cov[rows] + means[rows][:, :, None] * means[rows][:, None, :])
        assert np.allclose(merged.means[row], mu, atol=1e-6)
        got = covariances(merged)[row].numpy()
        assert np.allclose(got, second - np.outer(mu, mu), atol=2e-6)
        assert np.linalg.eigvalsh(got).min() > 0
        assert float(torch.sigmoid(merged.opacity_logits[row])) == pytest.approx(alpha[rows].mean(), rel=1e-5)
        sh0 = (w[:, None] * g.sh0.double().numpy()[rows]).sum(0)
        assert np.allclose(merged.sh0[row], sh0, atol=1e-6)


def test_the_printed_sign_would_be_indefinite():
    g = line([0.0, 4.0])
    means = g.means.double().numpy()
    away = means - means.mean(0)
    printed = (covariances(g).numpy() + away[:, :, None] * -away[:, None, :]).mean(0)
    assert np.linalg.eigvalsh(printed).min() < 0
    assert np.linalg.eigvalsh(covariances(merge_members(g, torch.zeros(2).long()))[0]).min() > 0


def test_coincident_orthogonal_needles_stay_positive_definite():
    g = line([0.0, 0.0])
    g.log_scales[:] = torch.log(torch.tensor([[1e3, 1e-4, 1e-4], [1e-4, 1e3, 1e-4]]))
    merged = merge_members(g, torch.zeros(2).long())
    assert torch.isfinite(merged.log_scales).all()
    values = np.linalg.eigvalsh(covariances(merged)[0])
    assert values.min() > 0
    assert values.max() == pytest.approx(0.5e6, rel=1e-4)
    assert not len(merge_pairs(g, torch.ones(2).bool(), MergeConfig()))  # they hardly overlap


def test_identical_gaussians_merge_into_themselves():
    one = cloud(1, 8)
    g = one
    for _ in range(999):
        g = g.cat(one)
    pairs = merge_pairs(g, torch.ones(1000).bool(), MergeConfig(neighbours=999))
    cluster = clusters(1000, pairs)
    assert len(np.unique(cluster)) == 1
    merged = merge_members(g, cluster)
    assert np.allclose(merged.means, one.means, atol=1e-5)
    assert np.allclose(covariances(merged), covariances(one), atol=1e-5)


def test_a_chain_merges_by_union_find_and_not_under_a_limit():
    g = line([0.0, 2.0, 4.0])
    pairs = merge_pairs(g, torch.ones(3).bool(), MergeConfig())
    assert {tuple(p) for p in pairs.tolist()} == {(0, 1), (1, 2)}  # the ends do not overlap
    assert len(np.unique(clusters(3, pairs))) == 1
    assert len(np.unique(clusters(3, pairs, most=2))) == 2


def test_far_apart_or_other_colour_or_other_gradient_does_not_merge():
    assert not len(merge_pairs(line([0.0, 100.0]), torch.ones(2).bool(), MergeConfig()))
    g = line([0.0, 0.1])
    assert len(merge_pairs(g, torch.ones(2).bool(), MergeConfig())) == 1
    assert not len(merge_pairs(g, torch.tensor([True, False]), MergeConfig()))
    g.sh0[1] = 0.2 / SH_C0
    assert not len(merge_pairs(g, torch.ones(2).bool(), MergeConfig()))
