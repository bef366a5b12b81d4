"""Merging on a device against merging on the host: neighbours, pairs, couples, moments."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from ambiguous_wild.methods.refinesplat import merging
from ambiguous_wild.methods.refinesplat.merging import MergeConfig
from ambiguous_wild.methods.refinesplat.on_device import merging as there
from ambiguous_wild.splat import device as devices
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.gpu import nearest


def cloud(count, seed=0, spread=1.0, size=-2.0):
    rng = np.random.default_rng(seed)
    g = Gaussians.from_points(rng.normal(size=(count, 3)) * spread, np.full((count, 3), 120, np.uint8))
    g.quats[:] = torch.from_numpy(rng.normal(size=(count, 4)).astype(np.float32))
    g.log_scales[:] = torch.from_numpy((size + 0.6 * rng.normal(size=(count, 3))).astype(np.float32))
    g.opacity_logits[:] = torch.from_numpy(rng.normal(size=count).astype(np.float32))
    g.sh0 += torch.from_numpy(0.1 * rng.normal(size=(count, 3)).astype(np.float32))
    g.sh_rest[:] = torch.from_numpy(rng.normal(size=tuple(g.sh_rest.shape)).astype(np.float32))
    return g


@pytest.mark.parametrize("kind", ["even", "clustered", "line", "plane", "outlier", "few"])
def test_neighbours_are_those_of_a_tree(kind, monkeypatch):
    rng = np.random.default_rng(1)
    count = 7 if kind == "few" else 3000
    xyz = rng.normal(size=(count, 3)).astype(np.float32)
    if kind == "clustered":
        xyz = (xyz * 0.01 + rng.integers(0, 9, (count, 1)) * np.array([10.0, 3.0, 0.0])).astype(np.float32)
    if kind == "line":
        xyz[:, 1:] = 2.0
    if kind == "plane":
        xyz[:, 2] = 0.5
    if kind == "outlier":
        xyz[count // 3] = 1e5
    monkeypatch.setattr(nearest, "BOX", 32)  # many boxes, so that the first look is not enough for all
    found = nearest.nearest(torch.from_numpy(xyz), min(9, count)).numpy()
    distances = np.linalg.norm(xyz[:, None].astype(float) - xyz[found], axis=2)
    expected = cKDTree(xyz.astype(float)).query(xyz.astype(float), k=min(9, count))[0]
    np.testing.assert_allclose(distances, expected, rtol=1e-4, atol=1e-6 * np.abs(xyz).max())
    assert all(len(set(row)) == len(row) for row in found.tolist())


def test_coincident_points_have_neighbours(monkeypatch):
    monkeypatch.setattr(nearest, "BOX", 16)
    points = torch.zeros(100, 3)
    points[50:] = torch.rand(50, 3) + 5
    found = nearest.nearest(points, 9)
    assert int(found.min()) >= 0 and int(found.max()) < 100
    assert (found[:50] < 50).all()


@pytest.mark.parametrize("form", ["normalised", "literal"])
@pytest.mark.parametrize("seed", range(3))
def test_pairs_are_those_of_the_host(form, seed):
    g = cloud(600, seed)
    candidates = torch.from_numpy(np.random.default_rng(seed).random(600) < 0.8)
    config = MergeConfig(form=form, overlap=0.2, colour=0.3)
    expected = merging.merge_pairs(g, candidates.numpy(), config)
    found = there.merge_pairs(g, candidates, config).numpy()
    assert len(expected) > 50
    np.testing.assert_array_equal(found, expected)


def test_needles_and_scales_overlap_as_on_the_host():
    g = cloud(400, 4)
    g.log_scales[:200] += torch.tensor([0.0, -9.0, -9.0])  # aspect 1e4
    g.means[1::2] = g.means[::2] + 0.01 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    pairs = torch.arange(400).view(-1, 2)
    for factor in (1e-3, 1.0, 1e3):
        scaled = g.clone()
        scaled.means *= factor
        scaled.log_scales += np.log(factor)
        cov = merging.covariances(scaled)
        delta = scaled.means[::2].double().numpy() - scaled.means[1::2].double().numpy()
        expected = merging.overlap(delta, cov[::2], cov[1::2])
        found = there.overlap(scaled, pairs, "normalised").numpy()
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_couples_are_those_that_one_after_the_other_gives(seed):
    rng = np.random.default_rng(seed)
    pairs = np.unique(np.sort(rng.integers(0, 60, (200, 2)), 1), axis=0)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    rng.shuffle(pairs)
    cluster = merging.clusters(60, pairs, 2)
    taken = there.matching(60, torch.from_numpy(pairs)).numpy()
    assert taken.sum() > 10
    expected = [bool(cluster[i] == cluster[j]) for i, j in pairs.tolist()]
    assert taken.tolist() == expected


def test_merged_moments_are_those_of_the_host():
    g = cloud(200, 5)
    couples = torch.arange(200).view(-1, 2)
    expected = merging.merge_members(g, np.repeat(np.arange(100), 2))
    found = there.merge(g.select(couples[:, 0]), g.select(couples[:, 1]))
    for name in ("means", "log_scales", "opacity_logits", "sh0", "sh_rest"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(
        merging.covariances(found), merging.covariances(expected), rtol=1e-4, atol=1e-7
    )


def test_a_round_on_an_accelerator_merges_what_the_host_merges(monkeypatch):
    from types import SimpleNamespace

    from ambiguous_wild.methods.refinesplat.density import EntropyAwareDensity, EntropyDensityConfig
    from ambiguous_wild.splat.optim import SplatAdam

    results = []
    for on_device in (False, True):
        g = cloud(300, 6)
        rates = dict.fromkeys(("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest"), 1e-3)
        density = EntropyAwareDensity(EntropyDensityConfig(), 1.0, 0)
        optimiser = SplatAdam(g, rates)
        density._match(g)
        density.seen += 1
        step = SimpleNamespace(nominal=5000.0, iteration=5000, gaussians=g)
        density.log.begin(5000)
        with monkeypatch.context() as patch:
            patch.setattr(devices, "accelerated", lambda device, on=on_device: on)
            results.append((density.after_growth(step, g, optimiser), density))
    (host, one), (device, two) = results
    assert one.merged == two.merged > 20 and len(host) == len(device) == 300 - one.merged
    # the same rows are left, and the new ones are the same in some order
    order = [torch.argsort(g.means[:, 0]) for g in (host, device)]
    torch.testing.assert_close(host.means[order[0]], device.means[order[1]], rtol=1e-5, atol=1e-6)
    assert len(two.grad_sum) == len(device)
