"""Density control keeps parameters, moments and statistics on the same rows."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.splat.density import DensityConfig, DensityControl
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import Gradients

RATES = {
    "means": 1e-3,
    "quats": 1e-3,
    "log_scales": 5e-3,
    "opacity_logits": 0.05,
    "sh0": 2.5e-3,
    "sh_rest": 1e-4,
}


def model(n: int = 8, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians.from_points(rng.uniform(-1, 1, (n, 3)), rng.integers(0, 255, (n, 3)).astype(np.uint8))


def gradients(gaussians: Gaussians, screen: torch.Tensor) -> Gradients:
    zeros = {name: torch.zeros_like(tensor) for name, tensor in gaussians.items()}
    return Gradients(**zeros, screen=screen)


def step_at(gaussians, iteration, nominal, *, ceiling=1000, visible=None, width=2, height=2):
    visible = torch.ones(len(gaussians), dtype=torch.bool) if visible is None else visible
    return SimpleNamespace(
        iteration=iteration,
        nominal=nominal,
        growth_cap=ceiling,
        gaussians=gaussians,
        camera=SimpleNamespace(width=width, height=height),
        rendered=SimpleNamespace(visible=visible),
    )


def refined(gaussians, screen, *, extent=10.0, ceiling=1000, config=None):
    """One observation and one round of growth."""
    density = DensityControl(config or DensityConfig(), extent=extent, seed=0)
    optimiser = SplatAdam(gaussians, RATES)
    step = step_at(gaussians, 600, 600.0, ceiling=ceiling)
    density.observe(step, gradients(gaussians, screen))
    after, events = density.refine(step, gaussians, optimiser)
    return after, events, density, optimiser


def test_small_ones_with_large_gradients_are_cloned_in_place():
    before = model()
    screen = torch.zeros(8, 2)
    screen[3] = torch.tensor([3e-4, 0.0])
    after, events, _, _ = refined(before, screen, extent=1000.0)
    assert events == ["grow"]
    assert len(after) == 9
    assert torch.equal(after.means[8], before.means[3])
    assert torch.equal(after.means[:8], before.means)


def test_large_ones_are_split_in_two_smaller_and_the_parent_goes():
    before = model()
    screen = torch.zeros(8, 2)
    screen[3] = torch.tensor([3e-4, 0.0])
    after, _, _, _ = refined(before, screen, extent=1e-3, config=DensityConfig(prune_scale=1e9))
    assert len(after) == 9
    parent = before.means[3]
    assert not (after.means == parent).all(dim=1).any()
    assert torch.allclose(
        after.log_scales[7:].exp() * 1.6, before.log_scales[3].exp().expand(2, 3), rtol=1e-5
    )
    assert (after.means[7:] - parent).norm(dim=1).max() < 6 * before.log_scales[3].exp().max()


def test_the_statistic_does_not_depend_on_the_resolution():
    scores = []
    for size, factor in ((2, 1.0), (4, 0.5)):
        gaussians = model()
        density = DensityControl(DensityConfig(), extent=1.0, seed=0)
        step = step_at(gaussians, 10, 600.0, width=size, height=size)
        density.observe(step, gradients(gaussians, torch.full((8, 2), 1e-4 * factor)))
        scores.append(density.grad_sum / density.views_seen)
    assert torch.allclose(scores[0], scores[1])


def test_rows_that_no_view_saw_do_not_dilute_the_mean():
    gaussians = model()
    density = DensityControl(DensityConfig(), extent=1.0, seed=0)
    seen = torch.zeros(8, dtype=torch.bool)
    seen[2] = True
    density.observe(step_at(gaussians, 1, 600.0, visible=seen), gradients(gaussians, torch.full((8, 2), 1.0)))
    density.observe(
        step_at(gaussians, 2, 600.0, visible=~seen), gradients(gaussians, torch.full((8, 2), 0.0))
    )
    assert density.views_seen.tolist() == [1] * 8
    assert density.grad_sum[2] == pytest.approx(2**0.5)


def test_the_ceiling_lets_the_largest_gradients_through():
    before = model()
    screen = torch.zeros(8, 2)
    screen[:, 0] = torch.linspace(3e-4, 9e-4, 8)
    after, _, _, _ = refined(before, screen, extent=1000.0, ceiling=10)
    assert len(after) == 10
    assert torch.equal(after.means[8:], before.means[[6, 7]])


def test_transparent_ones_are_pruned_and_everything_keeps_its_row():
    before = model()
    before.opacity_logits[5] = -9.0
    screen = torch.zeros(8, 2)
    screen[1] = torch.tensor([1e-2, 0.0])
    after, _, density, optimiser = refined(before, screen, extent=1000.0)
    assert len(after) == 8
    assert len(density.views_seen) == len(density.grad_sum) == 8
    zero = {name: torch.zeros_like(tensor) for name, tensor in after.items()}
    optimiser.bind(after)
    optimiser.step(Gradients(**zero, screen=torch.zeros(8, 2)), torch.ones(8, dtype=torch.bool), RATES)


def test_a_round_that_would_remove_everything_removes_nothing():
    before = model()
    before.opacity_logits[:] = -9.0
    after, _, _, _ = refined(before, torch.zeros(8, 2))
    assert len(after) == 8


def test_non_finite_rows_are_removed():
    before = model()
    before.means[2, 1] = float("nan")
    after, _, _, _ = refined(before, torch.zeros(8, 2))
    assert len(after) == 7
    assert torch.isfinite(after.means).all()


def resets_of_a_run(iterations: int, stop: float = 1e9, **config: object) -> tuple[list[int], Gaussians]:
    gaussians = model()
    density = DensityControl(DensityConfig(start=1e9, stop=stop, **config), extent=1.0, seed=0)
    optimiser, fired = SplatAdam(gaussians, RATES), []
    for iteration in range(50, iterations + 1, 50):
        step = step_at(gaussians, iteration, iteration * 30_000 / iterations)
        _, events = density.refine(step, gaussians, optimiser)
        fired += [iteration] if "reset" in events else []
    return fired, gaussians


def test_opacity_resets_fire_as_published_in_a_run_of_full_length():
    fired, gaussians = resets_of_a_run(30_000)
    assert fired == [3000, 6000, 9000, 12_000]
    assert torch.sigmoid(gaussians.opacity_logits).max() <= 0.01 + 1e-6
    often = [2500, 5000, 7500, 10_000, 12_500, 15_000, 17_500]  # splatfacto-w's
    assert resets_of_a_run(30_000, resets=tuple(map(float, often)))[0] == often


def test_opacity_resets_keep_apart_and_leave_time_to_heal():
    assert resets_of_a_run(15_000)[0] == [3000, 6000]
    assert resets_of_a_run(10_000)[0] == [3000]
    fired, gaussians = resets_of_a_run(3000)
    assert fired == []
    assert torch.sigmoid(gaussians.opacity_logits).min() > 0.09


def test_no_opacity_reset_after_growth():
    assert resets_of_a_run(30_000, stop=7000)[0] == [3000, 6000]


def test_state_goes_on_with_the_same_random_numbers():
    runs = []
    for interrupted in (False, True):
        density = DensityControl(DensityConfig(), extent=1e-3, seed=4)
        first = density._split_half(model())
        if interrupted:
            other = DensityControl(DensityConfig(), extent=1e-3, seed=99)
            other.load_state_dict(density.state_dict())
            density = other
        runs.append((first.means, density._split_half(model()).means))
    assert torch.equal(runs[0][1], runs[1][1])
    assert not torch.equal(runs[0][0], runs[0][1])
