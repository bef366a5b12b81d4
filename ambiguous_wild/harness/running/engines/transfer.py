"""Scenes to a node and run folders back, through Ray's object store: for clusters without shared storage."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.running.cell import CellReport
from ambiguous_wild.harness.running.engines.job import LOCK_WAIT_S, Job, run_job
from ambiguous_wild.harness.running.run_folder import is_finished
from ambiguous_wild.io.archive import Limits, pack_folder, unpack
from ambiguous_wild.io.atomic import atomic_dir
from ambiguous_wild.io.lock import folder_lock, patient_lock


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
        folder = Path(own) / "seed"
        here = dataclasses.replace(
            job, scene=str(place), folder=str(folder), cache_dir=str(cache / "features"), overwrite="missing"
        )
        report = run_job(here)
        content = pack_folder(folder, limit_mb) if folder.is_dir() else b""
    return Sent(dataclasses.replace(report, folder=Path(job.folder)), content)


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


def stays(job: Job) -> CellReport | None:
    """The report of a run that need not be made: finished here before, or to be left alone; else None."""
    folder = Path(job.folder)
    if folder.exists() and job.overwrite == "never":
        return CellReport(folder, "skipped")
    return CellReport(folder, "kept") if job.overwrite != "always" and is_finished(folder) else None
