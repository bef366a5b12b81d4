"""`aw bench --engine`, --jobs and what goes with them: where cells run, and what is said meanwhile."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.core.errors import AwError

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell, CellReport, Overwrite
    from ambiguous_wild.harness.engines.job import Job
    from ambiguous_wild.harness.engines.ray_cluster import RayCluster

_OPTIONS = (
    click.option("--engine", type=click.Choice(["local", "ray"]), default="local", show_default=True, help="ray: a cluster, see docs/cluster.md."),
    click.option("--jobs", type=click.IntRange(1), help="Cells at a time on this machine; cores and GPUs are divided.  [default: 1; on cuda one a GPU]"),
    click.option("--address", help="Ray: auto, HOST:PORT or ray://HOST:10001.  [default: $RAY_ADDRESS, else this machine]"),
    click.option("--cpus-per-cell", type=click.FloatRange(min=0, min_open=True), help="Ray: CPUs, also the threads.  [default: --threads, else 1]"),
    click.option("--gpus-per-cell", type=click.FloatRange(min=0), help="Ray: GPUs; 0.5 lets two cells share one.  [default: 1 on cuda]"),
    click.option("--memory-per-cell", type=click.FloatRange(min=0), metavar="GB", help="Ray: memory in GB."),
    click.option("--retries", type=click.IntRange(0), default=3, show_default=True, help="How often a cell is run again whose process or node was lost."),
    click.option("--transfer", type=click.Choice(["shared", "store"]), default="shared", show_default=True, help="Ray: -o and scenes lie on shared storage, or travel through Ray's object store."),
    click.option("--transfer-limit", type=click.FloatRange(min=0, min_open=True), default=4000.0, show_default=True, metavar="MB", help="Ray: largest scene or run that travels."),
)  # fmt: skip
_RAY_ONLY = ("address", "cpus_per_cell", "gpus_per_cell", "memory_per_cell")


def engine_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add them to a click command, as one argument `engine`: an `Engine`."""

    def with_engine(**values: Any) -> Any:
        names = [f for f in Engine.__dataclass_fields__ if f in values]
        return command(engine=Engine(**{name: values.pop(name) for name in names}), **values)

    with_engine.__doc__, with_engine.__name__ = command.__doc__, command.__name__
    # Options added below this one are on the function already.
    with_engine.__dict__.update(command.__dict__)
    wrapped: Callable[..., Any] = with_engine
    for option in reversed(_OPTIONS):
        wrapped = option(wrapped)
    return wrapped


@dataclass(frozen=True)
class Engine:
    """Where cells run."""

    engine: str = "local"
    jobs: int | None = None
    address: str | None = None
    cpus_per_cell: float | None = None
    gpus_per_cell: float | None = None
    memory_per_cell: float | None = None
    retries: int = 3
    transfer: str = "shared"
    transfer_limit: float = 4000.0

    def check(self) -> None:
        """Raise AwError for what does not go together, before anything heavy is loaded."""
        stray = [f"--{name.replace('_', '-')}" for name in _RAY_ONLY if getattr(self, name) is not None]
        if self.engine == "local" and (stray or self.transfer != "shared"):
            raise AwError(
                f"{', '.join(stray) or '--transfer'} is for a cluster: add --engine ray, or leave it out"
            )
        if self.engine == "ray":
            from ambiguous_wild.harness.engines.ray_cluster import check_ray

            check_ray()
            if self.jobs is not None and self.address is not None:
                raise AwError("--jobs is for this machine: a cluster at --address runs as many cells as fit")

    @property
    def remote(self) -> bool:
        """A cluster that is there already, not one that this command starts."""
        return self.engine == "ray" and bool(self.address or os.environ.get("RAY_ADDRESS"))


