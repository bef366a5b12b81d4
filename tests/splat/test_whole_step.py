"""Every method's whole step on an accelerator: no read of a value, no copy from the host, few launches."""

import collections
from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.gpu import fused_loss
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from tests.benchmark_scripts import benchmark
from tests.host_reads import READ, moved, no_transfers
from tests.tiny_scene import with_points, write_tiny_scene

from . import fake_gsplat

ALL = ("poses", "exposure", "appearance", "antialias")
METHODS = ("3dgs", "3dgs+truth", "robustsplat", "dronesplat", "refinesplat")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return with_points(load_scene(write_tiny_scene(tmp_path_factory.mktemp("data") / "scene")), 60)


@pytest.fixture
def fake(monkeypatch):
    with fake_gsplat.installed(monkeypatch):
        yield


def late(scene, folder, method, effects=()) -> Trainer:
    """A trainer in the middle of a run: masks have begun, all harmonics are on, nothing grows."""
    entry = get_method(method)
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=folder / "cache")
    parts = with_effects(entry.build(entry.options()), effects)
    trainer = Trainer(data, parts, TrainConfig(iterations=100_000, probes=0), folder=folder / "run")
    trainer.iteration = 50_000
    trainer.watchdog.every = 10**9  # looking does read
    trainer.density.config = replace(trainer.density.config, start=1e9, stop=1e9, resets=(), min_every=10**9)
    return trainer


@pytest.mark.parametrize("effects", [(), ALL], ids=["plain", "effects"])
@pytest.mark.parametrize("method", METHODS)
def test_nothing_is_read_and_nothing_sent(scene, tmp_path, fake, method, effects):
    trainer = late(scene, tmp_path, method, effects)
    trainer.step()  # what is made at the first step needs numbers
    trainer = moved(trainer)
    for _ in range(12):  # what is copied once, is: every photo, wherever its epoch begins
        trainer.timeline.loss(trainer.step())
    with no_transfers():
        for _ in range(6 if effects else 24):  # every photo four times: masks are made anew
            trainer.timeline.loss(trainer.step())
    with pytest.raises((RuntimeError, NotImplementedError), match=READ):
        trainer.check_parameters()  # reading is what raises there


_FREE = {
    "alias", "as_strided", "detach", "empty", "empty_like", "expand", "narrow", "new_empty_strided",
    "permute", "result_type", "select", "slice", "split", "split_with_sizes", "squeeze", "t",
    "transpose", "unbind", "unsqueeze", "view", "_unsafe_view",
}  # fmt: skip


class Launches(TorchDispatchMode):
    """Counts what would be a kernel; not what the stand-in or the loss, compiled there, is made of."""

    def __init__(self, monkeypatch):
        super().__init__()
        self.counts, self.on = collections.Counter(), True
        import gsplat

        for name in ("isect_tiles", "isect_offset_encode"):
            monkeypatch.setattr(gsplat, name, self.apart(getattr(gsplat, name)))
        monkeypatch.setattr(fused_loss, "_compiled_loss", self.apart(fused_loss._loss))
        for name in ("fully_fused_projection", "spherical_harmonics", "rasterize_to_pixels"):
            monkeypatch.setattr(gsplat, name, self.as_one(getattr(gsplat, name)))

    def apart(self, function):
        def call(*a, **k):
            before, self.on = self.on, False
            try:
                return function(*a, **k)
            finally:
                self.on = before

        return call

    def as_one(self, function):
        """One node of the graph forwards and one back, as gsplat's own."""
        outer = self

        class Node(torch.autograd.Function):
            @staticmethod
            def forward(ctx, call, *tensors):
                ctx.leaves = [t.detach().requires_grad_(t.is_floating_point()) for t in tensors]
                with torch.enable_grad():
                    out = outer.apart(call)(*ctx.leaves)
                ctx.out = [o for o in out if o is not None and o.requires_grad]
                ctx.all = out
                found = tuple(o if o is None else o.detach() for o in out)
                ctx.mark_non_differentiable(
                    *[o for o in found if o is not None and not o.is_floating_point()]
                )
                return found

            @staticmethod
            def backward(ctx, *grads):
                pairs = [(o, g) for o, g in zip(ctx.all, grads) if o is not None and o.requires_grad]
                wanted = [t for t in ctx.leaves if t.requires_grad]
                pull = outer.apart(torch.autograd.grad)
                got = pull(
                    [o for o, _ in pairs], wanted, [g for _, g in pairs], allow_unused=True, retain_graph=True
                )
                found = iter(got)
                return None, *(next(found) if t.requires_grad else None for t in ctx.leaves)

        def call(*a, **k):
            names = [*range(len(a)), *k]
            values = [*a, *k.values()]
            tensors = [v for v in values if isinstance(v, torch.Tensor)]

            def again(*given):
                it = iter(given)
                filled = [next(it) if isinstance(v, torch.Tensor) else v for v in values]
                out = function(*filled[: len(a)], **dict(zip(names[len(a) :], filled[len(a) :])))
                return out if isinstance(out, tuple) else (out,)

            found = Node.apply(again, *tensors)
            return found if len(found) > 1 else found[0]

        return call

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        if self.on and name not in _FREE and not name.startswith("_record_function"):
            self.counts[name] += 1
        return func(*args, **(kwargs or {}))


def test_a_step_launches_no_more_than_gsplats_own_loop(scene, tmp_path, fake, monkeypatch):
    """The two meet the same gsplat; what a step adds to it is the host's time and the GPU's gaps."""
    trainer = late(scene, tmp_path, "3dgs")
    with benchmark("gpu") as gpu:
        plain = gpu.PlainLoop(trainer.gaussians, trainer.data, trainer.pace.learning_rates(0.5))
    trainer.step()
    launches = {}
    for name, step in (("ours", trainer.step), ("gsplat", plain.step)):
        with monkeypatch.context() as patch:
            watch = Launches(patch)
            step()
            with watch:
                step()
            launches[name] = sum(watch.counts.values())
    assert 20 < launches["ours"] < 100
    assert launches["ours"] <= launches["gsplat"] + 5
