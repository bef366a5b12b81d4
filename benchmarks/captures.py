"""Methods x captures x seeds on captures with ground truth, compared with training on exact masks.

    python benchmarks/captures.py --captures DIR... --out DIR [--methods ...] [--seeds 0 1 2]
        [--iterations 2000] [--max-gaussians N] [--jobs 2] [--effects none|auto|LIST]
        [--set METHOD.KEY=VALUE ...] [--results FILE] [--report-only]

A DIR is a scene folder (`aw build-scene`, `aw composite`, `aw import`) or a folder of them. Each run is an
ordinary one of `aw bench` under --out with one thread; --jobs run at the same time. Finished ones are kept,
stopped ones resume. Writes benchmarks/results/captures.md, without paths. --report-only trains nothing: it
makes no plan of effects, but reads the one in a run folder of the scene; without one the row is missing.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from captures_report import facts_of, missing_runs, rows_of, summarise, tabulate, to_markdown
from job_queue import Run, exit_code, find_scenes, parser_of, run_all

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.cell import Cell, environment
from ambiguous_wild.harness.chosen_effects import chosen_by
from ambiguous_wild.harness.grid import cell_folder, plan_cells
from ambiguous_wild.harness.run import EFFECTS, refuse_other_config
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.io.files import write_text
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.pace import TrainConfig

RESULTS = Path(__file__).parent / "results" / "captures.md"
METHODS = ("3dgs", "robustsplat", "dronesplat", "refinesplat", "3dgs+truth", "3dgs-clean")


def run_of(cell: Cell, args: argparse.Namespace) -> Run:
    """The run of one cell."""
    words = ["--scene", str(cell.scene.root), "--seed", str(cell.train.seed)]
    words += ["--iterations", str(cell.train.iterations), "--device", "cpu", "--threads", "1"]
    if cell.train.max_gaussians is not None:
        words += ["--max-gaussians", str(cell.train.max_gaussians)]
    words += ["--no-pictures", "--effects", args.effects, "-o", str(args.out)]
    for setting in args.settings:
        method, _, key = setting.partition("=")[0].partition(".")
        if cell.method.option_keys(method, key):
            words += ["--set", setting]
    name = f"{cell.method.name} on {cell.scene.name}, seed {cell.train.seed}"
    return Run(name, cell_folder(args.out, cell), cell.method.name, tuple(words))


def with_recorded_effects(cells: Sequence[Cell], out: Path) -> list[Cell]:
    """The cells, each with the effects that a recorded plan gives it; without those that lack a plan.

    A plan belongs to the scene: the one in any of its run folders holds for all methods and seeds.
    """
    plans: dict[str, tuple[str, ...]] = {}
    for cell in cells:
        planned = planned_effects(cell_folder(out, cell))
        if planned is not None:
            plans.setdefault(cell.scene.name, planned)
    return [
        dataclasses.replace(c, chosen=chosen_by(plans[c.scene.name], c.scene, c.method))
        for c in cells
        if c.scene.name in plans
    ]


def planned_effects(folder: Path) -> tuple[str, ...] | None:
    """All effects that the plan of the run called for; None where no plan is recorded."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        plan = json.loads((folder / EFFECTS).read_text(encoding="utf-8"))["plan"]
        return tuple(str(name) for name in plan["effects"])
    return None


def refuse_other_configs(cells: Sequence[Cell], out: Path) -> None:
    """Raise AwError if a run folder has another configuration: it is neither replaced nor used."""
    for cell in cells:
        folder = cell_folder(out, cell)
        if folder.exists():
            refuse_other_config(folder, cell)


def refuse_other_captures(scenes: Iterable[Path], results: Path) -> None:
    """Raise AwError if the table is there, of other captures: it is not replaced by another's."""
    if not results.is_file():
        return
    try:
        tabulated = set(re.findall(r"^## (\S+) \(\d+ \+", results.read_text(encoding="utf-8"), re.MULTILINE))
    except (OSError, ValueError) as error:
        raise AwError(f"{results} cannot be read ({error}); choose another --results") from error
    if tabulated.isdisjoint(load_scene(root, verify=False).name for root in scenes):
        names = ", ".join(sorted(tabulated)) or "none of this script's"
        raise AwError(f"{results} is of other captures ({names}); choose another --results")


def without_folders(setting: str) -> str:
    """METHOD.KEY=VALUE for publication: of a path only the last name."""
    key, equals, value = setting.partition("=")
    return f"{key}{equals}{value.replace(chr(92), '/').rsplit('/', 1)[-1]}"


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = parser_of(__doc__, RESULTS, iterations=2000)
    parser.add_argument("--max-gaussians", type=int, default=TrainConfig.max_gaussians)
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--effects", default="none", help="as of aw bench, the same for all methods")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="METHOD.KEY=VALUE")
    return parser.parse_args(words)


def measure(args: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    """Train what is missing; returns all that the table shows, and a line for each failed run."""
    scenes_given = find_scenes(args.captures)
    refuse_other_captures(scenes_given, args.results)
    train = TrainConfig(iterations=args.iterations, max_gaussians=args.max_gaussians)
    recorded = args.report_only and args.effects == "auto"
    cells = plan_cells(
        args.methods,
        scenes_given,
        args.seeds,
        train,
        settings=args.settings,
        device="cpu",
        effects="none" if recorded else args.effects,
    )
    known = with_recorded_effects(cells, args.out) if recorded else cells
    refuse_other_configs(known, args.out)  # before anything is trained
    failed = [] if args.report_only else run_all([run_of(cell, args) for cell in cells], args.jobs)
    runs = read_runs(args.out) if any(cell_folder(args.out, cell).is_dir() for cell in cells) else None
    finished = rows_of(runs, [cell.identity for cell in known])
    if args.report_only and finished.empty and args.results.is_file():
        raise AwError(f"none of these runs is in {args.out}; {args.results} is not changed")
    scenes = {cell.scene.name: cell.scene for cell in cells}
    methods = list(dict.fromkeys(cell.method.name for cell in cells))
    rows = tabulate(finished, list(scenes), methods, args.seeds)
    missing = missing_runs(finished, runs, list(scenes), methods, args.seeds)
    planned = {(cell.scene.name, cell.method.name) for cell in known}
    for run in missing:
        if (run["capture"], run["method"]) not in planned:
            run["why"] = "no run folder records a plan of effects"
    captures = [facts_of(scene) for scene in scenes.values()]
    data = {
        "environment": environment("cpu"),
        "iterations": args.iterations,
        "seeds": args.seeds,
        "jobs": args.jobs,
        "threads": sorted({int(count) for count in finished["threads"]}),
        "effects": args.effects,
        "settings": [without_folders(setting) for setting in args.settings],
        "captures": captures,
        "rows": rows,
        "summary": summarise(rows, captures),
        "missing": missing,
    }
    return data, failed


def main(words: Sequence[str] | None = None) -> int:
    args = arguments(words)
    data, failed = measure(args)
    write_text(args.results, to_markdown(data))
    print(to_markdown(data))
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
