"""What the benchmarks share: scenes of folders, `aw` commands, and a queue of `aw bench` runs.

Finished runs of a queue are kept and stopped ones resume, so a benchmark can be stopped and started again.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import yaml

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import flatten
from ambiguous_wild.harness.result_file import RESULT, read_result
from ambiguous_wild.harness.store import read_config
from ambiguous_wild.io.files import write_text


def exit_code(main: Callable[[], int | None]) -> int | None:
    """What `main` returns; 2 and one line on standard error where it raises AwError."""
    try:
        return main()
    except AwError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def aw(*words: str) -> str:
    """Run a command of the project; returns its standard output.

    Raises:
        AwError: the command failed; holds its last line.
    """
    command = [sys.executable, "-m", "ambiguous_wild.cli.main", *words]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        lines = (done.stderr.strip() or done.stdout.strip() or f"exit code {done.returncode}").splitlines()
        raise AwError(f"aw {' '.join(words[:2])}: {lines[-1]}")
    return done.stdout


def write_section(path: Path, title: str, body: str) -> None:
    """Write a section of a page of results, in place of the earlier one of this title."""
    text = path.read_text(encoding="utf-8") if path.is_file() else f"# {path.stem.capitalize()}\n"
    head, *sections = text.split("\n## ")
    kept = [section for section in sections if section.partition("\n")[0] != title]
    write_text(path, "\n## ".join([head, *kept, f"{title}\n\n{body}\n"]))


def find_scenes(folders: Iterable[Path]) -> list[Path]:
    """Scene folders among the folders and one level below them.

    Raises:
        AwError: a folder that is and holds none.
    """
    scenes: list[Path] = []
    for folder in folders:
        below = sorted(p.parent for p in folder.glob("*/scene.json")) if folder.is_dir() else []
        if (folder / "sparse").is_dir() or (folder / "scene.json").is_file():
            scenes.append(folder)
        elif below:
            scenes += below
        else:
            raise AwError(f"{folder} is no scene folder and holds none; 'aw build-scene' makes them")
    return scenes


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


def count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no count from 1 on")
    return int(text)


def seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is no seed from 0 on")
    return int(text)


def run_all(runs: Sequence[Run], at_once: int = 1) -> list[str]:
    """Run what has no result; returns a line for each failure.

    Methods with the same other words share a process: it loads packages, kernels and photos once.
    """
    todo = [run for run in runs if not run.finished]
    print(f"{len(runs)} runs: {len(runs) - len(todo)} finished before, {len(todo)} to go", flush=True)
    # one thread each in whatever a run calls: those of libraries wait by spinning, on the others' cores
    env = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    failed = []
    number = 0
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
                number += 1
                psnr = run.psnr()
                print(f"[{number}/{len(todo)}] {run.name}: {psnr or lines[-1]}", flush=True)
                if psnr is None:
                    failed.append(f"{run.name}: {lines[-1]}")
    return failed


def batches(runs: Sequence[Run], largest: int = 8) -> list[list[Run]]:
    """Runs that differ in the method alone, at most `largest` together; each method once."""
    groups: dict[tuple[str, ...], list[list[Run]]] = {}
    for run in runs:
        own = groups.setdefault(run.words, [[]])
        if len(own[-1]) == largest or any(run.method == other.method for other in own[-1]):
            own.append([])
        own[-1].append(run)
    return [batch for own in groups.values() for batch in own]


def command(batch: Sequence[Run]) -> list[str]:
    """The words of `aw` that make these runs."""
    words = ["bench"]
    for run in batch:
        words += ["--method", run.method]
        for option in run.options:
            words += ["--set", f"{run.method}.{option}"]
    return [*words, *batch[0].words]
