"""What a run notes about the machine: alone or contended, reference seconds, state."""

from __future__ import annotations

import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from ambiguous_wild.harness import meter as machine
from ambiguous_wild.harness.grid import plan_cells, run_cells
from ambiguous_wild.harness.meter import ActiveRuns, Meter
from ambiguous_wild.harness.timing import in_reference_seconds
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.calibration import KERNELS, Calibration, CalibrationResult, KernelSize
from ambiguous_wild.splat.cpu.compile import threads
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import train

CORES = 4


class Machine:
    """Clocks that a test moves: `others` processors are busy with other work."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall = self.others = self.own = 0.0
        monkeypatch.setattr(time, "monotonic", lambda: self.wall)
        monkeypatch.setattr(machine, "busy_s", lambda: 1000.0 + self.others + self.own)
        monkeypatch.setattr(machine, "own_s", lambda: 5.0 + self.own)
        monkeypatch.setattr(machine, "allowed_cores", lambda: set(range(CORES)))

    def work(self, seconds: float, *, threads: int = CORES, others: float = 0.0) -> None:
        self.wall, self.own = self.wall + seconds, self.own + threads * seconds
        self.others += others * seconds


def meter(tmp_path: Path, *, kernel: list[float] | None = None, threads: int = CORES) -> Meter:
    seconds = iter(kernel or [0.5] * 100)
    presence = ActiveRuns("cpu", tmp_path)
    return Meter("cpu", threads, read=lambda: CalibrationResult(next(seconds)), presence=presence)


def measured(m: Meter, m_work, seconds: float = 40.0, **how: float) -> tuple[str, str]:
    m.begin(0.0)
    m_work(seconds, **how)
    m.calibrate(seconds)
    m.end()
    return m.verdict(seconds)


def test_a_run_that_has_its_processors_is_alone(tmp_path, monkeypatch):
    assert measured(meter(tmp_path), Machine(monkeypatch).work) == ("alone", "")
    # others may use what this run does not need
    here = Machine(monkeypatch)
    assert measured(meter(tmp_path, threads=1), here.work, threads=1, others=2.9) == ("alone", "")


@pytest.mark.parametrize(("threads", "others"), [(4, 0.5), (4, 2.0), (1, 3.2)])
def test_other_programs_make_a_run_contended(tmp_path, monkeypatch, threads, others):
    m = meter(tmp_path, threads=threads)
    verdict, reason = measured(m, Machine(monkeypatch).work, threads=threads, others=others)
    assert verdict == "contended"
    assert reason == f"other programs used {others:.1f} of 4 processors"
    assert m.cost(40.0)["timing"]["others"] == pytest.approx(others)


def test_a_load_that_others_brought_once_is_not_forgotten(tmp_path, monkeypatch):
    here, m = Machine(monkeypatch), meter(tmp_path)
    m.begin(0.0)
    for k in range(4):
        here.work(10.0, others=2.0 if k == 0 else 0.0)
        m.calibrate(10.0 * (k + 1))
    m.end()
    assert m.verdict(40.0) == ("contended", "other programs used 0.5 of 4 processors")


def sampled(m: Meter, here: Machine, seconds: int) -> tuple[str, str]:
    m.begin(0.0)
    for k in range(1, seconds + 1):
        here.work(1.0)
        m.calibrate(float(k))
    m.end()
    return m.verdict(float(seconds))


def test_a_speed_that_varies_is_contention(tmp_path, monkeypatch):
    slower_later = meter(tmp_path, kernel=[0.5] * 10 + [0.8] * 11)
    words = "the machine's speed varied 1.6 times during the training"
    assert sampled(slower_later, Machine(monkeypatch), 20) == ("contended", words)


def test_noise_of_single_calibrations_is_not_contention(tmp_path, monkeypatch):
    noisy = meter(tmp_path, kernel=[0.4, 0.5, 0.6, 0.5, 0.5, 0.8, 0.5] * 3)
    assert sampled(noisy, Machine(monkeypatch), 20) == ("alone", "")


def test_a_run_that_was_calibrated_late_is_unknown(tmp_path, monkeypatch):
    here, m = Machine(monkeypatch), meter(tmp_path)
    m.begin(30.0)
    here.work(10.0)
    m.calibrate(40.0)
    assert m.verdict(40.0) == ("unknown", "calibrations cover 25 % of the training")


def test_reference_seconds_are_of_the_reference_machine(tmp_path, monkeypatch):
    twice = KERNELS["cpu"].reference_s * 2
    m = meter(tmp_path, kernel=[twice] * 9)
    measured(m, Machine(monkeypatch).work, 40.0)
    cost = m.cost(40.0)
    assert cost["reference_s"] == pytest.approx(20.0)
    record = cost["timing"]
    again = in_reference_seconds(record["samples"], record["kernel_reference_s"], [40.0])
    assert again[0] == cost["reference_s"]


@pytest.mark.parametrize("parallel_s", [0.0, 12.0, 30.0])
def test_load_slows_what_is_serial_less_and_cancels_out(tmp_path, monkeypatch, parallel_s):
    """30 s alone; busy, one thread gets 2/3 of a processor, two get one."""
    found = []
    kernel = KERNELS["cpu"]
    for one, two in ((1.0, 2.0), (2 / 3, 1.0)):
        here = Machine(monkeypatch)
        wall = (30.0 - parallel_s) / one + parallel_s * 2.0 / two
        reading = CalibrationResult(kernel.reference_s * 2.0 / two, two, kernel.serial_reference_s / one, one)
        m = Meter("cpu", 2, read=lambda r=reading: r, presence=ActiveRuns("cpu", tmp_path))
        m.begin(0.0)
        here.wall, here.own = here.wall + wall, here.own + 30.0 + parallel_s
        m.calibrate(wall)
        m.end()
        cost = m.cost(wall)
        # busy, the same work in parallel is a larger share of the time
        share = parallel_s * 2.0 / two / wall
        assert cost["timing"]["parallel_share"] == pytest.approx(share)
        found.append(cost["reference_s"])
    assert found == [pytest.approx(30.0), pytest.approx(30.0)]


def test_a_run_of_one_thread_needs_no_second_kernel(tmp_path, monkeypatch):
    here = Machine(monkeypatch)
    kernel = KERNELS["cpu"]
    reading = CalibrationResult(kernel.reference_s, 1.0, 9.0, 1.0)
    m = Meter("cpu", 1, read=lambda: reading, presence=ActiveRuns("cpu", tmp_path))
    measured(m, here.work, 40.0, threads=1)
    assert m.cost(40.0)["reference_s"] == pytest.approx(40.0)


def test_the_kernel_is_read_on_all_threads_and_on_one():
    size = KernelSize("test", 1.0, 200, 48, 32, 3, 1, 1.0)
    before = threads()
    reading = Calibration(torch.device("cpu"), size).read()
    assert reading.seconds > 0.0 and reading.serial_s is not None and reading.serial_s > 0.0
    assert threads() == before


def test_calibrations_come_often_at_first_and_every_fifteen_seconds_later(tmp_path, monkeypatch):
    Machine(monkeypatch)
    for total, step, fewest, most in ((0.5, 0.01, 2, 2), (40.0, 0.1, 20, 28), (300.0, 0.5, 42, 55)):
        m = meter(tmp_path)
        m.begin(0.0)
        for k in range(1, round(total / step) + 1):
            if m.due(k * step, k * step / total):
                m.calibrate(k * step)
        m.end()
        times = [sample[0] for sample in m.samples]
        assert fewest <= len(times) <= most
        assert times[0] == 0.0 and times[-1] == pytest.approx(total)
        assert max(b - a for a, b in pairwise(times)) <= 15.0 + step


def test_the_state_of_a_meter_goes_on_after_a_kill(tmp_path, monkeypatch):
    here, m = Machine(monkeypatch), meter(tmp_path)
    m.begin(0.0)
    here.work(20.0, others=2.0)
    m.calibrate(20.0)
    here.work(10.0, others=2.0)
    state = m.state_dict()
    m.end()
    other = meter(tmp_path)
    other.load_state_dict(state)
    other.begin(30.0)
    here.work(10.0)
    other.calibrate(40.0)
    other.end()
    assert other.verdict(40.0) == ("contended", "other programs used 1.5 of 4 processors")
    assert [sample[0] for sample in other.samples] == [0.0, 20.0, 30.0, 40.0]


def test_a_rollback_keeps_what_was_spent_and_seen(tmp_path, monkeypatch):
    here, m = Machine(monkeypatch), meter(tmp_path)
    before_the_run = m.state_dict()
    m.begin(0.0)
    here.work(20.0, others=2.0)
    m.calibrate(20.0)
    m.load_state_dict(before_the_run)
    assert not m.due(20.5, 0.5)
    here.work(20.0)
    m.calibrate(40.0)
    assert m.verdict(40.0) == ("contended", "other programs used 1.0 of 4 processors")


def test_runs_count_each_other_and_forget_the_dead(tmp_path):
    one, two = ActiveRuns("cpu", tmp_path), ActiveRuns("cpu", tmp_path)
    other_gpu = ActiveRuns("GPU-1234", tmp_path)
    with one.announced():
        assert one.count() == 1
        with two.announced(), other_gpu.announced():
            assert one.count() == two.count() == 2
            assert other_gpu.count() == 1
        assert one.count() == 1
    code = (
        "import os, sys\nfrom pathlib import Path\n"
        "from ambiguous_wild.harness.meter import ActiveRuns\n"
        "p = ActiveRuns('cpu', Path(sys.argv[1]))\np.announced().__enter__()\nprint(p.count(), flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert done.stdout == "1\n"
    with one.announced():
        assert one.count() == 1
    assert not list(tmp_path.rglob("*.lock"))


def test_two_runs_at_once_are_contended(tmp_path, monkeypatch):
    here, m = Machine(monkeypatch), meter(tmp_path)
    with ActiveRuns("cpu", tmp_path).announced():
        assert measured(m, here.work) == ("contended", "2 runs shared the machine")


def test_busy_seconds_count_the_work_of_others():
    if machine.busy_s() is None:
        pytest.skip("this system does not tell")
    busy, own = machine.busy_s(), machine.own_s()
    subprocess.run([sys.executable, "-c", "sum(range(8_000_000))"], check=True)
    grown, spent = machine.busy_s() - busy, machine.own_s() - own
    assert spent > 0.05  # a child that has ended is ours
    assert grown > spent - 0.05  # ticks of a hundredth


def test_what_the_system_does_not_tell_is_unknown(tmp_path, monkeypatch):
    here = Machine(monkeypatch)
    monkeypatch.setattr(machine, "busy_s", lambda: None)
    m = meter(tmp_path)
    assert measured(m, here.work)[0] == "unknown" and "others" not in m.cost(40.0)["timing"]
    monkeypatch.setattr(machine, "_STAT", tmp_path / "absent")
    monkeypatch.undo()
    monkeypatch.setattr(machine, "_STAT", tmp_path / "absent")
    assert machine.busy_s() is None


def test_the_kernel_does_the_same_work_every_time():
    kernel = Calibration(torch.device("cpu"), KernelSize("test", 1.0, 200, 48, 32, 3))
    before = {name: tensor.clone() for name, tensor in kernel.gaussians.items()}
    assert kernel.seconds() > 0.0
    assert kernel.seconds() > 0.0
    assert all(torch.equal(before[name], tensor) for name, tensor in kernel.gaussians.items())


def test_a_meter_changes_no_bit_of_a_run(scene, tmp_path):
    found = []
    for name in ("with", "without"):
        data = load_train_data(load_scene(scene), device=torch.device("cpu"), seed=0, cache_dir=tmp_path)
        trainer = Trainer(data, MethodHooks(), TrainConfig(iterations=60, probes=2), folder=tmp_path / name)
        if name == "with":
            trainer.meter = meter(tmp_path, kernel=[1.0] * 100)
            monitored = trainer.meter
            monitored.due = lambda trained_s, progress: True  # after every iteration
            kernel = Calibration(torch.device("cpu"), KernelSize("test", 1.0, 200, 48, 32, 1))
            monitored._read = kernel.read
        train(trainer)
        found.append({k: v.numpy().tobytes() for k, v in trainer.gaussians.items()})
    assert len(monitored.samples) == 61
    assert found[0] == found[1]


def test_every_run_records_its_time(scene, tmp_path):
    cells = plan_cells(["3dgs"], [scene], [0], TrainConfig(iterations=30))
    (report,) = run_cells(cells, tmp_path / "runs")
    cost = report.result["cost"]
    record = cost["timing"]
    assert record["kernel"] == "cpu-3" and record["runs"] >= 1
    assert [at for at, _ in record["samples"]] == [0.0, pytest.approx(cost["train_s"])]
    again = in_reference_seconds(record["samples"], record["kernel_reference_s"], [cost["train_s"]])
    assert cost["reference_s"] == pytest.approx(again[0])
    assert 0.0 < cost["cpu_s"] <= 1.5 * len(machine.allowed_cores()) * cost["train_s"]
