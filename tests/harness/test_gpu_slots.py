"""Cells side by side on one machine: which GPU each process sees. No GPU is needed to look at variables."""

import os
from dataclasses import dataclass
from typing import ClassVar

import pytest

from ambiguous_wild.harness.running.callbacks import Lines
from ambiguous_wild.harness.running.cell import CellReport
from ambiguous_wild.harness.running.engines import processes
from ambiguous_wild.harness.running.engines.gpu_slots import VISIBLE, sharing, slot_environment, visible_gpus
from ambiguous_wild.harness.running.engines.processes import run_in_processes
from ambiguous_wild.harness.running.engines.session import Engine, Grid, Session


@pytest.mark.parametrize(
    ("count", "outer", "names"),
    [
        (3, None, ["0", "1", "2"]),
        (2, "3,1", ["3", "1"]),
        (2, " GPU-8932f937 , MIG-5c89/1/0 ", ["GPU-8932f937", "MIG-5c89/1/0"]),
        (1, "2,-1,3", ["2"]),  # CUDA stops at what is invalid, and torch counts what is left
        (0, "", []),
        (0, None, []),
    ],
)
def test_gpus_go_by_the_names_that_the_outer_variable_has(count, outer, names):
    assert visible_gpus(count, {} if outer is None else {VISIBLE: outer}) == names


def test_slots_take_turns():
    gpus = ["4", "GPU-a"]
    assert [slot_environment(i, gpus) for i in range(3)] == [{VISIBLE: g} for g in ("4", "GPU-a", "4")]
    assert slot_environment(5, []) == {}


def test_sharing_is_said():
    assert sharing(2, ["0", "1"]) == sharing(1, ["0"]) == sharing(8, []) == ""
    assert "4 cells at a time share 2 GPUs" in sharing(4, ["0", "1"])
    assert "--jobs 2 gives each its own" in sharing(4, ["0", "1"])
    assert "share 1 GPU," in sharing(2, ["0"])


@dataclass(frozen=True)
class Told:
    """A job that says what it saw, in the place of a `Job`."""

    folder: str
    dies: str = ""  # a file: gone, it no longer dies


def tell(job):
    """In the place of `run_job`, in a process of its own."""
    import sys
    from pathlib import Path

    torch = sys.modules.get("torch")  # imported with what the process runs, and not yet asked
    asked = torch is not None and torch.cuda.is_initialized()
    return CellReport(Path(job.folder), "trained", error=f"{os.environ.get(VISIBLE)} {asked}")


class Silent:
    """In the place of a worker's process: the worker alone is looked at, nothing starts."""

    started: ClassVar[list] = []

    def __init__(self, target, args, daemon):
        self.pipe, self.exitcode = args[0], 0

    def start(self):
        Silent.started.append(dict(os.environ))
        self.serve()

    def serve(self):
        import threading

        seen = os.environ.get(VISIBLE)

        def life():
            try:
                while True:
                    job = self.pipe.recv()
                    if job.dies and os.path.exists(job.dies):
                        os.unlink(job.dies)
                        break
                    self.pipe.send(CellReport(job.folder, "trained", error=str(seen)))
            except (EOFError, OSError):
                pass
            mine.close()

        # The worker closes what it was given once the process has it.
        mine = self.pipe = type(self.pipe)(os.dup(self.pipe.fileno()))
        self.thread = threading.Thread(target=life, daemon=True)
        self.thread.start()

    def join(self, timeout=None):
        self.thread.join(timeout)

    def is_alive(self):
        return False

    def terminate(self):
        pass


@pytest.fixture
def started(monkeypatch):
    monkeypatch.setattr(Silent, "started", [])

    class Context:
        Pipe = staticmethod(processes.multiprocessing.Pipe)
        Process = Silent

    monkeypatch.setattr(processes.multiprocessing, "get_context", lambda kind: Context)
    monkeypatch.delenv(VISIBLE, raising=False)
    return Silent.started


def run(jobs, count, gpus):
    def lost(index, reason):
        return CellReport(jobs[index].folder, "failed", error=reason)

    return [report.error for report in run_in_processes(jobs, count, retries=1, lost=lost, gpus=gpus)]


