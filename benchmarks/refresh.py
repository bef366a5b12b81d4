"""Refresh intervals of RefineSplat's masks and entropy terms: quality against time.

    python benchmarks/refresh.py --scene SCENE [--scene ...] [--seed 0 --seed 1] [--iterations 3000]
        [--method refinesplat-paper] [--set KEY=VALUE] [--interval KEY=1,2,4,8] [--gaussians 20000]
        [-o RUNS] [--json PATH]

Each interval is varied alone, with the others at their defaults. Runs are ordinary cells under -o: finished
ones are kept, stopped ones resume. Writes benchmarks/results/refresh.json and refresh.png: PSNR and mask IoU
against ms per iteration, with the knee marked. Run it alone on the machine.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rasterizer import machine

from ambiguous_wild.cli.devices import prepare_cpu
from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import with_options
from ambiguous_wild.harness.ablation.plan import Outcome, read_outcomes
from ambiguous_wild.harness.running.cell import Cell
from ambiguous_wild.harness.running.grid import plan_cells, run_cells
from ambiguous_wild.io.atomic import atomic_path, write_json
from ambiguous_wild.io.palette import ADDED, MERGED, plot_colour
from ambiguous_wild.metrics import stats
from ambiguous_wild.splat.pace import TrainConfig

RESULTS = Path(__file__).parent / "results" / "refresh.json"
INTERVALS = {"mask_every": (1, 2, 4, 8, 16), "entropy_every": (1, 2, 4, 8, 16)}
KNEE_DB = 0.1  # a step to a cheaper interval that costs less than this is worth it


@dataclasses.dataclass(frozen=True)
class Point:
    """One value of one interval and its cells."""

    key: str
    value: int
    cells: tuple[Cell, ...]


def plan(args: argparse.Namespace) -> list[Point]:
    """Every value of every interval on every scene with every seed; each setting's runs have a name."""
    train = TrainConfig(iterations=args.iterations, probes=0, max_gaussians=args.gaussians)
    settings = [f"{args.method}.{text}" for text in args.settings]
    default = plan_cells([args.method], args.scenes, args.seeds or [0], train, settings=settings)
    points = []
    for key, values in list(args.intervals.items()):
        if key == "entropy_every" and not (default[0].options.lambda_id or default[0].options.lambda_cr):
            print("entropy_every: not swept, both entropy losses are off (--set lambda_cr=... switches on)")
            del args.intervals[key]
            continue
        for value in values:
            options = with_options(default[0].options, {key: str(value)})
            same = options == default[0].options
            method = default[0].method
            entry = method if same else dataclasses.replace(method, name=f"{args.method}@{key}-{value}")
            cells = tuple(dataclasses.replace(c, method=entry, options=options) for c in default)
            points.append(Point(key, value, cells))
    return points


