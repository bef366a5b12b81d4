"""Where cells run: this process, several processes, or a Ray cluster. Imports nothing heavy by itself."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.harness.running.callbacks import Callbacks

if TYPE_CHECKING:
    from ambiguous_wild.harness.running.cell import Cell, CellReport, Overwrite
    from ambiguous_wild.harness.running.engines.job import Job
    from ambiguous_wild.harness.running.engines.ray_cluster import RayCluster

_RAY_ONLY = ("address", "cpus_per_cell", "gpus_per_cell", "memory_per_cell")


@dataclass(frozen=True)
class Engine:
    """Where cells run, and how many at a time."""

    engine: Literal["local", "ray"] = "local"
    jobs: int | None = None  # cells at a time on this machine; None = 1, on cuda one a GPU
    address: str | None = None  # of a Ray cluster; None = $RAY_ADDRESS, else a Ray of our own
    cpus_per_cell: float | None = None  # Ray; None = the threads, else 1
    gpus_per_cell: float | None = None  # Ray; None = 1 on cuda
    memory_per_cell: float | None = None  # Ray; GB
    retries: int = 3  # of a cell whose process or node was lost
    transfer: Literal["shared", "store"] = "shared"  # Ray; "store": scenes and runs travel
    transfer_limit: float = 4000.0  # Ray; MB of the largest scene or run that travels

    def check(self) -> None:
        """Raise AwError for settings that exclude each other, before anything heavy is loaded."""
        stray = [f"--{name.replace('_', '-')}" for name in _RAY_ONLY if getattr(self, name) is not None]
        if self.engine == "local" and (stray or self.transfer != "shared"):
            raise AwError(
                f"{', '.join(stray) or '--transfer'} is for a cluster: add --engine ray, or leave it out"
            )
        if self.engine == "ray":
            from ambiguous_wild.harness.running.engines.ray_cluster import check_ray

            check_ray()
            if self.jobs is not None and self.address is not None:
                raise AwError("--jobs is for this machine: a cluster at --address runs as many cells as fit")

    @property
    def remote(self) -> bool:
        """Whether it is a running cluster, not a Ray that this process starts."""
        return self.engine == "ray" and bool(self.address or os.environ.get("RAY_ADDRESS"))


@dataclass(frozen=True)
class Grid:
    """Cells, and what they have in common when they run."""

    cells: Sequence[Cell]
    output: Path
    overwrite: Overwrite
    cache: Path
    pictures: bool
    plugins: Sequence[Path]
    methods: Sequence[str]  # as they were typed

    def folders(self) -> list[Path]:
        """The run folder of every cell, checked: see `checked_folders`."""
        from ambiguous_wild.harness.running.grid import checked_folders

        return checked_folders(self.cells, self.output, self.overwrite, self.cache)

    def jobs(self, threads: int) -> list[Job]:
        """The cells as jobs, which other processes can run."""
        from ambiguous_wild.harness.running.engines.job import JobSettings, make_job, read_sources

        sources = read_sources(self.plugins, self.methods)
        settings = JobSettings(self.cache, self.overwrite, self.pictures, threads, sources)
        return [make_job(cell, folder, settings) for cell, folder in zip(self.cells, self.folders())]

    def lost(self, index: int, reason: str) -> CellReport:
        """The report of a cell whose process died too often."""
        from ambiguous_wild.harness.running.engines.job import record_lost
        from ambiguous_wild.harness.running.grid import cell_folder

        cell = self.cells[index]
        return record_lost(cell, cell_folder(self.output, cell), reason)


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
            self.cluster.__exit__(*error)

    def device(self, device: str) -> str:
        """ "cpu" or "cuda": of a cluster by what its nodes offer, else of this machine.

        Raises:
            AwError: "cuda" was asked for and cannot be used here; says what is missing.
        """
        if not self.engine.remote:
            if device == "cpu":
                return device
            from ambiguous_wild.splat.readiness import choose

            return choose(device, self.callbacks.say)
        if device != "auto":
            return device
        return "cuda" if self._connected().has_gpu() else "cpu"

    def in_process(self, cells: Sequence[Cell]) -> bool:
        """Whether cells run in this process, one by one; else `run` starts others. Each GPU takes a cell."""
        if self.engine.engine != "local":
            return False
        if any(cell.device == "cuda" for cell in cells):
            import torch

            from ambiguous_wild.harness.running.engines.gpu_slots import visible_gpus

            self.gpus = visible_gpus(torch.cuda.device_count())
        if self.engine.jobs is None:
            self.engine = replace(self.engine, jobs=max(1, min(len(self.gpus), len(cells))))
        return self.engine.jobs == 1

    def run(self, grid: Grid) -> list[CellReport]:
        """Run the cells in processes of this machine or on the cluster; reports in their order."""
        engine, cluster = self.engine, self._connected() if self.engine.engine == "ray" else None
        if cluster is not None and engine.gpus_per_cell is None and grid.cells[0].device == "cuda":
            cluster.options = replace(cluster.options, gpus=1.0)
        jobs = grid.jobs(self.threads or _share_of_cores(engine, cluster))
        callbacks, cells = self.callbacks, grid.cells

        def ended(index: int, report: CellReport) -> None:
            callbacks.ended(cells[index], report)

        if cluster is not None:
            callbacks.say(f"Ray: {cluster.describe()}")
            return cluster.run(jobs, lost=grid.lost, on_end=ended, say=callbacks.say)
        from ambiguous_wild.harness.running.engines.gpu_slots import sharing
        from ambiguous_wild.harness.running.engines.processes import run_in_processes

        if said := sharing(min(engine.jobs or 1, len(jobs)), self.gpus):
            callbacks.say(f"warning: {said}")

        def started(index: int) -> None:
            callbacks.started(cells[index], Path(jobs[index].folder))

        return run_in_processes(
            jobs,
            engine.jobs or 1,
            retries=engine.retries,
            lost=grid.lost,
            on_start=started,
            on_end=ended,
            gpus=self.gpus,
        )

    def _connected(self) -> RayCluster:
        if self.cluster is None:
            from ambiguous_wild.harness.running.engines.ray_cluster import RayCluster, RayOptions

            engine = self.engine
            self.cluster = RayCluster(
                RayOptions(
                    address=engine.address,
                    jobs=engine.jobs,
                    cpus=engine.cpus_per_cell or float(self.threads or 1),
                    gpus=engine.gpus_per_cell or 0.0,
                    memory_gb=engine.memory_per_cell or 0.0,
                    retries=engine.retries,
                    transfer=engine.transfer,
                    limit_mb=engine.transfer_limit,
                )
            )
        return self.cluster


def _share_of_cores(engine: Engine, cluster: RayCluster | None) -> int:
    """Threads of one cell."""
    if cluster is not None:
        return max(1, int(cluster.options.cpus))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // (engine.jobs or 1))
