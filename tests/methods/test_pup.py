"""PUP: the score against exact derivatives, who is removed, and the one round of a run."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.methods.pup import PupConfig, PupDensity, log_det, prune_mask
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.training_loop import train
from tests.methods.baselines import parts_of, trained, trainer_of
from tests.splat import fake_gsplat
from tests.splat.scenes import camera, gaussians


def test_the_score_by_hand():
    blocks = torch.zeros(3, 6, 6, dtype=torch.float64)
    blocks[0] = torch.diag(torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))
    blocks[1] = torch.eye(6) * 0.5
    want = [math.log(720), 6 * math.log(0.5), 6 * math.log(1e-12)]
    assert log_det(blocks).tolist() == pytest.approx(want, rel=1e-9)


def test_who_is_removed_by_hand():
    score = torch.tensor([5.0, 1.0, 4.0, 2.0, 3.0])
    # index int(0.8 * 4) = 3 of the sorted scores is 4
    assert prune_mask(score, 0.8).tolist() == [False, True, True, True, True]
    assert prune_mask(score, 0.5).tolist() == [False, True, False, True, True]
    ties = torch.tensor([-9.0, -9.0, -9.0, 2.0, 3.0])
    assert prune_mask(ties, 0.2).tolist() == [True, True, True, False, False]


def test_the_block_approaches_the_sum_over_pixels_and_channels():
    """J J^T of every pixel and channel, one backward pass each, of a small picture."""
    g, view = gaussians(n=6, rest=3), camera(12, 9, fx=10.0, fy=11.0)
    g.means[:, 2] = 3.0
    g.opacity_logits.clamp_(min=0.0)
    exact = torch.zeros(6, 6, 6, dtype=torch.float64)
    picture = render(g, view, sh_degree=1)
    for index in range(12 * 9 * 3):
        one = torch.zeros(12 * 9 * 3)
        one[index] = 1.0
        back = picture.backward(one.reshape(9, 12, 3))
        j = torch.cat([back.means, back.log_scales], 1).double()
        exact += j[:, :, None] * j[:, None, :]
    density = PupDensity(PupConfig(signs=400), 1.0, 0)
    density.cameras = [view]
    step = SimpleNamespace(draw=lambda camera: render(g, camera, sh_degree=1))
    got = density.blocks(step, g)
    scale = exact.diagonal(dim1=1, dim2=2)
    assert bool((scale > 0).all(dim=1).any())
    root = (scale[:, :, None] * scale[:, None, :]).sqrt().clamp(min=1e-12)
    assert float(((got - exact) / root).abs().max()) < 0.3


def test_pruning_before_growth_ends_is_refused():
    with pytest.raises(AwError, match="prune_at"):
        PupConfig(prune_at=9000.0)


@pytest.mark.parametrize("options", [{"rounds": 8}, {"share": 1.0}])
def test_rounds_that_cannot_remove_the_share_are_refused(options):
    with pytest.raises(AwError, match=rf"pup-3dgs\.{next(iter(options))}"):
        PupConfig(**options)


def make():
    more = {"prune_at": "20000", "rounds": "1"}
    return parts_of("pup-3dgs", every="2000", min_every="10", share="0.75", divisor="2", signs="2", **more)


def test_one_round_removes_the_share_everywhere(scene, tmp_path):
    trainer = trainer_of(scene, tmp_path, make())
    while trainer.iteration < 79:
        trainer.step()
    before, means = len(trainer.gaussians), trainer.gaussians.means.clone()
    trainer.step()
    left = len(trainer.gaussians)
    assert left == pytest.approx(before / 4, abs=2)
    known = {tuple(row) for row in means.tolist()}
    assert sum(tuple(row) in known for row in trainer.gaussians.means.tolist()) < left  # the step moved them
    assert all(len(m) == left for m in trainer.optimiser.state_dict()["first"].values())
    assert trainer.density.log.rounds[-1].pruned == before - left
    while not trainer.done:
        trainer.step()
    assert len(trainer.gaussians) == left


def test_rounds_together_remove_the_share(scene, tmp_path):
    options = {"rounds": "3", "between": "5000", "share": "0.8", "divisor": "2", "signs": "2"}
    trainer = trainer_of(scene, tmp_path, parts_of("pup-3dgs", **options, max_gaussians="500"))
    while trainer.iteration < 39:
        trainer.step()
    before = len(trainer.gaussians)
    train(trainer)
    assert trainer.density.pruning_rounds == 3
    assert len(trainer.gaussians) == pytest.approx(0.2 * before, abs=4)


def test_what_no_view_sees_goes_first(scene, tmp_path):
    trainer = trainer_of(scene, tmp_path, make())
    with torch.no_grad():
        trainer.gaussians.means[::4, 2] = -5.0  # behind every camera
        trainer.gaussians.sh0[::4] = 9.0
    train(trainer)
    assert float(trainer.gaussians.sh0.max()) < 8.0


def test_a_round_runs_on_a_gpu_and_on_colours_from_a_net(scene, tmp_path, monkeypatch):
    options = {"rounds": "1", "divisor": "8", "signs": "2", "share": "0.5"}
    own, other = parts_of("pup-3dgs", **options), parts_of("splatfacto-w", width="8")
    grafted = replace(other, density=own.density, density_config=own.density_config)
    assert trained(scene, tmp_path / "net", grafted, iterations=30).density.pruning_rounds == 1
    with fake_gsplat.installed(monkeypatch):
        assert trained(scene, tmp_path / "gpu", own, iterations=30).density.pruning_rounds == 1
