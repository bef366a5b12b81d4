"""Time and result of structure from motion: `aw build-scene --sfm auto` against `--sfm thorough`.

    python benchmarks/build_scene.py photos/ more-photos/ -o /tmp/builds [--iterations 700]
        [--before CHECKOUT]

Builds each capture both ways, the other way first for every second one; finished builds are kept. With
--before another checkout of the project builds the thorough way. With --iterations plain 3DGS is trained on
both, on the same test photos. Run it alone on the machine. Writes benchmarks/results/build-scene.json and
.md; captures are named after their folders.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

from ambiguous_wild.harness.running.result_file import RESULT, read_result
from ambiguous_wild.harness.running.store import run_folders
from ambiguous_wild.io.atomic import write_json, write_text

RESULTS = Path(__file__).parent / "results" / "build-scene"
WAYS = ("thorough", "auto")
STAGES = ("features", "matches", "mapping")
DECIBELS = ("psnr", "psnr_supported")


def aw(*words: object, checkout: Path | None = None) -> None:
    """One command of this package, or of another checkout of it."""
    env = {**os.environ, "PYTHONPATH": str(checkout)} if checkout else None
    command = [sys.executable, "-m", "ambiguous_wild.cli.main", *map(str, words)]
    subprocess.run(command, check=True, env=env, cwd=checkout)


def psnr_of(scene: Path, runs: Path, iterations: int) -> dict[str, float]:
    """Test PSNR in dB of 3DGS: of whole photos, and where at least three train photos look."""
    length = ("--iterations", iterations, "--effects", "none", "--device", "cpu", "--no-pictures")
    aw("bench", "--method", "3dgs", "--scene", scene, *length, "-o", runs)
    result = read_result(next(iter(run_folders(runs))) / RESULT)
    rows = result["per_image"]
    return {key: fmean(float(row[key]) for row in rows) for key in DECIBELS}


def measure(raw: Path, out: Path, iterations: int, turn: int, before: Path | None) -> dict[str, Any]:
    """Both builds of one capture."""
    found: dict[str, Any] = {"capture": raw.name}
    for way in WAYS if turn % 2 == 0 else WAYS[::-1]:
        scene = out / raw.name / way
        checkout = before if way == WAYS[0] else None
        aw("build-scene", raw, "-o", scene, "--sfm", way, "--name", raw.name, checkout=checkout)
        facts = json.loads((scene / "scene.json").read_text(encoding="utf-8"))
        seconds = facts["seconds"]
        found[way] = {
            "chosen": facts["chosen"]["sfm"],
            "seconds": {stage: seconds[stage] for stage in STAGES},
            "total_s": sum(seconds.values()),
            "photos": facts["counts"]["photos"],
            "registered": facts["counts"]["registered"],
            "pairs": facts["counts"]["pairs"],
            "points": facts["counts"]["points"],
            "error_px": facts["reprojection_error_px"],
        }
        if iterations:
            found[way] |= psnr_of(scene, out / raw.name / f"runs-{way}", iterations)
    return found


def markdown(rows: list[dict[str, Any]]) -> str:
    """A row a capture; times of the whole build."""
    lines = [
        "| capture | photos | placed | error px | features s | matches s | mapping s | all s | faster "
        "| dB | supported dB |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        both = [row[way] for way in WAYS]

        def pair(text: str, values: list[float]) -> str:
            return " → ".join(format(v, text) for v in values)

        decibels = [pair(".2f", [b[key] for b in both]) if key in both[0] else "" for key in DECIBELS]
        stages = [pair(".1f", [b["seconds"][s] for b in both]) for s in STAGES]
        lines.append(
            f"| {row['capture']} | {both[0]['photos']} | {pair('d', [b['registered'] for b in both])} | "
            f"{pair('.3f', [b['error_px'] for b in both])} | {' | '.join(stages)} | "
            f"{pair('.1f', [b['total_s'] for b in both])} | {both[0]['total_s'] / both[1]['total_s']:.2f} | "
            f"{' | '.join(decibels)} |"
        )
    ratios = [row["thorough"]["total_s"] / row["auto"]["total_s"] for row in rows]
    mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
    lines += ["", f"`thorough → auto`; geometric mean of how much faster: {mean:.2f}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Build what is missing; write both files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=0)
    parser.add_argument("--before", type=Path, metavar="CHECKOUT")
    wanted = parser.parse_args()
    rows = [
        measure(raw.resolve(), wanted.output.resolve(), wanted.iterations, turn, wanted.before)
        for turn, raw in enumerate(wanted.captures)
    ]
    write_json(RESULTS.with_suffix(".json"), rows)
    write_text(RESULTS.with_suffix(".md"), markdown(rows))
    print(markdown(rows))


if __name__ == "__main__":
    main()
