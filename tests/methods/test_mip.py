"""Mip-Splatting: filters, the reset of filtered opacity, matched growth; UAD's weights by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.methods import get_method
from ambiguous_wild.methods.mip import (
    AbsoluteMipDensity,
    MipConfig,
    MipDensity,
    build,
    opacity_factor,
    upper_quantile,
)
from ambiguous_wild.methods.uad import UncertaintyAwareDensity, footprint_mean
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.effects.smoothing import SmoothingFilter, filter_sizes
from ambiguous_wild.splat.rendered import GSPLAT_SUMS, check_needs
from tests.methods.baselines import data_of, parts_of, trained, trainer_of
from tests.splat.scenes import bits, camera, gaussians


def test_both_filters_reach_the_renderer(scene, tmp_path):
    parts = build(MipConfig())
    assert parts.antialias and parts.blur == 0.1 and isinstance(parts.effects[0], SmoothingFilter)
    assert not parts.density.needs
    trainer = trainer_of(scene, tmp_path, parts)
    wide = trainer.neutral_model()
    size = filter_sizes(trainer.gaussians.means, trainer.data.cameras)
    # wall at 4 m, focal length 60 px
    assert size.tolist() == pytest.approx([np.sqrt(0.2) * 4 / 60] * len(size), rel=1e-4)
    want = (2 * trainer.gaussians.log_scales).exp() + size[:, None] ** 2
    torch.testing.assert_close((2 * wide.log_scales).exp(), want)


def test_the_factor_by_hand():
    log_scales = torch.log(torch.tensor([[1.0, 2.0, 3.0]]))
    want = np.sqrt(1 * 4 * 9 / (2.0 * 5 * 10))
    assert opacity_factor(log_scales, torch.tensor([1.0])).item() == pytest.approx(want)


def test_a_reset_leaves_the_filtered_opacity_at_its_target(scene, tmp_path):
    data = data_of(scene, tmp_path)
    density = MipDensity(DensityConfig(), extent=1.0, seed=0)
    density.setup(data)
    g = trainer_of(scene, tmp_path / "run", parts_of("3dgs")).gaussians
    g.opacity_logits[:3] = torch.logit(torch.tensor([0.9, 0.5, 0.004]))
    factor = opacity_factor(g.log_scales, filter_sizes(g.means, data.cameras))
    before = torch.sigmoid(g.opacity_logits) * factor
    density.reset_opacity(g)
    torch.testing.assert_close(torch.sigmoid(g.opacity_logits) * factor, before.clamp(max=0.01))
    assert torch.sigmoid(g.opacity_logits[0]) > 0.01  # the plain one is higher
    assert torch.sigmoid(g.opacity_logits[2]).item() == pytest.approx(0.004, rel=1e-3)


def test_without_the_filter_the_density_control_is_refused(scene, tmp_path):
    grafted = get_method("3dgs@density=mip-splatting")
    parts = grafted.build(grafted.options())
    with pytest.raises(AwError, match="needs the effect antialias: add --effects antialias"):
        trainer_of(scene, tmp_path, parts)
    trainer_of(scene, tmp_path, with_effects(parts, ("antialias",)))


def test_matched_growth_takes_as_many_by_the_absolute_gradient():
    absolute = torch.arange(100.0)
    assert upper_quantile(absolute, 0.1) == pytest.approx(np.quantile(np.arange(100.0), 0.9))
    g = gaussians(n=100, rest=3)
    density = AbsoluteMipDensity(DensityConfig(grow_grad=1.0), extent=1.0, seed=0)
    density._match(g)
    density.views_seen += 2
    density.grad_sum[:10] = 4.0  # 2 on average: a tenth of all is above the threshold
    density.abs_sum += 2 * absolute
    growth = density.choose(SimpleNamespace(growth_cap=1000), g)
    rows = torch.cat([growth.clones, growth.splits]).sort().values.tolist()
    assert rows == [*range(10), *range(90, 100)]


# -- UAD ------------------------------------------------------------------------------------------


def test_the_mean_under_a_footprint_is_that_of_its_square():
    view = camera()
    values = torch.rand(view.height, view.width, generator=torch.Generator().manual_seed(0))
    g = gaussians(n=40, rest=3)
    radii = torch.linspace(0.0, 9.0, 40)
    found = footprint_mean(values, g.means, radii, view)
    local = g.means.double().numpy() @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    for i in range(40):
        u = view.fx * local[i, 0] / local[i, 2] + view.cx
        v = view.fy * local[i, 1] / local[i, 2] + view.cy
        r = float(radii[i])
        rows = slice(max(int(np.floor(v - r)), 0), max(int(np.ceil(v + r)), 0))
        columns = slice(max(int(np.floor(u - r)), 0), max(int(np.ceil(u + r)), 0))
        square = values[rows, columns].double()
        want = 1.0 if local[i, 2] <= 0 or square.numel() == 0 else float(square.mean())
        assert found[i].item() == pytest.approx(want, abs=1e-5)


def test_masked_views_and_small_ones_count_less():
    g = gaussians(n=2, rest=3)
    g.means.copy_(torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 3.0]]))
    view = camera()
    density = UncertaintyAwareDensity(DensityConfig(), extent=1.0, seed=0)

    def see(gradient, count, keep):
        rendered = SimpleNamespace(visible=torch.ones(2, dtype=torch.bool), radii=torch.ones(2))
        step = SimpleNamespace(nominal=1000.0, gaussians=g, rendered=rendered, camera=view)
        screen = torch.tensor([[gradient / (view.width / 2), 0.0]] * 2)
        density.observe(step, SimpleNamespace(screen=screen, count=torch.tensor(count)), keep)

    see(1.0, [10.0, 30.0], None)
    see(3.0, [30.0, 10.0], torch.full((view.height, view.width), 0.5))
    mean = density.grad_sum / density.views_seen
    # (10 * 1 + 15 * 3) / 25 and (30 * 1 + 5 * 3) / 35
    assert mean.tolist() == pytest.approx([55 / 25, 45 / 35])


def test_uad_is_a_density_control_for_any_host_and_for_the_cpu_alone(scene, tmp_path):
    often = {"density.every": "2000", "density.min_every": "10"}
    plain = trained(scene, tmp_path / "plain", parts_of("dronesplat", **often), iterations=120)
    host = parts_of("dronesplat@density=uad", **often)
    assert host.density is UncertaintyAwareDensity
    assert bits(trained(scene, tmp_path / "uad", host, iterations=120)) != bits(plain)
    with pytest.raises(AwError, match=r"'count'.*gsplat.*--device cpu"):
        check_needs(host.density.needs, GSPLAT_SUMS)
