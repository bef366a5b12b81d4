"""Run cells in several processes on this machine; a process that dies costs its cell one attempt."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing.connection import Connection, wait

from ambiguous_wild.harness.running.cell import CellReport
from ambiguous_wild.harness.running.engines.gpu_slots import slot_environment
from ambiguous_wild.harness.running.engines.job import Job, run_job

STOP_S = 5.0  # between asking a process to end and ending it


def run_in_processes(
    jobs: Sequence[Job],
    processes: int,
    *,
    retries: int,
    lost: Callable[[int, str], CellReport],
    on_start: Callable[[int], None] = lambda index: None,
    on_end: Callable[[int, CellReport], None] = lambda index, report: None,
    gpus: Sequence[str] = (),
) -> list[CellReport]:
    """Run every job, at most `processes` at a time.

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
    workers: list[_Worker] = []
    try:
        while len(reports) < len(jobs):
            busy = [worker for worker in workers if worker.index is not None]
            idle = [worker for worker in workers if worker.index is None]
            while waiting and (idle or len(workers) < processes):
                if not idle:
                    # The slot of a process that died is taken first, and with it that one's GPU.
                    slot = min(set(range(processes)) - {worker.slot for worker in workers})
                    idle = [_Worker(slot, slot_environment(slot, gpus))]
                    workers += idle
                worker = idle.pop()
                index = waiting.popleft()
                on_start(index)
                worker.send(index, jobs[index])
                busy.append(worker)
            ready = set(wait([worker.connection for worker in busy]))
            for worker in [w for w in busy if w.connection in ready]:
                index, report = worker.receive()
                if report is None:
                    workers.remove(worker)
                    reason = worker.stop()
                    deaths[index] += 1
                    if deaths[index] <= retries:
                        waiting.appendleft(index)
                        continue
                    report = lost(index, f"its process {reason}, {deaths[index]} times")
                reports[index] = report
                on_end(index, report)
    finally:
        for worker in workers:
            worker.stop()
    return [reports[index] for index in range(len(jobs))]


class _Worker:
    """A process that runs one job after another."""

    def __init__(self, slot: int, environment: Mapping[str, str]) -> None:
        """
        Args:
            slot: its number among the processes, from 0.
            environment: variables that differ from this process's.
        """
        self.slot = slot
        # Not forked: the threads of torch and Numba do not survive that.
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,), daemon=False)
        # There from its start, before torch is imported in it: CUDA reads it once.
        with _environment(environment):
            self.process.start()
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


@contextlib.contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Change this process's variables while a child starts, which inherits them."""
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(connection: Connection) -> None:
    """The loop of a worker process; it ends when the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends us
    threading.Thread(target=_follow_parent, daemon=True).start()
    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        connection.send(run_job(job))


def _follow_parent() -> None:
    """End when the parent ends: a worker that outlives a killed parent would keep its folder locked."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
