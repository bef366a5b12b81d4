"""As many probes as were asked for, evenly spaced, whatever the length."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.method_hooks import MethodHooks, Schedule
from ambiguous_wild.splat.run_schedule import RunSchedule
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import advance, train
from ambiguous_wild.splat.training_records import ROWS, Timeline
from tests.splat.scenes import trained

COUNTS = (1, 3, 7, 8, 16)


class Empty(Trainer):
    """A run whose steps learn nothing; its clock is set by the test."""

    gaussians = range(5)  # type: ignore[assignment]
    meter = marks = device_check = None  # type: ignore[assignment]
    density = SimpleNamespace(last_reset=0)  # type: ignore[assignment]
    step_s = 0.01
    between_s = 0.0  # pass after a step, before the clock is read again

    def __init__(self, config: TrainConfig, folder: Any) -> None:
        photo, camera = torch.zeros(8, 8, 3), SimpleNamespace(height=8, width=8)
        data = SimpleNamespace(scene=SimpleNamespace(extent=1.0), photos=[photo], cameras=[camera])
        self.config, self.folder, self.iteration = config, folder, 0
        self.probe = lambda draw: 20.0 + self.iteration
        self.timeline = Timeline()
        self.run_schedule = RunSchedule(config, Schedule(), data, start=5, most=5)  # type: ignore[arg-type]
        self.clock = Steady(self)

    def step(self) -> float:
        self.iteration += 1
        self.clock.elapsed_s += self.step_s
        return 0.5

    def check_parameters(self) -> None: ...

    def state(self) -> dict[str, Any]:
        rows = [dict(row) for row in self.timeline.rows]
        return {"iteration": self.iteration, "elapsed_s": self.clock.elapsed_s, "rows": rows}

    def load_state(self, state: dict[str, Any]) -> None:
        self.iteration, self.clock.elapsed_s = state["iteration"], state["elapsed_s"]
        self.timeline.rows = state["rows"]
        self.marks = None

    def probed(self) -> list[dict[str, Any]]:
        return [row for row in self.timeline.rows if row["psnr_probe"] is not None]


class Steady:
    """A clock that stands still but for the steps, and for what passes while it is stopped and started."""

    def __init__(self, run: Empty) -> None:
        self.run, self.elapsed_s, self.parts_s, self.cpu_s = run, 0.0, {}, 0.0

    def start(self) -> None: ...

    def stop(self) -> None:
        self.elapsed_s += self.run.between_s

    def now(self) -> float:
        return self.elapsed_s

    def settle_stopped(self) -> None: ...


@pytest.mark.parametrize("probes", COUNTS)
@pytest.mark.parametrize("iterations", [1000, 3000])
def test_iterations_have_the_probes_that_were_asked_for(tmp_path, probes, iterations):
    run = Empty(TrainConfig(iterations=iterations, probes=probes), tmp_path)
    train(run)
    at = [row["iteration"] for row in run.probed()]
    assert at == [-(-k * iterations // probes) for k in range(1, probes + 1)]
    assert sum(row["iteration"] * ROWS % iterations < ROWS for row in run.timeline.rows) == ROWS


@pytest.mark.parametrize("probes", COUNTS)
@pytest.mark.parametrize("between_s", [0.0, 0.003, 0.02])
def test_a_budget_has_the_probes_that_were_asked_for(tmp_path, probes, between_s):
    run = Empty(TrainConfig(budget_s=10.0, probes=probes), tmp_path)
    run.between_s = between_s
    train(run)
    at = np.array([row["wall_s"] for row in run.probed()])
    assert len(at) == probes
    np.testing.assert_allclose(
        at, 10.0 * np.arange(1, probes + 1) / probes, atol=run.step_s + between_s + 1e-9
    )
    assert at[-1] >= 10.0  # the last is of the model that is saved


@pytest.mark.parametrize("budget_s", [None, 10.0])
def test_a_run_that_goes_on_has_no_probe_twice_and_none_too_few(tmp_path, budget_s):
    config = TrainConfig(iterations=1000, budget_s=budget_s, probes=7)
    whole = Empty(config, tmp_path)
    train(whole)
    state: dict[str, Any] | None = None
    for stop in (1, 142, 143, 144, 500, 999, 1001):
        run = Empty(config, tmp_path)
        if state is not None:
            run.load_state(state)
        while run.iteration < stop and not run.done:
            advance(run)
        state = run.state()
    assert run.done
    assert [r["iteration"] for r in run.probed()] == [r["iteration"] for r in whole.probed()]


def test_steps_longer_than_the_distance_of_probes_have_one_each(tmp_path):
    run = Empty(TrainConfig(iterations=5, probes=16), tmp_path)
    train(run)
    assert [row["iteration"] for row in run.probed()] == [1, 2, 3, 4, 5]


def test_no_probe_falls_on_a_reset_of_opacities(scene, tmp_path):
    density = DensityConfig(resets=(15_000.0,), min_reset_rest=1, min_reset_spacing=1)
    parts = MethodHooks(density_config=density)
    run = trained(scene, tmp_path, parts=parts, probe=lambda draw: 20.0, iterations=40, probes=4)
    assert run.density.last_reset == 20
    probed = [row["iteration"] for row in run.timeline.rows if row["psnr_probe"] is not None]
    assert probed == [10, 30, 40]
