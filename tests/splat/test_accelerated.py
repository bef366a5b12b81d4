"""The training loop of an accelerator: with numbers on the CPU, and without any where host reads raise."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from ambiguous_wild.splat import gpu_kernels
from ambiguous_wild.splat.gpu_kernels import compiled
from ambiguous_wild.splat.losses import photometric, ssim_map
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.reference import photometric_reference, ssim_map_reference
from ambiguous_wild.splat.rendered import Cotangents
from ambiguous_wild.splat.training_loop import train
from ambiguous_wild.splat.training_records import SAMPLED, Clock, GpuClock, clock_for
from ambiguous_wild.splat.watchdog import DeviceFiniteCheck, NonFinite
from tests.tiny_scene import with_points

from . import fake_gsplat
from .scenes import trained, trainer_for
from .test_losses import pictures
from .test_watchdog import Poison


@pytest.fixture(scope="module")
def scene(scene):
    return with_points(scene, 150)


def error_of(trainer) -> float:
    """Mean squared error over the train photos."""
    pairs = zip(trainer.data.cameras, trainer.data.photos)
    return float(np.mean([float((trainer.render(c).image - p).square().mean()) for c, p in pairs]))


def test_it_learns_what_the_cpu_learns(scene, tmp_path, monkeypatch):
    cpu = trained(scene, tmp_path / "cpu", iterations=40, probes=0)
    before = error_of(trainer_for(scene, tmp_path / "before"))
    with fake_gsplat.installed(monkeypatch):
        gpu = trained(scene, tmp_path / "gpu", iterations=40, probes=0)
        after = error_of(gpu)
    for name, tensor in cpu.gaussians.items():
        # Adam makes a whole step of a gradient that is rounding, and of a ball's turning nothing else is
        if name != "quats":
            apart = (tensor - getattr(gpu.gaussians, name)).abs() > 2e-3
            assert float(apart.float().mean()) < 0.02, name
    assert before / after > 3
    assert error_of(cpu) == pytest.approx(after, rel=1e-3)
    losses = [[row["loss"] for row in t.timeline.rows] for t in (cpu, gpu)]
    np.testing.assert_allclose(losses[0], losses[1], rtol=1e-3)


def test_densification_and_reset_run_there_too(scene, tmp_path, fake):
    from ambiguous_wild.splat.density import DensityConfig

    config = DensityConfig(start=0.0, min_every=8, resets=(15_000.0,), min_reset_spacing=1, min_reset_rest=1)
    parts = MethodHooks(density_config=replace(config, grow_grad=1e-6, max_gaussians=500))
    trainer = trained(scene, tmp_path / "run", parts=parts, iterations=24, probes=0)
    assert len(trainer.gaussians) > 150
    assert trainer.density.last_reset > 0
    assert all(bool(torch.isfinite(tensor).all()) for _, tensor in trainer.gaussians.items())


class Fickle(MaskPolicy):
    """Gives another keep map and another loss of its own at every call; what it predicts is neither."""

    def __init__(self, bad=None, where="keep"):
        self.bad, self.where, self.calls = bad, where, 0

    def keep(self, step):
        self.calls += 1
        keep = torch.full_like(step.photo[..., 0], 1.0 / self.calls)
        if step.iteration == self.bad and self.where == "keep":
            keep[20, 30] = math.nan
        return keep

    def predict(self, step):
        return None

    def cotangent(self, step, keep):
        self.calls += 1
        alpha = torch.full_like(keep, 1e-4 / self.calls)
        if step.iteration == self.bad and self.where == "alpha":
            alpha[20, 30] = math.nan
        return Cotangents(alpha=alpha, extra=1e-4 * keep[..., None] * step.photo)


@pytest.mark.parametrize("where", ["keep", "alpha"])
def test_the_step_that_broke_is_made_again_with_its_own_keep_map(scene, tmp_path, fake, where):
    """Whatever the policy would say now: it has learnt since."""
    mask = Fickle(7, where)
    trainer = trainer_for(scene, tmp_path / "run", parts=MethodHooks(mask=mask), iterations=60, probes=0)
    trainer.watchdog.every = 12
    said = "loss is" if where == "keep" else "gradient of .*means.*"
    with pytest.raises(NonFinite, match=rf"{said} .* iteration 7, view") as info:
        for _ in range(12):
            trainer.step()
    assert mask.calls == 24  # nobody asks the policy again
    keep = info.value.tensors["keep"]
    expected = torch.full_like(keep, 1.0 / 13)  # of its call in step 7
    if where == "keep":
        expected[20, 30] = math.nan
    assert torch.equal(keep.nan_to_num(-1.0), expected.nan_to_num(-1.0))


def test_what_weighed_the_broken_step_is_kept_whatever_the_sizes_after_it():
    sentinel, loss = DeviceFiniteCheck(torch.device("cpu"), 3), torch.tensor(0.5)
    sound, broken = [torch.ones(2)], [torch.tensor([1.0, math.inf])]
    sentinel.watch(1, 0, loss, sound, torch.full((4, 5), 0.1))
    weights = torch.rand(2, 3), Cotangents(image=torch.rand(2, 3, 3), depth=torch.rand(2, 3))
    sentinel.watch(2, 1, loss, broken, *weights)
    sentinel.watch(3, 2, loss, broken, torch.full((4, 5), 0.3), torch.full((4, 5, 3), 0.4))
    found = sentinel.first_broken()
    assert found.iteration == 2 and torch.equal(found.keep, weights[0])
    own = found.method_cotangents
    assert torch.equal(own.image, weights[1].image) and own.extra is None
    assert torch.equal(own.depth, weights[1].depth) and own.alpha is None
    sentinel.reset()
    sentinel.watch(4, 0, loss, broken, None)
    assert sentinel.first_broken().keep is None


@pytest.mark.parametrize("bad", [7, 12])
def test_what_breaks_is_found_later_and_named_as_if_at_once(scene, tmp_path, fake, bad):
    parts = MethodHooks(mask=Poison([bad]))
    trainer = trainer_for(scene, tmp_path / "run", parts=parts, iterations=60, probes=0)
    trainer.watchdog.every = 15
    view = scene.train[trainer.run_schedule.view(bad)].name
    before = None
    while trainer.iteration < 14:
        if trainer.iteration == bad - 1:
            before = trainer.gaussians.clone()
        trainer.step()
    for name, tensor in trainer.gaussians.items():  # called off, then and until somebody looks
        assert torch.equal(tensor, getattr(before, name))
    assert torch.isfinite(trainer.density.grad_sum).all()
    with pytest.raises(NonFinite, match=rf"gradient of .*means.* iteration {bad}, view {view}"):
        trainer.step()


def test_a_rollback_leaves_the_photo_out_and_goes_on(scene, tmp_path, fake):
    trainer = trainer_for(
        scene, tmp_path / "run", parts=MethodHooks(mask=Poison([9])), iterations=24, probes=0,
        on_nonfinite="rollback",
    )  # fmt: skip
    trainer.watchdog.every = 10
    train(trainer)
    assert trainer.iteration == 24
    assert [r["iteration"] for r in trainer.watchdog.rollbacks] == [9]
    assert all(bool(torch.isfinite(tensor).all()) for _, tensor in trainer.gaussians.items())


class Nothing(MaskPolicy):
    """Masks the whole of one photo."""

    def keep(self, step):
        self.last = step
        return torch.zeros(step.photo.shape[:2]) if step.view == 2 else None


def test_a_photo_that_is_all_masked_moves_nothing_and_is_said(scene, tmp_path, fake):
    mask = Nothing()
    trainer = trainer_for(scene, tmp_path / "run", parts=MethodHooks(mask=mask), iterations=60, probes=0)
    moved = {}
    for iteration in range(1, 13):
        before = trainer.gaussians.clone()
        seen = trainer.density.views_seen.clone()
        trainer.step()
        if trainer.run_schedule.view(iteration) == 2 and len(seen):
            assert torch.equal(trainer.density.views_seen, seen)  # nobody was looked at
        assert mask.last.rendered.visible.any()  # what the method was shown does not change
        same = all(torch.equal(t, getattr(before, name)) for name, t in trainer.gaussians.items())
        moved[trainer.run_schedule.view(iteration)] = not same
    assert moved == {view: view != 2 for view in range(6)}
    assert trainer.skipped_views == [scene.train[2].name]
    trainer.save()
    again = trainer_for(scene, tmp_path / "run", parts=MethodHooks(mask=Nothing()), iterations=60, probes=0)
    again.resume()
    assert again.skipped_views == [scene.train[2].name]


def test_a_run_of_an_accelerator_goes_on_on_the_cpu_and_back(scene, tmp_path, monkeypatch):
    with fake_gsplat.installed(monkeypatch):
        trainer = trainer_for(scene, tmp_path / "run", iterations=30, probes=0)
        while trainer.iteration < 15:
            trainer.timeline.loss(trainer.step())
        trainer.save()
    cpu = trainer_for(scene, tmp_path / "run", iterations=30, probes=0)
    assert cpu.resume() and cpu.iteration == 15
    while cpu.iteration < 20:
        cpu.timeline.loss(cpu.step())
    cpu.save()
    with fake_gsplat.installed(monkeypatch):
        back = trainer_for(scene, tmp_path / "run", iterations=30, probes=0)
        assert back.resume() and back.iteration == 20
        train(back)
        straight = trained(scene, tmp_path / "straight", iterations=30, probes=0)
        assert error_of(back) == pytest.approx(error_of(straight), rel=1e-3)


# -- the parts of it ------------------------------------------------------------------------------


@pytest.mark.parametrize("weighting", ["map", "images"])
@pytest.mark.parametrize("size", [(1, 1), (3, 2), (17, 23), (40, 21)])
@pytest.mark.parametrize("masked", [False, True])
def test_the_fused_loss_equals_autograd_in_float64(fake, weighting, size, masked):
    a, b, keep = (t.double() for t in pictures(*size))
    keep = keep if masked else None
    loss = photometric(a, b, keep, lambda_dssim=0.3, weighting=weighting)
    l1, dssim, gradient = photometric_reference(a, b, keep, 0.3, weighting)
    assert isinstance(loss.value, torch.Tensor) and loss.value.dim() == 0
    assert float(loss.l1) == pytest.approx(l1, rel=1e-12)
    assert float(loss.dssim) == pytest.approx(dssim, rel=1e-12, abs=1e-14)
    assert (loss.d_image - gradient).abs().max() < 1e-12 * gradient.abs().max()
    assert (ssim_map(a, b) - ssim_map_reference(a, b)).abs().max() < 1e-12


def test_the_fused_loss_in_float32_is_as_near_as_the_kernels_of_the_cpu(fake):
    a, b, keep = pictures(40, 21)
    loss = photometric(a, b, keep)
    l1, dssim, gradient = photometric_reference(a.double(), b.double(), keep.double(), 0.2, "map")
    assert float(loss.l1) == pytest.approx(l1, rel=1e-6)
    assert float(loss.dssim) == pytest.approx(dssim, rel=1e-5)
    assert (loss.d_image - gradient).abs().max() < 4e-6 * gradient.abs().max()


def test_the_fused_loss_reads_nothing_and_is_one_graph_for_a_compiler():
    a, b, keep = (t.to("meta") for t in pictures(17, 23))
    assert photometric(a, b, keep).d_image.shape == a.shape
    # `fullgraph` raises where tracing would have to fall back to Python in between
    traced = torch.compile(gpu_kernels._loss, fullgraph=True, backend="eager")
    a, b, keep = pictures(17, 23)
    for mask, inside in ((None, False), (keep, False), (keep, True)):
        for x, y in zip(traced(a, b, mask, 0.2, inside), gpu_kernels._loss(a, b, mask, 0.2, inside)):
            assert torch.equal(x, y)


def test_without_a_compiler_the_loss_runs_as_it_stands_and_says_so(monkeypatch):
    class Cuda(torch.Tensor):
        device = torch.device("cuda")

    def broken(*arguments):
        raise RuntimeError("no triton\nand more")

    monkeypatch.setattr(torch, "compile", lambda function, **options: broken)
    call = compiled(lambda x: x + 1, "the loss")
    argument = torch.zeros(2).as_subclass(Cuda)
    with pytest.warns(UserWarning, match="the loss is not compiled and slower for it: no triton$"):
        assert torch.equal(torch.Tensor(call(argument)), torch.ones(2))
    with warnings.catch_warnings(action="error"):  # it says so once
        assert torch.equal(torch.Tensor(call(argument)), torch.ones(2))


def test_the_sentinel_stays_up_and_counts_what_was_sound():
    sentinel = DeviceFiniteCheck(torch.device("cpu"), 3)
    sound, broken = [torch.ones(4, 3)], [torch.tensor([1.0, math.inf])]
    loss = torch.tensor(0.5)
    assert sentinel.first_broken() is None
    assert not sentinel.watch(1, 0, loss, sound, None)
    assert sentinel.first_broken() is None
    assert not sentinel.watch(2, 1, loss, sound, torch.ones(2, 2))
    assert sentinel.watch(3, 2, loss, sound, torch.zeros(2, 2))  # nothing kept: off, and nothing broken
    assert not sentinel.watch(5, 0, loss, sound, None)
    assert sentinel.watch(6, 0, loss, broken, None)
    assert sentinel.watch(7, 0, loss, sound, None)  # it stays up
    assert sentinel.first_broken().iteration == 6
    assert sentinel.empty_views() == {2}
    sentinel.reset()
    assert sentinel.first_broken() is None
    assert sentinel.watch(8, 0, torch.tensor(math.nan), sound, None)
    assert sentinel.first_broken().iteration == 8
    assert torch.equal(sound[0], torch.ones(4, 3))


def test_parts_are_timed_by_the_devices_own_events_now_and_then():
    class Event:
        now = 0.0
        waited = 0

        def __init__(self):
            self.at = None

        def record(self):
            self.at = Event.now

        def synchronize(self):
            Event.waited += 1

        def elapsed_time(self, other):
            return other.at - self.at

    gpu = GpuClock(event=Event)
    for _ in range(3 * SAMPLED):
        gpu.start()
        with gpu.part("render"):
            Event.now += 2.0  # ms
        with gpu.part("loss"):
            Event.now += 0.5
        gpu.stop()
        with gpu.part("render"):  # pictures are looked at with the clock stopped
            Event.now += 100.0
    assert Event.waited == 0 and gpu.parts_s == {}
    gpu.settle()
    assert Event.waited == 1
    steps = 3 * SAMPLED
    assert gpu.parts_s == pytest.approx({"render": steps * 2e-3, "loss": steps * 0.5e-3})
    gpu.settle()
    assert gpu.parts_s == pytest.approx({"render": steps * 2e-3, "loss": steps * 0.5e-3})
    assert type(clock_for(torch.device("cpu"))) is Clock
    assert type(clock_for(torch.device("cuda"))) is GpuClock
