"""The training loop: learns, repeats bit for bit, resumes, and counts only its own time."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.core.scene import NO_PHOTO
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.cpu import set_threads
from ambiguous_wild.splat.data import shrink, shrink_keep
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks, Schedule
from ambiguous_wild.splat.rendered import Cotangents
from ambiguous_wild.splat.run_schedule import (
    ResolutionLevel,
    RunSchedule,
    coarse_to_fine,
    downsampling_at,
    growth_cap_at,
)
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.training_loop import train
from tests.splat.scenes import bits, same, trained, trainer_for
from tests.tiny_scene import write_tiny_scene


def parts_of(method: str) -> MethodHooks:
    """A method's parts; RefineSplat with a short warm-up, so that all of it runs in a short test."""
    entry = get_method(method)
    options = entry.options()
    if method == "refinesplat":
        psi, density = replace(options.psi, steps=40), replace(options.density, min_every=20, merge_every=1.0)
        options = replace(options, psi=psi, density=density, min_mask_start=20, min_reset_pause=10)
    return entry.build(options)


def test_training_learns_the_scene(tmp_path):
    scene = load_scene(write_tiny_scene(tmp_path / "scene", distractors=False))
    trainer = trained(scene, tmp_path / "run", iterations=300)
    errors = [
        float((trainer.render(camera).image - photo).square().mean())
        for camera, photo in zip(trainer.data.cameras, trainer.data.photos)
    ]
    assert -10 * np.log10(np.mean(errors)) > 25
    losses = [row["loss"] for row in trainer.timeline.rows]
    assert losses[-1] < 0.5 * losses[0]


@pytest.mark.parametrize("method", ["3dgs", "refinesplat"])
def test_same_seed_same_bits_for_one_and_two_threads(scene, tmp_path, method):
    results = []
    try:
        for threads in (1, 2):
            set_threads(threads)
            run = trained(scene, tmp_path / str(threads), parts=parts_of(method), iterations=80)
            results.append(bits(run))
    finally:
        set_threads(2)
    assert results[0] == results[1]


def test_another_seed_gives_other_bits(scene, tmp_path):
    runs = [trained(scene, tmp_path / str(seed), seed=seed, iterations=10) for seed in (0, 1)]
    assert bits(runs[0]) != bits(runs[1])


SCRIPT = """
import sys, torch
from pathlib import Path
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import train
scene, folder = load_scene(sys.argv[1]), Path(sys.argv[2])
data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=folder)
config = TrainConfig(iterations=400, checkpoint_every_s=0.05, probes=0)
trainer = Trainer(data, MethodHooks(), config, folder=folder)
trainer.resume()
train(trainer)
"""


@pytest.mark.slow
def test_kill_in_mid_training_then_again_gives_the_same_checkpoint(scene, tmp_path):
    """kill -9 after the first checkpoint appeared; the same command ends with the same state."""
    for name in ("whole", "killed"):
        command = [sys.executable, "-c", SCRIPT, str(scene.root), str(tmp_path / name)]
        if name == "killed":
            process = subprocess.Popen(command, cwd=Path(__file__).parents[2])
            saved = tmp_path / name / "checkpoint" / "last.safetensors"
            deadline = time.monotonic() + 60
            while not saved.exists() and time.monotonic() < deadline:
                time.sleep(0.005)
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            assert checkpoint.load(saved)["iteration"] < 400
        subprocess.run(command, check=True, cwd=Path(__file__).parents[2])
    whole, killed = (
        checkpoint.load(tmp_path / n / "checkpoint" / "last.safetensors") for n in ("whole", "killed")
    )
    for part in ("gaussians", "optimiser", "density"):
        assert same(whole[part], killed[part]), part


