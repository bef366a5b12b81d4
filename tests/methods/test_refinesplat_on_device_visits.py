"""Masks on an accelerator over many visits, density control and losses: the same as on the host."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.methods.refinesplat import multiview
from ambiguous_wild.methods.refinesplat.config import MaskConfig
from ambiguous_wild.methods.refinesplat.losses import consistency_loss, instance_matrix
from ambiguous_wild.methods.refinesplat.on_device.mask_builder import only_on_host
from ambiguous_wild.methods.refinesplat.on_host import HostMasks
from ambiguous_wild.methods.refinesplat.support import Support, SupportConfig
from ambiguous_wild.splat import device as devices
from tests.methods.on_device import (
    LOOK,
    MOST,
    PLAIN,
    both,
    capture,
    differing,
    made,
    noise,
    tensor,
    visit,
)
from tests.methods.test_refinesplat_policy import (
    FAST,
    HEIGHT,
    VIEWS,
    WIDTH,
)
from tests.splat import scenes


@pytest.fixture
def accelerated(monkeypatch):
    monkeypatch.setattr(devices, "accelerated", lambda device: True)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    yield from capture(tmp_path_factory.mktemp("scene"))


NO_OTHERS = dataclasses.replace(PLAIN.mask, multiview=multiview.MultiViewConfig(strength=0.0))


@pytest.mark.parametrize(
    "config",
    [
        PLAIN,
        dataclasses.replace(PLAIN, mask=dataclasses.replace(PLAIN.mask, memory=0.0, w2=0.4, ceiling=0.0)),
        dataclasses.replace(PLAIN, mask=NO_OTHERS, first_look=dataclasses.replace(LOOK, on=False)),
    ],
    ids=["default", "no memory", "nobody asked"],
)
def test_masks_over_visits_are_the_hosts(scene, monkeypatch, config):
    host, device = both(scene, monkeypatch, config)
    changed = 0
    for number in range(3 * VIEWS):
        step = visit(scene, number)
        expected, found = host.keep(step), device.keep(step)
        assert differing(expected, found) <= MOST
        assert differing(host.predict(step), device.predict(step)) <= MOST
        changed += int((expected == 0).sum())
        assert np.allclose(device.shares[step.view], host.shares[step.view], rtol=1e-3, atol=MOST)
    assert changed > 0.02 * 3 * sum(t.size for t in scene.truths)
    assert device.w2 == pytest.approx(host.w2, abs=1e-3)
    assert (host.w2 != 0.5) == (config.mask.w2 is None) or config.mask.w2 == host.w2
    # residuals of earlier visits are kept in half precision, which rounds to 1 in 2000
    assert float(torch.nanmedian(device.pixels.normal)) == pytest.approx(host.pixels.unit, rel=0.05)
    for name, value in host.facts().items():
        assert device.facts()[name] == (value if value is None else pytest.approx(value, rel=1e-2)), name
    maps, seen = device.examine(visit(scene, 1))
    at_host, known = host.examine(visit(scene, 1))
    assert np.allclose(maps.statistic, at_host.statistic, rtol=5e-3, atol=5e-3)
    assert np.allclose(seen.judged.values, known.judged.values, rtol=1e-3, atol=1e-3)
    assert np.array_equal(seen.judged.areas, known.judged.areas)


def test_a_prediction_leaves_no_trace(scene, accelerated):
    policy = made(scene)
    for number in range(VIEWS):
        policy.keep(visit(scene, number))
    before = repr(policy.state_dict())
    policy.predict(visit(scene, VIEWS + 1))
    policy.examine(visit(scene, VIEWS + 2))
    assert repr(policy.state_dict()) == before


@pytest.mark.parametrize("to_device", [True, False])
def test_a_run_goes_on_on_the_other_machine(scene, monkeypatch, to_device):
    host, device = both(scene, monkeypatch)
    begun, resumed = (host, device) if to_device else (device, host)
    for number in range(VIEWS + 2):
        begun.keep(visit(scene, number))
    state = begun.state_dict()
    resumed.load_state_dict(state)
    again = resumed.state_dict()
    assert state.keys() == again.keys()
    assert repr(plain(state)) == repr(plain(again))
    for number in range(VIEWS + 2, 2 * VIEWS + 2):
        step = visit(scene, number)
        assert differing(begun.keep(step), resumed.keep(step)) <= MOST


def plain(value):
    if isinstance(value, torch.Tensor):
        return str(value.dtype), value.tolist()
    if isinstance(value, dict):
        return {key: plain(v) for key, v in sorted(value.items())}
    return value


def test_pictures_are_drawn_of_what_the_device_holds(scene, accelerated, tmp_path):
    policy = made(scene, dataclasses.replace(PLAIN, psi=FAST.psi))
    for number in range(VIEWS):
        policy.keep(visit(scene, number))
    panels = policy.panels(visit(scene, 0))
    assert all(p.shape == (HEIGHT, WIDTH, 3) for p in panels.values())
    assert [path.exists() for path in policy.draw(tmp_path)] == [True]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"statistic": "evidence"}, "statistic=evidence"),
        ({"entropy_weight": 0.5}, "entropy_weight=0.5"),
    ],
)
def test_what_the_device_cannot_do_is_done_on_the_host_and_said(scene, accelerated, changes, named):
    config = dataclasses.replace(PLAIN, mask=MaskConfig(**changes), psi=FAST.psi)
    with pytest.warns(UserWarning, match=named):
        policy = made(scene, config)
    assert isinstance(policy.masks, HostMasks)
    assert only_on_host(PLAIN) is None


@pytest.mark.parametrize("masked", [True, False])
def test_looks_at_all_rows_count_what_looks_at_some_do(monkeypatch, masked):
    cam = scenes.camera()
    keep = tensor(cv2.resize(noise(3, 4, 5), (cam.width, cam.height)) > 0.6).float() if masked else None
    counts = []
    for accelerated in (False, True):
        monkeypatch.setattr(devices, "accelerated", lambda device, yes=accelerated: yes)
        support = Support(SupportConfig())
        support.match(300, torch.device("cpu"))
        for seed in range(4):
            gaussians = scenes.gaussians(seed, 300)
            gaussians.means[0] = torch.nan  # until the next round of density control
            support.look(gaussians, tensor(noise(seed, 300) < 0.8), cam, keep)
        counts.append(support)
    host, device = counts
    assert torch.equal(host.looked, device.looked) and torch.equal(host.kept, device.kept)
    assert host.kept.sum() > 0 and bool((host.kept < host.looked).any()) == masked


@pytest.mark.parametrize("variant", ["sigmoid", "softmax"])
@pytest.mark.parametrize("labels", [[1, 1, 1, 1, 3, 3, 3, 0, 0], [0] * 9, [2] * 9])
def test_consistency_is_the_hosts_with_its_gradient(monkeypatch, variant, labels):
    member = instance_matrix(torch.tensor(labels), 4, tensor(noise(1, 9))).double()
    found = []
    for accelerated in (False, True):
        monkeypatch.setattr(devices, "accelerated", lambda device, yes=accelerated: yes)
        logits = tensor(noise(2, 9, 5) * 6).double().requires_grad_(True)
        loss = consistency_loss(logits, member, variant)
        (gradient,) = torch.autograd.grad(loss, logits)
        found.append((float(loss.detach()), gradient))
    # the same sums, and zeros among them
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-12)
    assert torch.allclose(found[1][1], found[0][1], rtol=1e-10, atol=1e-15)
    assert (found[0][0] > 0) == any(labels)