def row(point: Point, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Mean and spread over scenes and seeds, and every run; a failed run makes the means missing."""

    def summary(metric: str) -> dict[str, float | None]:
        values = [np.nan if (v := o.value(metric)) is None else v for o in outcomes]
        both = {"mean": stats.mean(values), "spread": stats.spread(values)}
        return {name: None if np.isnan(v) else round(v, 5) for name, v in both.items()}

    metrics = ("psnr", "iou", "ms_per_iteration", "setup_s", "total_s")
    runs = [
        {"scene": o.scene, "seed": o.seed, "error": o.error or None, **{m: o.value(m) for m in metrics}}
        for o in outcomes
    ]
    return {"interval": point.key, "value": point.value, **{m: summary(m) for m in metrics}, "runs": runs}


def knee(rows: Sequence[dict[str, Any]]) -> int | None:
    """The fastest value whose PSNR is within `KNEE_DB` of the best; None without measurements."""
    known = [r for r in rows if r["psnr"]["mean"] is not None]
    if not known:
        return None
    best = max(r["psnr"]["mean"] for r in known)
    good = [r for r in known if r["psnr"]["mean"] >= best - KNEE_DB]
    return int(min(good, key=lambda r: r["ms_per_iteration"]["mean"])["value"])


def draw(data: dict[str, Any], path: Path) -> None:
    """A column per interval: PSNR above, IoU below, points labelled by value, the knee circled."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    keys = list(data["knees"])
    figure = Figure(figsize=(5.2 * len(keys), 6.4), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(keys), squeeze=False)
    for column, key in enumerate(keys):
        rows = [r for r in data["rows"] if r["interval"] == key and r["ms_per_iteration"]["mean"] is not None]
        for panel, metric, label in ((axes[0, column], "psnr", "PSNR (dB)"), (axes[1, column], "iou", "IoU")):
            known = [r for r in rows if r[metric]["mean"] is not None]
            ms = [r["ms_per_iteration"]["mean"] for r in known]
            values = [r[metric]["mean"] for r in known]
            spreads = [r[metric]["spread"] or 0.0 for r in known]
            panel.errorbar(ms, values, yerr=spreads, fmt="o-", color=plot_colour(ADDED), lw=1, capsize=2)
            for r, x, y in zip(known, ms, values, strict=True):
                panel.annotate(str(r["value"]), (x, y), xytext=(5, 5), textcoords="offset points", fontsize=8)
                if r["value"] == data["knees"][key]:
                    ring = plot_colour(MERGED)
                    panel.plot(x, y, "o", ms=15, mfc="none", mec=ring, label=f"knee: {r['value']}")
                    panel.legend(fontsize=8)
            panel.set_xlabel("ms per iteration")
            panel.set_ylabel(label)
            panel.grid(alpha=0.25)
        axes[0, column].set_title(f"{data['method']}.{key}", fontsize=10)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, metadata={"Software": None})


def _interval(text: str) -> tuple[str, tuple[int, ...]]:
    key, _, values = text.partition("=")
    try:
        return key, tuple(int(v) for v in values.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: write KEY=1,2,4") from None


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", dest="scenes", action="append", type=Path, required=True)
    parser.add_argument("--seed", dest="seeds", action="append", type=int, help="default: 0")
    parser.add_argument("--method", default="refinesplat")
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--gaussians", type=int, help="most Gaussians; default: as in training")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--interval", dest="intervals", action="append", type=_interval, metavar="KEY=1,2,4",
        help="default: " + " ".join(f"{k}={','.join(map(str, v))}" for k, v in INTERVALS.items()),
    )  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, default=Path("runs-refresh"))
    parser.add_argument("--json", type=Path, default=RESULTS, help="where the figures go")
    args = parser.parse_args(words)
    args.intervals = dict(args.intervals or INTERVALS)
    return args


def main() -> None:
    args = arguments()
    try:
        points = plan(args)
    except AwError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    prepare_cpu(None)
    unique = {(c.method.name, c.scene.name, c.train.seed): c for p in points for c in p.cells}
    reports = run_cells(
        list(unique.values()),
        args.output,
        pictures=False,
        on_start=lambda cell, folder: print(
            f"{cell.method.name} on {cell.scene.name} -> {folder}", flush=True
        ),
    )
    rows = [row(point, read_outcomes(point.cells, args.output)) for point in points]
    knees = {key: knee([r for r in rows if r["interval"] == key]) for key in args.intervals}
    data = {
        "machine": machine(),
        "method": args.method,
        "scenes": [str(p.name) for p in args.scenes],
        "seeds": args.seeds or [0],
        "iterations": args.iterations,
        "settings": args.settings,
        "knee_db": KNEE_DB,
        "knees": knees,
        "rows": rows,
    }
    write_json(args.json, data)
    draw(data, args.json.with_suffix(".png"))
    for r in rows:
        psnr, ms, iou = (r[m]["mean"] for m in ("psnr", "ms_per_iteration", "iou"))
        mark = "  <- knee" if knees[r["interval"]] == r["value"] else ""
        print(f"{r['interval']:16s} {r['value']:4d}  PSNR {psnr}  IoU {iou}  {ms} ms/it{mark}")
    failed = [r for r in reports if r.outcome == "failed"]
    print(f"wrote {args.json}" + (f"; {len(failed)} runs failed: {failed[0].error}" if failed else ""))


if __name__ == "__main__":
    main()
