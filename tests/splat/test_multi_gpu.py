"""One model on two ranks: real processes with gloo on the CPU, around the stand-in for gsplat."""

import gc
import math
import multiprocessing
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.gpu.render import render_cuda
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.multi_gpu import shards
from ambiguous_wild.splat.multi_gpu.exchange import exchange
from ambiguous_wild.splat.multi_gpu.launch import launch
from ambiguous_wild.splat.multi_gpu.render import render_shared
from ambiguous_wild.splat.multi_gpu.run import Progress, train_rank
from ambiguous_wild.splat.multi_gpu.trainer import SharedTrainer
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import MaskPolicy, Parts
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.trainer import Trainer
from tests.tiny_scene import write_tiny_scene

from . import fake_gsplat
from .scenes import camera, cotangents, gaussians, given

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest")
BACKGROUND = (0.1, 0.5, 0.9)
POINTS, MOST = 80, 130
TABLES = ([[2, 3], [4, 0]], [[0, 0], [2, 1]])  # rows that each rank sends to each
STEPS = 10
# -- what both sides make -------------------------------------------------------------------------


def rows_of(table, rank, width=5):
    rng = np.random.default_rng([7, rank])
    return torch.from_numpy(rng.normal(size=(sum(table[rank]), width)).astype(np.float32))


def weights_of(table, rank, width=5):
    rng = np.random.default_rng([8, rank])
    arriving = sum(row[rank] for row in table)
    return torch.from_numpy(rng.normal(size=(arriving, width)).astype(np.float32))


CAMERAS = [camera(), camera(24, 21, angle=0.1)]
DRAWN = {  # Gaussians of the first rank, options, cotangents
    "ragged": (41, {"sh_degree": 3, "antialias": True, "blur": 0.1}, ("d_image", "d_alpha", "d_depth")),
    "one rank has none": (60, {"sh_degree": 1, "antialias": False}, ("d_image",)),
}


def asked(rank, names):
    found = cotangents(CAMERAS[rank].height, CAMERAS[rank].width, seed=rank)
    return given({name: found[name] for name in names})


def data_of(root, folder):
    """The tiny scene with fewer points."""
    scene = load_scene(root)
    points = replace(
        scene.points, **{k: v[:POINTS] for k, v in vars(scene.points).items() if len(v) > POINTS}
    )
    scene = replace(scene, points=points)
    return load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=folder)


def stretch(g: Gaussians, rows: np.ndarray) -> None:
    """Balls become ellipsoids: of a ball's turning nothing is a gradient but rounding."""
    noise = np.random.default_rng(3).normal(size=(POINTS, 3)).astype(np.float32)
    g.log_scales += 0.5 * torch.from_numpy(noise[rows])


NO_GROWTH = Parts(density_config=DensityConfig(start=1e6, resets=()))
GROWTH = Parts(
    density_config=DensityConfig(
        start=0.0, min_every=8, resets=(15_000.0,), min_reset_spacing=1, min_reset_rest=1, grow_grad=1e-6,
        max_gaussians=MOST,
    )
)  # fmt: skip
CONFIG = TrainConfig(iterations=24, probes=2)


def bright(draw):
    return float(draw(CAMERAS[0]).mean())


class Spoilt(MaskPolicy):
    """Masks these views altogether, or breaks them; what it predicts later is sound."""

    def __init__(self, views, value=0.0):
        self.views, self.value, self.calls = views, value, 0

    def keep(self, step):
        self.calls += 1
        return torch.full(step.photo.shape[:2], self.value) if step.view in self.views else None

    def predict(self, step):
        return None


# -- what the ranks do ----------------------------------------------------------------------------


def in_ranks(ranks, tell, root, folder):
    """Everything that needs two processes, in one start of them: plain arrays and numbers."""
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch, fake_gsplat.installed(patch):
        return {
            "exchanged": [exchanged(ranks, table) for table in TABLES],
            "drawn": {name: drawn(ranks, *what) for name, what in DRAWN.items()},
            "steps": steps(ranks, data_of(root, folder), folder / "steps"),
            "grown": grown(ranks, tell, data_of(root, folder), folder),
            "spoilt": spoilt(ranks, data_of(root, folder), folder / "spoilt"),
        }


def exchanged(ranks, table):
    rows = rows_of(table, ranks.rank).requires_grad_()
    found = exchange(rows, table[ranks.rank], [row[ranks.rank] for row in table])
    (weights_of(table, ranks.rank) * found.square()).sum().backward()
    return found.detach().numpy(), rows.grad.numpy()