class Session:
    """An engine at work: connects to Ray when that is needed, and lets go of it at the end."""

    def __init__(self, engine: Engine, threads: int | None) -> None:
        self.engine, self.threads = engine, threads
        self.gpus: list[str] = []  # of this machine, where its processes share them out
        self.cluster: RayCluster | None = None

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *error: object) -> None:
        if self.cluster is not None:
            self.cluster.__exit__(*error)

    def device(self, device: str) -> str:
        """ "cpu" or "cuda": of a cluster by what its nodes offer, else of this machine."""
        from ambiguous_wild.cli.devices import choose_device

        if not self.engine.remote:
            return choose_device(device)
        if device != "auto":
            return device
        return "cuda" if self._connected().has_gpu() else "cpu"

    def in_process(self, cells: Sequence[Cell]) -> bool:
        """Whether they run here, one after another; else `run` does. Several GPUs get a cell each."""
        if self.engine.engine != "local":
            return False
        if any(cell.device == "cuda" for cell in cells):
            import torch

            from ambiguous_wild.harness.engines.gpu_slots import visible_gpus

            self.gpus = visible_gpus(torch.cuda.device_count())
        if self.engine.jobs is None:
            self.engine = replace(self.engine, jobs=max(1, min(len(self.gpus), len(cells))))
        return self.engine.jobs == 1

    def run(self, grid: Grid) -> list[CellReport]:
        """Run the cells in processes of this machine or on the cluster; reports in their order."""
        from ambiguous_wild.harness.engines.processes import run_in_processes

        engine, cluster = self.engine, self._connected() if self.engine.engine == "ray" else None
        if cluster is not None and engine.gpus_per_cell is None and grid.cells[0].device == "cuda":
            cluster.options = replace(cluster.options, gpus=1.0)
        jobs = grid.jobs(self.threads or _share_of_cores(engine, cluster))
        progress = ManyAtOnce(grid.cells)
        if cluster is not None:
            click.echo(f"Ray: {cluster.describe()}", err=True)
            return cluster.run(jobs, lost=grid.lost, on_end=progress.end, say=_say)
        from ambiguous_wild.harness.engines.gpu_slots import sharing

        if said := sharing(min(engine.jobs or 1, len(jobs)), self.gpus):
            _say(f"warning: {said}")
        return run_in_processes(
            jobs, engine.jobs or 1, retries=engine.retries, lost=grid.lost,
            on_start=progress.start, on_end=progress.end, gpus=self.gpus,
        )  # fmt: skip

    def _connected(self) -> RayCluster:
        if self.cluster is None:
            from ambiguous_wild.harness.engines.ray_cluster import RayCluster, RayOptions

            engine = self.engine
            self.cluster = RayCluster(
                RayOptions(
                    address=engine.address,
                    jobs=engine.jobs,
                    cpus=engine.cpus_per_cell or float(self.threads or 1),
                    gpus=engine.gpus_per_cell or 0.0,
                    memory_gb=engine.memory_per_cell or 0.0,
                    retries=engine.retries,
                    transfer=engine.transfer,  # type: ignore[arg-type]
                    limit_mb=engine.transfer_limit,
                )
            )
        return self.cluster


@dataclass(frozen=True)
class Grid:
    """Cells and how they are run, whatever runs them."""

    cells: Sequence[Cell]
    output: Path
    overwrite: Overwrite
    cache: Path
    pictures: bool
    plugins: Sequence[Path]
    methods: Sequence[str]  # as they were typed

    def folders(self) -> list[Path]:
        """The run folder of every cell, looked at: see `checked_folders`."""
        from ambiguous_wild.harness.grid import checked_folders

        return checked_folders(self.cells, self.output, self.overwrite, self.cache)

    def jobs(self, threads: int) -> list[Job]:
        """The cells as what travels."""
        from ambiguous_wild.harness.engines.job import Shared, make_job, read_sources

        sources = read_sources(self.plugins, self.methods)
        shared = Shared(self.cache, self.overwrite, self.pictures, threads, sources)
        return [make_job(cell, folder, shared) for cell, folder in zip(self.cells, self.folders())]

    def lost(self, index: int, reason: str) -> CellReport:
        """The report of a cell whose process died too often."""
        from ambiguous_wild.harness.engines.job import record_lost
        from ambiguous_wild.harness.grid import cell_folder

        cell = self.cells[index]
        return record_lost(cell, cell_folder(self.output, cell), reason)


def _say(text: str) -> None:
    click.echo(text, err=True)


def _share_of_cores(engine: Engine, cluster: RayCluster | None) -> int:
    """Threads of one cell."""
    if cluster is not None:
        return max(1, int(cluster.options.cpus))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // (engine.jobs or 1))


class ManyAtOnce:
    """A line where a cell begins and one where it ends: bars of several at a time would mix."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        self.cells, self.done = cells, 0

    def _name(self, index: int) -> str:
        cell = self.cells[index]
        return f"{cell.method.name} on {cell.scene.name}, seed {cell.train.seed}"

    def start(self, index: int) -> None:
        click.echo(f"begins: {self._name(index)}", err=True)

    def end(self, index: int, report: CellReport) -> None:
        from ambiguous_wild.cli.progress import outcome_line

        self.done += 1
        click.echo(
            f"[{self.done}/{len(self.cells)}] {self._name(index)}: {outcome_line(report)} -> {report.folder}",
            err=True,
        )
