"""SpotLessSplats: Ward's clusters, bounds, votes and annealing by hand; density."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.methods.masking_common import annealed, hashed_uniform, sampled
from ambiguous_wild.methods.spotlesssplats import (
    PositionalMaskNet,
    PruningDensity,
    SpotLessDensityConfig,
    positional_encoding,
)
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.vision.segments import ward_clusters
from tests.methods.baselines import data_of, masked_more_inside, parts_of, step_of, trained
from tests.splat.scenes import gaussians
from tests.tiny_scene import TRAIN


def brute_force(grid, count):
    """The same greedy rule, with every touching pair looked at in every round."""
    h, w, _ = grid.shape
    clusters = [[(r, c)] for r in range(h) for c in range(w)]

    def touch(a, b):
        return any(max(abs(p[0] - q[0]), abs(p[1] - q[1])) == 1 for p in a for q in b)

    def spread(cells):
        rows = np.array([grid[cell] for cell in cells])
        return ((rows - rows.mean(0)) ** 2).sum()

    while len(clusters) > count:
        pairs = [(i, j) for i in range(len(clusters)) for j in range(i) if touch(clusters[i], clusters[j])]
        i, j = min(
            pairs,
            key=lambda p: (
                spread(clusters[p[0]] + clusters[p[1]]) - spread(clusters[p[0]]) - spread(clusters[p[1]])
            ),
        )
        clusters[j] += clusters.pop(i)
    return {frozenset(cluster) for cluster in clusters}


@pytest.mark.parametrize("count", [1, 4, 9])
def test_clusters_are_those_of_wards_rule(count):
    grid = np.random.default_rng(count).normal(size=(5, 6, 3))
    labels = ward_clusters(grid, count)
    found = {frozenset(zip(*np.nonzero(labels == k))) for k in range(labels.max() + 1)}
    assert found == brute_force(grid, count) and len(found) == count


def test_annealing_and_sampling_by_hand():
    at = SimpleNamespace(iteration=345, nominal=345.0)
    assert annealed(at, 0.003) == pytest.approx(np.exp(-0.003 * 230))  # the card: 0.5 near step 345
    # a run of 1500 iterations: 20 nominal ones each
    assert annealed(SimpleNamespace(iteration=345, nominal=6900.0), 0.003) == annealed(at, 0.003)
    keep = torch.zeros(200, 200)
    keep[:, :100] = 1.0
    drawn = sampled(keep, 0.3, (0, 7))
    assert drawn[:, :100].all() and float(drawn[:, 100:].mean()) == pytest.approx(0.3, abs=0.01)
    assert torch.equal(drawn, sampled(keep, 0.3, (0, 7))) and not torch.equal(
        drawn, sampled(keep, 0.3, (0, 8))
    )


def test_hashed_numbers_are_uniform_and_do_not_depend_on_their_neighbours():
    u = hashed_uniform(100_000, (3, 5), torch.device("cpu")).double()
    assert u.min() > 0 and u.max() < 1
    shares = torch.histc(u, 20, 0, 1) / len(u)
    assert float((shares - 0.05).abs().max()) < 0.004
    assert abs(float(torch.corrcoef(torch.stack([u[:-1], u[1:]]))[0, 1])) < 0.01
    other = hashed_uniform(100_000, (3, 6), torch.device("cpu")).double()
    assert abs(float(torch.corrcoef(torch.stack([u, other]))[0, 1])) < 0.01


def test_the_net_is_one_layer_on_features_and_place():
    net = PositionalMaskNet(torch.zeros(3), torch.ones(3), 4, seed=0)
    phi = torch.randn(5, 7, 3, generator=torch.Generator().manual_seed(0))
    x, y = positional_encoding(7, phi), positional_encoding(5, phi)
    assert x[3, 0] == pytest.approx(np.sin(np.pi * 0.5)) and x[6, 21] == pytest.approx(np.cos(2 * np.pi))
    inputs = torch.cat([phi, x[None].expand(5, -1, -1), y[:, None].expand(-1, 7, -1)], dim=2)
    weight = torch.cat([net.first.weight, net.place.weight], dim=1)
    want = torch.sigmoid(net.last(torch.relu(inputs @ weight.T + net.first.bias))).squeeze(2)
    torch.testing.assert_close(net(phi, 5, 7), want)


def test_a_cluster_is_static_where_most_of_it_is(scene, tmp_path):
    policy, data = parts_of("spotlesssplats-cluster").mask, data_of(scene, tmp_path)
    policy.setup(data)
    labels = torch.zeros(48, 64, dtype=torch.int64)
    labels[:, 32:] = 1
    policy.labels = [labels] * len(TRAIN)
    inlier = torch.ones(48, 64)
    inlier[:20, :32], inlier[:25, 32:] = 0.0, 0.0  # 20 and 25 of 48 rows are outliers
    kept = policy._vote(inlier, 0)
    assert kept[:, :32].all() and not kept[:, 32:].any()


def test_bounds_come_from_the_steps_before(scene, tmp_path):
    policy, data = parts_of("spotlesssplats", lower="0.2", upper="0.6").mask, data_of(scene, tmp_path)
    policy.setup(data)
    error = torch.zeros(48, 64)
    error[24:] = 0.5
    (upper, first), (lower, start) = policy._limits
    assert policy._bound(error, upper, first).all() and not policy._bound(error, lower, start).any()
    policy.keep(step_of(data, 0, data.photos[0] + 0.1))  # residuals of 0.1 everywhere
    assert policy._bound(error, upper, first)[:22].all() and not policy._bound(error, upper, first)[26:].any()


@pytest.mark.parametrize("mask", ["mlp", "cluster", "filter"])
def test_distractors_are_masked(scene, tmp_path, mask):
    trainer = trained(scene, tmp_path, parts_of("spotlesssplats", mask=mask), iterations=400)
    assert trainer.density.cut and not trainer.density.last_reset
    inside, outside = masked_more_inside(trainer)
    assert inside < outside - 0.2


def test_harmonics_are_cut_from_above_alone_and_start_anew():
    g = gaussians(n=20, rest=3)
    g.sh_rest.copy_(torch.linspace(-1, 1, g.sh_rest.numel()).reshape(g.sh_rest.shape))
    names = [name for name, _ in g.items()]
    adam = SplatAdam(g, dict.fromkeys(names, 0.1))
    for moments in adam._moments.values():
        for moment in moments:
            moment.fill_(1.0)
    config = SpotLessDensityConfig(start=1e9, stop=1e9)
    density = PruningDensity(config, extent=1.0, seed=0)
    before = g.sh_rest.clone()
    step = SimpleNamespace(iteration=100, nominal=9000.0, gaussians=g, growth_cap=1000)
    assert density.due(step)  # the host of an accelerator asks then whether the photo was all masked
    density.refine(step, g, adam)
    assert not density.due(step)
    assert torch.equal(g.sh_rest, before.clamp(max=0.001)) and g.sh_rest.min() == -1
    assert not adam._moments["sh_rest"][0].any() and adam._moments["means"][0].all()
    g.sh_rest.fill_(0.5)
    density.refine(replace_step(step, 101), g, adam)
    assert (g.sh_rest == 0.5).all()  # once


def replace_step(step, iteration):
    return SimpleNamespace(**{**vars(step), "iteration": iteration})


def test_gaussians_without_use_are_removed_but_not_new_ones():
    g = gaussians(n=30, rest=3)
    g.opacity_logits.fill_(1.0)
    adam = SplatAdam(g, dict.fromkeys([name for name, _ in g.items()], 0.1))
    config = SpotLessDensityConfig(start=1.0, every=1.0, min_every=1, grow_grad=1e-3, least_use=1e-6)
    density = PruningDensity(config, extent=1.0, seed=0)
    density._match(g)
    density.use_sum[:] = 1e-3
    density.use_sum[:4] = 1e-9
    density.views_seen += 1
    density.grad_sum[10:13] = 1.0
    step = SimpleNamespace(iteration=10, nominal=10.0, gaussians=g, growth_cap=1000)
    gone, kept = g.means[:4].clone(), g.means[4:10].clone()
    new, events = density.refine(step, g, adam)
    assert events == ["grow"] and density.log.now.pruned == 4
    assert torch.equal(new.means[:6], kept) and not (new.means[:, None] == gone).all(dim=2).any()
    grown = density.log.now.cloned + density.log.now.split
    assert grown == 3 and len(new) == 30 - 4 + 3
    assert len(density.use_sum) == len(new)


def test_utilisation_asks_for_squared_gradients_and_only_then(scene, tmp_path):
    assert not parts_of("spotlesssplats").density.needs
    parts = parts_of("spotlesssplats", **{"density.least_use": "1e-14", "density.every": "2000"})
    assert parts.density.needs == {"squared"}
    trainer = trained(scene, tmp_path, parts)
    assert len(trainer.gaussians) > 0


def test_what_cannot_be_is_refused():
    with pytest.raises(AwError, match=r"spotlesssplats\.upper"):
        parts_of("spotlesssplats", upper="1.5")
    with pytest.raises(AwError, match="labhog"):
        parts_of("spotlesssplats", features="labhogg")


def test_no_draw_is_one():
    # the one of these numbers whose 24 bits are all set
    draws = hashed_uniform(1_043_727, (0, 2), torch.device("cpu"))
    assert 0.9999 < float(draws[1_043_726]) == float(draws.max()) < 1.0
