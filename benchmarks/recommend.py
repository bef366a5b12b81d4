"""How far `aw cost --recommend` is from the best of a measured grid on captures that it has not seen.

    python benchmarks/recommend.py RUNS... --held-back SCENE SCENE [--budgets 6 10 18 30] [--scenes SCENE ...]

RUNS are folders of `aw bench`: settings at several lengths on several captures. The captures held back are
judged by the curves of the others; every pair of captures is held back in turn as well. Budgets are seconds
of the reference machine. Writes benchmarks/results/recommend.json.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from job_queue import exit_code

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.cell import environment
from ambiguous_wild.io.files import write_json
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.report.cost_recommend import CLOSE_DB, additive, values_within
from ambiguous_wild.report.cost_runs import CostRun, read_cost_runs

RESULTS = Path(__file__).parent / "results" / "recommend.json"


def leave_out(
    runs: Sequence[CostRun], scenes: Sequence[str], budget_s: float
) -> dict[str, tuple[str, float]]:
    """How good the recommendation is on scenes that it has not seen.

    Returns:
        By scene: the setting that the other scenes recommend, and how many dB it is behind the scene's best.

    Args:
        runs: of all scenes, those held back included.
        scenes: held back, all at once.
        budget_s: in the seconds of the runs.
    """
    rivals = [run for run in runs if not run.error and not knows_truth(run.method)]
    # of all runs at once: a setting is named after what varies among them
    values = values_within(rivals, budget_s)
    kept = {key: value for key, value in values.items() if key[1] not in scenes}
    if not kept:
        raise AwError("no scene is left to learn from: hold fewer back, or give a longer budget")
    parts, _ = additive(kept)
    found = {}
    for scene in scenes:
        here = {name: value for (name, where), value in values.items() if where == scene}
        known = [name for name in parts if name in here]
        if not known:
            raise AwError(f"{scene} was trained with none of the settings of the other scenes")
        chosen = max(known, key=lambda name: parts[name])
        found[scene] = chosen, max(here.values()) - here[chosen]
    return found


def judge(runs: Sequence[CostRun], held_back: Sequence[str], budget_s: float) -> dict[str, Any]:
    """The choice for the captures held back, and how far behind it is for all pairs."""

    def choices(scenes: Sequence[str]) -> dict[str, dict[str, Any]]:
        found = leave_out(runs, scenes, budget_s)
        return {scene: {"setting": name, "behind_db": behind} for scene, (name, behind) in found.items()}

    scenes = sorted({run.scene for run in runs})
    pairs = [choices(pair) for pair in itertools.combinations(scenes, 2)]
    behind = [choice["behind_db"] for pair in pairs for choice in pair.values()]
    return {
        "budget_s": budget_s,
        "held_back": choices(held_back),
        "pairs": len(pairs),
        "share_within": sum(db <= CLOSE_DB for db in behind) / len(behind),
        "worst_db": max(behind),
    }


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--held-back", nargs="+", required=True, metavar="SCENE")
    parser.add_argument("--scenes", nargs="+", help="captures to use; by default all")
    parser.add_argument("--budgets", nargs="+", type=float, default=[6.0, 10.0, 18.0, 30.0])
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args(words)
    found = read_cost_runs(args.runs)
    runs = [run for run in found.runs if args.scenes is None or run.scene in args.scenes]
    data = {
        "environment": environment("cpu"),
        "runs": len(runs),
        "contended": sum(run.timing.verdict != "alone" for run in runs),
        "scenes": sorted({run.scene for run in runs}),
        "methods": sorted({run.method for run in runs}),
        "within_db": CLOSE_DB,
        "budgets": [judge(runs, args.held_back, budget) for budget in args.budgets],
    }
    write_json(args.results, data)
    for row in data["budgets"]:
        told = ", ".join(
            f"{scene}: {choice['setting']}, {choice['behind_db']:.2f} dB behind the best"
            for scene, choice in row["held_back"].items()
        )
        print(
            f"{row['budget_s']:g} s: {told}; all pairs: {row['share_within']:.0%} within {CLOSE_DB} dB, "
            f"worst {row['worst_db']:.2f} dB"
        )
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
