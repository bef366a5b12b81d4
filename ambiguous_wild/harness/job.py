"""A job is a cell as plain values, from which another process or machine makes the cell again and runs it.

A `Cell` holds code (a method's recipe) and an opened scene, which cannot be sent. A job holds the names,
options, paths and sources of plugins to make them again. The receiver compares the identity of its cell
with the one in the job: another version of the code, a plugin or the scene is an error, not a wrong result.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import platform
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.config import from_plain
from ambiguous_wild.harness.cell import Cell, CellReport, RunOptions, code_hash, scene_identity
from ambiguous_wild.harness.cell_run import error_line, run_cell
from ambiguous_wild.harness.chosen_effects import ChosenEffects
from ambiguous_wild.harness.measures import load_metrics
from ambiguous_wild.harness.result_file import FAILED, RESULT, RunConfig, write_result
from ambiguous_wild.harness.start import recorded_start
from ambiguous_wild.io.corrections import recorded_corrections
from ambiguous_wild.io.files import folder_lock, patient_lock
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.entry import trained_once
from ambiguous_wild.methods.graft import graft_pairs, split_graft
from ambiguous_wild.methods.references import (
    EXTERNAL,
    MASKS,
    NERFBASELINES,
    reference_file,
    replace_reference_file,
)
from ambiguous_wild.methods.registry import get_method, load_plugin, load_reference
from ambiguous_wild.splat.train_config import TrainConfig

# A node that is lost keeps its lock until the file server forgets it (NFS: 90 s by default).
LOCK_WAIT_S = 150.0


@dataclass(frozen=True)
class CodeSource:
    """Code that a run needs: a plugin, metrics, or a method given as ``recipe.py:my_recipe``."""

    text: str  # the reference as typed, or the file's path
    kind: str  # "plugin", "metric" or "method"
    path: str = ""  # absolute path of its file, if it has one
    content: bytes = b""


@dataclass(frozen=True)
class Job:
    """The values to make a cell again and run it."""

    config: RunConfig
    chosen: ChosenEffects
    identity: str
    scene: str  # absolute path
    folder: str  # absolute path of the run folder
    options: RunOptions
    sources: tuple[CodeSource, ...]
    threads: int | None  # of the CPU kernels; None = all cores
    code: str  # `code_hash` of the sender
    token: str = ""  # path of a file that the receiver must see, see `check_storage`


def read_sources(
    plugins: Sequence[str | Path], methods: Sequence[str], metrics: Sequence[str | Path] = ()
) -> tuple[CodeSource, ...]:
    """Read the code of plugins, and of methods and metrics given as files; other methods need none."""
    files = {str(path): reference_file(str(path)) for path in plugins}
    sources = [
        _source(text, "method" if file else "plugin", file or Path(text)) for text, file in files.items()
    ]
    sources += [_source(str(path), "metric", Path(path)) for path in metrics]
    for name in methods:
        # the host of a graft may be a reference, and so may its donors
        host, _ = split_graft(trained_once(name))
        for member in (host, *(donor for _, donor in graft_pairs(trained_once(name)))):
            file = reference_file(member)
            if file is not None:
                sources.append(_source(member, "method", file))
            elif member.startswith((EXTERNAL, NERFBASELINES, MASKS)):
                sources.append(CodeSource(member, "method"))
    return tuple(sources)


def _source(text: str, kind: str, path: Path) -> CodeSource:
    return CodeSource(text, kind, str(path.resolve()), path.read_bytes())


def make_job(
    cell: Cell,
    folder: Path,
    options: RunOptions,
    sources: tuple[CodeSource, ...] = (),
    threads: int | None = None,
) -> Job:
    """Return the job of a cell; `get_method` must find its method once the sources are loaded."""
    config, scene = cell.config, str(cell.scene.root.resolve())
    options = RunOptions(options.cache_dir.absolute(), options.overwrite, options.pictures)
    identity, place = cell.identity, str(folder.absolute())
    return Job(config, cell.chosen, identity, scene, place, options, sources, threads, code_hash())


def run_job(job: Job) -> CellReport:
    """Make the cell and run it as `aw bench` does in one process; every error becomes a report."""
    from ambiguous_wild.splat import readiness
    from ambiguous_wild.splat.calibration import prepare_cpu

    folder = Path(job.folder)
    try:
        check_storage(job)
        cell = make_cell(job)
        if cell.method.program is None and cell.device == "cpu":
            prepare_cpu(job.threads)
        elif cell.method.program is None:
            readiness.require_gpu(readiness.gpu_facts())
        with patient_lock(folder, "aw bench", LOCK_WAIT_S):
            pass
    except Exception as error:
        return CellReport(folder, "failed", error=f"on {platform.node()}: {error_line(error)}")
    return run_cell(cell, folder, job.options)


def make_cell(job: Job) -> Cell:
    """Make the cell that the job describes.

    Raises:
        AwError: the code, the scene or a file of the method differs from that of the sender.
    """
    if job.code != code_hash():
        raise AwError(
            "the code of ambiguous_wild differs from that on the machine that sent the run: "
            "install the same version on every node"
        )
    for source in job.sources:
        _load(source)
    config = job.config
    entry = get_method(config["method"])
    scene = _scene(job.scene, config["scene"]["factor"])
    cell = Cell(
        method=entry,
        options=from_plain(type(entry.options()), config["options"], f"options of {entry.name}"),
        scene=scene,
        scene_id=scene_identity(scene),
        train=from_plain(TrainConfig, config["train"], "train"),
        device=config["device"],
        chosen=job.chosen,
        protocol="half" if config.get("protocol") == "half" else "full",
        start=recorded_start(config.get("start")),
        corrections=recorded_corrections(config.get("corrections")),
        continued=tuple(config.get("continued", ())),
    )
    if cell.identity != job.identity:
        raise AwError(
            f"{entry.name} on {scene.name} would be another run than on the machine that sent it: "
            f"the scene {job.scene} or a file of the method differs there"
        )
    return cell


def check_storage(job: Job, wait_s: float = 30.0) -> None:
    """Check that this machine shares the output folder with the sender.

    Raises:
        AwError: the file that the sender left in that folder is not visible.
    """
    deadline = time.monotonic() + wait_s
    while job.token and not Path(job.token).exists():  # NFS caches for seconds that a file is absent
        if time.monotonic() > deadline:
            raise AwError(
                f"this node cannot see {Path(job.token).parent}: give -o a folder on storage that all "
                "nodes share, or send scenes and results with --set engine.transfer=store"
            )
        time.sleep(1.0)


def record_lost(cell: Cell, folder: Path, error: str) -> CellReport:
    """Write failed.json for a run whose process died; its checkpoint stays, so that it can be resumed."""
    try:
        with folder_lock(folder, "aw bench"):
            if folder.is_dir() and not (folder / RESULT).exists():
                write_result(folder / FAILED, cell.result(error=error))
    except (AwError, OSError):
        pass  # the report has the error in any case
    return CellReport(folder, "failed", error=error)


def _load(source: CodeSource) -> None:
    if not source.path:
        load_reference(source.text)
        return
    path = _local_file(source)
    if source.kind == "plugin":
        load_plugin(path)
    elif source.kind == "metric":
        load_metrics(path)
    else:
        load_reference(
            replace_reference_file(source.text, path),
            given_as=replace_reference_file(source.text, Path(source.path)),
        )


@functools.cache
def _local_file(source: CodeSource) -> Path:
    """Return the source's own file where this machine has it unchanged, else a copy."""
    path = Path(source.path)
    with contextlib.suppress(OSError):  # the file is absent, or another user's
        if path.read_bytes() == source.content:
            return path
    folder = Path(tempfile.mkdtemp(prefix="aw-source-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    copy = folder / path.name
    copy.write_bytes(source.content)
    return copy


@functools.lru_cache(maxsize=4)
def _scene(path: str, factor: int | None) -> Scene:
    # The sender has compared every hash; "quick" still finds a copy with other sizes or another scene.json.
    return load_scene(path, factor=factor, verify="quick", check=False)
