"""Overhead of Ray per cell: wall seconds of a grid on Ray minus those of the same grid in one process.

    python benchmarks/ray_overhead.py [--cells 8] [--out benchmarks/results/ray_overhead.json]

Every cell is an external program that only copies photos of a tiny scene. The remaining time is the creation
of cells, the transfer of jobs and reports, and once the start of Ray and of a worker. There is one worker, so
that cells run one after the other, as without Ray.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import yaml

from ambiguous_wild.harness.running.engines.job import JobSettings, make_job, read_sources, record_lost
from ambiguous_wild.harness.running.engines.ray_cluster import RayCluster, RayOptions
from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.grid import cell_folder, plan_cells, run_cells
from ambiguous_wild.io.atomic import write_json
from ambiguous_wild.splat.pace import TrainConfig

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.tiny_scene import write_tiny_scene

COPY = (
    "import shutil, sys; from pathlib import Path; photos = sorted(Path(sys.argv[1]).iterdir()); "
    "[shutil.copy(photos[-1], Path(sys.argv[2]) / (str(i) + '.png')) for i in range(2)]"
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "ray_overhead.json")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measured = measure(Path(folder), arguments.cells)
    write_json(arguments.out, measured | {"environment": environment("cpu")})
    print(json.dumps(measured, indent=2))


def measure(folder: Path, count: int) -> dict[str, float]:
    """Seconds of the start and per cell, with and without Ray."""
    method = folder / "copy.yaml"
    command = [sys.executable, "-S", "-c", COPY, "{scene}/{images}", "{output}"]
    description = {"name": "copy", "train": command, "renders": "{output}/{index}.png"}
    method.write_text(yaml.safe_dump(description))
    scene = write_tiny_scene(folder / "scene")
    name = f"external:{method}"
    cells = plan_cells([name], [scene], list(range(count)), TrainConfig(iterations=1))

    begin = time.perf_counter()
    reports = run_cells(cells, folder / "local")
    local_s = time.perf_counter() - begin
    assert all(r.outcome == "trained" for r in reports), reports

    output = folder / "ray"
    shared = JobSettings(output / ".cache", sources=read_sources([], [name]))
    jobs = [make_job(cell, cell_folder(output, cell), shared) for cell in cells]
    ends: list[float] = []
    begin = time.perf_counter()
    with RayCluster(RayOptions(jobs=1)) as cluster:
        started_s = time.perf_counter() - begin
        reports = cluster.run(
            jobs,
            lost=lambda i, reason: record_lost(cells[i], cell_folder(output, cells[i]), reason),
            on_end=lambda i, report: ends.append(time.perf_counter() - begin),
        )
    assert all(r.outcome == "trained" for r in reports), reports
    per_cell_s = (ends[-1] - ends[0]) / (count - 1)
    return {
        "cells": count,
        "local_s_per_cell": local_s / count,
        "ray_s_per_cell": per_cell_s,
        "overhead_s_per_cell": per_cell_s - local_s / count,
        "ray_start_s": started_s,
        "first_cell_s": ends[0] - started_s,  # starts the worker, which imports torch
        "overhead_s_per_cell_all_in": (ends[-1] - local_s) / count,
    }


if __name__ == "__main__":
    main()
