"""A job: a cell as plain values, which another process or machine turns into the cell again and runs.

A `Cell` holds code (a method's recipe) and an opened scene. What travels is how to get them: names, options,
paths and the sources of plugins. Whoever runs it compares the identity of what it made with the one it was
sent, so that another version of the code, of a plugin or of the scene is an error and never a number.
"""

from __future__ import annotations

import functools
import platform
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.config import from_plain, to_plain
from ambiguous_wild.harness.running.cell import Cell, CellReport, Overwrite, Protocol
from ambiguous_wild.harness.running.choosing import Chosen
from ambiguous_wild.harness.running.identity import scene_identity
from ambiguous_wild.harness.running.prepare import prepare_cpu
from ambiguous_wild.harness.running.provenance import code_hash
from ambiguous_wild.harness.running.result import failed_result
from ambiguous_wild.harness.running.result_file import FAILED, RESULT, write_result
from ambiguous_wild.harness.running.run import run_isolated
from ambiguous_wild.harness.running.run_folder import error_line
from ambiguous_wild.io.lock import Busy, folder_lock, patient_lock
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.graft import split_graft
from ambiguous_wild.methods.references import reference_file, with_file
from ambiguous_wild.methods.registry import get_method, load_plugin, load_reference
from ambiguous_wild.methods.second_pass import trained_once
from ambiguous_wild.splat.pace import TrainConfig

# A node that is lost keeps its lock until the file server forgets it (NFS: 90 s by default).
LOCK_WAIT_S = 150.0


@dataclass(frozen=True)
class Source:
    """Code that a method comes from: a plugin, or a reference such as ``recipe.py:my_recipe``."""

    text: str  # the reference as typed, or the plugin's path
    plugin: bool
    path: str = ""  # absolute path of its file, if it has one
    content: bytes = b""


@dataclass(frozen=True)
class Job:
    """How to make a cell again, and how to run it."""

    method: str
    sources: tuple[Source, ...]
    options: dict[str, Any]
    scene: str  # absolute path
    factor: int | None
    device: str
    protocol: Protocol
    train: dict[str, Any]
    chosen: Chosen
    identity: str
    code: str  # `code_hash` of the sender
    folder: str  # absolute path of the run folder
    cache_dir: str
    overwrite: Overwrite
    pictures: bool
    threads: int | None  # of the CPU kernels; None = as many as there are
    token: str = ""  # a file that the runner must see, see `check_storage`

    @property
    def title(self) -> str:
        return f"{self.method} on {Path(self.scene).name}, seed {self.train['seed']}"


@dataclass(frozen=True)
class JobSettings:
    """Settings that all jobs of one grid share."""

    cache_dir: Path
    overwrite: Overwrite = "missing"
    pictures: bool = True
    threads: int | None = None
    sources: tuple[Source, ...] = ()
    token: str = ""


def read_sources(plugins: Sequence[Path], methods: Sequence[str]) -> tuple[Source, ...]:
    """The code of plugins and of methods given as files; names of `aw methods` need none."""
    sources = [_source(str(path), True, path) for path in plugins]
    for name in methods:
        # A graft may have a reference as its host.
        host, _ = split_graft(trained_once(name))
        file = reference_file(host)
        if file is not None:
            sources.append(_source(host, False, file))
        elif host.startswith("nerfbaselines:"):
            sources.append(Source(host, False))
    return tuple(sources)


def _source(text: str, plugin: bool, path: Path) -> Source:
    return Source(text, plugin, str(path.resolve()), path.read_bytes())


def make_job(cell: Cell, folder: Path, shared: JobSettings) -> Job:
    """The job of a cell whose method `get_method` finds once the sources are loaded."""
    return Job(
        method=cell.method.name,
        sources=shared.sources,
        options=to_plain(cell.options),
        scene=str(cell.scene.root.resolve()),
        factor=cell.scene.info.get("loaded_factor"),
        device=cell.device,
        protocol=cell.protocol,
        train=to_plain(cell.train),
        chosen=cell.chosen,
        identity=cell.identity,
        code=code_hash(),
        folder=str(folder.absolute()),
        cache_dir=str(shared.cache_dir.absolute()),
        overwrite=shared.overwrite,
        pictures=shared.pictures,
        threads=shared.threads,
        token=shared.token,
    )


