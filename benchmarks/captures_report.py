"""Table and summary of the runs of captures.py."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ambiguous_wild.core import Scene
from ambiguous_wild.harness.cell import scene_identity
from ambiguous_wild.harness.regions import true_distractor
from ambiguous_wild.harness.store import Runs
from ambiguous_wild.io.images import read_gray
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.metrics import stats

OURS, PLAIN = "refinesplat", "3dgs"
EXACT = ("3dgs+truth", "refinesplat@mask=truth")  # trained on exact masks: the better one is the ceiling
BASELINES = ("robustsplat", "dronesplat")
GAP_DB = 1.0  # of exact masks over none: below it a share of the gap is noise
Row = dict[str, Any]
# key, label, digits
COLUMNS = (
    ("psnr", "PSNR dB", 2),
    ("psnr_supported", "supported dB", 2),
    ("ssim", "SSIM", 3),
    ("iou", "IoU", 3),
    ("precision", "precision", 3),
    ("recall", "recall", 3),
    ("masked_share", "masked %", 1),
    ("gaussians", "Gaussians", 0),
    ("model_mb", "MB", 2),
    ("train_s", "train s", 1),
    ("setup_s", "setup s", 1),
    ("ms_per_iteration", "ms/it", 1),
)
IMAGES = ("psnr", "psnr_supported", "ssim")  # means over the test photos
TIMES = ("train_s", "setup_s", "ms_per_iteration")

RUN_COLUMNS = ["capture", "method", "seed", "threads", *(key for key, _, _ in COLUMNS)]


def facts_of(scene: Scene) -> dict[str, Any]:
    """Name, hash, photos, and the mean share of distractor pixels in the train photos, if known."""
    masks = [true_distractor(scene, view) for view in scene.train]
    known = [float(mask.mean()) for mask in masks if mask is not None]
    share = float(np.mean(known)) if len(known) == len(masks) else None
    return {
        "name": scene.name,
        "sha256": scene_identity(scene),
        "train": len(scene.train),
        "test": len(scene.test),
        "distractor_share": share,
    }


def masked_share(run: Path) -> float:
    """Mean share of masked pixels over the train photos; 0 where the method wrote no masks."""
    shares = [float((read_gray(path) < 128).mean()) for path in sorted((run / "masks").rglob("*.png"))]
    return float(np.mean(shares)) if shares else 0.0


def run_numbers(run: pd.Series, images: pd.DataFrame) -> dict[str, float]:
    """The columns of one run; image metrics are means over the test photos."""
    mine = images[(images.scene == run.scene) & (images.method == run.method) & (images.seed == run.seed)]
    means = {m: stats.mean(mine[mine.metric == m]["value"].to_numpy()) for m in IMAGES}
    return means | {
        "iou": float(run.mask_iou),
        "precision": float(run.mask_precision),
        "recall": float(run.mask_recall),
        "masked_share": 100.0 * masked_share(Path(run.folder)),
        "gaussians": float(run.gaussians),
        "model_mb": float(run.model_mb),
        "train_s": float(run.train_s),
        "setup_s": float(run.setup_s),
        "ms_per_iteration": float(run.ms_per_iteration),
    }


def rows_of(runs: Runs | None, identities: Sequence[str]) -> pd.DataFrame:
    """A row per finished run of these configurations: capture, method, seed, threads and the columns."""
    if runs is None or not len(runs.runs):
        return pd.DataFrame(columns=RUN_COLUMNS)
    wanted = runs.runs[(runs.runs.status == "ok") & runs.runs.config_hash.isin(list(identities))]
    rows = [
        {
            "capture": run.scene,
            "method": run.method,
            "seed": int(run.seed),
            "threads": int(run.threads),
            **run_numbers(run, runs.images),
        }
        for _, run in wanted.iterrows()
    ]
    return pd.DataFrame(rows, columns=RUN_COLUMNS)


def tabulate(
    runs: pd.DataFrame, scenes: Sequence[str], methods: Sequence[str], seeds: Sequence[int]
) -> list[Row]:
    """A row a capture and method: mean and sample deviation over the seeds, None where one is missing.

    Times are those of the runs that have any: a run on a shared machine has none.
    """
    rows = []
    for scene in scenes:
        for method in methods:
            here = runs[(runs.capture == scene) & (runs.method == method) & runs.seed.isin(list(seeds))]
            row: Row = {"capture": scene, "method": method, "runs": len(here)}
            complete = len(here) == len(set(seeds))
            for key, _, _ in COLUMNS:
                values = [float(x) for x in here[key]] if complete else []
                if key in TIMES:
                    values = [x for x in values if not math.isnan(x)]
                row[key] = _plain(stats.mean(values))
                row[f"{key}_sd"] = _plain(stats.spread(values))
            rows.append(row)
    return rows


def missing_runs(
    finished: pd.DataFrame,
    runs: Runs | None,
    scenes: Sequence[str],
    methods: Sequence[str],
    seeds: Sequence[int],
) -> list[dict[str, Any]]:
    """Every run that is not finished: capture, method, seed, and whether it failed or is unfinished."""
    known = set(zip(finished.capture, finished.method, finished.seed, strict=True))
    tried = set() if runs is None else {(r.scene, r.method, r.seed) for r in runs.runs.itertuples()}
    return [
        {
            "capture": scene,
            "method": method,
            "seed": seed,
            "why": "failed" if run in tried else "not finished",
        }
        for scene in scenes
        for method in methods
        for seed in dict.fromkeys(seeds)
        if (run := (scene, method, seed)) not in known
    ]


def summarise(rows: Sequence[Row], captures: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Share of the gap to exact masks, ranking, masks against baselines, clean captures, model sizes."""
    of = {(row["capture"], row["method"]): row for row in rows}
    names = [capture["name"] for capture in captures]
    methods = list(dict.fromkeys(row["method"] for row in rows))

    def value(capture: str, method: str, key: str) -> float:
        found = of.get((capture, method), {}).get(key)
        return math.nan if found is None else float(found)

    gaps = {name: _gap({m: value(name, m, "psnr") for m in (OURS, PLAIN, *EXACT)}) for name in names}
    wide = {name: gap for name, gap in gaps.items() if gap["gap_db"] >= GAP_DB}
    # A capture that may belong to the mean makes it missing; one without distractors has no gap to close.
    unknown = [c["name"] for c in captures if c["distractor_share"] and math.isnan(gaps[c["name"]]["gap_db"])]
    means = {m: stats.mean([value(name, m, "psnr") for name in names]) for m in methods}
    ranked = {m: v for m, v in means.items() if not knows_truth(m) and not math.isnan(v)}
    iou = {name: {m: value(name, m, "iou") for m in (OURS, *BASELINES)} for name in names}
    ratios = {name: value(name, OURS, "gaussians") / value(name, BASELINES[0], "gaussians") for name in names}
    clean = [c["name"] for c in captures if c["distractor_share"] == 0.0]
    return _plain_tree(
        {
            "gap": wide,
            "gap_unknown": unknown,
            "gap_share_mean": math.nan if unknown else stats.mean([g["share"] for g in wide.values()]),
            "psnr_mean": means,
            "best": max(ranked, key=lambda m: ranked[m]) if ranked else None,
            "best_by_capture": {name: _best(name, methods, value) for name in names},
            "iou": iou,
            "iou_beats_both": [n for n in names if all(iou[n][OURS] > iou[n][b] for b in BASELINES)],
            "clean": {
                name: {
                    "difference_db": value(name, OURS, "psnr") - value(name, PLAIN, "psnr"),
                    "masked_share": value(name, OURS, "masked_share"),
                }
                for name in clean
            },
            "gaussians_ratio": ratios,
            "gaussians_ratio_mean": stats.mean(list(ratios.values())),
        }
    )


