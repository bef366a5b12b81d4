"""Run cells as tasks of a Ray cluster: Ray places them on nodes, and restarts those whose node was lost.

On clusters without shared storage, scenes and run folders travel through Ray's object store.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import tempfile
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.callbacks import Engine
from ambiguous_wild.harness.cell import CellReport, RunOptions
from ambiguous_wild.harness.cell_run import OURS, TRACEBACK, error_line, existing_outcome, is_finished
from ambiguous_wild.harness.job import LOCK_WAIT_S, Job, run_job
from ambiguous_wild.harness.result_file import FAILED, RESULT, read_result
from ambiguous_wild.io.archive import Limits, pack_folder, unpack
from ambiguous_wild.io.files import atomic_dir, folder_lock, patient_lock

HEARTBEAT_S = 60.0


class RayCluster:
    """A connection to a Ray cluster, or a Ray started on this machine."""

    def __init__(self, engine: Engine, cpus: float) -> None:
        """
        Args:
            engine: the address of the cluster, and what a cell needs.
            cpus: number of CPUs of a cell.

        Raises:
            AwError: there is no cluster at the address.
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # send no usage reports
        # by default Ray's workers have the lowest priority (nice 15), which would distort measured times
        os.environ.setdefault("RAY_worker_niceness", "0")
        # what Ray will do by default, without its warning
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        import ray

        self.ray, self.engine, self.cpus = ray, engine, cpus
        self.ours = not ray.is_initialized()
        if not self.ours:
            return
        address = engine.address or os.environ.get("RAY_ADDRESS")
        start = partial(ray.init, log_to_driver=False, logging_level=logging.ERROR)
        try:
            if address:
                start(address=address, namespace="ambiguous_wild")
            else:
                slots = None if engine.jobs is None else max(1, round(engine.jobs * cpus))
                start(address="local", num_cpus=slots, include_dashboard=False)
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            text = " ".join(str(error).split())[:300]
            raise AwError(
                f"no Ray cluster at {address or 'this machine'}: {text}; run 'ray status' on its head node; "
                "a cluster with tokens needs RAY_AUTH_MODE=token here too"
            ) from error

    def close(self) -> None:
        """End the tasks of this connection, and Ray itself if it was started here."""
        if self.ours:
            self.ray.shutdown()

    def has_gpu(self) -> bool:
        """Return whether any node offers a GPU."""
        return self.ray.cluster_resources().get("GPU", 0.0) > 0

    def describe(self) -> str:
        """Return what the cluster offers, for example "2 nodes, 32 CPU, 4 GPU"."""
        total = self.ray.cluster_resources()
        nodes = sum(1 for node in self.ray.nodes() if node["Alive"])
        parts = [f"{nodes} node{'s' if nodes != 1 else ''}", f"{total.get('CPU', 0):g} CPU"]
        return ", ".join([*parts, *([f"{total['GPU']:g} GPU"] if total.get("GPU") else [])])

    def run(
        self,
        jobs: Sequence[Job],
        lost: Callable[[int, str], CellReport],
        on_end: Callable[[int, CellReport], None],
        say: Callable[[str], None],
    ) -> list[CellReport]:
        """Run every job; return reports in their order.

        Args:
            jobs: what to run.
            lost: makes the report of a job that Ray gave up, from its index and the reason.
            on_end: called with the index and the report of a job that has ended.
            say: gets a line about the progress now and then.

        Raises:
            AwError: no node can ever take a cell, or a scene is too large to be sent.
        """
        ray, engine = self.ray, self.engine
        gpus = engine.gpus_per_cell
        if gpus is None:
            gpus = 1.0 if jobs[0].config["device"] == "cuda" else 0.0
        self._check_room(
            {"CPU": self.cpus, "GPU": gpus, "memory": 1e9 * (engine.memory_per_cell or 0.0)}, say
        )
        # Retries are for workers and nodes that die; an error of the cell itself is its result.
        memory = {"memory": 1e9 * engine.memory_per_cell} if engine.memory_per_cell else {}
        remote = ray.remote(num_cpus=self.cpus, num_gpus=gpus, max_retries=engine.retries, **memory)
        store = engine.transfer == "store"
        task = remote(run_sent if store else run_job)
        finished = [is_finished(Path(job.folder)) for job in jobs]
        token = Path(jobs[0].folder).parents[2] / f".aw-shared-{uuid.uuid4().hex}"
        scenes: dict[str, tuple[str, Any]] = {}  # by path: the key and Ray's reference to the content
        pending: dict[Any, int] = {}
        reports: dict[int, CellReport] = {}

        def ended(index: int, report: CellReport) -> None:
            # the node was lost between the end of the run and its report: a second attempt kept the run
            if report.outcome == "kept" and not finished[index]:
                report = replace(report, outcome="trained", result=read_result(report.folder / RESULT))
            reports[index] = report
            on_end(index, report)

        try:
            if not store:
                token.parent.mkdir(parents=True, exist_ok=True)
                token.touch()
            for index, job in enumerate(jobs):
                folder = Path(job.folder)
                if (outcome := existing_outcome(folder, job.options.overwrite, job.config)) is not None:
                    ended(index, CellReport(folder, outcome))
                elif store:
                    if job.scene not in scenes:
                        key, content = send_scene(Path(job.scene), engine.transfer_limit)
                        scenes[job.scene] = key, ray.put(content)
                    pending[task.remote(job, *scenes[job.scene], engine.transfer_limit)] = index
                else:
                    pending[task.remote(replace(job, token=str(token)))] = index
            while pending:
                ready, _ = ray.wait(list(pending), num_returns=1, timeout=HEARTBEAT_S)
                if not ready:
                    say(f"{len(reports)} of {len(jobs)} cells done, the others run or wait for a node")
                for reference in ready:
                    index = pending.pop(reference)
                    ended(index, self._report(reference, jobs[index], index, lost))
        except BaseException:
            for reference in pending:
                ray.cancel(reference, force=True)
            raise
        finally:
            token.unlink(missing_ok=True)
        return [reports[index] for index in range(len(jobs))]

    def _check_room(self, needs: dict[str, float], say: Callable[[str], None]) -> None:
        """Raise AwError if no cell fits this machine; on a cluster, say that a larger node is awaited."""
        nodes = [node["Resources"] for node in self.ray.nodes() if node["Alive"]]
        if any(all(node.get(name, 0.0) >= need for name, need in needs.items()) for node in nodes):
            return
        words = [f"{v / 1e9:g} GB memory" if k == "memory" else f"{v:g} {k}" for k, v in needs.items() if v]
        if not self.engine.remote:
            raise AwError(
                f"a cell needs {', '.join(words)}, more than this machine has; ask for less or give --address"
            )
        say(f"no node has {', '.join(words)} now: waiting for such a node (Ctrl-C to give up)")

    def _report(
        self, reference: Any, job: Job, index: int, lost: Callable[[int, str], CellReport]
    ) -> CellReport:
        errors = self.ray.exceptions
        try:
            value = self.ray.get(reference)
            return (
                unpack_report(value, job, self.engine.transfer_limit)
                if isinstance(value, PackedReport)
                else value
            )
        except errors.RayTaskError as error:
            # the task could not begin on its node; errors of the cell itself are reports
            cause = error.cause if isinstance(error.cause, Exception) else error
            return CellReport(Path(job.folder), "failed", error=error_line(cause))
        except errors.RayError as error:
            again = f", {self.engine.retries + 1} times" if self.engine.retries else ""
            return lost(index, f"its worker or node was lost{again} ({type(error).__name__})")
        except AwError as error:
            return CellReport(Path(job.folder), "failed", error=str(error))


