"""Time and result of structure from motion: `aw build-scene --sfm auto` against `--sfm thorough`.

    python benchmarks/build_scene.py photos/ more-photos/ -o /tmp/builds [--iterations 700]
        [--before CHECKOUT]

Builds each capture both ways, the other way first for every second one; finished builds are kept. With
--before another checkout of the project builds the thorough way. With --iterations plain 3DGS is trained on
both, on the same test photos. Run it alone on the machine. Writes benchmarks/results/build-scene.json and
.md; captures are named after their folders. The .json names the commit of each build, and for --before the
environment of that checkout.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.result_file import RESULT, read_result
from ambiguous_wild.harness.running.store import run_folders
from ambiguous_wild.io.atomic import write_json, write_text
from ambiguous_wild.metrics import stats

HERE = Path(__file__).resolve().parents[1]  # this checkout
RESULTS = Path(__file__).parent / "results" / "build-scene"
WAYS = ("thorough", "auto")
STAGES = ("features", "matches", "mapping")
DECIBELS = ("psnr", "psnr_supported")


def python(*words: object, checkout: Path | None = None, **more: Any) -> subprocess.CompletedProcess[str]:
    """This Python with this package, or with another checkout of it."""
    env = {**os.environ, "PYTHONPATH": str(checkout)} if checkout else None
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, check=True, env=env, cwd=checkout, text=True, **more)


def aw(*words: object, checkout: Path | None = None) -> None:
    """One command of this package, or of another checkout of it."""
    python("-m", "ambiguous_wild.cli.main", *words, checkout=checkout)


def commit_of(checkout: Path) -> str | None:
    """Its commit, with "-dirty" where files were changed since; None where git knows none."""
    if not (checkout / ".git").exists():
        return None  # git would answer for a repository around it
    # no optional locks: refreshing the index must not disturb somebody's commit
    git = ["git", "--no-optional-locks", "-C", str(checkout)]
    try:
        done = subprocess.run(
            [*git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            capture_output=True,
            text=True,
        )
    except OSError:
        return None
    return done.stdout.strip() or None


def environment_of(checkout: Path) -> dict[str, Any]:
    """The environment of its commands: the same Python and libraries, its own version."""
    code = "import ambiguous_wild; print(ambiguous_wild.__version__)"
    version = python("-c", code, checkout=checkout, stdout=subprocess.PIPE).stdout.strip()
    return {**environment("cpu"), "ambiguous_wild": version}


def psnr_of(scene: Path, runs: Path, iterations: int) -> dict[str, float | None]:
    """Test PSNR in dB of 3DGS: of whole photos, and where at least three train photos look.

    A photo without a supported pixel has no entry and does not count; None = missing.
    """
    length = ("--iterations", iterations, "--effects", "none", "--device", "cpu", "--no-pictures")
    aw("bench", "--method", "3dgs", "--scene", scene, *length, "-o", runs)
    result = read_result(next(iter(run_folders(runs))) / RESULT)
    rows: list[dict[str, Any]] = [dict(row) for row in result["per_image"]]
    values = {key: [row[key] for row in rows if key in row] for key in DECIBELS}
    means = {key: stats.mean([math.nan if v is None else v for v in found]) for key, found in values.items()}
    return {key: None if math.isnan(mean) else mean for key, mean in means.items()}


def measure(raw: Path, out: Path, iterations: int, turn: int, before: Path | None) -> dict[str, Any]:
    """Both builds of one capture."""
    found: dict[str, Any] = {"capture": raw.name}
    for way in WAYS if turn % 2 == 0 else WAYS[::-1]:
        scene = out / raw.name / way
        checkout = before if way == WAYS[0] else None
        made_by = scene.with_name(f"{way}-commit.txt")  # a kept build may be of an earlier commit
        if not (scene / "scene.json").is_file():
            write_text(made_by, f"{commit_of(checkout or HERE) or ''}\n")
        aw("build-scene", raw, "-o", scene, "--sfm", way, "--name", raw.name, checkout=checkout)
        facts = json.loads((scene / "scene.json").read_text(encoding="utf-8"))
        seconds = facts["seconds"]
        found[way] = {
            "commit": made_by.read_text(encoding="utf-8").strip() or None if made_by.is_file() else None,
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

        def pair(text: str, values: list[float | None]) -> str:
            return " → ".join("-" if v is None else format(v, text) for v in values)

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


def main(words: Sequence[str] | None = None) -> None:
    """Build what is missing; write both files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=0)
    parser.add_argument("--before", type=Path, metavar="CHECKOUT")
    parser.add_argument("--results", type=Path, default=RESULTS, help="where .json and .md go")
    wanted = parser.parse_args(words)
    # its commands run inside it, where another relative path would be meant
    before = wanted.before.resolve() if wanted.before else None
    if before and not (before / "ambiguous_wild").is_dir():
        parser.error(f"--before {wanted.before}: no checkout of this project")  # else it would compare itself
    other = {"commit": commit_of(before), "environment": environment_of(before)} if before else None
    rows = [
        measure(raw.resolve(), wanted.output.resolve(), wanted.iterations, turn, before)
        for turn, raw in enumerate(wanted.captures)
    ]
    data = {"environment": environment("cpu"), "before": other, "captures": rows}
    table = markdown(rows)
    write_json(wanted.results.with_name(wanted.results.name + ".json"), data)
    write_text(wanted.results.with_name(wanted.results.name + ".md"), table)
    print(table)


if __name__ == "__main__":
    main()
