"""Test PSNR of `--effects auto` against hand-picked sets of effects, on presets with known effects.

    python benchmarks/auto.py --scenes DIR --out DIR [--presets NAME ...] [--iterations 1000] [--factor 2]

Uses the scenes of benchmarks/presets.py (its --work DIR/scenes). On each, RefineSplat is trained with `auto`,
with the effects the preset was designed for (colour per photo once as exposure, once as appearance), with
none and with all. A lower SH degree is left out (its cost is in docs/effects.md). Writes
benchmarks/results/auto.json and .md: test PSNR and training seconds of each set, and auto against the best
other one: by PSNR, or by time within 0.02 dB. If both are the same set, times are not compared. What `auto`
tried before it decided, and the seconds of that, are in a column of their own.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from presets import Stopped, aw, check_presets, mean_psnr, save

from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.result_file import RESULT, read_result
from ambiguous_wild.simulate.presets import PRESETS

RESULTS = Path(__file__).parent / "results" / "auto"
METHOD = "refinesplat"
TIE_DB = 0.02
# what a preset was designed for -> the trainer's effects that answer it
ANSWERS = {"appearance": ("exposure", "appearance"), "antialiasing": ("antialias",), "pose": ("poses",)}


def sets_of(preset: str) -> dict[str, str]:
    """name -> value of --effects."""
    designed = PRESETS[preset].designed.effects
    wanted = [effect for effect in designed if effect in ANSWERS]
    found = {"auto": "auto", "none": "none", "all": "all"}
    for k in range(max((len(ANSWERS[effect]) for effect in wanted), default=1)):
        picked = [ANSWERS[effect][min(k, len(ANSWERS[effect]) - 1)] for effect in wanted]
        if picked:
            found["+".join(picked)] = ",".join(picked)
    return found


def train(scene: Path, effects: str, out: Path, args: argparse.Namespace) -> dict[str, Any]:
    """One run: test PSNR, seconds of training, and the effects that were on.

    Raises:
        Stopped: the run failed.
    """
    words = ["bench", "--method", METHOD, "--scene", str(scene), "--effects", effects, "--no-pictures"]
    words += ["--iterations", str(args.iterations), "--factor", str(args.factor), "-o", str(out)]
    aw(*words)
    run = out / scene.name / METHOD / "seed0"
    result = read_result(run / RESULT)
    told = run / "effects.json"
    said = json.loads(told.read_text(encoding="utf-8")) if told.is_file() else {}
    plan = said.get("plan") or {"decisions": [], "cost": None}
    return {
        "psnr": mean_psnr(result),
        "train_s": result["cost"]["train_s"],
        "setup_s": result["cost"].get("setup_s"),
        "effects": said.get("effects"),
        "tried": {
            d["effect"]: [d["gain_db"], d["error_db"]] for d in plan["decisions"] if d["gain_db"] is not None
        },
        "deciding": plan["cost"],
    }


def measure(preset: str, args: argparse.Namespace) -> dict[str, Any]:
    """All sets on one preset, and auto against the best of the others."""
    scene = args.scenes / preset
    sets = sets_of(preset)
    runs = {"auto": train(scene, sets.pop("auto"), args.out / "auto", args)}
    for name, value in sets.items():
        # what auto chose is the same run to the bit: not trained again
        same = sorted(runs["auto"]["effects"] or []) == sorted([] if name == "none" else value.split(","))
        runs[name] = runs["auto"] if same else train(scene, value, args.out / name, args)
    others = {name: run for name, run in runs.items() if name != "auto"}
    top = max(run["psnr"] for run in others.values())
    near = {name: run for name, run in others.items() if run["psnr"] >= top - TIE_DB}
    best = min(near, key=lambda name: near[name]["train_s"])
    same = runs[best] is runs["auto"]
    return {
        "preset": preset,
        "runs": runs,
        "best": best,
        "auto_minus_best_db": runs["auto"]["psnr"] - runs[best]["psnr"],
        "same_set": same,
        "auto_over_best_time": None if same else runs["auto"]["train_s"] / runs[best]["train_s"],
    }


def to_markdown(data: dict[str, Any]) -> str:
    """The results as Markdown."""
    lines = [
        "# Effects: what `auto` loses against the best set picked by hand",
        "",
        f"{METHOD}, {data['iterations']} iterations, --factor {data['factor']}, seed 0; dB / s of training",
        "",
        "| preset | auto chose | tried | auto | none | all | designed for | best | auto - best, dB | time |",
        "|---|---|---|---:|---:|---:|---|---|---:|---:|",
    ]
    for row in data["presets"]:
        if "error" in row:
            lines.append(f"| {row['preset']} | {row['error']} |" + " |" * 8)
            continue
        shown = {name: f"{run['psnr']:.2f} / {run['train_s']:.0f}" for name, run in row["runs"].items()}
        chosen = row["runs"]["auto"]["effects"]
        hand = "; ".join(f"{k}: {v}" for k, v in shown.items() if k not in ("auto", "none", "all"))
        lines.append(
            f"| {row['preset']} | {', '.join(chosen or []) or 'none'} | {_tried(row['runs']['auto'])} "
            f"| {shown['auto']} | {shown['none']} "
            f"| {shown['all']} | {hand or 'none'} | {row['best']} | {row['auto_minus_best_db']:+.2f} "
            f"| {'same set' if row['same_set'] else format(row['auto_over_best_time'], '.2f')} |"
        )
    return "\n".join(lines) + "\n"


def _tried(run: dict[str, Any]) -> str:
    found = [f"{effect} {gain:+.2f} ± {error:.2f} dB" for effect, (gain, error) in run["tried"].items()]
    cost = run["deciding"]
    return f"{'; '.join(found)} ({cost['seconds']:.0f} s)" if found and cost else "nothing"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=Path, required=True, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the runs")
    parser.add_argument("--presets", nargs="+", default=[n for n in PRESETS if n != "tiny"])
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--factor", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args(argv)
    check_presets(parser, args.presets)
    rows = []
    for k, preset in enumerate(args.presets, 1):
        try:
            rows.append(measure(preset, args))
        except Stopped as error:
            rows.append({"preset": preset, "error": str(error)})
        row = rows[-1]
        shown = row.get("error") or f"{row['auto_minus_best_db']:+.2f} dB against {row['best']}"
        print(f"[{k}/{len(args.presets)}] {preset}: {shown}", flush=True)
        data = {
            "environment": environment("cpu"),
            "method": METHOD,
            "iterations": args.iterations,
            "factor": args.factor,
            "presets": rows,
        }
        save(args.results, data, to_markdown(data))
    print(to_markdown(data))
    return 1 if any("error" in row for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
