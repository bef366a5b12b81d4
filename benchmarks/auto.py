"""Test PSNR of `--effects auto` against effects picked by hand: presets, composites, real captures.

    python benchmarks/auto.py --scenes DIR... --out DIR [--iterations 1500] [--jobs 2]

A DIR is a scene folder or a folder of them. On each scene RefineSplat is trained with `auto` and with none,
`near`, `dense`, and what may help there: on a preset the effects it was designed for (colour per photo once
as exposure, once as appearance), elsewhere `exposure` and `antialias`; each alone and with `near`. One seed,
one thread a run. Finished runs are kept. Writes benchmarks/results/auto.json and .md.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import fmean
from typing import Any

from captures import find_scenes
from presets import Stopped, aw, mean_psnr

from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.result_file import RESULT, read_result
from ambiguous_wild.io.atomic import write_json, write_text
from ambiguous_wild.simulate.presets import PRESETS
from ambiguous_wild.splat.effects import check_effects

RESULTS = Path(__file__).parent / "results" / "auto"
METHOD = "refinesplat"
# what a preset was designed for -> the trainer's effects that answer it
ANSWERS = {"appearance": ("exposure", "appearance"), "antialiasing": ("antialias",), "pose": ("poses",)}
ANYWHERE = ("exposure", "antialias")  # tried where nobody designed the scene


def picked_by_hand(scene: str) -> list[str]:
    """Values of --effects."""
    if scene in PRESETS:
        designed = [ANSWERS[e] for e in PRESETS[scene].designed.effects if e in ANSWERS]
        depth = max((len(answers) for answers in designed), default=0)
        helpful = [[answers[min(k, len(answers) - 1)] for answers in designed] for k in range(depth)]
    else:
        helpful = [[effect] for effect in ANYWHERE]
    sets = [[], ["near"], ["dense"], *helpful, *([*names, "near"] for names in helpful)]
    return list(dict.fromkeys(",".join(check_effects(names)) or "none" for names in sets))


def train(scene: Path, effects: str, out: Path, iterations: int) -> dict[str, Any]:
    """One run: test PSNR, the effects that were on, and what was tried before.

    Raises:
        Stopped: the run failed, or is there with another configuration.
    """
    folder = out / effects.replace(",", "+")
    run = folder / scene.name / METHOD / "seed0"
    words = ["bench", "--method", METHOD, "--scene", str(scene), "--effects", effects, "--threads", "1"]
    words += ["--device", "cpu", "--iterations", str(iterations), "--no-pictures", "-o", str(folder)]
    aw(*words)  # keeps a finished run of the same configuration and scene, refuses another one
    told = run / "effects.json"
    said = json.loads(told.read_text(encoding="utf-8")) if told.is_file() else {}
    decisions = (said.get("plan") or {"decisions": []})["decisions"]
    return {
        "psnr": mean_psnr(read_result(run / RESULT)),
        "effects": ",".join(said.get("effects") or []) or "none",
        "tried": {d["effect"]: [d["gain_db"], d["error_db"]] for d in decisions if d["gain_db"] is not None},
    }


def measure(scene: Path, out: Path, iterations: int) -> dict[str, Any]:
    """All sets on one scene, and auto against the best of the others."""
    auto = train(scene, "auto", out, iterations)
    sets = {name: train(scene, name, out, iterations)["psnr"] for name in picked_by_hand(scene.name)}
    best = max(sets, key=lambda name: sets[name])
    sets.setdefault(auto["effects"], auto["psnr"])
    return {
        "scene": scene.name,
        "auto": auto,
        "sets": sets,
        "best": best,
        "below_best_db": max(sets[best] - auto["psnr"], 0.0),
        "over_none_db": auto["psnr"] - sets["none"],
    }


def to_markdown(data: dict[str, Any]) -> str:
    """The results as Markdown."""
    rows = data["scenes"]
    lines = [
        "# Effects: `auto` against sets picked by hand",
        "",
        f"{METHOD}, {data['iterations']} iterations, seed 0, test PSNR in dB",
        "",
        "| scene | auto chose | auto | none | best by hand | below it | over none | tried |",
        "|---|---|---:|---:|---|---:|---:|---|",
    ]
    for row in rows:
        auto, sets = row["auto"], row["sets"]
        tried = "; ".join(
            f"{name} {gain:+.2f} ± {error:.2f}" for name, (gain, error) in auto["tried"].items()
        )
        lines.append(
            f"| {row['scene']} | {auto['effects']} | {auto['psnr']:.2f} | {sets['none']:.2f} "
            f"| {row['best']} {sets[row['best']]:.2f} | {row['below_best_db']:.2f} "
            f"| {row['over_none_db']:+.2f} | {tried} |"
        )
    near = sum(row["below_best_db"] <= 0.1 for row in rows)
    worst = min(rows, key=lambda row: row["over_none_db"])
    lines += [
        "",
        f"Within 0.1 dB of the best on {near} of {len(rows)}; mean below it "
        f"{fmean(row['below_best_db'] for row in rows):.2f} dB, mean over none "
        f"{fmean(row['over_none_db'] for row in rows):.2f} dB, least {worst['over_none_db']:+.2f} "
        f"({worst['scene']}).",
    ]
    return "\n".join(lines) + "\n"


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", type=Path, required=True, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args(words)
    scenes = find_scenes(args.scenes)
    if len({scene.name for scene in scenes}) < len(scenes):
        parser.error("two scenes have the same name: their runs would share a folder")
    with ThreadPoolExecutor(args.jobs) as pool:
        rows = list(pool.map(lambda scene: measure(scene, args.out, args.iterations), scenes))
    data = {"environment": environment("cpu"), "iterations": args.iterations, "scenes": rows}
    write_json(args.results.with_suffix(".json"), data)
    write_text(args.results.with_suffix(".md"), to_markdown(data))
    print(to_markdown(data))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except Stopped as error:
        sys.exit(f"error: {error}")
