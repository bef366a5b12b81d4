"""Run cells as tasks of a Ray cluster: Ray places them, and starts them again where a node was lost."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.extras import install_command
from ambiguous_wild.harness.running.cell import CellReport
from ambiguous_wild.harness.running.engines.job import Job, run_job
from ambiguous_wild.harness.running.engines.transfer import Sent, receive, run_sent, send_scene, stays
from ambiguous_wild.harness.running.result_file import RESULT, read_result
from ambiguous_wild.harness.running.run_folder import error_line, is_finished

Transfer = Literal["shared", "store"]
HEARTBEAT_S = 60.0


@dataclass(frozen=True)
class RayOptions:
    """What a cell needs, where the cluster is, and how results come back."""

    address: str | None = None  # "auto", HOST:PORT or ray://...; None = $RAY_ADDRESS, else a Ray of our own
    jobs: int | None = None  # of a Ray of our own: cells at a time; None = as many as there are cores
    cpus: float = 1.0  # of a cell
    gpus: float = 0.0  # of a cell
    memory_gb: float = 0.0  # of a cell, 10^9 bytes; 0 = no matter
    retries: int = 3  # how often a cell is run again whose worker or node was lost
    transfer: Transfer = "shared"
    limit_mb: float = 4000.0  # of a scene or a run folder that is sent through the object store

    @property
    def needs(self) -> dict[str, float]:
        """Resources by Ray's names."""
        wanted = {"CPU": self.cpus, "GPU": self.gpus, "memory": self.memory_gb * 1e9}
        return {name: amount for name, amount in wanted.items() if amount > 0}


def check_ray() -> None:
    """Raise AwError where Ray is not installed."""
    if importlib.util.find_spec("ray") is None:
        raise AwError(f"--engine ray needs Ray: {install_command('ray')}")


