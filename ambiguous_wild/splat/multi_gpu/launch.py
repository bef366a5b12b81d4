"""Starts a process for each GPU, and ends them all if one of them ends too early."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from ambiguous_wild.core import AwError
from ambiguous_wild.io.atomic import write_text
from ambiguous_wild.splat.multi_gpu.ranks import Ranks
from ambiguous_wild.splat.multi_gpu.refuse import refuse_more_than

Tell = Callable[[Any], None]
HOST = "127.0.0.1"
START_S = 300.0  # for all to find each other: torch's import from a cold disk, CUDA's start
LONGEST = timedelta(days=1)  # a rank waits for another, which may be probing; a dead one is noticed at once
GRACE_S = 1.0  # after the first failure: others fail because of it, or may have failed before it
STOP_S = 5.0  # between asking a process to end and ending it


def launch(
    gpus: int,
    work: Callable[..., Any],
    arguments: Sequence[Any] = (),
    *,
    backend: str = "nccl",
    heard: Tell = lambda message: None,
    logs: Path | None = None,
) -> list[Any]:
    """Call `work(ranks, tell, *arguments)` in a process a GPU; returns their results by rank.

    Args:
        gpus: how many; rank i gets GPU i of those that torch sees.
        work: a function of a module; its messages arrive at `heard`.
        arguments: values that can be pickled.
        backend: of torch.distributed; "gloo" runs on the CPU.
        heard: called here with the messages of all ranks.
        logs: folder for the traceback of an unexpected error.

    Raises:
        AwError: fewer GPUs, or one of the processes failed or died; the others are ended.
    """
    if backend == "nccl":
        refuse_more_than(torch.cuda.device_count(), gpus)
    # The system chooses a free port.
    store = dist.TCPStore(HOST, 0, None, is_master=True, wait_for_workers=False)
    workers: list[_Worker] = []
    try:
        order = (backend, store.port, work, tuple(arguments))
        workers.extend(_Worker(rank, gpus, order) for rank in range(gpus))
        return _results(workers, heard, logs)
    finally:
        for worker in workers:
            worker.ask_to_end()
        for worker in workers:
            worker.end()


@dataclass
class _Failure:
    """How a rank failed; the smallest of several is the cause of the others."""

    rank: int
    at: float  # time.time()
    follows: int  # how likely it is that it failed because another had
    text: str
    traceback: str = ""  # of what is no AwError
    died: bool = False  # without a word


class _Worker:
    """One process."""

    def __init__(self, rank: int, size: int, order: tuple[Any, ...]) -> None:
        self.rank = rank
        # Not forked: CUDA and the threads of torch do not survive that.
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, rank, size, *order), daemon=True)
        self.process.start()
        theirs.close()  # so that the end of the process is the end of the pipe

    def receive(self) -> tuple[str, Any]:
        """Its next message: "told", "done" or "failed", and the value."""
        try:
            kind, value = self.connection.recv()
        except (EOFError, OSError):
            return "failed", self._died()
        return kind, value

    def _died(self) -> _Failure:
        at = time.time()
        self.process.join(STOP_S)
        code = self.process.exitcode or 0
        how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        # NCCL's watchdog aborts a process whose partner has gone
        return _Failure(self.rank, at, 2 if code == -signal.SIGABRT else 0, f"its process {how}", died=True)

    def ask_to_end(self) -> None:
        if self.process.is_alive():
            self.process.terminate()

    def end(self) -> None:
        self.connection.close()
        self.process.join(STOP_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _results(workers: list[_Worker], heard: Tell, logs: Path | None) -> list[Any]:
    """Results of all; raises the error of the first that failed."""
    results: dict[int, Any] = {}
    failures: list[_Failure] = []
    patience = None
    while len(results) + len(failures) < len(workers):
        failed = {failure.rank for failure in failures}
        waiting = {w.connection: w for w in workers if w.rank not in results and w.rank not in failed}
        if failures and patience is None:
            patience = time.monotonic() + GRACE_S
        ready = wait(list(waiting), None if patience is None else max(patience - time.monotonic(), 0.0))
        if not ready:
            break
        for connection in ready:
            worker = waiting[connection]  # type: ignore[index]
            kind, value = worker.receive()
            if kind == "told":
                heard(value)
            elif kind == "done":
                results[worker.rank] = value
            else:
                failures.append(value)
    if failures:
        raise _error(min(failures, key=lambda f: (f.follows, f.at)), len(workers), logs)
    return [results[rank] for rank in range(len(workers))]


def _error(failure: _Failure, size: int, logs: Path | None) -> AwError:
    who = f"GPU {failure.rank + 1} of {size}"
    if failure.died:
        return AwError(
            f"{who}: {failure.text}, and the others were ended; the same command goes on from the last "
            "checkpoint"
        )
    if not failure.traceback:
        return AwError(failure.text)
    told = ""
    if logs is not None:
        path = logs / f"traceback-rank{failure.rank + 1}of{size}.txt"
        write_text(path, failure.traceback)
        told = f"; its traceback is in {path}"
    return AwError(f"{who}: {failure.text}{told}")


def _serve(
    connection: Connection,
    rank: int,
    size: int,
    backend: str,
    port: int,
    work: Callable[..., Any],
    arguments: tuple[Any, ...],
) -> None:
    """The life of one process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends us
    threading.Thread(target=_follow_parent, daemon=True).start()
    try:
        device = torch.device("cpu")
        if backend == "nccl":
            device = torch.device("cuda", rank)
            torch.cuda.set_device(device)
        store = dist.TCPStore(HOST, port, None, is_master=False, timeout=timedelta(seconds=START_S))
        dist.init_process_group(
            backend, store=store, rank=rank, world_size=size, timeout=LONGEST,
            device_id=device if backend == "nccl" else None,
        )  # fmt: skip
        value = work(
            Ranks(rank, size, device), lambda message: connection.send(("told", message)), *arguments
        )
        dist.barrier()
        dist.destroy_process_group()
    except BaseException as error:
        connection.send(("failed", _failure(rank, error)))
        connection.close()
        os._exit(1)  # at once: what belongs to the group would wait for the others
    connection.send(("done", value))


def _failure(rank: int, error: BaseException) -> _Failure:
    if isinstance(error, AwError):
        return _Failure(rank, time.time(), 0, str(error))
    text = " ".join(f"{type(error).__name__}: {error}".split())[:500]
    return _Failure(rank, time.time(), 1, text, "".join(traceback.format_exception(error)))


def _follow_parent() -> None:
    """A parent that was killed cannot end us."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
