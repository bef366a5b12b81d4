"""Where cells run: this process, several processes, or a Ray cluster. Imports nothing heavy by itself."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING

from ambiguous_wild.harness.callbacks import Callbacks, Engine

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell, CellReport, RunOptions
    from ambiguous_wild.harness.job import Job, Source
    from ambiguous_wild.harness.ray_cluster import RayCluster

VISIBLE = "CUDA_VISIBLE_DEVICES"
STOP_S = 5.0  # between asking a process to end and ending it


class Session:
    """An engine in use: connects to Ray when that is needed, and disconnects at the end of the `with`."""

    def __init__(self, engine: Engine, threads: int | None, callbacks: Callbacks | None = None) -> None:
        """
        Args:
            engine: where cells run.
            threads: of the CPU kernels of one cell; None = the cores, divided.
            callbacks: told what happens.
        """
        self.engine, self.threads = engine, threads
        self.callbacks = Callbacks() if callbacks is None else callbacks
        self.gpus: list[str] = []  # of this machine, where its processes share them out
        self.cluster: RayCluster | None = None

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *error: object) -> None:
        if self.cluster is not None:
            self.cluster.close()

    def device(self, device: str) -> str:
        """ "cpu" or "cuda": of a cluster by what its nodes offer, else of this machine.

        Raises:
            AwError: "cuda" was asked for and cannot be used here; says what is missing.
        """
        if self.engine.remote:
            if device == "auto":
                return "cuda" if self._connected().has_gpu() else "cpu"
            return device
        if device == "cpu":
            return device
        from ambiguous_wild.splat.readiness import choose

        return choose(device, self.callbacks.say)

    def in_process(self, cells: Sequence[Cell]) -> bool:
        """Whether cells run in this process, one by one; else `run` starts others. Each GPU takes a cell."""
        if self.engine.engine != "local":
            return False
        if any(cell.device == "cuda" for cell in cells):
            import torch

            self.gpus = visible_gpus(torch.cuda.device_count())
        if self.engine.jobs is None:
            self.engine = replace(self.engine, jobs=max(1, min(len(self.gpus), len(cells))))
        return self.engine.jobs == 1

    def run(
        self,
        cells: Sequence[Cell],
        output: Path,
        options: RunOptions,
        sources: tuple[Source, ...] = (),  # code that the runs need
    ) -> list[CellReport]:
        """Run the cells in processes of this machine or on the cluster; reports in their order."""
        from ambiguous_wild.harness.grid import checked_folders
        from ambiguous_wild.harness.job import make_job, record_lost

        engine, say = self.engine, self.callbacks.say
        cluster = self._connected() if engine.engine == "ray" else None
        threads = self.threads or (
            max(1, int(engine.cpus_per_cell or 1)) if cluster else max(1, _cores() // (engine.jobs or 1))
        )
        folders = checked_folders(cells, output, options)
        jobs = [make_job(cell, folder, options, sources, threads) for cell, folder in zip(cells, folders)]

        def lost(index: int, reason: str) -> CellReport:
            return record_lost(cells[index], folders[index], reason)

        def ended(index: int, report: CellReport) -> None:
            self.callbacks.ended(cells[index], report)

        if cluster is not None:
            say(f"Ray: {cluster.describe()}")
            return cluster.run(jobs, lost, ended, say)
        at_a_time = engine.jobs or 1
        if self.gpus and min(at_a_time, len(jobs)) > len(self.gpus):
            have = "1 GPU" if len(self.gpus) == 1 else f"{len(self.gpus)} GPUs"
            say(
                f"warning: {at_a_time} cells at a time share {have}, memory and time; "
                f"--jobs {len(self.gpus)} gives each its own"
            )

        def started(index: int) -> None:
            self.callbacks.started(cells[index], folders[index])

        return run_in_processes(jobs, at_a_time, engine.retries, lost, started, ended, self.gpus)

    def _connected(self) -> RayCluster:
        if self.cluster is None:
            from ambiguous_wild.harness.ray_cluster import RayCluster

            self.cluster = RayCluster(self.engine, self.engine.cpus_per_cell or float(self.threads or 1))
        return self.cluster


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def visible_gpus(count: int) -> list[str]:
    """The first `count` GPUs of this process by the names that CUDA_VISIBLE_DEVICES of a child needs.

    Where that variable is set here, its own entries: numbers of the machine's GPUs, UUIDs (``GPU-...``) or
    MIG instances. A child that got 0 to `count` - 1 instead would leave what this process was given. Entries
    after an invalid one do not count, as for CUDA; torch's count says how many that leaves.
    """
    given = os.environ.get(VISIBLE)
    names = [str(i) for i in range(count)] if given is None else [name.strip() for name in given.split(",")]
    return names[:count]


def run_in_processes(
    jobs: Sequence[Job],
    processes: int,
    retries: int,
    lost: Callable[[int, str], CellReport],
    on_start: Callable[[int], None] = lambda index: None,
    on_end: Callable[[int, CellReport], None] = lambda index, report: None,
    gpus: Sequence[str] = (),
) -> list[CellReport]:
    """Run every job, at most `processes` at a time; a process that dies costs its cell one attempt.

    Not a `ProcessPoolExecutor`: there one killed process ends the others, and running ones cannot be ended.

    Args:
        jobs: what to run; each writes its own folder.
        processes: how many at a time.
        retries: how often a job is run again whose process died (killed, out of memory).
        lost: makes the report of a job whose process died too often, from its index and the reason.
        on_start: told the index when a job begins, again when it begins again.
        on_end: told the index and what became of it.
        gpus: as CUDA_VISIBLE_DEVICES names them; each process sees one of them, in turns.

    Returns:
        Reports in the order of the jobs.
    """
    waiting, deaths = deque(range(len(jobs))), Counter[int]()
    reports: dict[int, CellReport] = {}
    workers: dict[int, _Worker] = {}  # by slot; a new one takes the slot, and the GPU, of one that died
    try:
        while len(reports) < len(jobs):
            for slot in range(processes):
                if waiting and (slot not in workers or workers[slot].index is None):
                    if slot not in workers:
                        workers[slot] = _Worker(gpus[slot % len(gpus)] if gpus else None)
                    index = waiting.popleft()
                    on_start(index)
                    workers[slot].send(index, jobs[index])
            busy = {worker.connection: slot for slot, worker in workers.items() if worker.index is not None}
            for slot in [busy[connection] for connection in wait(list(busy))]:  # type: ignore[index]
                index, report = workers[slot].receive()
                if report is None:
                    reason = workers.pop(slot).stop()
                    deaths[index] += 1
                    if deaths[index] <= retries:
                        waiting.appendleft(index)
                        continue
                    report = lost(index, f"its process {reason}, {deaths[index]} times")
                reports[index] = report
                on_end(index, report)
    finally:
        for worker in workers.values():
            worker.stop()
    return [reports[index] for index in range(len(jobs))]


class _Worker:
    """A process that runs one job after another."""

    def __init__(self, gpu: str | None) -> None:
        # Not forked: the threads of torch and Numba do not survive that.
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=serve, args=(theirs,))
        # there from the start: spawn imports the caller's main module first, and CUDA reads it once
        before = os.environ.get(VISIBLE)
        if gpu is not None:
            os.environ[VISIBLE] = gpu
        try:
            self.process.start()
        finally:
            if gpu is not None:
                os.environ.pop(VISIBLE)
                os.environ.update({} if before is None else {VISIBLE: before})
        theirs.close()  # so that the end of the process is the end of the pipe
        self.index: int | None = None

    def send(self, index: int, job: Job) -> None:
        self.index = index
        with contextlib.suppress(OSError):  # it is dead already; `receive` finds out
            self.connection.send(job)

    def receive(self) -> tuple[int, CellReport | None]:
        """The job's index and report; None where the process died."""
        assert self.index is not None
        index, self.index = self.index, None
        try:
            return index, self.connection.recv()
        except (EOFError, OSError):
            return index, None

    def stop(self) -> str:
        """End the process if it has not ended; how it did."""
        if self.index is not None:
            self.process.terminate()  # a run in the middle: its checkpoint is what stays
        self.connection.close()
        self.process.join(STOP_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        code = self.process.exitcode or 0
        return f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"


def serve(connection: Connection) -> None:
    """The loop of a worker process; it ends when the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends us
    threading.Thread(target=_follow_parent, daemon=True).start()
    from ambiguous_wild.harness.job import run_job

    with contextlib.suppress(EOFError):
        while True:
            connection.send(run_job(connection.recv()))


def _follow_parent() -> None:
    """End when the parent ends: a worker that outlives a killed parent would keep its folder locked."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
