"""PSNR within a training time: refinesplat at several budgets, other methods at one. Run it alone.

    python benchmarks/budgets.py --captures DIR[@FACTOR]... --out DIR [--budgets 60s 180s]
        [--methods 3dgs robustsplat] [--at 60s] [--seed 0] [--results STEM] [--report-only]

A DIR is a scene folder, FACTOR one of its sizes. Every run is one `aw bench` with its default effects and all
threads; one runs at a time. Finished runs are kept. Writes benchmarks/results/budgets.json and .md: for each
capture refinesplat at each budget, how far each is below the best of them, and the other methods at --at.
The cores at work before each run are kept too (`busy_cores`): above 0.5 something else ran, and the row is
marked, as it is where the system does not tell.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from ending import exit_code

from ambiguous_wild.core import Scene
from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.result_file import RESULT, read_result
from ambiguous_wild.io.atomic import write_json, write_text
from ambiguous_wild.io.scene_folder import load_scene

RESULTS = Path(__file__).parent / "results" / "budgets"
QUIET = 0.5  # cores at work, up to which nothing else ran
STAT = Path("/proc/stat")
NOTE = "busy-cores.txt"  # beside the run's result
# of earlier runs: busy cores or, before those were counted, the load average; rows keep it as "load"
OLD_NOTE = "load.txt"
OURS = "refinesplat"


def place_of(text: str) -> tuple[Path, int | None]:
    """DIR or DIR@FACTOR."""
    folder, _, factor = text.rpartition("@")
    return (Path(folder), int(factor)) if folder and factor.isdecimal() else (Path(text), None)


def folder_of(out: Path, scene: Scene, method: str, budget: str, seed: int) -> Path:
    return out / f"{scene.train[0].camera.width}px-{budget}" / scene.name / method / f"seed{seed}"


def busy_cores(seconds: float = 3.0) -> float | None:
    """Cores at work in the next seconds, as a mean; None where the system does not tell."""

    def read() -> tuple[int, int]:
        values = [int(word) for word in STAT.read_text().split("\n", 1)[0].split()[1:9]]
        return sum(values), values[3] + values[4]  # idle, and waiting for a disk

    if not STAT.is_file():
        return None
    total, idle = read()
    time.sleep(seconds)
    later_total, later_idle = read()
    return (1 - (later_idle - idle) / max(later_total - total, 1)) * (os.cpu_count() or 1)


def once_quiet(patience_s: float = 60.0) -> float | None:
    """Cores at work once nothing else is, or after so long."""
    end = time.monotonic() + patience_s
    while (busy := busy_cores()) is not None and busy > QUIET and time.monotonic() < end:
        time.sleep(3)
    return None if busy is None else round(busy, 2)


def bench(scene: Path, factor: int | None, method: str, budget: str, seed: int, folder: Path) -> str | None:
    """One run; returns what went wrong."""
    words = ["bench", "--scene", str(scene), "--method", method, "--budget", budget, "--seed", str(seed)]
    words += ["--device", "cpu", "--no-pictures", "--probes", "0", "-o", str(folder.parents[2])]
    words += ["--factor", str(factor)] if factor else []
    busy = once_quiet()
    done = subprocess.run(
        [sys.executable, "-m", "ambiguous_wild.cli.main", *words], capture_output=True, text=True
    )
    if not (folder / RESULT).is_file():
        return (done.stderr.strip().splitlines() or ["no output"])[-1]
    if busy is not None:
        write_text(folder / NOTE, f"{busy}\n")
    return None


def noted(path: Path) -> float | None:
    return float(path.read_text(encoding="utf-8")) if path.is_file() else None


def row_of(folder: Path, method: str, budget: str, scene: Scene) -> dict[str, Any] | None:
    if not (folder / RESULT).is_file():
        return None
    result = read_result(folder / RESULT)
    if result["status"] != "ok":
        return None
    busy, old = noted(folder / NOTE), noted(folder / OLD_NOTE)
    return {
        "scene": scene.name,
        "width": scene.train[0].camera.width,
        "method": method,
        "budget": budget,
        "psnr": fmean(float(row["psnr"]) for row in result["per_image"]),
        "iterations": result["cost"]["iterations"],
        "gaussians": result["cost"]["gaussians"],
        "busy_cores": busy,
        **({"load": old} if busy is None and old is not None else {}),
    }


def below_best(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows, ours with `below`: dB under our best on the same capture at the same size."""
    found = []
    for row in rows:
        same = [r["psnr"] for r in rows if (r["scene"], r["width"]) == (row["scene"], row["width"])
                and r["method"] == OURS]  # fmt: skip
        found.append(row | {"below": max(same) - row["psnr"] if row["method"] == OURS else None})
    return found


def to_markdown(data: dict[str, Any]) -> str:
    lines = [
        "# PSNR within a training time",
        "",
        f"`aw bench --budget`, default effects, seed {data['seed']}, {data['environment']['cores']} cores. "
        'Made by `benchmarks/budgets.py`. "Below best": dB under RefineSplat\'s best budget of the table. '
        f"(!): more than {QUIET} cores were at work before the run, or it is not known how many.",
        "",
        "| capture | width px | method | budget | PSNR | below best | iterations | Gaussians |",
        "|---|---:|---|---:|---:|---:|---:|---:|",
    ]
    for row in data["rows"]:
        seen = row.get("busy_cores")
        seen = row.get("load") if seen is None else seen  # of an earlier run
        busy = " (!)" if seen is None or seen > QUIET else ""
        below = "" if row["below"] is None else f"{row['below']:.2f}"
        cells = [row["scene"], row["width"], row["method"], row["budget"] + busy, f"{row['psnr']:.2f}", below,
                 row["iterations"], row["gaussians"]]  # fmt: skip
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", nargs="+", required=True, metavar="DIR[@FACTOR]")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--budgets", nargs="+", default=["60s", "180s"], help=f"of {OURS}")
    parser.add_argument("--methods", nargs="*", default=["3dgs", "robustsplat"], help="others, at --at")
    parser.add_argument("--at", default="60s", help="budget of the others")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=RESULTS, help="where .json and .md go")
    parser.add_argument("--report-only", action="store_true", help="train nothing, tabulate what is there")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    args = arguments(words)
    rows, failed = [], []
    for text in args.captures:
        place, factor = place_of(text)
        scene = load_scene(place, factor=factor)
        runs = [(OURS, budget) for budget in args.budgets] + [(name, args.at) for name in args.methods]
        for method, budget in runs:
            folder = folder_of(args.out, scene, method, budget, args.seed)
            if not args.report_only and not (folder / RESULT).is_file():
                wrong = bench(place, factor, method, budget, args.seed, folder)
                if wrong:
                    failed.append(f"{method}, {budget}, {scene.name}: {wrong}")
            row = row_of(folder, method, budget, scene)
            if row:
                rows.append(row)
                print(
                    f"{row['scene']} {row['width']} px, {method}, {budget}: {row['psnr']:.2f} dB", flush=True
                )
    data = {"environment": environment("cpu"), "seed": args.seed, "rows": below_best(rows)}
    write_json(args.results.with_name(args.results.name + ".json"), data)
    write_text(args.results.with_name(args.results.name + ".md"), to_markdown(data))
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
