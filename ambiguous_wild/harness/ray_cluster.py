"""Run cells as tasks of a Ray cluster: Ray places them, and starts them again where a node was lost.

On clusters without shared storage, scenes and run folders travel through Ray's object store.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.callbacks import Engine
from ambiguous_wild.harness.cell import CellReport, RunOptions
from ambiguous_wild.harness.job import LOCK_WAIT_S, Job, run_job
from ambiguous_wild.harness.result_file import RESULT, read_result
from ambiguous_wild.harness.run import error_line, is_finished, left_alone
from ambiguous_wild.io.archive import Limits, pack_folder, unpack
from ambiguous_wild.io.files import atomic_dir, folder_lock, patient_lock

HEARTBEAT_S = 60.0


class RayCluster:
    """A connection to a Ray cluster, or a Ray of our own on this machine."""

    def __init__(self, engine: Engine, cpus: float) -> None:
        """
        Args:
            engine: where the cluster is, and what a cell needs.
            cpus: of a cell.

        Raises:
            AwError: there is no cluster at the address.
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported to anyone
        # Ray's workers step back behind everything else (nice 15); a cell's time is measured, so ours do not.
        os.environ.setdefault("RAY_worker_niceness", "0")
        # what Ray will do by default, without its warning
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        import ray

        self.ray, self.engine, self.cpus = ray, engine, cpus
        self.ours = not ray.is_initialized()
        if not self.ours:
            return
        address = engine.address or os.environ.get("RAY_ADDRESS")
        where: dict[str, Any] = {"address": address, "namespace": "ambiguous_wild"}
        if not address:
            slots = None if engine.jobs is None else max(1, round(engine.jobs * cpus))
            where = {"address": "local", "num_cpus": slots, "include_dashboard": False}
        quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
        try:
            ray.init(**where, **quiet)
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            text = " ".join(str(error).split())[:300]
            raise AwError(
                f"no Ray cluster at {address or 'this machine'}: {text}; 'ray status' on its head tells more"
            ) from error

    def close(self) -> None:
        """End the tasks of this connection, and a Ray that we started."""
        if self.ours:
            self.ray.shutdown()

    def has_gpu(self) -> bool:
        """Whether any node offers a GPU."""
        return self.ray.cluster_resources().get("GPU", 0.0) > 0

    def describe(self) -> str:
        """ "2 nodes, 32 CPU, 4 GPU"."""
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
        """Run every job; reports in their order.

        Args:
            jobs: what to run.
            lost: makes the report of a job that Ray gave up, from its index and the reason.
            on_end: told the index and what became of it.
            say: told now and then how far it is.

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
        needs: dict[str, Any] = {"num_cpus": self.cpus, "num_gpus": gpus, "max_retries": engine.retries}
        if engine.memory_per_cell:
            needs["memory"] = 1e9 * engine.memory_per_cell
        store = engine.transfer == "store"
        task = ray.remote(**needs)(run_sent if store else run_job)
        made = [is_finished(Path(job.folder)) for job in jobs]
        token = Path(jobs[0].folder).parents[2] / f".aw-shared-{uuid.uuid4().hex}"
        scenes: dict[str, Any] = {}
        pending: dict[Any, int] = {}
        reports: dict[int, CellReport] = {}

        def ended(index: int, report: CellReport) -> None:
            # Its node was lost between the end and the answer: the second attempt found it finished.
            if report.outcome == "kept" and not made[index]:
                report = replace(report, outcome="trained", result=read_result(report.folder / RESULT))
            reports[index] = report
            on_end(index, report)

        try:
            if not store:
                token.parent.mkdir(parents=True, exist_ok=True)
                token.touch()
            for index, job in enumerate(jobs):
                folder = Path(job.folder)
                if (outcome := left_alone(folder, job.options.overwrite, job.config)) is not None:
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
        """Raise AwError if no node of a Ray of our own can take a cell; of a cluster, tell that it waits."""
        nodes = [node["Resources"] for node in self.ray.nodes() if node["Alive"]]
        if any(all(node.get(name, 0.0) >= need for name, need in needs.items()) for node in nodes):
            return
        words = [f"{v / 1e9:g} GB memory" if k == "memory" else f"{v:g} {k}" for k, v in needs.items() if v]
        if not self.engine.remote:
            raise AwError(
                f"a cell needs {', '.join(words)}, more than this machine has; ask for less or give --address"
            )
        say(f"no node has {', '.join(words)} now: waiting for one to come (Ctrl-C to give up)")

    def _report(
        self, reference: Any, job: Job, index: int, lost: Callable[[int, str], CellReport]
    ) -> CellReport:
        errors = self.ray.exceptions
        try:
            value = self.ray.get(reference)
            return receive(value, job, self.engine.transfer_limit) if isinstance(value, Sent) else value
        except errors.RayTaskError as error:
            # Not of the cell, whose errors are reports: the task could not begin there.
            cause = error.cause if isinstance(error.cause, Exception) else error
            return CellReport(Path(job.folder), "failed", error=error_line(cause))
        except errors.RayError as error:
            again = f", {self.engine.retries + 1} times" if self.engine.retries else ""
            return lost(index, f"its worker or node was lost{again} ({type(error).__name__})")
        except AwError as error:
            return CellReport(Path(job.folder), "failed", error=str(error))


@dataclass(frozen=True)
class Sent:
    """A report and the packed run folder it is about; empty where there is none."""

    report: CellReport
    content: bytes


def send_scene(scene: Path, limit_mb: float) -> tuple[str, bytes]:
    """A name for the scene's content, and the content.

    Raises:
        AwError: more than the limit.
    """
    content = pack_folder(scene, limit_mb)
    return hashlib.sha256(content).hexdigest(), content


def run_sent(job: Job, scene_key: str, scene: bytes, limit_mb: float) -> Sent:
    """On a node: unpack the scene unless it is there, run the job in a folder there, pack that."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    cache = Path(tempfile.gettempdir()) / f"ambiguous_wild-{user}"
    cache.mkdir(mode=0o700, exist_ok=True)
    if cache.is_symlink() or (hasattr(os, "getuid") and cache.stat().st_uid != os.getuid()):
        raise AwError(f"{cache} belongs to somebody else: remove it, or set TMPDIR on the nodes")
    # The folder's own name: a plain COLMAP scene is called after it.
    place = cache / "scenes" / scene_key / Path(job.scene).name
    with patient_lock(place.parent, "aw bench", LOCK_WAIT_S):
        if not place.is_dir():
            with atomic_dir(place) as temporary:
                unpack(scene, temporary, Limits(bytes=int(limit_mb * 1e6)))
    with tempfile.TemporaryDirectory(prefix="run-", dir=cache) as own:
        folder, options = Path(own) / "seed", RunOptions(cache / "features", pictures=job.options.pictures)
        report = run_job(replace(job, scene=str(place), folder=str(folder), options=options))
        content = pack_folder(folder, limit_mb) if folder.is_dir() else b""
    return Sent(replace(report, folder=Path(job.folder)), content)


def receive(sent: Sent, job: Job, limit_mb: float) -> CellReport:
    """On the machine that sent the job: the run folder appears whole, or not at all.

    Raises:
        AwError: the archive is no run folder, or somebody works on that folder here.
    """
    folder = Path(job.folder)
    if sent.content:
        with folder_lock(folder, "aw bench"), atomic_dir(folder) as temporary:
            unpack(sent.content, temporary, Limits(bytes=int(limit_mb * 1e6)))
    return sent.report