def test_every_process_starts_with_a_gpu_of_its_own(started):
    saw = run([Told(str(i)) for i in range(5)], 3, ["7", "GPU-b", "2"])
    assert [environment[VISIBLE] for environment in started] == ["7", "GPU-b", "2"]
    assert set(saw) == {"7", "GPU-b", "2"}
    assert VISIBLE not in os.environ


def test_more_processes_than_gpus_share_them_in_turns(started, monkeypatch):
    monkeypatch.setenv(VISIBLE, "0,1")
    run([Told(str(i)) for i in range(4)], 4, ["0", "1"])
    assert [environment[VISIBLE] for environment in started] == ["0", "1", "0", "1"]
    assert os.environ[VISIBLE] == "0,1"


def test_on_the_cpu_nothing_is_set(started):
    run([Told("a"), Told("b")], 2, [])
    assert len(started) == 2 and not any(VISIBLE in environment for environment in started)


def test_the_process_after_one_that_died_takes_its_gpu(started, tmp_path):
    jobs = [Told(str(i), dies=str(tmp_path / f"deadly{i}")) for i in range(2)]
    for job in jobs:
        (tmp_path / f"deadly{job.folder}").touch()
    saw = run(jobs, 2, ["0", "1", "2"])
    seen = [environment[VISIBLE] for environment in started]
    assert len(seen) > 2 and set(seen) == {"0", "1"} and set(saw) <= {"0", "1"}


def test_a_real_process_has_it_before_torch_looks(monkeypatch):
    monkeypatch.delenv(VISIBLE, raising=False)
    monkeypatch.setattr(processes, "_serve", serve)
    assert run([Told("a"), Told("b")], 2, ["5", "6"]) in (["5 False", "6 False"], ["6 False", "5 False"])


def serve(connection):
    """What `_serve` does, for jobs of this file."""
    while True:
        try:
            connection.send(tell(connection.recv()))
        except EOFError:
            return


# -- the command line -----------------------------------------------------------------------------


@dataclass
class FakeCell:
    device: str = "cuda"


@pytest.fixture
def four_gpus(monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    monkeypatch.setenv(VISIBLE, "4,5,6,7")


@pytest.mark.parametrize(
    ("jobs", "cells", "device", "here", "at_a_time"),
    [
        (None, 9, "cuda", False, 4),  # one a GPU
        (None, 3, "cuda", False, 3),
        (None, 1, "cuda", True, 1),
        (2, 9, "cuda", False, 2),
        (1, 9, "cuda", True, 1),
        (None, 9, "cpu", True, 1),
        (3, 9, "cpu", False, 3),
    ],
)
def test_how_many_cells_at_a_time(four_gpus, jobs, cells, device, here, at_a_time):
    session = Session(Engine(jobs=jobs), None)
    assert session.in_process([FakeCell(device)] * cells) is here
    assert session.engine.jobs == at_a_time
    assert session.gpus == (["4", "5", "6", "7"] if device == "cuda" else [])


def test_ray_shares_gpus_out_itself(four_gpus):
    session = Session(Engine(engine="ray"), None)
    assert not session.in_process([FakeCell()]) and session.gpus == [] and session.engine.jobs is None


@pytest.mark.parametrize(("jobs", "warned"), [(6, True), (4, False)])
def test_the_session_hands_the_gpus_on_and_warns_where_they_are_shared(four_gpus, monkeypatch, jobs, warned):
    given = {}
    monkeypatch.setattr(
        processes, "run_in_processes", lambda made, count, **rest: given.update(rest, count=count) or []
    )
    monkeypatch.setattr(Grid, "jobs", lambda self, threads: [None] * 9)
    said = []
    session = Session(Engine(jobs=jobs), None, Lines(said.append))
    cells = [FakeCell()] * 9
    session.in_process(cells)
    session.run(Grid(cells, None, "missing", None, False, (), ()))
    assert given["gpus"] == ["4", "5", "6", "7"] and given["count"] == jobs
    begins = f"warning: {jobs} cells at a time share 4 GPUs"
    assert any(line.startswith(begins) for line in said) is warned