class RayCluster:
    """A connection; close it, or use it in a `with`."""

    def __init__(self, options: RayOptions) -> None:
        """Connect, or start a Ray of our own on this machine.

        Raises:
            AwError: Ray is not installed, or there is no cluster at the address.
        """
        check_ray()
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported to anyone
        # Ray's workers step back behind everything else (nice 15); a cell's time is measured, so ours do not.
        os.environ.setdefault("RAY_worker_niceness", "0")
        os.environ.setdefault(
            "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0"
        )  # what Ray will do by default, without its warning
        import ray

        self.ray, self.options = ray, options
        self.ours = not ray.is_initialized()
        if self.ours:
            _connect(ray, options)

    def __enter__(self) -> RayCluster:
        return self

    def __exit__(self, *error: object) -> None:
        if self.ours:
            self.ray.shutdown()  # ends the tasks of this connection, and a Ray that we started

    def has_gpu(self) -> bool:
        """Whether any node offers a GPU."""
        return self.ray.cluster_resources().get("GPU", 0.0) > 0

    def describe(self) -> str:
        """ "2 nodes, 32 CPU, 4 GPU"."""
        total = self.ray.cluster_resources()
        nodes = sum(1 for node in self.ray.nodes() if node["Alive"])
        parts = [f"{nodes} node{'s' if nodes != 1 else ''}", f"{total.get('CPU', 0):g} CPU"]
        return ", ".join([*parts, *([f"{total['GPU']:g} GPU"] if total.get("GPU") else [])])

    def unmet(self) -> str:
        """Resources that a cell needs and no single node has now; empty where a node has all."""
        needs = self.options.needs
        for node in self.ray.nodes():
            if node["Alive"] and all(node["Resources"].get(k, 0.0) >= v for k, v in needs.items()):
                return ""
        return ", ".join(
            f"{v / 1e9:g} GB memory" if k == "memory" else f"{v:g} {k}" for k, v in needs.items()
        )

    def run(
        self,
        jobs: Sequence[Job],
        *,
        lost: Callable[[int, str], CellReport],
        on_end: Callable[[int, CellReport], None] = lambda index, report: None,
        say: Callable[[str], None] = lambda text: None,
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
        unmet = self.unmet()
        if unmet and self.options.address is None and "RAY_ADDRESS" not in os.environ:
            raise AwError(
                f"a cell needs {unmet}, more than this machine has; ask for less, or give --address"
            )
        if unmet:
            say(f"no node has {unmet} now: waiting for one to come (Ctrl-C to give up)")
        made = {i for i, job in enumerate(jobs) if is_finished(Path(job.folder))}

        def ended(index: int, report: CellReport) -> CellReport:
            # Its node was lost between the end and the answer: the second attempt found it finished.
            if report.outcome == "kept" and index not in made:
                report = dataclasses.replace(
                    report, outcome="trained", result=read_result(report.folder / RESULT)
                )
            on_end(index, report)
            return report

        if self.options.transfer == "store":
            return self._drive(self._send(jobs), jobs, lost, ended, say)
        with _token(Path(jobs[0].folder).parents[2]) as token:
            task = self._remote(run_job)
            shared = [dataclasses.replace(job, token=str(token)) for job in jobs]
            return self._drive(lambda i: task.remote(shared[i]), jobs, lost, ended, say)

    def _remote(self, function: Callable[..., Any]) -> Any:
        wanted = self.options
        # Retries are for workers and nodes that die; an error of the cell itself is its result.
        settings: dict[str, Any] = {"num_cpus": wanted.cpus, "num_gpus": wanted.gpus}
        settings["max_retries"] = wanted.retries
        if wanted.memory_gb:
            settings["memory"] = wanted.memory_gb * 1e9
        return self.ray.remote(**settings)(function)

    def _send(self, jobs: Sequence[Job]) -> Callable[[int], Any]:
        scenes = {job.scene: None for job in jobs}
        limit = self.options.limit_mb
        packed = {scene: send_scene(Path(scene), limit) for scene in scenes}
        stored = {scene: self.ray.put(content) for scene, (_, content) in packed.items()}
        task = self._remote(run_sent)
        return lambda i: task.remote(jobs[i], packed[jobs[i].scene][0], stored[jobs[i].scene], limit)

    def _drive(
        self,
        start: Callable[[int], Any],
        jobs: Sequence[Job],
        lost: Callable[[int, str], CellReport],
        ended: Callable[[int, CellReport], CellReport],
        say: Callable[[str], None],
    ) -> list[CellReport]:
        pending: dict[Any, int] = {}
        reports: dict[int, CellReport] = {}
        try:
            for index, job in enumerate(jobs):
                here = stays(job)
                if here is None:
                    pending[start(index)] = index
                else:
                    reports[index] = ended(index, here)
            while pending:
                ready, _ = self.ray.wait(list(pending), num_returns=1, timeout=HEARTBEAT_S)
                if not ready:
                    say(f"{len(reports)} of {len(jobs)} cells done, the others run or wait for a node")
                for reference in ready:
                    index = pending.pop(reference)
                    reports[index] = ended(index, self._report(reference, jobs[index], index, lost))
        except BaseException:
            for reference in pending:
                self.ray.cancel(reference, force=True)
            raise
        return [reports[index] for index in range(len(jobs))]

    def _report(
        self, reference: Any, job: Job, index: int, lost: Callable[[int, str], CellReport]
    ) -> CellReport:
        errors = self.ray.exceptions
        try:
            value = self.ray.get(reference)
            return receive(value, job, self.options.limit_mb) if isinstance(value, Sent) else value
        except errors.RayTaskError as error:
            # Not of the cell, whose errors are reports: the task could not begin there.
            cause = error.cause if isinstance(error.cause, Exception) else error
            return CellReport(Path(job.folder), "failed", error=error_line(cause))
        except errors.RayError as error:
            again = f", {self.options.retries + 1} times" if self.options.retries else ""
            return lost(index, f"its worker or node was lost{again} ({type(error).__name__})")
        except AwError as error:
            return CellReport(Path(job.folder), "failed", error=str(error))


def _connect(ray: Any, options: RayOptions) -> None:
    address = options.address or os.environ.get("RAY_ADDRESS")
    common: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address:
            ray.init(address=address, namespace="ambiguous_wild", **common)
        else:
            slots = None if options.jobs is None else max(1, round(options.jobs * options.cpus))
            ray.init(address="local", num_cpus=slots, include_dashboard=False, **common)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        text = " ".join(str(error).split())[:300]
        raise AwError(
            f"no Ray cluster at {address or 'this machine'}: {text}; 'ray status' on its head tells more"
        ) from error


@contextmanager
def _token(folder: Path) -> Iterator[Path]:
    """A file that every node must see; gone afterwards."""
    path = folder.absolute() / f".aw-shared-{uuid.uuid4().hex}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)
