"""Methods x captures x seeds on captures with ground truth, compared with training on exact masks.

    python benchmarks/captures.py --captures DIR... --out DIR [--methods ...] [--seeds 0 1 2]
        [--iterations 2000] [--jobs 2] [--effects none|default|LIST] [--set METHOD.KEY=VALUE ...]
        [--results STEM] [--report-only]

A DIR is a scene folder or a folder of them. Each run is one `aw bench` with one thread; --jobs run at the
same time. Runs are ordinary run folders under --out: finished ones are kept, stopped ones resume. Writes
benchmarks/results/captures.json, .csv and .md, without paths, and captures-runs.csv with a row per run. A run
that is in this file with the same configuration and scene is not trained again, even on another machine.
--report-only trains nothing. It makes no plan of effects, but reads the one in a run folder of the scene;
without one the row is missing.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import pandas as pd
from captures_report import (
    book_of,
    facts_of,
    merged,
    missing_runs,
    read_book,
    summarise,
    tabulate,
    threads_of,
    to_csv,
    to_markdown,
)
from ending import exit_code

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.running.cell import Cell
from ambiguous_wild.harness.running.choosing import PLANNED, Probing, chosen_by
from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.grid import cell_folder, plan_cells
from ambiguous_wild.harness.running.prepare import prepare_cpu
from ambiguous_wild.harness.running.result_file import RESULT
from ambiguous_wild.harness.running.run_folder import planned_effects, refuse_other_config
from ambiguous_wild.harness.running.store import read_runs
from ambiguous_wild.io.atomic import write_json, write_text
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.pace import TrainConfig

RESULTS = Path(__file__).parent / "results" / "captures"
METHODS = ("3dgs", "robustsplat", "dronesplat", "refinesplat", "3dgs+truth", "3dgs-clean")


def find_scenes(folders: Iterable[Path]) -> list[Path]:
    """Scene folders among the folders and one level below them.

    Raises:
        AwError: a folder that is and holds none.
    """
    scenes: list[Path] = []
    for folder in folders:
        below = sorted(p.parent for p in folder.glob("*/scene.json")) if folder.is_dir() else []
        if (folder / "sparse").is_dir() or (folder / "scene.json").is_file():
            scenes.append(folder)
        elif below:
            scenes += below
        else:
            raise AwError(f"{folder} is no scene folder and holds none; 'aw build-scene' makes them")
    return scenes


def command(cell: Cell, args: argparse.Namespace) -> list[str]:
    """The `aw bench` command of one cell."""
    words = ["bench", "--method", cell.method.name, "--scene", str(cell.scene.root)]
    words += ["--seed", str(cell.train.seed), "--iterations", str(cell.train.iterations)]
    words += ["--device", "cpu", "--threads", "1", "--no-pictures", "--effects", args.effects]
    words += ["-o", str(args.out)]
    for setting in args.settings:
        method, _, key = setting.partition("=")[0].partition(".")
        if cell.method.option_keys(method, key):
            words += ["--set", setting]
    return [sys.executable, "-m", "ambiguous_wild.cli.main", *words]


def current(book: pd.DataFrame, cells: Sequence[Cell]) -> pd.DataFrame:
    """The recorded rows of these cells with their present configuration."""
    return book[book.config_hash.isin([cell.identity for cell in cells])]


def run_all(cells: Sequence[Cell], book: pd.DataFrame, args: argparse.Namespace) -> list[str]:
    """Run the missing cells, `jobs` at a time; returns a line for each failure."""
    known = set(book.config_hash)
    todo = [c for c in cells if c.identity not in known and not (cell_folder(args.out, c) / RESULT).is_file()]
    print(f"{len(cells)} runs: {len(cells) - len(todo)} finished before, {len(todo)} to go", flush=True)
    failed = []
    # one thread each in whatever a run calls: those of libraries wait by spinning, on the others' cores
    env = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with ThreadPoolExecutor(args.jobs) as pool:
        waiting = {
            pool.submit(subprocess.run, command(cell, args), env=env, capture_output=True, text=True): cell
            for cell in todo
        }
        for number, done in enumerate(as_completed(waiting), start=1):
            cell, process = waiting[done], done.result()
            name = f"{cell.method.name} on {cell.scene.name}, seed {cell.train.seed}"
            lines = [line.strip() for line in process.stderr.splitlines() if line.strip()] or ["no output"]
            if process.returncode:
                failed.append(f"{name}: {lines[-1]}")
            told = lines[-1] if process.returncode else next((x for x in lines if "PSNR" in x), lines[-1])
            print(f"[{number}/{len(todo)}] {name}: {told}", flush=True)
    return failed


def with_recorded_effects(cells: Sequence[Cell], wanted: str, out: Path) -> list[Cell]:
    """The cells, each with the effects that a recorded plan gives it; without those that lack a plan.

    A plan belongs to the scene: the one in any of its run folders holds for all methods and seeds.
    """
    plans: dict[str, tuple[str, ...]] = {}
    for cell in cells:
        found = planned_effects(cell_folder(out, cell))
        if found is not None:
            plans.setdefault(cell.scene.name, found)
    chosen = [chosen_by(plans.get(c.scene.name), wanted, c.scene, c.method) for c in cells]
    return [dataclasses.replace(c, chosen=found) for c, found in zip(cells, chosen) if found is not None]


def refuse_other_configs(cells: Sequence[Cell], out: Path) -> None:
    """Raise AwError if a run folder has another configuration: it is neither replaced nor used."""
    for cell in cells:
        folder = cell_folder(out, cell)
        if folder.exists():
            refuse_other_config(folder, cell)


def beside(stem: Path, ending: str) -> Path:
    """A file of the results; the stem may hold dots."""
    return stem.with_name(stem.name + ending)


def refuse_other_captures(scenes: Iterable[Path], stem: Path) -> None:
    """Raise AwError if the results are there, of other captures: a table is not replaced by another's."""
    path = beside(stem, ".json")
    if not path.is_file():
        return
    try:
        told = {capture["name"] for capture in json.loads(path.read_text(encoding="utf-8"))["captures"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise AwError(f"{path} is no result of this script ({error}); choose another --results") from error
    if told.isdisjoint(load_scene(root, verify=False).name for root in scenes):
        raise AwError(f"{path} is of other captures ({', '.join(sorted(told))}); choose another --results")


def without_folders(setting: str) -> str:
    """METHOD.KEY=VALUE for publication: of a path only the last name."""
    key, equals, value = setting.partition("=")
    return f"{key}{equals}{value.replace(chr(92), '/').rsplit('/', 1)[-1]}"


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", nargs="+", type=Path, required=True, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--effects", default="none", help="as of aw bench; default: what each method chooses")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="METHOD.KEY=VALUE")
    parser.add_argument("--results", type=Path, default=RESULTS, help="where .json, .csv and .md go")
    parser.add_argument("--report-only", action="store_true", help="train nothing, tabulate what is there")
    args = parser.parse_args(words)
    if args.jobs < 1 or args.iterations < 1:
        parser.error("--jobs and --iterations count from 1")
    if min(args.seeds) < 0:
        parser.error("--seeds count from 0")
    return args


