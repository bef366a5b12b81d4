"""A queue of `aw bench` runs that stops and goes on: finished runs are kept, stopped ones resume.

The texts of finished runs (settings, metrics, machine; no models, no pictures) go into an archive beside the
tables, so that the queue goes on at another machine and every figure can be traced.
"""

from __future__ import annotations

import io
import json
import lzma
import os
import subprocess
import sys
import tarfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.running.result_file import RESULT
from ambiguous_wild.harness.running.store import read_config, run_folders
from ambiguous_wild.io.atomic import atomic_path

TEXTS = ("config.yaml", "env.json", RESULT)


@dataclass(frozen=True)
class Run:
    """One run of one thread."""

    name: str  # in messages
    folder: Path  # of the run
    words: tuple[str, ...]  # of `aw`

    @property
    def finished(self) -> bool:
        return (self.folder / RESULT).is_file()


def run_all(runs: Sequence[Run], at_once: int = 1, most: int | None = None) -> list[str]:
    """Run what has no result, at most `most` of it; returns a line for each failure."""
    todo = [run for run in runs if not run.finished]
    print(f"{len(runs)} runs: {len(runs) - len(todo)} finished before, {len(todo)} to go", flush=True)
    env = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    failed = []
    todo = todo[:most]
    with ThreadPoolExecutor(at_once) as pool:
        waiting = {
            pool.submit(
                subprocess.run,
                [sys.executable, "-m", "ambiguous_wild.cli.main", *run.words],
                env=env,
                capture_output=True,
                text=True,
            ): run
            for run in todo
        }
        for number, done in enumerate(as_completed(waiting), start=1):
            run, process = waiting[done], done.result()
            lines = [line.strip() for line in process.stderr.splitlines() if line.strip()] or ["no output"]
            told = lines[-1] if process.returncode else next((x for x in lines if "PSNR" in x), lines[-1])
            print(f"[{number}/{len(todo)}] {run.name}: {told}", flush=True)
            if process.returncode:
                failed.append(f"{run.name}: {lines[-1]}")
    return failed


def keep(root: Path, archive: Path) -> None:
    """Write the texts of all finished runs below root into an archive; the same runs give the same bytes.

    Folders of this machine are left out: a scene goes by its name.
    """
    with atomic_path(archive) as temporary, tarfile.open(temporary, "w:xz", preset=9) as tar:
        for run in run_folders(root):
            if not (run / RESULT).is_file():
                continue
            place = str((read_config(run).get("scene") or {}).get("path", ""))
            for name in TEXTS:
                text = (run / name).read_text(encoding="utf-8")
                if Path(place).is_absolute():
                    text = text.replace(place, Path(place).name)
                info, data = tarfile.TarInfo(str((run / name).relative_to(root))), text.encode()
                info.size = len(data)
                tar.addfile(info, io.BytesIO(data))


def archive_of(stem: Path) -> Path:
    """The archive beside the tables stem.json and stem.md."""
    return stem.with_name(stem.name + "-runs.tar.xz")


def check_settings(stem: Path, **settings: object) -> None:
    """Refuse to mix runs of other settings with those of stem.json.

    Raises:
        AwError: a setting differs from the one that the tables were made with.
    """
    path = stem.with_name(stem.name + ".json")
    known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    for name, value in settings.items():
        if known.get(name, value) != value:
            told = f"{path} is of {name} {known[name]}, not {value}: give --results another name"
            raise AwError(told)


def restore(root: Path, archive: Path) -> int:
    """Put archived runs below root where none lies; returns how many.

    Raises:
        AwError: a damaged archive, or a path that leaves root.
    """
    if not archive.is_file():
        return 0
    root.mkdir(parents=True, exist_ok=True)
    try:
        with tarfile.open(archive, "r:xz") as tar:
            members = [m for m in tar if not (root / m.name).parent.joinpath(RESULT).is_file()]
            tar.extractall(root, members=members, filter="data")
    except (OSError, tarfile.TarError, lzma.LZMAError, EOFError) as error:
        raise AwError(
            f"cannot read the kept runs {archive}: {error}; remove it to train them again"
        ) from error
    return sum(Path(m.name).name == RESULT for m in members)
