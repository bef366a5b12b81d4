"""Masks of methods on an accelerator: the CPU's numbers, and a state that goes from one to the other."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.methods import dronesplat, masking_common, robustsplat
from ambiguous_wild.methods.masking_common import MaskNet, adam_of, adam_state, load_adam_state, upsampled
from ambiguous_wild.methods.robustsplat import RobustSplatConfig
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.step import Step
from tests.host_reads import READ, moved, no_transfers, on_accelerator
from tests.methods.baselines import data_of, parts_of, step_of
from tests.splat.scenes import same
from tests.tiny_scene import TRAIN

STEPS = 8


@pytest.fixture
def cache(tmp_path_factory):
    return tmp_path_factory.getbasetemp() / "features"  # of one scene: computed once for all tests


@pytest.fixture
def drawn(monkeypatch):
    """The coarse render, without a renderer: its cameras are kept, its picture is grey."""
    cameras = []

    def draw(step, camera=None, gaussians=None, *, without=()):
        cameras.append(camera)
        like = step.gaussians.means
        grey = torch.full((camera.height, camera.width, 3), 0.5, dtype=like.dtype, device=like.device)
        return SimpleNamespace(image=grey)

    monkeypatch.setattr(Step, "draw", draw)
    return cameras


def renders(data, steps=STEPS):
    """(view, render) of some steps: the photo, but for noise and a patch that is not in it."""
    rng = np.random.default_rng(0)
    for k in range(steps):
        view = k % len(TRAIN)
        noise = rng.normal(size=data.photos[view].shape).astype(np.float32) * 0.03
        image = (data.photos[view] + torch.from_numpy(noise)).clamp(0, 1)
        image[10 + view : 26 + view, 20:40] = 0.1
        yield view, image


def step_at(data, view, image, **kw):
    gaussians = SimpleNamespace(means=torch.zeros(1, 3), sh_degree=3)
    return replace(step_of(data, view, image, **kw), gaussians=gaussians)


def robustsplat_on(scene, cache, **changes):
    policy = robustsplat.RobustSplatMask(replace(RobustSplatConfig(), **changes))
    policy.setup(data_of(scene, cache))
    return policy


# -- the same numbers -----------------------------------------------------------------------------


def test_the_histogram_and_its_percentiles_are_the_cpus_bits(monkeypatch):
    rng = np.random.default_rng(0)
    residuals = [torch.from_numpy(rng.beta(1.5, 6.0, (40, 50)).astype(np.float32)) for _ in range(4)]

    def run():
        histogram = torch.zeros(1000, dtype=torch.float64)
        found = [masking_common.percentile(histogram, 0.6)]
        for e in residuals:
            histogram = masking_common.update_histogram(histogram, e, 0.95)
            found += [masking_common.percentile(histogram, share) for share in (0.01, 0.6, 0.8, 1.0)]
        return histogram, found, masking_common.inlier_map(residuals[0], found[-2])

    histogram, numbers, bound = run()
    on_accelerator(monkeypatch)
    there = run()
    assert all(isinstance(n, float) for n in numbers)
    assert all(isinstance(n, torch.Tensor) for n in there[1])
    assert torch.equal(there[0], histogram)
    assert [float(n) for n in there[1]] == numbers
    assert torch.equal(there[2], bound)


@pytest.mark.parametrize("bootstrap", [0.0, 30_000.0], ids=["fine", "coarse"])
def test_robustsplat_learns_what_it_learns_on_the_cpu(scene, cache, monkeypatch, drawn, bootstrap):
    runs = []
    for yes in (False, True):
        on_accelerator(monkeypatch, yes)
        policy = robustsplat_on(scene, cache, bootstrap=bootstrap, lr=2e-2)
        keeps = [policy.keep(step_at(policy.data, *seen)) for seen in renders(policy.data, 24)]
        runs.append((policy, torch.stack(keeps)))
    (cpu, keeps), (there, keeps_there) = runs
    assert isinstance(there.shares[0], torch.Tensor) and isinstance(there.loss_sum, torch.Tensor)
    assert isinstance(cpu.shares[0], float) and isinstance(cpu.loss_sum, float)
    assert there.optimiser.defaults["fused"] and not cpu.optimiser.defaults["fused"]
    assert torch.equal(there.histogram, cpu.histogram) and cpu.histogram.any()
    # one rounding a step between torch's two kernels for Adam
    for one, other in zip(there.net.parameters(), cpu.net.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    assert 0.0 < float((keeps == 0).float().mean()) < 1.0
    assert float((keeps != keeps_there).float().mean()) < 1e-3
    assert float(there.loss_sum) == pytest.approx(float(cpu.loss_sum), rel=1e-5)
    assert there.facts()["masked_share"] == pytest.approx(cpu.facts()["masked_share"], abs=1e-3)
    assert isinstance(there.facts()["masked_share"], float)


def test_the_coarse_render_meets_a_camera_again(scene, cache, drawn):
    policy = robustsplat_on(scene, cache, bootstrap=30_000.0)
    steps = [step_at(policy.data, view, policy.data.photos[view]) for view in (0, 1)]
    for step in (*steps, *steps):
        policy.keep(step)
    assert [c.width for c in drawn] == [16] * 4 and drawn[0] is drawn[2] and drawn[1] is drawn[3]
    assert drawn[0] is not drawn[1]
    policy.keep(replace(steps[0], camera=steps[1].camera))
    assert drawn[4] is not drawn[0]  # another camera of the same view, as a learnt pose has it


def test_instance_means_are_the_cpus(monkeypatch):
    rng = np.random.default_rng(0)
    labels = torch.from_numpy(rng.integers(0, 6, (31, 43)))
    residual = torch.from_numpy(rng.random((31, 43), dtype=np.float32))
    cpu = dronesplat.heat_map(residual, labels)
    on_accelerator(monkeypatch)
    for count in (6, 9):  # above the largest label there may be room
        found = dronesplat.heat_map(residual, labels, count)
        torch.testing.assert_close(found, cpu, rtol=0, atol=1e-13)  # sums in another order, in float64
    flat = dronesplat.heat_map(torch.full((31, 43), 0.3), torch.zeros_like(labels), 6)
    assert not flat.any()


def test_dronesplat_masks_what_it_masks_on_the_cpu(scene, cache, monkeypatch):
    runs = []
    for yes in (False, True):
        on_accelerator(monkeypatch, yes)
        policy, data = parts_of("dronesplat").mask, data_of(scene, cache)
        policy.setup(data)
        runs.append((policy, torch.stack([policy.keep(step_at(data, *seen)) for seen in renders(data)])))
    (cpu, keeps), (there, keeps_there) = runs
    assert isinstance(cpu.shares[0], float) and isinstance(there.shares[0], torch.Tensor)
    assert 0.0 < float((keeps == 0).float().mean()) < 1.0
    # an instance whose heat is within rounding of the threshold would go as a whole; none is here
    assert torch.equal(keeps, keeps_there)
    assert there.facts() == cpu.facts()


def test_enlarging_copies_its_weights_once():
    grid = torch.randn(5, 6, 3, generator=torch.Generator().manual_seed(0))
    for dtype, tolerance in ((torch.float32, 1e-6), (torch.float64, 1e-6)):
        chw = grid.to(dtype).permute(2, 0, 1)[None]
        want = torch.nn.functional.interpolate(chw, size=(17, 13), mode="bilinear")[0].permute(1, 2, 0)
        torch.testing.assert_close(upsampled(grid.to(dtype), 17, 13), want, rtol=0, atol=tolerance)


# -- state ----------------------------------------------------------------------------------------


def test_the_state_goes_from_an_accelerator_to_a_cpu_and_back(scene, cache, monkeypatch, drawn, tmp_path):
    on_accelerator(monkeypatch)
    first = robustsplat_on(scene, cache)
    steps = [step_at(first.data, *seen) for seen in renders(first.data)]
    for step in steps[:5]:
        first.keep(step)
    checkpoint.save(tmp_path / "state", first.state_dict())
    facts = first.facts()

    def resumed():
        policy = robustsplat_on(scene, cache)
        policy.load_state_dict(checkpoint.load(tmp_path / "state"))
        checkpoint.save(tmp_path / "again", policy.state_dict())
        assert same(*(checkpoint.load(tmp_path / name) for name in ("again", "state")))
        assert policy.facts() == facts
        for step in steps[5:]:
            policy.keep(step)
        return policy

    second = resumed()
    on_accelerator(monkeypatch, False)
    cpu = resumed()
    on_accelerator(monkeypatch)
    for step in steps[5:]:
        first.keep(step)
    for whole, one, other in zip(*(p.net.parameters() for p in (first, second, cpu)), strict=True):
        assert torch.equal(one, whole)
        torch.testing.assert_close(other, whole, rtol=1e-4, atol=1e-6)
    assert second.facts() == first.facts()


@pytest.mark.parametrize("there, place", [(True, "meta"), (False, "cpu")])
def test_adams_count_of_steps_is_loaded_to_where_adam_reads_it(monkeypatch, there, place):
    on_accelerator(monkeypatch, there)
    net = MaskNet(torch.zeros(4), torch.ones(4), 3, seed=0)
    optimiser = adam_of(net, 1e-3, torch.device("cpu"))
    net(torch.ones(2, 2, 4), 2, 2).sum().backward()
    optimiser.step()
    rows = adam_state(optimiser)
    net, optimiser = moved((net, optimiser))
    load_adam_state(optimiser, rows)
    states = [optimiser.state[p] for p in net.parameters()]
    assert [s["step"].device.type for s in states] == [place] * 4
    assert {s["exp_avg"].device.type for s in states} == {"meta"}


def test_dronesplats_state_holds_numbers(scene, cache, monkeypatch, tmp_path):
    on_accelerator(monkeypatch)
    policy, data = parts_of("dronesplat").mask, data_of(scene, cache)
    policy.setup(data)
    for seen in renders(data):
        policy.keep(step_at(data, *seen))
    checkpoint.save(tmp_path / "state", policy.state_dict())
    again = parts_of("dronesplat").mask
    again.setup(data)
    again.load_state_dict(checkpoint.load(tmp_path / "state"))
    assert again.facts() == policy.facts() and policy.facts()["masked_share"] > 0


# -- what tests/splat/test_whole_step.py relies on ----------------------------------------------------


@pytest.mark.parametrize(
    "read",
    [
        lambda t: float(t.sum()),
        lambda t: bool(t.any()),
        lambda t: t[t > 0],
        lambda t: torch.bincount(t.long()),
        lambda t: t.cpu(),
        lambda t: t * torch.ones(3).to(t.device),
        lambda t: t.new_tensor([1.0, 2.0, 3.0]) * t,
        lambda t: torch.tensor([1.0], device=t.device),
        lambda t: torch.as_tensor(np.ones(3), device=t.device),
        lambda t: t.copy_(torch.ones(3)),
    ],
)
def test_the_watch_sees_what_makes_a_host_wait(read):
    there = moved([torch.ones(3)])[0]
    with pytest.raises((RuntimeError, NotImplementedError, AssertionError), match=READ), no_transfers():
        read(there)
    with no_transfers():
        torch.where(there > 0, there * 2.0, 0.0).sum()