def main(words: Sequence[str] | None = None) -> int:
    args = arguments(words)
    scenes_given = find_scenes(args.captures)
    refuse_other_captures(scenes_given, args.results)  # before a plan trains probes
    book_path = beside(args.results, "-runs.csv")
    book = read_book(book_path)
    train = TrainConfig(iterations=args.iterations)
    plans = Probing(train, args.out / ".cache" / "plans", lambda: prepare_cpu(args.jobs, print), print)
    recorded = args.report_only and args.effects in PLANNED
    cells = plan_cells(
        args.methods,
        scenes_given,
        args.seeds,
        train,
        settings=args.settings,
        device="cpu",
        effects="none" if recorded else args.effects,  # a plan trains probes
        probing=plans,
    )
    known = with_recorded_effects(cells, args.effects, args.out) if recorded else cells
    refuse_other_configs(known, args.out)  # before anything is trained
    failed = [] if args.report_only else run_all(cells, book, args)
    # without a run folder the book may hold them all
    runs = read_runs(args.out) if any(cell_folder(args.out, cell).is_dir() for cell in cells) else None
    book = book if runs is None else merged(book, book_of(runs))
    record, book = book, current(book, known)
    if args.report_only and book.empty and beside(args.results, ".json").is_file():
        raise AwError(f"none of these runs is in {args.out} or {book_path}; {args.results}.md is not changed")
    write_text(book_path, record.to_csv(index=False, float_format="%.7g"))
    scenes = {cell.scene.name: cell.scene for cell in cells}
    methods = list(dict.fromkeys(cell.method.name for cell in cells))
    rows = tabulate(book, list(scenes), methods, args.seeds)
    missing = missing_runs(book, runs, list(scenes), methods, args.seeds)
    told = {(cell.scene.name, cell.method.name) for cell in known}
    for run in missing:
        if (run["capture"], run["method"]) not in told:
            run["why"] = "no run folder records a plan of effects"
    captures = [facts_of(scene) for scene in scenes.values()]
    data = {
        "environment": environment("cpu"),
        "iterations": args.iterations,
        "seeds": args.seeds,
        "jobs": args.jobs,
        "threads": threads_of(book),
        "effects": args.effects,
        "settings": [without_folders(setting) for setting in args.settings],
        "captures": captures,
        "rows": rows,
        "summary": summarise(rows, captures),
        "missing": missing,
    }
    stem = args.results
    write_json(beside(stem, ".json"), data)
    write_text(beside(stem, ".csv"), to_csv(rows))
    write_text(beside(stem, ".md"), to_markdown(data))
    print(to_markdown(data))
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
