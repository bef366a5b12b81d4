"""MCMC: relocation by hand, what a round does to the set, regularisers and noise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.methods.mcmc import McmcConfig, McmcDensity, relocation
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.rendered import Gradients
from tests.methods.baselines import parts_of, trained
from tests.splat.scenes import camera, gaussians

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest", "tag")
ROUND = McmcConfig(start=1.0, every=1.0, min_every=1, noise=0.0, apart=0.0)  # as released


def some(n=40):
    """Gaussians that carry their number, of which the first five are dead."""
    g = gaussians(n=n, rest=3).with_attributes({"tag": torch.arange(float(n))})
    g.opacity_logits[:5] = -9.0
    return g


def one_round(g, config=ROUND, ceiling=1000, iteration=1):
    adam = SplatAdam(g, dict.fromkeys(NAMES, 0.1))
    for moments in adam._moments.values():
        for moment in moments:
            moment.fill_(1.0)
    density = McmcDensity(config, extent=1.0, seed=0)
    step = SimpleNamespace(iteration=iteration, nominal=float(iteration), gaussians=g, growth_cap=ceiling)
    new, events = density.refine(step, g, adam)
    adam.bind(new)
    return new, events, adam


def test_copies_by_hand():
    opacity, factor = relocation(torch.tensor([0.5, 0.5, 0.3]), torch.tensor([1, 2, 3]))
    # m = 2: o' = 1 - sqrt(1/2), D = 2 o' - o'^2 / sqrt(2)
    assert opacity[:2].tolist() == pytest.approx([0.5, 0.292893], abs=1e-6)
    assert factor[:2].tolist() == pytest.approx([1.0, 0.5 / 0.525126], abs=1e-5)
    each = 1 - 0.7 ** (1 / 3)
    total = sum(
        (1, [1], [1, -1], [1, -2, 1])[i][k] * each ** (k + 1) / (k + 1) ** 0.5
        for i in (1, 2, 3)
        for k in range(i)
    )
    assert opacity[2].item() == pytest.approx(each)
    assert factor[2].item() == pytest.approx(0.3 / total)


def test_many_copies_stay_in_range():
    opacity, factor = relocation(torch.tensor([0.999, 0.01, 1.0 - 1e-7]), torch.tensor([51, 400, 51]))
    assert bool((opacity >= 0.005).all()) and bool((opacity < 1).all())
    assert bool(torch.isfinite(factor).all()) and bool((factor > 0).all())


def test_the_dead_move_and_the_number_grows_by_a_share():
    g = some()
    new, events, adam = one_round(g)
    assert events == ["grow"]
    assert len(new) == 42  # 5 % of 40 more
    tag = new.attributes["tag"]
    assert bool((tag >= 5).all())  # nobody is a copy of a dead one
    for row in range(5):
        twin = int(tag[row])
        for name, tensor in new.named_tensors():
            assert torch.equal(tensor[row], tensor[twin]), name
    moved = tag.unique(return_counts=True)
    sources = moved[0][moved[1] > 1].long()
    first = adam.state_dict()["first"]["means"]
    assert bool((first[sources] == 0).all()) and bool((first[40:] == 0).all())
    assert bool((first[:5] == 1).all())  # of rows that moved they stay, as in the released code


@pytest.mark.parametrize("dead", [0, 1500])
def test_copies_start_at_draws_of_their_source(dead):
    g = gaussians(n=1, rest=3).with_attributes({"tag": torch.zeros(1)})
    for tensor, value in ((g.means, 0.0), (g.quats, 0.0), (g.opacity_logits, 3.0)):
        tensor.fill_(value)
    g.quats[:, 0] = g.quats[:, 3] = 0.5**0.5  # a quarter turn around z: x becomes y
    g.log_scales[:] = torch.log(torch.tensor([1.0, 2.0, 0.5]))
    g = g.select(torch.zeros(20_000, dtype=torch.int64))
    g.opacity_logits[:dead] = -9.0
    # the dead move and nothing grows, or nobody is dead and the number grows
    new, _, _ = one_round(g, replace(ROUND, apart=0.5), ceiling=20_000 if dead else 30_000)
    copies = torch.arange(len(new)) < dead if dead else torch.arange(len(new)) >= 20_000
    assert int(copies.sum()) == (dead or 1000) and not new.means[~copies].any()
    along = new.log_scales[copies].exp()[:, [1, 0, 2]]  # copies have the scales of their sources
    assert (new.means[copies] / along).std(dim=0).tolist() == pytest.approx([0.5] * 3, rel=0.1)


def test_growth_stops_at_the_ceiling_and_after_its_time():
    assert len(one_round(some(), ceiling=41)[0]) == 41
    assert len(one_round(some(), ceiling=10)[0]) == 40
    late, events, _ = one_round(some(), replace(ROUND, stop=2.0), iteration=3)
    assert len(late) == 40 and events == []


def test_a_picture_stays_nearly_the_same():
    g = some(60)
    g.opacity_logits[5:].clamp_(max=0.0)
    before = render(g, camera(), sh_degree=1).image.clone()
    dead_moved = one_round(g)[0]
    after = render(dead_moved, camera(), sh_degree=1).image
    assert float((after - before).abs().mean()) < 0.02


@pytest.mark.parametrize(
    ("name", "value"),
    [("apart", -1.0), ("start_scale", 0.0), ("start_opacity", 2.0), ("grow_grad", 7.0), ("grow_scale", 1.0)],
)
def test_values_out_of_range_and_options_without_use_are_refused(name, value):
    with pytest.raises(AwError, match=rf"mcmc\.{name}"):
        McmcConfig(**{name: value})


def test_the_regularisers_against_differences():
    g = some(8)
    zeros = {name: torch.zeros_like(tensor) for name, tensor in g.items()}
    density = McmcDensity(McmcConfig(lambda_opacity=0.3, lambda_scale=0.7), 1.0, 0)
    step = SimpleNamespace(gaussians=g)
    got = density.before_step(step, Gradients(**zeros, screen=torch.zeros(8, 2)))

    def loss(logits, scales):
        return 0.3 * torch.sigmoid(logits).mean() + 0.7 * scales.exp().mean()

    leaves = [t.double().requires_grad_(True) for t in (g.opacity_logits, g.log_scales)]
    loss(*leaves).backward()
    assert torch.allclose(got.opacity_logits.double(), leaves[0].grad, rtol=1e-4, atol=1e-9)
    assert torch.allclose(got.log_scales.double(), leaves[1].grad, rtol=1e-4, atol=1e-9)


def test_noise_has_the_covariance_of_its_gaussian_and_spares_opaque_ones():
    g = gaussians(n=4000, rest=0)
    for tensor, value in ((g.means, 0.0), (g.quats, 0.0), (g.opacity_logits, float(np.log(0.005 / 0.995)))):
        tensor.fill_(value)
    g.quats[:, 0] = 1.0
    g.log_scales[:] = torch.log(torch.tensor([1.0, 2.0, 0.5]))
    g.opacity_logits[2000:] = 1.0
    density = McmcDensity(McmcConfig(start=1e9, stop=2e9, noise=10.0), 1.0, 0)
    adam = SplatAdam(g, dict.fromkeys(NAMES[:-1], 0.02))
    density.refine(SimpleNamespace(iteration=1, nominal=1.0, gaussians=g, growth_cap=1), g, adam)
    # at 0.005 the gate is 1/2: deviations 0.5 * 10 * 0.02 * scale^2
    assert g.means[:2000].std(dim=0).tolist() == pytest.approx([0.1, 0.4, 0.025], rel=0.06)
    assert float(g.means[2000:].abs().max()) < 1e-12


def test_it_trains_to_its_ceiling(scene, tmp_path):
    trainer = trained(scene, tmp_path, parts_of("mcmc", every="500", min_every="4", max_gaussians="450"))
    assert len(trainer.gaussians) == 450
