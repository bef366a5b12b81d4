"""Do reference seconds survive a busy machine? The same grid alone and beside busy processes.

    python benchmarks/trusted_time.py -o /tmp/trusted            # an otherwise idle machine; about 15 minutes
    python benchmarks/trusted_time.py -o /tmp/short --scene scene --iterations 60 --seeds 1 --methods 3dgs

3 methods x 2 captures x 2 seeds, 1000 iterations. The second grid runs beside two processes that never pause,
one in its cache and one through memory. Passes where reference seconds of every cell agree within 10 %,
every cell of the busy grid is contended, none of it is ranked, and every cell of the quiet grid is alone.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from job_queue import aw, exit_code

from ambiguous_wild.harness.result_file import RESULT, read_result
from ambiguous_wild.harness.store import read_runs, run_folders
from ambiguous_wild.harness.timing import timing_of
from ambiguous_wild.io.files import write_json
from ambiguous_wild.report.comparison import comparison

METHODS = ("3dgs", "robustsplat", "refinesplat")
PRESETS = ("courtyard", "courtyard-twin")
WITHIN = 0.10
BUSY = (
    "while True: sum(range(10_000))",
    "import numpy as np\na = np.ones(8_000_000)\nwhile True: a *= 1.0000001",
)


@dataclass(frozen=True)
class Cell:
    """One cell, quiet and busy."""

    scene: str
    method: str
    seed: int
    wall_s: tuple[float, float]
    reference_s: tuple[float, float]
    cpu_s: tuple[float, float]
    verdicts: tuple[str, str]
    reasons: tuple[str, str]

    @property
    def deviation(self) -> float:
        """Of the busy reference seconds from the quiet ones."""
        return self.reference_s[1] / self.reference_s[0] - 1.0


def captures(folder: Path, width: int) -> list[Path]:
    """The two captures as scenes; made once."""
    scenes = []
    for name in PRESETS:
        scene = folder / f"{name}-scene"
        if not scene.is_dir():
            aw("simulate", name, "-o", str(folder / name), "--width", str(width))
            aw("build-scene", str(folder / name), "-o", str(scene), "--factor", "2")
        scenes.append(scene)
    return scenes


@contextmanager
def busy(count: int) -> Iterator[None]:
    """So many processes that compute without a pause, one thread each."""
    quiet = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    started = [subprocess.Popen([sys.executable, "-c", BUSY[k % len(BUSY)]], env=quiet) for k in range(count)]
    try:
        time.sleep(2.0 if count else 0.0)
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def grid(scenes: Sequence[Path], out: Path, methods: Sequence[str], seeds: int, iterations: int) -> None:
    """Every method on every scene with every seed; one by one."""
    words: list[object] = ["bench", "--iterations", iterations, "-o", out, "--device", "cpu", "--no-pictures"]
    for method in methods:
        words += ["--method", method]
    for scene in scenes:
        words += ["--scene", scene]
    for seed in range(seeds):
        words += ["--seed", seed]
    aw(*map(str, words))


def compared(quiet: Path, loud: Path) -> list[Cell]:
    """Cells that both grids have."""
    cells = []
    for folder in run_folders(quiet):
        costs = [read_result(at / RESULT)["cost"] for at in (folder, loud / folder.relative_to(quiet))]
        one, two = (timing_of(cost) for cost in costs)
        result = read_result(folder / RESULT)
        cells.append(
            Cell(
                result["scene"], result["method"], result["seed"],
                (costs[0]["train_s"], costs[1]["train_s"]), (one.reference_s, two.reference_s),
                (costs[0]["cpu_s"], costs[1]["cpu_s"]), (one.verdict, two.verdict), (one.reason, two.reason),
            )
        )  # fmt: skip
    return cells


def ranked(folder: Path) -> int:
    """Cells of the grid's table that have a rank in a column of times."""
    tables = comparison(read_runs(folder))
    timed = [k for k, column in enumerate(tables[0].columns) if column.measure.timed]
    return sum(row.cells[k].rank is not None for table in tables for row in table.rows for k in timed)


def kernel_seconds(folder: Path) -> float:
    """Median over all calibrations of a grid; KERNELS in splat/calibration.py has that of its machine."""
    records = [read_result(at / RESULT)["cost"]["timing"] for at in run_folders(folder)]
    return statistics.median(seconds for record in records for _, seconds in record["samples"])


def main() -> int:
    """Run both grids, or what is missing of them; print and write the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument(
        "--scene", type=Path, action="append", help="Instead of simulated captures; repeatable."
    )
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--busy", type=int, default=2, help="Busy processes beside the second grid.")
    wanted = parser.parse_args()
    out: Path = wanted.output
    scenes = wanted.scene or captures(out, wanted.width)
    for name, count in (("quiet", 0), ("busy", wanted.busy)):
        with busy(count):
            grid(scenes, out / name, wanted.methods.split(","), wanted.seeds, wanted.iterations)
    cells = compared(out / "quiet", out / "busy")
    print(f"{'cell':40} {'wall s':>15} {'processor s':>15} {'reference s':>15} {'deviation':>9}  verdicts")
    for cell in cells:
        pairs = " ".join(f"{a:7.1f} {b:7.1f}" for a, b in (cell.wall_s, cell.cpu_s, cell.reference_s))
        name = f"{cell.method} on {cell.scene}, seed {cell.seed}"
        print(f"{name:40} {pairs} {100 * cell.deviation:+8.1f} %  {', '.join(cell.verdicts)}")
    worst = max(abs(cell.deviation) for cell in cells)
    facts = {
        "worst_deviation": worst,
        "busy_flagged": all(cell.verdicts[1] == "contended" for cell in cells),
        "busy_ranked_cells": ranked(out / "busy"),
        "quiet_alone": all(cell.verdicts[0] == "alone" for cell in cells),
        "kernel_s": kernel_seconds(out / "quiet"),
    }
    passed = worst <= WITHIN and facts["busy_flagged"] and not facts["busy_ranked_cells"]
    passed = passed and facts["quiet_alone"]
    write_json(
        out / "trusted_time.json",
        {"passed": passed, "command": sys.argv, **facts, "cells": [asdict(cell) for cell in cells]},
    )
    print(json.dumps({"passed": passed, **facts}, indent=2))
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(exit_code(main))