class FakeTime:
    """A clock that moves about a millisecond each time it is read, and on request; sums are exact."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        self.now += 2.0**-10
        return self.now

    def monotonic(self):
        return self.now

    def process_time(self):
        return 2.0 * self.now


@pytest.fixture
def fake_time(monkeypatch):
    clock = FakeTime()
    for module in ("training_loop", "training_records"):
        monkeypatch.setattr(f"ambiguous_wild.splat.{module}.time", clock)
    return clock


def test_probing_changes_nothing_and_costs_no_training_time(scene, tmp_path, fake_time):
    def slow_probe(draw):
        for view in scene.test:
            draw(view.camera)
        fake_time.now += 1000.0
        return 12.5

    without = trained(scene, tmp_path / "a", probes=0)
    probed = trained(scene, tmp_path / "b", probes=4, probe=slow_probe)
    assert bits(without) == bits(probed)
    values = [row["psnr_probe"] for row in probed.timeline.rows if row["psnr_probe"] is not None]
    assert values == [12.5] * 4
    assert probed.clock.now() == pytest.approx(without.clock.now())


def test_under_a_budget_probes_take_no_iteration_from_the_run(scene, tmp_path, fake_time):
    def slow_probe(draw):
        draw(scene.test[0].camera)
        fake_time.now += 1000.0
        return 12.5

    def run(name, **kw):  # effects learn: each run has its own
        return trained(
            scene, tmp_path / name, parts=with_effects(MethodHooks(), ("exposure",)), budget_s=1.0, **kw
        )

    without, probed = run("a", probes=0), run("b", probes=8, probe=slow_probe)
    assert probed.iteration == without.iteration > 20
    assert bits(without) == bits(probed)
    assert probed.clock.now() == without.clock.now()
    assert probed.clock.parts_s == without.clock.parts_s
    assert [row["wall_s"] for row in probed.timeline.rows] == [row["wall_s"] for row in without.timeline.rows]
    assert sum(row["psnr_probe"] is not None for row in probed.timeline.rows) == 8


def test_the_timeline_is_a_table(scene, tmp_path):
    import pandas as pd

    trainer = trained(scene, tmp_path)
    table = pd.read_csv(tmp_path / "timeline.csv")
    assert table["iteration"].is_monotonic_increasing
    assert table["iteration"].iloc[-1] == 60
    assert {"wall_s", "loss", "gaussians", "ms_render", "ms_backward"} <= set(table.columns)
    assert table["gaussians"].iloc[-1] == len(trainer.gaussians)


class _AllMasked(MaskPolicy):
    def keep(self, step):
        return torch.zeros(step.photo.shape[:2])


def test_photos_that_are_all_masked_teach_nothing_and_are_named(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path, parts=MethodHooks(mask=_AllMasked()), iterations=12)
    before = bits(trainer)
    train(trainer)
    assert bits(trainer) == before
    assert trainer.skipped_views == [v.name for v in scene.train]


@pytest.mark.parametrize("value", [-5.0, 5.0, 1e30, float("nan")])
def test_keep_maps_of_absurd_values_are_refused(scene, tmp_path, value):
    class Absurd(MaskPolicy):
        def keep(self, step):
            return torch.full(step.photo.shape[:2], value)

    with pytest.raises(AwError, match="gave values from"):
        trainer_for(scene, tmp_path, parts=MethodHooks(mask=Absurd())).step()


def _narrow(step):
    return step.photo[..., :1]


@pytest.mark.parametrize(
    ("place", "fault", "message"),
    [
        (
            "keep",
            lambda step: step.photo.mul_(0.99)[..., 0],
            "keep, loss or cotangent of MaskPolicy changed step.ph",
        ),
        (
            "keep",
            lambda step: step.rendered.image.clamp_(0, 0.5)[..., 0],
            "changed step.photo or step.rendered.image in",
        ),
        (
            "cotangent",
            lambda step, keep: Cotangents(image=_narrow(step)),
            r"image \[48, 64, 1\]; .* \[48, 64, 3\]",
        ),
        (
            "cotangent",
            lambda step, keep: Cotangents(alpha=_narrow(step)),
            r"alpha \[48, 64, 1\]; .* \[48, 64\]",
        ),
    ],
)
def test_what_a_policy_must_not_do_is_refused(scene, tmp_path, place, fault, message):
    mask = MaskPolicy()
    setattr(mask, place, fault)
    with pytest.raises(AwError, match=message):
        trainer_for(scene, tmp_path, parts=MethodHooks(mask=mask)).step()


def test_an_old_name_says_the_new_one(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path)
    with pytest.raises(AwError, match=r"trainer\.hooks"):
        _ = trainer.parts
    with pytest.raises(AwError, match=r"step\.downsampling"):
        _ = trainer.make_step(1, 0).divisor


def test_a_method_gets_no_test_photo(scene, tmp_path):
    given = []

    class Curious(MaskPolicy):
        def setup(self, data):
            given.append(data)

    parts = MethodHooks(mask=Curious(), train_data=lambda data: given.append(data) or data)
    trainer = trainer_for(scene, tmp_path, parts=parts)
    assert len(given) == 2 and trainer.data.scene.test == scene.test
    for data in given:
        assert data.scene.train == scene.train and len(data.scene.test) == len(scene.test) > 0
        assert all((view.image_path, view.keep_path) == (NO_PHOTO, None) for view in data.scene.test)


def test_a_length_that_nobody_trains_is_refused():
    for iterations in (0, 10**20 - 1):
        with pytest.raises(AwError, match="--iterations"):
            TrainConfig(iterations=iterations)


class _Counting(MaskPolicy):
    calls: dict[str, int]

    def __init__(self):
        self.calls = {"keep": 0, "predict": 0}

    def keep(self, step):
        self.calls["keep"] += 1

    def predict(self, step):
        self.calls["predict"] += 1


def test_a_users_mask_is_obeyed(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path)
    user = torch.ones(trainer.data.photos[0].shape[:2])
    user[:10] = 0
    trainer.data = replace(trainer.data, user_keep=[user, *trainer.data.user_keep[1:]])
    step = trainer.make_step(1, 0)
    assert torch.equal(trainer.combine_user_keep(step, None), user)
    half = torch.full_like(user, 0.5)
    assert torch.equal(trainer.combine_user_keep(step, half), user * 0.5)
    assert trainer.combine_user_keep(trainer.make_step(1, 1), None) is None


def test_a_budget_scales_the_schedule_and_is_kept(scene, tmp_path, fake_time):
    trainer = trained(scene, tmp_path, budget_s=1.5, probes=0)
    assert trainer.progress(trainer.iteration) == 1.0
    per_iteration = trainer.clock.now() / trainer.iteration
    assert 1.5 <= trainer.clock.now() < 1.5 + 2 * per_iteration
    # SH grows by nominal time: a budgeted run of any length ends at the full degree
    assert trainer.render(trainer.data.cameras[0]).image.shape == trainer.data.photos[0].shape
    assert [row["wall_s"] for row in trainer.timeline.rows] == sorted(
        row["wall_s"] for row in trainer.timeline.rows
    )


def test_every_view_once_an_epoch(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path)
    order = [trainer.run_schedule.view(i) for i in range(1, 13)]
    assert sorted(order[:6]) == sorted(order[6:]) == list(range(6))


def test_coarse_to_fine_follows_the_photos_spectrum():
    rng = np.random.default_rng(0)
    noise = rng.random((400, 400, 3))
    smooth = np.cumsum(np.cumsum(noise - 0.5, 0), 1)
    rough_levels, smooth_levels = coarse_to_fine([noise]), coarse_to_fine([smooth])
    assert [level.factor for level in rough_levels] == [4, 2, 1]
    assert all(0 <= a.begin < b.begin <= 0.4 for a, b in pairwise(rough_levels))
    assert [level.factor for level in smooth_levels] == [4, 2, 1]
    assert coarse_to_fine([np.full((400, 400, 3), 0.5)]) == (ResolutionLevel(0.0, 1),)
    assert coarse_to_fine([noise[:80, :80]]) == (ResolutionLevel(0.0, 1),)
    assert [downsampling_at(rough_levels, p) for p in (0.0, 0.5, 1.0)] == [4, 1, 1]


def test_the_number_of_gaussians_needs_no_photo():
    """A photo that does not fit into memory is read from its file."""
    camera, scene = SimpleNamespace(height=8, width=9), SimpleNamespace(extent=1.0)
    data = SimpleNamespace(scene=scene, photos=[None], cameras=[camera])
    assert RunSchedule(TrainConfig(iterations=100), Schedule(), data, start=5, most=100).max_gaussians == 72


def test_the_count_ceiling_rises_with_the_resolution():
    values = [
        growth_cap_at(1000, 50_000, d, p) for d, p in ((4, 0.0), (4, 0.2), (2, 0.2), (2, 0.4), (1, 0.4))
    ]
    assert values == sorted(values)
    assert values[0] == 1000 + 49_000 // 16
    assert values[-1] == 50_000


def test_a_short_run_grows_no_more_than_a_gaussian_a_pixel(scene, tmp_path):
    pixels = 64 * 48
    assert trainer_for(scene, tmp_path, iterations=100).run_schedule.max_gaussians == pixels
    assert trainer_for(scene, tmp_path, iterations=30_000).run_schedule.max_gaussians == 1_000_000
    assert trainer_for(scene, tmp_path, iterations=100, max_gaussians=500).run_schedule.max_gaussians == 500


def test_more_points_than_a_run_may_hold_are_thinned_evenly(scene, tmp_path):
    whole, few = trainer_for(scene, tmp_path / "a"), trainer_for(scene, tmp_path / "b", max_gaussians=300)
    assert len(whole.gaussians) == 400 and len(few.gaussians) == 200
    kept = (few.gaussians.means[:, None] == whole.gaussians.means[None]).all(dim=2)
    assert (
        kept.sum() == 200
        and abs(float(few.gaussians.means[:, 0].mean() - whole.gaussians.means[:, 0].mean())) < 0.3
    )


def test_shrinking_averages_photos_and_keeps_only_whole_blocks():
    photo = torch.arange(4 * 6 * 3, dtype=torch.float32).reshape(4, 6, 3)
    small = shrink(photo, 2)
    assert small.shape == (2, 3, 3)
    assert torch.allclose(small[0, 0], photo[:2, :2].mean(dim=(0, 1)))
    keep = torch.ones(4, 6)
    keep[0, 1] = 0
    assert shrink_keep(keep, 2).tolist() == [[0, 1, 1], [1, 1, 1]]


FIRST_IN_A_PROCESS = """
import sys
from pathlib import Path
import torch
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.io.scene_folder import load_scene

torch.set_num_threads(2)
scene, folder = load_scene(sys.argv[1]), Path(sys.argv[2])
data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=folder)
trainer = Trainer(data, MethodHooks(), TrainConfig(iterations=2, probes=0), folder=folder)
trainer.step()
print(torch.get_num_threads())
"""


def test_the_first_training_of_a_process_has_its_number_of_torch_threads(tmp_path):
    """Numba's pool, which starts with its first kernel, sets the number for torch too."""
    scene = write_tiny_scene(tmp_path / "scene")
    command = [sys.executable, "-c", FIRST_IN_A_PROCESS, str(scene), str(tmp_path / "run")]
    found = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"NUMBA_NUM_THREADS": "2"}
    )
    assert found.stdout.split() == ["1"], found.stderr
