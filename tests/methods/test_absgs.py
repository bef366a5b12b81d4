"""AbsGS: who grows by which gradient, and the clamp of opacity."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.absgs import AbsDensity, AbsGsConfig
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import Gradients
from tests.methods.baselines import parts_of, trained
from tests.splat.scenes import gaussians

CONFIG = AbsGsConfig(start=1.0, every=1.0, min_every=1, resets=(), clamp_every=2.0, min_clamp_every=2)


def four():
    """Two small Gaussians, then two large ones, all of opacity 0.9."""
    g = gaussians(n=4, rest=0)
    g.log_scales[:] = torch.log(torch.tensor([1e-4, 1e-4, 0.5, 0.5]))[:, None]
    g.opacity_logits[:] = torch.logit(torch.tensor(0.9))
    return g


def control(config=CONFIG):
    return AbsDensity(config, extent=1.0, seed=0)


def step_of(g, iteration=1, ceiling=100, hidden=()):
    """A picture of 200 x 100 px: gradients count 100 and 50 times; all rows but `hidden` are visible."""
    camera = Camera(200, 100, 100.0, 100.0, 100.0, 50.0, torch.eye(4).numpy())
    rendered = SimpleNamespace(visible=torch.ones(len(g), dtype=torch.bool))
    rendered.visible[list(hidden)] = False
    return SimpleNamespace(
        iteration=iteration, nominal=float(iteration), camera=camera, rendered=rendered, gaussians=g,
        growth_cap=ceiling,
    )  # fmt: skip


def gradients(g, signed, absolute):
    zeros = {name: torch.zeros_like(tensor) for name, tensor in g.items()}
    column = torch.zeros(len(g))
    return Gradients(
        **zeros,
        screen=torch.stack([torch.tensor(signed), column], 1),
        screen_abs=torch.stack([torch.tensor(absolute), column], 1),
    )


def chosen(density, g, ceiling=100):
    growth = density.choose(step_of(g, ceiling=ceiling), g)
    return growth.clones.tolist(), growth.splits.tolist()


def test_small_ones_grow_by_the_signed_gradient_and_large_ones_by_the_absolute():
    g, density = four(), control()
    # times 100 px: 3e-4 and 1e-4 against 2e-4 for clones, 3e-4 and 5e-4 against 4e-4 for splits
    density.observe(step_of(g), gradients(g, [3e-6, 1e-6, 0.0, 0.0], [9e-6, 9e-6, 3e-6, 5e-6]))
    assert chosen(density, g) == ([0], [3])


def test_the_statistic_is_the_mean_over_views_that_saw_the_row():
    g, density = four(), control()
    density.observe(step_of(g), gradients(g, [0.0] * 4, [0.0, 0.0, 9e-6, 5e-6]))
    density.observe(step_of(g, hidden=[3]), gradients(g, [0.0] * 4, [0.0, 0.0, 0.0, 9e-6]))
    assert density.abs_sum.tolist() == pytest.approx([0.0, 0.0, 9e-4, 5e-4])
    assert density.views_seen.tolist() == [2.0, 2.0, 2.0, 1.0]
    assert chosen(density, g) == ([], [2, 3])  # means 4.5e-4 and 5e-4


def test_where_room_is_short_those_furthest_above_their_threshold_grow():
    g, density = four(), control()
    # 1.5 and 3 times the threshold of clones, 2 and 1.25 times that of splits
    density.observe(step_of(g), gradients(g, [3e-6, 6e-6, 0.0, 0.0], [9e-6, 9e-6, 8e-6, 5e-6]))
    assert chosen(density, g, ceiling=6) == ([1], [2])
    assert chosen(density, g, ceiling=4) == ([], [])


def test_opacity_is_clamped_on_schedule_until_growth_ends():
    g, density = four(), control(replace(CONFIG, start=3.0, stop=4.0))
    adam = SplatAdam(
        g, dict.fromkeys(("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest"), 0.1)
    )
    density.refine(step_of(g, 1), g, adam)
    assert torch.sigmoid(g.opacity_logits).tolist() == pytest.approx([0.9] * 4)
    density.refine(step_of(g, 2), g, adam)
    assert torch.sigmoid(g.opacity_logits).tolist() == pytest.approx([0.8] * 4)
    g.opacity_logits[:] = 3.0
    density.last_growth = 5
    density.refine(step_of(g, 5), g, adam)
    assert g.opacity_logits.tolist() == [3.0] * 4


def test_it_grows_and_clamps(scene, tmp_path):
    parts = parts_of("absgs", every="2000", min_every="10", clamp_every="5000", min_clamp_every="20")
    trainer = trained(scene, tmp_path / "run", parts)
    assert sum(r.split for r in trainer.density.log.rounds) > 0
    assert len(trainer.density.abs_sum) == len(trainer.gaussians) > 400
    assert trainer.density.last_clamp == 60