def drawn(ranks, first, options, names):
    everything = gaussians(3)
    rows = (slice(None, first), slice(first, None))[ranks.rank]
    own = Gaussians(**{name: tensor[rows] for name, tensor in everything.items()})
    counts = ranks.counts(len(own))
    rendered = render_shared(own, CAMERAS, ranks, counts, background=BACKGROUND, **options)
    grads = rendered.backward(asked(ranks.rank, names))
    found = {
        "counts": counts,
        "pictures": [t.numpy() for t in (rendered.image, rendered.alpha, rendered.depth)],
        "grads": {name: getattr(grads, name).numpy() for name in NAMES},
        "screens": rendered.screens.numpy(),
        "visible": np.stack([rendered.seen_by(q).visible.numpy() for q in range(2)]),
        "radii": np.stack([rendered.seen_by(q).radii.numpy() for q in range(2)]),
        "own": torch.equal(grads.screen, rendered.screens[ranks.rank]),
    }
    watched = weakref.ref(rendered)
    gc.disable()
    del rendered, grads
    found["freed"] = watched() is None
    gc.enable()
    return found


def steps(ranks, data, folder):
    trainer = SharedTrainer(data, NO_GROWTH, CONFIG, folder=folder, ranks=ranks)
    stretch(trainer.gaussians, np.arange(ranks.rank, POINTS, 2))
    for _ in range(STEPS):
        trainer.timeline.loss(trainer.step())
    first = trainer.optimiser.state_dict()["first"]
    found = {name: (tensor.numpy(), first[name].numpy()) for name, tensor in trainer.gaussians.items()}
    return found | {"density": (trainer.density.grad_sum.numpy(), trainer.density.seen.numpy())}


def state(trainer):
    moments = trainer.optimiser.state_dict()
    return [
        t.numpy().tobytes() for t in trainer.gaussians.__dict__.values() if isinstance(t, torch.Tensor)
    ] + [moments[kind][name].numpy().tobytes() for kind in ("first", "second") for name in NAMES]


def grown(ranks, tell, data, folder):
    config = replace(CONFIG, checkpoint_every_s=(1e-9, 1e9)[ranks.rank])
    train_rank(ranks, tell, data, GROWTH, config, folder / "straight", bright)
    straight = SharedTrainer(data, GROWTH, config, folder=folder / "straight", ranks=ranks)
    assert straight.resume() and straight.done
    first = SharedTrainer(data, GROWTH, config, folder=folder / "parts", ranks=ranks, probe=bright)
    assert not first.resume()
    while first.iteration < 14:
        first._advance(None)
    first.save()
    if ranks.rank == 0:  # killed between the shards of one moment: only this rank got so far
        first.iteration += 2
        coming = shards.shard_path(folder / "parts", 0, 2, "next")
        shards.checkpoint.save(coming, first.state())
    ranks.wait()
    second = SharedTrainer(data, GROWTH, config, folder=folder / "parts", ranks=ranks, probe=bright)
    assert second.resume()
    begun, stale = second.iteration, shards.shard_path(folder / "parts", ranks.rank, 2, "next").exists()
    second.watchdog.every, saves = 2, []
    second.save = lambda: saves.append(second.iteration) or SharedTrainer.save(second)
    second.train()
    ranks.wait()
    return {
        "same": state(second) == state(straight),
        "begun": begun,
        "stale": stale,
        "saves": saves,
        "left": sorted(path.name for path in (folder / "parts" / "checkpoint").iterdir()),
        "count": len(straight.gaussians),
        "counts": straight.counts,
        "moments": [len(m[0]) for m in straight.optimiser._moments.values()],
        "betas": (straight.optimiser.betas, straight.optimiser.eps),
        "iteration": straight.iteration,
        "reset": straight.density.last_reset,
        "noise": float(straight.density.rng.standard_normal()),
        "probes": [row["psnr_probe"] for row in straight.timeline.rows],
        "losses": [row["loss"] for row in straight.timeline.rows],
        "model": {name: tensor.numpy() for name, tensor in straight.gaussians.items()},
    }


