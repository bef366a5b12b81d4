"""A queue of `aw bench` runs that stops and goes on: finished runs are kept, stopped ones resume."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.harness.running.result_file import RESULT


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
