"""A queue of `aw bench` runs that stops and goes on: finished runs are kept, stopped ones resume.

The texts of finished runs (settings, metrics, machine; no models, no pictures) go into an archive beside the
tables, so that the queue goes on at another machine and every figure can be traced.
"""

from __future__ import annotations

import argparse
import io
import json
import lzma
import os
import subprocess
import sys
import tarfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import yaml

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import flatten
from ambiguous_wild.harness.running.result_file import RESULT, read_result
from ambiguous_wild.harness.running.store import read_config, run_folders
from ambiguous_wild.io.atomic import atomic_path

TEXTS = ("config.yaml", "env.json", RESULT)


@dataclass(frozen=True)
class Run:
    """One run of one thread."""

    name: str  # in messages
    folder: Path  # of the run
    method: str
    words: tuple[str, ...]  # of `aw bench`, all but the method and its options
    options: tuple[str, ...] = ()  # of the method, KEY=VALUE

    @property
    def finished(self) -> bool:
        """Whether there is a result with these options; one with others `aw bench` refuses by itself."""
        return (self.folder / RESULT).is_file() and self._has(read_config(self.folder).get("options") or {})

    def _has(self, options: Mapping[str, object]) -> bool:
        known = flatten(options)
        return all(
            known.get(key) == yaml.safe_load(value)
            for key, _, value in (option.partition("=") for option in self.options)
        )

    def psnr(self) -> str | None:
        """The mean over its test photos in words; None if it is not finished, or failed."""
        result = read_result(self.folder / RESULT) if self.finished else {"status": "missing"}
        if result["status"] != "ok":
            return None
        return f"{fmean(float(row['psnr']) for row in result['per_image']):.2f} dB"


def parser_of(doc: str | None, iterations: int, tables: str) -> argparse.ArgumentParser:
    """The options that every queue has.

    Args:
        doc: of the script.
        iterations: of a run, the default.
        tables: endings of the files that hold the tables, in words.
    """
    parser = argparse.ArgumentParser(description=(doc or "").partition("\n")[0])
    parser.add_argument("--captures", nargs="+", type=Path, required=True, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--iterations", type=_count, default=iterations)
    parser.add_argument("--max-gaussians", type=_count, default=12_000)
    parser.add_argument("--jobs", type=_count, default=1, help="runs at a time")
    parser.add_argument("--most", type=_count, help="runs of this call at most")
    parser.add_argument("--results", type=Path, help=f"where {tables} go")
    parser.add_argument("--report-only", action="store_true", help="train nothing, tabulate what is there")
    return parser


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no count from 1 on")
    return int(text)


def run_all(runs: Sequence[Run], at_once: int = 1, most: int | None = None) -> list[str]:
    """Run what has no result, at most `most` of it; returns a line for each failure.

    Methods with the same other words share a process: it loads packages, kernels and photos once.
    """
    todo = [run for run in runs if not run.finished]
    print(f"{len(runs)} runs: {len(runs) - len(todo)} finished before, {len(todo)} to go", flush=True)
    env = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    failed = []
    todo = todo[:most]
    count = 0
    with ThreadPoolExecutor(at_once) as pool:
        waiting = {
            pool.submit(
                subprocess.run,
                [sys.executable, "-m", "ambiguous_wild.cli.main", *command(batch)],
                env=env,
                capture_output=True,
                text=True,
            ): batch
            for batch in batches(todo)
        }
        for done in as_completed(waiting):
            batch, process = waiting[done], done.result()
            lines = [line.strip() for line in process.stderr.splitlines() if line.strip()] or ["no output"]
            for run in batch:
                count += 1
                told = run.psnr()
                print(f"[{count}/{len(todo)}] {run.name}: {told or lines[-1]}", flush=True)
                if told is None:
                    failed.append(f"{run.name}: {lines[-1]}")
    return failed


def batches(runs: Sequence[Run], largest: int = 8) -> list[list[Run]]:
    """Runs that differ in the method alone, at most `largest` together; each method once."""
    found: dict[tuple[str, ...], list[list[Run]]] = {}
    for run in runs:
        own = found.setdefault(run.words, [[]])
        if len(own[-1]) == largest or any(run.method == other.method for other in own[-1]):
            own.append([])
        own[-1].append(run)
    return [batch for own in found.values() for batch in own]


def command(batch: Sequence[Run]) -> list[str]:
    """The words of `aw` that make these runs."""
    words = ["bench"]
    for run in batch:
        words += ["--method", run.method]
        for option in run.options:
            words += ["--set", f"{run.method}.{option}"]
    return [*words, *batch[0].words]


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