def spoilt(ranks, data, folder):
    """Whether a step moves when the photo of one rank shows nothing, when both do; what a bad one says."""
    plain = SharedTrainer(data, NO_GROWTH, CONFIG, folder=folder, ranks=ranks)
    views = plain._views(2)
    moved = []
    for masked in (views[:1], views):
        trainer = SharedTrainer(
            data, replace(NO_GROWTH, mask=Spoilt(masked)), CONFIG, folder=folder, ranks=ranks
        )
        before = trainer.gaussians.clone()
        trainer.step()
        moved.append(not torch.equal(before.means, trainer.gaussians.means))
    sentinel, loss, sound = plain.sentinel, torch.tensor(0.5), [torch.ones(3)]
    broken = [torch.full((3,), math.inf)] if ranks.rank == 1 else sound
    off = [bool(sentinel.watch(k, 0, loss, sound if k != 4 else broken, None)) for k in (2, 4, 6)]
    bad = replace(NO_GROWTH, mask=Spoilt(views[1:], math.nan))
    trainer = SharedTrainer(data, bad, CONFIG, folder=folder, ranks=ranks)
    trainer.watchdog.every = 3
    before = trainer.gaussians.clone()
    said = ""
    try:
        for _ in range(4):
            trainer.step()
    except AwError as error:
        said = str(error)
    kept = torch.equal(before.means, trainer.gaussians.means)
    observed = bool(trainer.density.seen.any()) or not bool(torch.isfinite(trainer.density.grad_sum).all())
    asked = trainer.parts.mask.calls
    with pytest.raises(AwError, match="draws pictures of its own"):
        plain.make_step(2, -1).draw()
    return {"moved": moved, "said": said, "kept": kept, "name": data.scene.train[views[1]].name,
            "at": trainer.iteration, "off": off, "first": sentinel.first_broken().iteration,
            "observed": observed, "asked": asked}  # fmt: skip


# -- what must hold --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """What the two ranks found, and where."""
    folder = tmp_path_factory.mktemp("shared")
    root = write_tiny_scene(folder / "scene")
    heard = []
    found = launch(2, in_ranks, (root, folder), backend="gloo", heard=heard.append, logs=folder)
    assert multiprocessing.active_children() == []
    return found, folder, heard


@pytest.fixture
def fake(monkeypatch):
    with fake_gsplat.installed(monkeypatch):
        yield


@pytest.mark.parametrize("number", range(len(TABLES)))
def test_the_exchange_and_its_gradient_are_those_of_one_process(both, number):
    table = TABLES[number]
    rows = [rows_of(table, r).requires_grad_() for r in range(2)]
    parts = [row.split(sends) for row, sends in zip(rows, table)]
    arrived = [torch.cat([part[q] for part in parts]) for q in range(2)]
    sum((weights_of(table, q) * arrived[q].square()).sum() for q in range(2)).backward()
    for rank in range(2):
        found, gradient = both[0][rank]["exchanged"][number]
        assert np.array_equal(found, arrived[rank].detach().numpy())
        assert np.array_equal(gradient, rows[rank].grad.numpy())


@pytest.mark.parametrize("name", DRAWN)
def test_two_ranks_draw_what_one_gpu_draws_of_all_gaussians(both, fake, name):
    first, options, names = DRAWN[name]
    everything, total, screens = gaussians(3), None, []
    found = [rank["drawn"][name] for rank in both[0]]
    for q, cam in enumerate(CAMERAS):
        rendered = render_cuda(everything, cam, background=BACKGROUND, **options)
        for picture, expected in zip(found[q]["pictures"], (rendered.image, rendered.alpha, rendered.depth)):
            np.testing.assert_allclose(picture, expected.numpy(), rtol=1e-5, atol=1e-6)
        for what in ("visible", "radii"):
            whole = np.concatenate([rank[what][q] for rank in found])
            assert np.array_equal(whole, getattr(rendered, what).numpy())
        grads = rendered.backward(asked(q, names))
        screens.append(grads.screen.numpy())
        own = {n: getattr(grads, n) for n in NAMES}
        total = own if total is None else {n: total[n] + own[n] for n in NAMES}
    for n in NAMES:
        whole = np.concatenate([rank["grads"][n] for rank in found])
        assert np.abs(whole - total[n].numpy()).max() <= 1e-5 * np.abs(total[n].numpy()).max(), n
    for q in range(2):
        whole = np.concatenate([rank["screens"][q] for rank in found])
        assert np.abs(whole - screens[q]).max() <= 1e-5 * np.abs(screens[q]).max()
    assert [rank["counts"] for rank in found] == 2 * [[first, 60 - first]]
    assert all(rank["own"] and rank["freed"] for rank in found)