@dataclass(frozen=True)
class PackedReport:
    """A report with its packed run folder, which is empty where there is none."""

    report: CellReport
    content: bytes


def send_scene(scene: Path, limit_mb: float) -> tuple[str, bytes]:
    """Pack a scene; return the hash of the content, and the content.

    Raises:
        AwError: the content is larger than the limit.
    """
    content = pack_folder(scene, limit_mb)
    return hashlib.sha256(content).hexdigest(), content


def run_sent(job: Job, scene_key: str, scene: bytes, limit_mb: float) -> PackedReport:
    """On a node: unpack the scene unless it is cached, run the job in a local folder, and pack that."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    cache = Path(tempfile.gettempdir()) / f"ambiguous_wild-{user}"
    cache.mkdir(mode=0o700, exist_ok=True)
    if cache.is_symlink() or (hasattr(os, "getuid") and cache.stat().st_uid != os.getuid()):
        raise AwError(f"{cache} belongs to somebody else: remove it, or set TMPDIR on the nodes")
    # the folder keeps its name, because a plain COLMAP scene is called after it
    place = cache / "scenes" / scene_key / Path(job.scene).name
    with patient_lock(place.parent, "aw bench", LOCK_WAIT_S):
        if not place.is_dir():
            with atomic_dir(place) as temporary:
                unpack(scene, temporary, Limits(bytes=int(limit_mb * 1e6)))
    with tempfile.TemporaryDirectory(prefix="run-", dir=cache) as own:
        folder, options = Path(own) / "seed", RunOptions(cache / "features", pictures=job.options.pictures)
        report = run_job(replace(job, scene=str(place), folder=str(folder), options=options))
        content = pack_folder(folder, limit_mb) if folder.is_dir() else b""
    return PackedReport(replace(report, folder=Path(job.folder)), content)


def unpack_report(sent: PackedReport, job: Job, limit_mb: float) -> CellReport:
    """On the machine that sent the job: unpack the run folder, whole or not at all.

    A run that failed replaces nothing: an earlier run here, or its checkpoint, is worth more.

    Raises:
        AwError: the archive is no run folder, or another process uses that folder here.
    """
    folder, report, limits = Path(job.folder), sent.report, Limits(bytes=int(limit_mb * 1e6))
    if not sent.content:
        return report
    with folder_lock(folder, "aw bench"):
        if report.outcome == "trained" or not folder.is_dir():
            with atomic_dir(folder) as temporary:
                unpack(sent.content, temporary, limits)
                for path in folder.glob("[!.]*"):  # what a user put beside the run stays
                    if path.name not in {*OURS, *os.listdir(temporary)}:
                        (shutil.copytree if path.is_dir() else shutil.copy2)(path, temporary / path.name)
        elif not (folder / RESULT).exists():
            for name in (FAILED, TRACEBACK):
                (folder / name).unlink(missing_ok=True)
            unpack(sent.content, folder, limits, wanted=(FAILED, TRACEBACK).__contains__)
    return report