def run_job(job: Job) -> CellReport:
    """Make the cell and run it as `aw bench` does in one process; every error is a report."""
    folder = Path(job.folder)
    try:
        check_storage(job)
        cell = make_cell(job)
        if cell.method.program is None:
            if cell.device == "cpu":
                prepare_cpu(job.threads)
            else:
                _prepare_cuda()
    except Exception as error:
        return CellReport(folder, "failed", error=error_line(error))
    try:
        with patient_lock(folder, "aw bench", LOCK_WAIT_S):
            pass
    except Busy as error:
        return CellReport(folder, "failed", error=str(error))
    return run_isolated(
        cell, folder, cache_dir=Path(job.cache_dir), overwrite=job.overwrite, pictures=job.pictures
    )


def make_cell(job: Job) -> Cell:
    """The cell that the job describes.

    Raises:
        AwError: this process runs other code than the sender, or something on the way differs there.
    """
    if job.code != code_hash():
        raise AwError(
            f"{platform.node()} runs another state of ambiguous_wild than the machine that sent the run: "
            "install the same on every node"
        )
    for source in job.sources:
        _load(source)
    entry = get_method(job.method)
    scene = _scene(job.scene, job.factor)
    cell = Cell(
        method=entry,
        options=from_plain(type(entry.options()), job.options, f"options of {job.method}"),
        scene=scene,
        scene_id=scene_identity(scene),
        train=from_plain(TrainConfig, job.train, "train"),
        device=job.device,
        chosen=job.chosen,
        protocol=job.protocol,
    )
    if cell.identity != job.identity:
        raise AwError(
            f"{job.title}: {platform.node()} makes another run of it than the machine that sent it: "
            f"the scene {job.scene} or a file of the method differs there"
        )
    return cell


def check_storage(job: Job, wait_s: float = 30.0) -> None:
    """Make sure that this machine sees the folder that results go to.

    Raises:
        AwError: it does not see the file that the sender left there.
    """
    deadline = time.monotonic() + wait_s
    while job.token and not Path(job.token).exists():  # NFS remembers for seconds what was not there
        if time.monotonic() > deadline:
            raise AwError(
                f"{platform.node()} does not see {Path(job.token).parent}: give a folder on storage that all "
                "nodes share as -o, or send scenes and results with --transfer store"
            )
        time.sleep(1.0)


def record_lost(cell: Cell, folder: Path, error: str) -> CellReport:
    """Write failed.json for a run whose process died; its checkpoints stay, so that it can go on."""
    try:
        with folder_lock(folder, "aw bench"):
            if folder.is_dir() and not (folder / RESULT).exists():
                write_result(folder / FAILED, failed_result(cell, error))
    except (AwError, OSError):
        pass  # the report below has the error in any case
    return CellReport(folder, "failed", error=error)


def _load(source: Source) -> None:
    if not source.path:
        load_reference(source.text)
        return
    path = _present(source)
    if source.plugin:
        load_plugin(path)
    else:
        load_reference(with_file(source.text, path), given_as=with_file(source.text, Path(source.path)))


@functools.cache
def _present(source: Source) -> Path:
    """The source's own file where this machine has it, else a copy."""
    path = Path(source.path)
    try:
        if path.read_bytes() == source.content:
            return path
    except OSError:
        pass
    copy = Path(tempfile.mkdtemp(prefix="aw-source-")) / path.name
    copy.write_bytes(source.content)
    return copy


@functools.lru_cache(maxsize=4)
def _scene(path: str, factor: int | None) -> Scene:
    # The sender has compared every hash; a copy with other sizes or another scene.json is found all the same.
    return load_scene(path, factor=factor, verify="quick")


def _prepare_cuda() -> None:
    """Prepare the GPU of a cluster's node; elsewhere this is done before any job starts."""
    from ambiguous_wild.splat import readiness

    try:
        readiness.require(readiness.look())
    except AwError as error:
        raise AwError(f"{platform.node()} cannot use its GPU: {error}") from None