def _gap(psnr: dict[str, float]) -> dict[str, float]:
    known = [psnr[m] for m in EXACT if not math.isnan(psnr[m])]
    gap = max(known, default=math.nan) - psnr[PLAIN]
    return {
        "gap_db": gap,
        "gained_db": psnr[OURS] - psnr[PLAIN],
        "share": (psnr[OURS] - psnr[PLAIN]) / gap if gap else math.nan,
    }


def _best(capture: str, methods: Sequence[str], value: Any) -> str | None:
    found = {m: value(capture, m, "psnr") for m in methods if not knows_truth(m)}
    found = {m: v for m, v in found.items() if not math.isnan(v)}
    return max(found, key=lambda m: found[m]) if found else None


def to_markdown(data: dict[str, Any]) -> str:
    """A table per capture, then the summary."""
    seeds = ", ".join(map(str, data["seeds"]))
    settings = "".join(f"{setting}; " for setting in data["settings"])
    lines = [
        "# Captures with exact truth",
        "",
        f"{data['iterations']} iterations, seeds {seeds}, {data['jobs']} runs at a time, kernel threads a "
        f"run: {' or '.join(map(str, data['threads']))}; effects: {data['effects']}; {settings}"
        f"{data['environment']['cpu']}. Mean +- sample "
        "deviation over the seeds; a cell that is `-` is missing. IoU, precision and recall are of masked "
        "pixels, counted over all train photos. Setup is what a method prepares before its first step, less "
        "what an earlier run left in the cache. Times are of the runs that had the machine to themselves.",
    ]
    for capture in data["captures"]:
        share = capture["distractor_share"]
        about = "no truth" if share is None else f"{100 * share:.1f} % distractors"
        lines += ["", f"## {capture['name']} ({capture['train']} + {capture['test']} photos, {about})", ""]
        lines.append("| method | " + " | ".join(label for _, label, _ in COLUMNS) + " |")
        lines.append("| --- |" + " ---: |" * len(COLUMNS))
        for row in data["rows"]:
            if row["capture"] == capture["name"]:
                cells = [_cell(row, key, digits) for key, _, digits in COLUMNS]
                lines.append(f"| {row['method']} | " + " | ".join(cells) + " |")
    lines += ["", "## Summary", "", *_summary_lines(data["summary"])]
    if data["missing"]:
        named = [f"{m['method']} on {m['capture']}, seed {m['seed']} ({m['why']})" for m in data["missing"]]
        lines += ["", "## Missing runs", "", *(f"- {name}" for name in named)]
    return "\n".join(lines) + "\n"


