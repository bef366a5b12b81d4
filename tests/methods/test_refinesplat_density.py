"""Entropy-aware density control: what decides, where clones go, what merges and what stays."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.methods.refinesplat.density_control import EntropyAwareDensity, EntropyDensityConfig
from ambiguous_wild.splat.density import DensityConfig, DensityControl
from ambiguous_wild.splat.gaussians import Gaussians


def test_the_deciding_gradient_is_selectable():
    screen, extra = torch.tensor([[1.0, 2.0]]), torch.tensor([[10.0, -2.0]])
    gradients = SimpleNamespace(screen=screen, screen_extra=extra)
    plain = SimpleNamespace(screen=screen, screen_extra=None)

    def control(decides):
        return EntropyAwareDensity(EntropyDensityConfig(decides=decides), 1.0, 0)

    assert torch.equal(control("total").statistic(gradients), screen + extra)
    assert torch.equal(control("photometric").statistic(gradients), screen)
    assert torch.equal(control("entropy").statistic(gradients), extra)
    assert torch.equal(control("total").statistic(plain), screen)
    assert not control("entropy").statistic(plain).any()
    with pytest.raises(AwError, match="total"):
        control("totl")


def test_clones_go_downhill_and_stay_inside():
    n = 6
    g = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        torch.zeros(n, 3),
        torch.randn(n, 4, generator=g),
        torch.randn(n, 3, generator=g) - 3,
        torch.zeros(n),
        torch.zeros(n, 3),
        torch.zeros(n, 0, 3),
    )
    control = EntropyAwareDensity(EntropyDensityConfig(clone_shift=0.5), 1.0, 0)
    control.downhill = torch.randn(n, 3, generator=g)
    control.downhill[5] = 0.0
    rows = torch.arange(n)
    offset = control.clone_offset(gaussians, rows)
    assert ((offset * control.downhill).sum(1)[:5] > 0).all()
    assert (offset.norm(dim=1) <= 0.5 * gaussians.log_scales.exp().amax(1) + 1e-7).all()
    assert not offset[5].any()
    still = EntropyAwareDensity(EntropyDensityConfig(clone_shift=0.0), 1.0, 0)
    assert still.clone_offset(gaussians, rows) is None


def test_merging_removes_quiet_twins_and_keeps_statistics_in_step():
    base = Gaussians.from_points(np.random.default_rng(0).random((20, 3)) * 50, np.zeros((20, 3), np.uint8))
    base.log_scales -= 4.0  # nobody reaches its neighbour
    gaussians = base.cat(base)  # every Gaussian twice
    calls = []
    optimiser = SimpleNamespace(select=lambda rows: calls.append(int(rows.sum())), append=calls.append)
    control = EntropyAwareDensity(EntropyDensityConfig(), 1.0, 0)
    control._match(gaussians)
    control.views_seen += 1
    control.grad_sum[:] = 0.0
    control.grad_sum[:5] = 1.0  # busy ones stay as they are
    step = SimpleNamespace(nominal=12_000.0)
    merged = control.after_growth(step, gaussians, optimiser)
    assert len(merged) == 25
    assert control.merged == 15
    assert calls == [10, 15]
    assert len(control.views_seen) == len(control.downhill) == 25
    assert control.after_growth(step, merged, optimiser) is merged  # not due again
    other = EntropyAwareDensity(EntropyDensityConfig(), 1.0, 0)
    other.load_state_dict(control.state_dict())
    assert other.merged == 15
    assert other.last_merge == 12_000.0


def test_what_is_large_stays_after_an_opacity_reset():
    gaussians = Gaussians.from_points(np.eye(4)[:, :3], np.zeros((4, 3), np.uint8), opacity=0.5)
    gaussians.log_scales[:] = -5.0
    gaussians.log_scales[0] = 10.0  # sky
    optimiser = SimpleNamespace(select=lambda rows: None)
    counts = []
    for control in (
        EntropyAwareDensity(EntropyDensityConfig(), 1.0, 0),
        DensityControl(DensityConfig(), 1.0, 0),  # 3DGS
    ):
        control._match(gaussians)
        control.last_reset = 15_000
        counts.append(len(control._prune(gaussians, optimiser)))
    assert counts == [4, 3]
