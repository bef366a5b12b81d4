"""Test PSNR of `--effects auto` against effects picked by hand: presets, composites, real captures.

    python benchmarks/auto.py --captures DIR... --out DIR [--iterations 1500] [--seeds 0] [--jobs 2]

A DIR is a scene folder or a folder of them. On each scene RefineSplat is trained with `auto` and with sets of
the effects among which it chooses: none, `dense`, `skybox`, and what may help there: on a preset what it was
designed for (colour per photo once as exposure, once as appearance), elsewhere `exposure`, also with `dense`
and `skybox`, and `antialias`. The set that `auto` chose is not trained again: the bits are the same. One
thread a run. Finished runs are kept. Writes benchmarks/results/auto.md.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import fmean
from typing import Any

from job_queue import aw, count, exit_code, find_scenes, seed

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.harness.result_file import RESULT, read_result
from ambiguous_wild.io.files import own_json, write_text
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.metrics import stats
from ambiguous_wild.simulate.presets import PRESETS
from ambiguous_wild.splat.effects import check_effects

RESULTS = Path(__file__).parent / "results" / "auto.md"
METHOD = "refinesplat"
METRICS = {
    "psnr": "Whole photos.",
    "psnr_supported": "Pixels whose surface at least three train photos see.",
}
# what a preset was designed for -> the trainer's effects that answer it
ANSWERS = {"appearance": ("exposure", "appearance"), "antialiasing": ("antialias",), "pose": ("poses",)}
# tried where nobody designed the scene; such scenes have few photos
ANYWHERE = (("exposure",), ("antialias",), ("exposure", "dense"), ("exposure", "skybox"))


def picked_by_hand(scene: str) -> list[str]:
    """Values of --effects."""
    if scene in PRESETS:
        designed = [ANSWERS[e] for e in PRESETS[scene].designed.effects if e in ANSWERS]
        depth = max((len(answers) for answers in designed), default=0)
        helpful = [[answers[min(k, len(answers) - 1)] for answers in designed] for k in range(depth)]
    else:
        helpful = [list(effects) for effects in ANYWHERE]
    sets = [[], ["dense"], ["skybox"], *helpful]
    return list(dict.fromkeys(",".join(check_effects(names)) or "none" for names in sets))


def train(scene: Scene, effects: str, out: Path, iterations: int, seeds: Sequence[int]) -> dict[str, Any]:
    """A run a seed: their metrics, and the effects that were on.

    Raises:
        AwError: the run failed, or is there with another configuration.
    """
    folder = out / effects.replace(",", "+")
    runs = [folder / scene.name / METHOD / f"seed{seed}" for seed in seeds]
    words = ["bench", "--method", METHOD, "--scene", str(scene.root), "--effects", effects, "--threads", "1"]
    words += ["--device", "cpu", "--iterations", str(iterations), "--no-pictures", "-o", str(folder)]
    words += [word for seed in seeds for word in ("--seed", str(seed))]
    aw(*words)  # keeps a finished run of the same configuration and scene, refuses another one
    plan = own_json(runs[0] / "effects.json")  # the same for every seed
    images = [read_result(run / RESULT)["per_image"] for run in runs]
    return {
        "seeds": {m: [_mean(of_run, m) for of_run in images] for m in METRICS},
        "effects": ",".join(plan.get("effects") or []) or "none",
    }


def _mean(images: Sequence[Mapping[str, Any]], metric: str) -> float:
    """NaN if any image lacks it."""
    values = [image.get(metric) for image in images]
    return stats.mean([math.nan if value is None else value for value in values])


def measure(scene: Scene, out: Path, iterations: int, seeds: Sequence[int]) -> dict[str, Any]:
    """All sets on one scene, and auto against the best of the others, in the mean of the seeds."""
    auto = train(scene, "auto", out, iterations, seeds)
    chosen = auto["effects"]
    runs = {chosen: auto["seeds"]}
    for name in picked_by_hand(scene.name):
        if name not in runs:
            runs[name] = train(scene, name, out, iterations, seeds)["seeds"]
    row: dict[str, Any] = {"scene": scene.name, "auto": chosen}
    for metric in METRICS:
        sets = {name: fmean(of_set[metric]) for name, of_set in runs.items()}
        if not any(map(math.isnan, sets.values())):
            by_seed = {name: of_set[metric] for name, of_set in runs.items()}
            best = max(sets, key=lambda name: sets[name])
            below, over = sets[best] - sets[chosen], sets[chosen] - sets["none"]
            row[metric] = {
                "seeds": by_seed,
                "sets": sets,
                "best": best,
                "below_best_db": below,
                "over_none_db": over,
            }
    return row


def to_markdown(data: dict[str, Any]) -> str:
    """The results as Markdown: a table and a line for each metric."""
    seeds = ", ".join(map(str, data["seeds"]))
    lines = [
        "# Effects: `auto` against sets picked by hand",
        "",
        f"{METHOD}, {data['iterations']} iterations, mean of seeds {seeds}, dB of the test photos.",
    ]
    for metric, about in METRICS.items():
        rows = [row for row in data["scenes"] if metric in row]
        if not rows:
            continue
        lines += ["", f"## {metric}", "", about, ""]
        lines.append("| scene | auto chose | auto | none | best by hand | below it | over none |")
        lines.append("|---|---|---:|---:|---|---:|---:|")
        for row in rows:
            found = row[metric]
            sets, best = found["sets"], found["best"]
            lines.append(
                f"| {row['scene']} | {row['auto']} | {sets[row['auto']]:.2f} | {sets['none']:.2f} "
                f"| {best} {sets[best]:.2f} | {found['below_best_db']:.2f} "
                f"| {found['over_none_db']:+.2f} |"
            )
        below = [row[metric]["below_best_db"] for row in rows]
        worst = min(rows, key=lambda row: row[metric]["over_none_db"])
        lines += [
            "",
            f"Within 0.1 dB of the best on {sum(b <= 0.1 for b in below)} of {len(rows)}; mean below it "
            f"{fmean(below):.2f} dB, mean over none "
            f"{fmean(row[metric]['over_none_db'] for row in rows):.2f} dB, least "
            f"{worst[metric]['over_none_db']:+.2f} ({worst['scene']}).",
        ]
    return "\n".join(lines) + "\n"


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--captures", nargs="+", type=Path, required=True, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--seeds", nargs="+", type=seed, default=[0])
    parser.add_argument("--iterations", type=count, default=1500)
    parser.add_argument("--jobs", type=count, default=2, help="runs at a time")
    parser.add_argument("--results", type=Path, default=RESULTS, help="where the table goes")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    args = arguments(words)
    scenes = [load_scene(root) for root in find_scenes(args.captures)]
    if len({scene.name for scene in scenes}) < len(scenes):
        raise AwError("two scenes have the same name: their runs would share a folder")
    rows: list[dict[str, Any]] = []
    failed: list[str] = []
    with ThreadPoolExecutor(args.jobs) as pool:
        waiting = [pool.submit(measure, scene, args.out, args.iterations, args.seeds) for scene in scenes]
        for scene, done in zip(scenes, waiting, strict=True):
            try:
                rows.append(done.result())
            except AwError as error:
                failed.append(f"{scene.name}: {error}")
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    if not rows:
        return 1
    table = to_markdown({"iterations": args.iterations, "seeds": args.seeds, "scenes": rows})
    write_text(args.results, table)
    print(table)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