def _summary_lines(summary: dict[str, Any]) -> list[str]:
    lines = [
        f"- {name}: {_number(gap['gained_db'], 2)} of {_number(gap['gap_db'], 2)} dB that exact masks bring "
        f"({_number(gap['share'], 2)})"
        for name, gap in summary["gap"].items()
    ]
    lines += [f"- {name}: what exact masks bring is unknown" for name in summary["gap_unknown"]]
    lines.append(
        f"- mean share of the gap, over captures where it is at least {GAP_DB:g} dB: "
        + _number(summary["gap_share_mean"], 2)
    )
    psnr = ", ".join(f"{m} {_number(v, 2)}" for m, v in summary["psnr_mean"].items())
    best = summary["best"] or "-"
    lines.append(f"- mean PSNR over all captures: {psnr}; best without the truth, of those complete: {best}")
    lines += [
        f"- best without the truth on {name}: {best or '-'}"
        for name, best in summary["best_by_capture"].items()
    ]
    beaten = ", ".join(summary["iou_beats_both"]) or "none"
    lines.append(f"- {OURS}'s IoU is above that of {' and '.join(BASELINES)} on: {beaten}")
    for name, clean in summary["clean"].items():
        lines.append(
            f"- {name} has no distractor: {OURS} differs from {PLAIN} by "
            f"{_number(clean['difference_db'], 2)} dB and masks {_number(clean['masked_share'], 1)} %"
        )
    lines.append(f"- Gaussians, {OURS} over {BASELINES[0]}: {_number(summary['gaussians_ratio_mean'], 2)}")
    return lines


def _cell(row: Row, key: str, digits: int) -> str:
    mean, sd = row[key], row[f"{key}_sd"]
    if mean is None:
        return "-"
    return f"{mean:,.{digits}f}" + ("" if sd is None else f" +- {sd:,.{digits}f}")


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _plain(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None


def _plain_tree(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _plain_tree(item) for key, item in tree.items()}
    if isinstance(tree, list):
        return [_plain_tree(item) for item in tree]
    return _plain(tree) if isinstance(tree, float) else tree
