"""What masks hide in every photo is removed; what any photo vouches for stays."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.density_control import (
    EntropyAwareDensity,
    EntropyDensityConfig,
    Support,
    SupportConfig,
)
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import Gradients

RATES = dict.fromkeys(("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest"), 1e-3)
CAMERA = Camera(fx=10.0, fy=10.0, cx=4.0, cy=4.0, width=8, height=8, cam_from_world=np.eye(4))
# left and right of the middle, outside the frame, behind the camera
MEANS = torch.tensor([[-0.25, 0.0, 1.0], [0.25, 0.0, 1.0], [9.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
VISIBLE = torch.tensor([True, True, True, False])
LEFT_MASKED = torch.cat([torch.zeros(8, 4), torch.ones(8, 4)], dim=1)


def model(size=0.01):
    """One Gaussian at each of MEANS, round."""
    gaussians = Gaussians.from_points(MEANS.double().numpy(), np.full((4, 3), 99, np.uint8))
    gaussians.log_scales[:] = float(np.log(size))
    return gaussians


def looked(looks, keep=LEFT_MASKED, size=0.01):
    support = Support(SupportConfig())
    support.match(4, torch.device("cpu"))
    for _ in range(looks):
        support.observe(model(size), VISIBLE, CAMERA, keep)
    return support


def test_hidden_in_every_look_goes_and_the_rest_stays():
    assert looked(8).unsupported().tolist() == [True, False, False, False]


def test_nobody_is_judged_before_enough_looks():
    assert not looked(7).unsupported().any()


def test_out_of_frame_and_behind_the_camera_are_no_looks():
    assert looked(8).looked.tolist() == [8, 8, 0, 0]


def test_without_a_mask_everyone_is_vouched_for():
    support = looked(8, None)
    assert support.kept.tolist() == [8, 8, 0, 0]
    assert not support.unsupported().any()


def test_one_kept_look_in_eight_is_enough():
    support = looked(7)
    support.observe(model(), VISIBLE, CAMERA, None)
    assert not support.unsupported().any()


def test_a_large_one_is_vouched_for_by_its_flanks():
    # 0.25 left of the middle: a standard deviation of 0.3 reaches the kept half, one of 0.2 does not
    assert looked(8, size=0.2).unsupported().tolist() == [True, False, False, False]
    assert not looked(8, size=0.3).unsupported().any()


def test_old_evidence_fades():
    support = looked(8, None)
    support.unsupported()
    for _ in range(80):
        support.observe(model(), VISIBLE, CAMERA, LEFT_MASKED)
        gone = support.unsupported()
        if bool(gone[0]):
            break
    assert gone.tolist() == [True, False, False, False]


def refined(control, gaussians, iterations, keep):
    """Steps in which nothing grows."""
    optimiser = SplatAdam(gaussians, RATES)
    for iteration in range(1, iterations + 1):
        visible = torch.ones(len(gaussians), dtype=torch.bool)
        step = SimpleNamespace(
            iteration=iteration,
            nominal=100.0,
            growth_cap=len(gaussians),
            gaussians=gaussians,
            camera=CAMERA,
            rendered=SimpleNamespace(visible=visible),
        )
        zeros = {name: torch.zeros_like(tensor) for name, tensor in gaussians.items()}
        control.observe(step, Gradients(**zeros, screen=torch.zeros(len(gaussians), 2)), keep)
        gaussians, events = control.refine(step, gaussians, optimiser)
        if events:
            break
    return gaussians, events, optimiser


@pytest.mark.parametrize(("share", "left"), [(0.1, 3), (0.0, 4)])
def test_rows_of_everything_go_together(share, left):
    config = EntropyDensityConfig(support=SupportConfig(least_share=share))
    control = EntropyAwareDensity(config, 1.0, 0)
    gaussians = model()
    after, events, optimiser = refined(control, gaussians, 60, LEFT_MASKED)
    assert len(after) == left
    assert events == (["prune"] if left == 3 else [])
    for rows in (control.support.looked, control.support.kept, control.downhill, control.views_seen):
        assert len(rows) in (left, 0)
    if left == 3:
        assert torch.equal(after.means, MEANS[1:])
        assert all(len(m) == 3 for m in optimiser.state_dict()["first"].values())


def test_it_never_removes_everything():
    control = EntropyAwareDensity(EntropyDensityConfig(), 1.0, 0)
    gaussians = model()
    gaussians = gaussians.select(torch.arange(2))
    after, events, _ = refined(control, gaussians, 60, torch.zeros(8, 8))
    assert len(after) == 2
    assert events == []


def test_the_counts_survive_a_stop():
    control = EntropyAwareDensity(EntropyDensityConfig(), 1.0, 0)
    gaussians = model()
    refined(control, gaussians, 30, LEFT_MASKED)
    other = EntropyAwareDensity(EntropyDensityConfig(), 1.0, 0)
    other.load_state_dict(control.state_dict())
    assert torch.equal(other.support.looked, control.support.looked)
    assert torch.equal(other.support.kept, control.support.kept)
    assert control.support.looked.sum() > 0


def test_growth_goes_first_and_the_judgement_follows():
    config = EntropyDensityConfig(start=0.0, grow_grad=1e-9, grow_scale=1e9, min_every=50)
    control = EntropyAwareDensity(config, 1.0, 0)
    gaussians = model()
    optimiser = SplatAdam(gaussians, RATES)
    seen = []
    for iteration in range(1, 56):
        step = SimpleNamespace(
            iteration=iteration,
            nominal=100.0 * iteration,
            growth_cap=100,
            gaussians=gaussians,
            camera=CAMERA,
            rendered=SimpleNamespace(visible=torch.ones(len(gaussians), dtype=torch.bool)),
        )
        zeros = {name: torch.zeros_like(tensor) for name, tensor in gaussians.items()}
        screen = torch.full((len(gaussians), 2), 1.0)
        control.observe(step, Gradients(**zeros, screen=screen), LEFT_MASKED)
        gaussians, events = control.refine(step, gaussians, optimiser)
        optimiser.bind(gaussians)
        seen += [(iteration, event) for event in events]
    assert seen == [(50, "grow"), (51, "prune")]
    assert len(gaussians) == 7  # four, each cloned; the hidden one's copy has not been looked at often enough
