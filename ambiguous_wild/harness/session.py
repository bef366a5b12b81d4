"""Run cells in this process, in several processes, or on a Ray cluster. Imports nothing heavy by itself."""

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

from ambiguous_wild.core.machine import usable_cores
from ambiguous_wild.harness.callbacks import Callbacks, Engine

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell, CellReport, RunOptions
    from ambiguous_wild.harness.job import CodeSource, Job
    from ambiguous_wild.harness.ray_cluster import RayCluster

VISIBLE = "CUDA_VISIBLE_DEVICES"
STOP_S = 5.0  # between asking a process to end and ending it


class Session:
    """An engine in use; it connects to Ray when needed and disconnects at the end of the `with`."""

    def __init__(self, engine: Engine, threads: int | None, callbacks: Callbacks | None = None) -> None:
        """
        Args:
            engine: where cells run.
            threads: threads of the CPU kernels of one cell; None = the cores, shared evenly by the cells.
            callbacks: called at every event.
        """
        self.engine, self.threads = engine, threads
        self.callbacks = Callbacks() if callbacks is None else callbacks
        self.gpus: list[str] = []  # of this machine; its processes take turns with them
        self.cluster: RayCluster | None = None

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *error: object) -> None:
        if self.cluster is not None:
            self.cluster.close()

    def device(self, device: str) -> str:
        """Return "cpu" or "cuda" for "auto": what the nodes of the cluster offer, or this machine.

        Raises:
            AwError: "cuda" was asked for and cannot be used here; the error says what is missing.
        """
        if self.engine.remote:
            if device == "auto":
                return "cuda" if self._connected().has_gpu() else "cpu"
            return device
        if device == "cpu":
            return device
        from ambiguous_wild.splat.readiness import choose_device

        return choose_device(device, self.callbacks.say)

    def in_process(self, cells: Sequence[Cell]) -> bool:
        """Return whether cells run in this process one by one; otherwise `run` starts other processes.

        Where the number of jobs is open, there is one for each GPU.
        """
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
        sources: tuple[CodeSource, ...] = (),  # code that the runs need
    ) -> list[CellReport]:
        """Run the cells in processes of this machine or on the cluster; return reports in their order."""
        from ambiguous_wild.harness.grid import check_run_folders
        from ambiguous_wild.harness.job import make_job, record_lost

        engine, say = self.engine, self.callbacks.say
        cluster = self._connected() if engine.engine == "ray" else None
        threads = self.threads or (
            max(1, int(engine.cpus_per_cell or 1))
            if cluster
            else max(1, usable_cores() // (engine.jobs or 1))
        )
        folders = check_run_folders(cells, output, options)
        jobs = [make_job(cell, folder, options, sources, threads) for cell, folder in zip(cells, folders)]

        def lost(index: int, reason: str) -> CellReport:
            return record_lost(cells[index], folders[index], reason)

        def ended(index: int, report: CellReport) -> None:
            self.callbacks.ended(cells[index], report)

        if cluster is not None:
            say(f"Ray: {cluster.describe()}")
            return cluster.run(jobs, lost, ended, say)
        processes = engine.jobs or 1
        if self.gpus and min(processes, len(jobs)) > len(self.gpus):
            gpus = "1 GPU" if len(self.gpus) == 1 else f"{len(self.gpus)} GPUs"
            say(
                f"warning: {processes} cells at a time share the memory and the time of {gpus}; "
                f"--jobs {len(self.gpus)} gives each cell a GPU"
            )

        def started(index: int) -> None:
            self.callbacks.started(cells[index], folders[index])

        return run_in_processes(jobs, processes, engine.retries, lost, started, ended, self.gpus)

    def _connected(self) -> RayCluster:
        if self.cluster is None:
            from ambiguous_wild.harness.ray_cluster import RayCluster

            self.cluster = RayCluster(self.engine, self.engine.cpus_per_cell or float(self.threads or 1))
        return self.cluster


def visible_gpus(count: int) -> list[str]:
    """Return the first `count` GPUs of this process as a child's CUDA_VISIBLE_DEVICES must name them.

    If that variable is set in this process, its entries are used: numbers of the machine's GPUs, UUIDs
    (``GPU-...``) or MIG instances. With 0 to `count` - 1 a child would use other GPUs than this process was
    given. CUDA ignores entries after an invalid one; `count`, which comes from torch, does not include them.
    """
    entries = os.environ.get(VISIBLE)
    if entries is None:
        return [str(i) for i in range(count)]
    return [name.strip() for name in entries.split(",")][:count]


def run_in_processes(
    jobs: Sequence[Job],
    processes: int,
    retries: int,
    lost: Callable[[int, str], CellReport],
    on_start: Callable[[int], None] = lambda index: None,
    on_end: Callable[[int, CellReport], None] = lambda index, report: None,
    gpus: Sequence[str] = (),
) -> list[CellReport]:
    """Run every job, at most `processes` at a time; a process that dies costs its job one attempt.

    A `ProcessPoolExecutor` does not do: one killed process ends all others, and none can be stopped.

    Args:
        jobs: what to run; each writes its own folder.
        processes: number of processes at a time.
        retries: how often a job is run again whose process died (killed, out of memory).
        lost: makes the report of a job whose process died too often, from its index and the reason.
        on_start: called with the index whenever a job begins, also when it is run again.
        on_end: called with the index and the report of a job that has ended.
        gpus: names for CUDA_VISIBLE_DEVICES; each process gets one of them, in turns.

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
        # set before the start: spawn imports the caller's main module first, and CUDA reads it only once
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
        """Return the job's index and report; None for the report if the process died."""
        assert self.index is not None
        index, self.index = self.index, None
        try:
            return index, self.connection.recv()
        except (EOFError, OSError):
            return index, None

    def stop(self) -> str:
        """End the process if it has not ended; return how it ended."""
        if self.index is not None:
            self.process.terminate()  # the run is not finished: its last checkpoint remains
        self.connection.close()
        self.process.join(STOP_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        code = self.process.exitcode or 0
        return f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"


def serve(connection: Connection) -> None:
    """Run the jobs of the pipe in a worker process until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends this one
    threading.Thread(target=_follow_parent, daemon=True).start()
    from ambiguous_wild.harness.job import run_job

    with contextlib.suppress(EOFError):
        while True:
            connection.send(run_job(connection.recv()))


def _follow_parent() -> None:
    """End this process when the parent ends, as its run folder would stay locked otherwise."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