def test_ten_shared_steps_are_ten_steps_of_a_batch_of_two(both, fake, tmp_path):
    """To 1e-3 of a step's length: Adam makes whole steps of gradients that are little but rounding."""
    data = data_of(both[1] / "scene", tmp_path)
    order = np.concatenate([np.arange(0, POINTS, 2), np.arange(1, POINTS, 2)])
    start = Trainer(data, NO_GROWTH, CONFIG, folder=tmp_path)
    pace, g = start.pace, start.gaussians.select(torch.from_numpy(order))
    stretch(g, order)
    before = g.clone()

    def rates(progress):
        return {name: math.sqrt(2) * rate for name, rate in pace.learning_rates(progress).items()}

    optimiser = SplatAdam(g, rates(0.0), betas=(0.8, 0.998), eps=1e-15 / math.sqrt(2))
    half, norms, seen = torch.tensor([32.0, 24.0]), 0, 0  # of the photos' size
    for k in range(STEPS):
        last = 2 * k + 2
        degree = min(int(30_000 * last / CONFIG.iterations // 1000), 3)
        found = []
        for view in (pace.view(last - 1), pace.view(last)):
            rendered = render_cuda(
                g, data.cameras[view], sh_degree=degree, background=(0.0, 0.0, 0.0), antialias=False
            )
            found.append(rendered.backward(photometric(rendered.image, data.photos[view]).d_image))
            if last <= CONFIG.iterations / 2:  # density control stops looking there
                norms = norms + (found[-1].screen * half).norm(dim=1) * rendered.visible
                seen = seen + rendered.visible.float()
        mean = {n: (getattr(found[0], n) + getattr(found[1], n)) / 2 for n in NAMES}
        optimiser.step(
            Gradients(**mean, screen=found[0].screen), rendered.visible, rates(last / CONFIG.iterations)
        )
    first = optimiser.state_dict()["first"]
    for name, tensor in g.items():
        length = rates(0.0)[name]
        whole, moments = (np.concatenate([rank["steps"][name][i] for rank in both[0]]) for i in range(2))
        assert np.abs(whole - getattr(before, name).numpy()).max() > length, name
        assert np.abs(whole - tensor.numpy()).max() <= 1e-3 * length, name
        expected = first[name].numpy()
        assert np.abs(moments - expected).max() <= 1e-5 * np.abs(expected).max(), name
    observed, times = (np.concatenate([rank["steps"]["density"][i] for rank in both[0]]) for i in range(2))
    np.testing.assert_allclose(observed, norms.numpy(), rtol=1e-3, atol=1e-7)
    assert np.array_equal(times, seen.numpy()) and times.max() == 12


def test_growth_keeps_rows_and_moments_together_and_the_ceiling_is_shared(both):
    ranks = [rank["grown"] for rank in both[0]]
    for rank in ranks:
        assert rank["moments"] == [rank["count"]] * len(NAMES)
        assert rank["counts"] == [other["count"] for other in ranks]
        assert rank["iteration"] == 24 and rank["reset"] > 0
        assert rank["betas"] == ((0.8, 0.998), 1e-15 / math.sqrt(2))
        assert all(np.isfinite(tensor).all() for tensor in rank["model"].values())
    assert POINTS + 20 < sum(rank["count"] for rank in ranks) <= MOST
    assert ranks[0]["noise"] != ranks[1]["noise"]
    assert ranks[0]["losses"] == ranks[1]["losses"]  # of all photos


def test_a_shared_run_that_stops_goes_on_with_the_same_bits(both):
    for rank in both[0]:
        assert rank["grown"]["same"]
        assert rank["grown"]["begun"] == 14  # not 16: of that one rank alone had a shard
        assert not rank["grown"]["stale"]
        assert rank["grown"]["saves"] == [16, 20, 24]  # when rank 0 says so
        assert rank["grown"]["left"] == ["last-rank1of2.safetensors", "last-rank2of2.safetensors"]


def test_one_gpu_takes_over_the_whole_model(both, fake, tmp_path):
    found, folder, heard = both
    trainer = Trainer(data_of(folder / "scene", tmp_path), GROWTH, CONFIG, folder=folder / "straight")
    facts = shards.take_over(trainer, folder / "straight")
    assert [fact["gaussians"] for fact in facts] == found[0]["grown"]["counts"]
    for name in NAMES:
        whole = np.concatenate([rank["grown"]["model"][name] for rank in found])
        assert np.array_equal(getattr(trainer.gaussians, name).numpy(), whole)
    assert trainer.done and trainer.density.log.rounds[-1].count == len(trainer.gaussians)
    probes = found[0]["grown"]["probes"]
    assert sum(p is not None for p in probes) == 2 and all(p is None for p in found[1]["grown"]["probes"])
    assert bright(lambda camera: trainer.render(camera).image) == pytest.approx(probes[-1], rel=1e-6)
    assert trainer.make_step(trainer.iteration, 0).view == 0  # masks are written so
    assert (folder / "straight" / "timeline.csv").read_text().count("\n") > 5
    assert isinstance(heard[-1], Progress) and heard[-1].done and heard[-1].iteration == 24
    assert heard[-1].gaussians == len(trainer.gaussians)


def test_what_one_rank_finds_calls_all_off(both):
    for rank in both[0]:
        spoilt = rank["spoilt"]
        assert spoilt["moved"] == [True, False]
        assert spoilt["off"] == [False, True, True] and spoilt["first"] == 4  # broken on one alone
        assert spoilt["kept"] and spoilt["at"] == 6 and spoilt["asked"] == 3
        assert not spoilt["observed"]  # a step that is called off tells density control nothing
        assert spoilt["said"].startswith(f"loss is not finite at iteration 2, view {spoilt['name']}; ")
