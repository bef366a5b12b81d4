"""Cells side by side on one machine: which GPU each process sees. No GPU is needed to look at variables."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from ambiguous_wild.harness import job, session
from ambiguous_wild.harness.callbacks import Engine, Lines
from ambiguous_wild.harness.cell import CellReport
from ambiguous_wild.harness.session import VISIBLE, Session, run_in_processes, visible_gpus


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
def test_gpus_go_by_the_names_that_the_outer_variable_has(count, outer, names, monkeypatch):
    monkeypatch.delenv(VISIBLE, raising=False)
    if outer is not None:
        monkeypatch.setenv(VISIBLE, outer)
    assert visible_gpus(count) == names


@dataclass(frozen=True)
class Told:
    """A job that says what it saw, in the place of a `Job`."""

    folder: str
    dies: str = ""  # a file: gone, it no longer dies


AT_IMPORT = os.environ.get(VISIBLE)  # a worker imports this file as it would import the caller's script


def serve(connection):
    """What a worker does, for jobs of this file."""
    before = "torch" in sys.modules  # CUDA reads the variable once
    assert os.environ.get(VISIBLE) == AT_IMPORT
    while True:
        try:
            told = connection.recv()
        except EOFError:
            return
        if told.dies and os.path.exists(told.dies):
            os.unlink(told.dies)
            os._exit(3)
        connection.send(CellReport(Path(told.folder), "trained", error=f"{os.environ.get(VISIBLE)} {before}"))


def run(jobs, count, gpus):
    def lost(index, reason):
        return CellReport(Path(jobs[index].folder), "failed", error=reason)

    return {report.error for report in run_in_processes(jobs, count, 1, lost, gpus=gpus)}


def test_every_process_sees_one_gpu_and_the_one_after_a_death_the_same(monkeypatch, tmp_path):
    monkeypatch.setenv(VISIBLE, "0,1")
    monkeypatch.setattr(session, "serve", serve)
    deadly = tmp_path / "deadly"
    deadly.touch()
    saw = run([Told("0", dies=str(deadly)), *(Told(str(i)) for i in range(1, 5))], 3, ["7", "GPU-b"])
    assert not deadly.exists() and os.environ[VISIBLE] == "0,1"
    assert {gpu for gpu, _ in map(str.split, saw)} == {"7", "GPU-b"}


def test_on_the_cpu_nothing_is_set(monkeypatch):
    monkeypatch.delenv(VISIBLE, raising=False)
    monkeypatch.setattr(session, "serve", serve)
    assert {gpu for gpu, _ in map(str.split, run([Told("a")], 2, []))} == {"None"}


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
    used = Session(Engine(jobs=jobs), None)
    assert used.in_process([FakeCell(device)] * cells) is here
    assert used.engine.jobs == at_a_time
    assert used.gpus == (["4", "5", "6", "7"] if device == "cuda" else [])


def test_ray_shares_gpus_out_itself(four_gpus):
    used = Session(Engine(engine="ray"), None)
    assert not used.in_process([FakeCell()]) and used.gpus == [] and used.engine.jobs is None


@pytest.mark.parametrize(("jobs", "warned"), [(6, True), (4, False)])
def test_the_session_hands_the_gpus_on_and_warns_where_they_are_shared(four_gpus, monkeypatch, jobs, warned):
    given, said, cells = [], [], [FakeCell()] * 9
    monkeypatch.setattr(session, "run_in_processes", lambda *made: given.extend(made) or [])
    monkeypatch.setattr(job, "make_job", lambda *made: None)
    monkeypatch.setattr("ambiguous_wild.harness.grid.check_run_folders", lambda *made: [None] * 9)
    used = Session(Engine(jobs=jobs), None, Lines(said.append))
    used.in_process(cells)
    used.run(cells, Path(), None)
    assert given[1] == jobs and given[-1] == ["4", "5", "6", "7"]
    begins = f"warning: {jobs} cells at a time share the memory and the time of 4 GPUs"
    assert any(line.startswith(begins) for line in said) is warned
