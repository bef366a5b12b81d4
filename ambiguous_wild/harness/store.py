"""Read run folders into tidy tables; a missing value is NaN, and its reason has a row."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import flatten
from ambiguous_wild.core.errors import counted
from ambiguous_wild.harness.measures import MASK_LABELS, Metric, measure, own
from ambiguous_wild.harness.result_file import FAILED, RESULT, RunResult, metrics_of, read_result
from ambiguous_wild.harness.timing import timing_of
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.photos import PHOTO_SUFFIXES

CONFIG = "config.yaml"
# Columns of `Runs.runs` that hold words, beside scene and method.
TEXT_OF_RUNS = (
    "status", "error", "folder", "device", "version", "config_hash", "scene_hash", "timing", "timing_reason",
    "timing_kernel", "hardware", "effects", "length", "features",
    "test_photos", "start",
)  # fmt: skip
FoundResult = tuple[Path, RunResult]  # of this run folder


@dataclass(frozen=True)
class Incomplete:
    """A run folder without a usable result, and why."""

    folder: Path
    reason: str
    method: str
    scene: str


@dataclass(frozen=True)
class Runs:
    """Every result below a folder, tidy.

    images: one row per run, image and metric: scene, method, seed, image, metric, value (NaN = missing).
    runs: one row per run: scene, method, seed, status, error, folder, images, config_hash, scene_hash,
        version, fit (what was done with test photos, see tables/notes.py), effects, length and features that
        it was trained with (words; empty features: the method has none), test_photos (what is wrong with
        them; empty: nothing that is known), device, the numbers of "cost",
        timing ("alone", "contended", "unknown"), timing_reason, timing_kernel, hardware, and mask_iou,
        mask_precision, mask_recall.
    missing: one row per run and missing metric: scene, method, seed, metric, reason.
    """

    images: pd.DataFrame
    runs: pd.DataFrame
    missing: pd.DataFrame
    incomplete: tuple[Incomplete, ...] = ()

    def __repr__(self) -> str:
        counts = [counted(self.runs[key].nunique(), key) for key in ("method", "scene")]
        return f"Runs({counted(len(self.runs), 'run')} of {' on '.join(counts)})"


def read_runs(*folders: Path | str) -> Runs:
    """Every result below folders of runs, at any depth.

    A run is a folder with config.yaml, metrics.json or failed.json in it. One without a result (still
    running, or stopped) and a damaged result are listed under `incomplete`, not dropped. A method that two
    folders have for one scene and seed is called "METHOD in FOLDER".

    Raises:
        AwError: no such folder, no run in it, or two results in it for the same method, scene and seed.
    """
    incomplete: list[Incomplete] = []
    roots = list({Path(folder).resolve(): Path(folder) for folder in folders}.values())
    of_root = [_read_folder(root, incomplete) for root in roots]
    owners = Counter((r["scene"], r["method"], r["seed"]) for found in of_root for _, r in found)
    shared = {method for (_, method, _), count in owners.items() if count > 1}
    results: list[FoundResult] = []
    for root, found in zip(roots, of_root):
        for run, result in found:
            if result["method"] in shared:
                result["method"] = f"{result['method']} in {root}"
            results.append((run, result))
    return Runs(
        images=_frame(_image_rows(results), ["scene", "method", "seed", "image", "metric", "value"]),
        runs=_frame(
            (_run_row(run, result) for run, result in results),
            ["scene", "method", "seed", "status", "error", "folder", "images"],
        ),
        missing=_frame(_missing_rows(results), ["scene", "method", "seed", "metric", "reason"]),
        incomplete=tuple(incomplete),
    )


def _read_folder(root: Path, incomplete: list[Incomplete]) -> list[FoundResult]:
    """The results below one folder; runs without one are added to `incomplete`."""
    if not root.is_dir():
        raise AwError(f"no folder of runs {root}: give the folder that 'aw bench -o' wrote")
    results: list[FoundResult] = []
    before = len(incomplete)
    for run in run_folders(root):
        paths = [run / name for name in (RESULT, FAILED) if (run / name).exists()]
        try:
            if not paths:
                raise AwError(
                    f"no {RESULT}: still running, or stopped; run the same command again to finish it"
                )
            result = read_result(paths[0])
            for what, value, why in impossible_values(result):
                raise AwError(f"{paths[0]} was changed: {what} is {value:g}, and such a number {why}")
            results.append((run, result))
        except AwError as error:
            incomplete.append(Incomplete(run, str(error), *_method_and_scene(run)))
    if not results and len(incomplete) == before:
        raise _no_run(root)
    _refuse_duplicates(results)
    return results


ROUNDING = 1e-9  # by which a share computed in floats may leave its range


def impossible_values(result: RunResult) -> Iterator[tuple[str, float, str]]:
    """Numbers that no measurement can give: which, the value, and what such a number is instead."""
    for row in result["per_image"]:
        for metric, value in metrics_of(row).items():
            about = measure(metric)
            if value is None or not isinstance(about, Metric):
                continue
            if not about.low - ROUNDING <= value <= about.high + ROUNDING:
                yield f"{metric} of {row['name']}", value, f"lies between {about.low:g} and {about.high:g}"
    masks: Mapping[str, Any] = result["masks"] or {}
    for name in MASK_LABELS:
        if masks.get(name) is not None and not 0.0 <= masks[name] <= 1.0 + ROUNDING:
            yield f"masks.{name}", masks[name], "is a share, from 0 to 1"
    for name, amount in result["cost"].items():
        if isinstance(amount, (int, float)) and not (math.isfinite(amount) and amount >= 0):
            yield f"cost.{name}", amount, "is finite and not below 0"


def _no_run(root: Path) -> AwError:
    """The error for a folder without runs; it says what the folder is, where that can be seen."""
    within = [root, *(child for child in root.iterdir() if child.is_dir())]
    if (root / "scene.json").exists():
        return AwError(
            f"{root} is a scene, not runs: 'aw bench --method NAME --scene {root} -o runs' makes some"
        )
    if any(path.suffix.lower() in PHOTO_SUFFIXES for folder in within for path in folder.iterdir()):
        return AwError(
            f"{root} holds photos, not runs: 'aw build-scene {root} -o scene' makes a scene of them, "
            "'aw bench --method NAME --scene scene -o runs' the runs"
        )
    return AwError(f"no run in {root}: 'aw bench --method NAME --scene SCENE -o {root}' makes one")


def run_folders(root: Path) -> Iterator[Path]:
    """Folders that hold a result or the settings of a run, in the order of their paths.

    A name alone makes no run: a scene may be called seed1.
    """
    for name, folders, files in os.walk(root):
        # Caches and half-written folders begin with a dot.
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        if not {RESULT, FAILED, CONFIG}.isdisjoint(files):
            folders.clear()
            yield Path(name)


def read_config(run: Path) -> dict[str, Any]:
    """The run's config.yaml; empty where it is absent or damaged."""
    try:
        return plain_yaml.read_mapping(run / CONFIG)
    except AwError:
        return {}


def known_iterations(root: Path) -> int | None:
    """The length of the first run below a folder; None where there is none, or it is not known."""
    for run in run_folders(root):
        train = read_config(run).get("train")
        known = train.get("iterations") if isinstance(train, dict) else None
        if isinstance(known, int):
            return known
    return None


def _method_and_scene(run: Path) -> tuple[str, str]:
    """Whose run it is, for one without a result: by its settings, else by its path."""
    config, method_folder = read_config(run), run.absolute().parent
    scene = config.get("scene")
    name = scene.get("name") if isinstance(scene, dict) else None
    return str(config.get("method") or method_folder.name), str(name or method_folder.parent.name)


def _refuse_duplicates(results: list[FoundResult]) -> None:
    seen: dict[tuple[str, str, int], tuple[Path, str]] = {}
    for run, result in results:
        key = (result["scene"], result["method"], result["seed"])
        if key in seen:
            other, settings = seen[key]
            # of the same settings they are copies, which `aw cost` refuses too
            both = " ('aw cost' takes both)" if settings != result["config_hash"] else ""
            raise AwError(
                f"two results for method {key[1]!r} on scene {key[0]!r} with seed {key[2]}: {other} and "
                f"{run}; give one of their folders, or move one of them elsewhere{both}"
            )
        seen[key] = run, result["config_hash"]


def _key(result: RunResult) -> dict[str, Any]:
    return {"scene": result["scene"], "method": result["method"], "seed": result["seed"]}


def _image_rows(results: list[FoundResult]) -> Iterator[dict[str, Any]]:
    for _, result in results:
        # A metric that one image lacks, or the whole run, has a row of its own: NaN is not "not asked".
        measured = [(row["name"], metrics_of(row)) for row in result["per_image"]]
        metrics = dict.fromkeys(metric for _, values in measured for metric in values)
        metrics |= dict.fromkeys(result["missing"])
        for name, values in measured:
            for metric in metrics:
                if metric not in values and measure(metric).partial:
                    continue
                value = values.get(metric)
                yield _key(result) | {
                    "image": name,
                    "metric": metric,
                    "value": math.nan if value is None else float(value),
                }


def _run_row(run: Path, result: RunResult) -> dict[str, Any]:
    masks: Mapping[str, Any] = result["masks"] or {}
    cost = {k: v for k, v in result["cost"].items() if not isinstance(v, (dict, list))}
    timing = timing_of(result["cost"])
    return (
        _key(result)
        | {
            "status": result["status"],
            "error": result["error"],
            "config_hash": result["config_hash"],
            "scene_hash": result["scene_hash"],
            "version": result["version"],
            "fit": _fit(result["facts"]),
            "effects": effects_of(result["facts"]),
            "length": str(result["facts"].get("length") or _length(read_config(run))),
            "test_photos": str(result["facts"].get("test_photos", "")),
            "features": _features(result["options"]),
            "start": str(result["facts"].get("start", "the scene's points")),
        }
        | {"folder": str(run), "images": len(result["per_image"])}
        | cost
        | {"timing": timing.verdict, "timing_reason": timing.reason, "timing_kernel": timing.kernel}
        | {"hardware": _hardware(result)}
        | {f"mask_{k}": math.nan if masks.get(k) is None else masks[k] for k in MASK_LABELS}
    )


def effects_of(facts: Mapping[str, Any]) -> str:
    """The effects that a run was trained with, in words."""
    names = facts.get("effects")
    if facts.get("no_effects"):
        return f"none: {facts['no_effects']}"
    return ", ".join(map(str, names)) if isinstance(names, list) and names else "none"


def _length(config: Mapping[str, Any]) -> str:
    """`asked_length` of a run whose result does not say it yet; empty where config.yaml does not either."""
    train = config.get("train")
    known = train if isinstance(train, dict) else {}
    if known.get("budget_s") is not None:
        return f"{known['budget_s']:g} s"
    return f"{known['iterations']} iterations" if "iterations" in known else ""


def _features(options: Mapping[str, Any]) -> str:
    """Options that are called `features`, whichever part of the method has them."""
    known = {str(v) for key, v in flatten(options).items() if key.rpartition(".")[2] == "features"}
    return ", ".join(sorted(known))


def _hardware(result: RunResult) -> str:
    """What times depend on: the GPU, or the processor and the threads; empty where it is not known."""
    known: Mapping[str, Any] = result.get("environment") or {}
    if known.get("gpu"):
        return str(known["gpu"])
    threads = result["cost"].get("threads")
    return f"{known['cpu']}, {threads} threads" if known.get("cpu") and threads else ""


def _fit(facts: Mapping[str, Any]) -> str:
    """What the method did with test photos, a key of `notes.FITTED`."""
    if facts.get("protocol", "full") != "half":
        return "full"
    fitted = facts.get("fitted")
    if not isinstance(fitted, dict):
        return "unknown"
    return "fitted" if fitted.get("steps") else "read" if fitted.get("read_by") else "plain"


def _missing_rows(results: list[FoundResult]) -> Iterator[dict[str, Any]]:
    for _, result in results:
        for metric, reason in result["missing"].items():
            yield _key(result) | {"metric": metric, "reason": reason}


def _frame(rows: Iterator[dict[str, Any]], columns: list[str]) -> pd.DataFrame:
    listed = list(rows)
    return pd.DataFrame(listed) if listed else pd.DataFrame(columns=columns)


def could_be_measured(results: Iterable[RunResult]) -> list[str]:
    """Metrics that these results lack and that can be measured now, as weights have come; and own ones."""
    from ambiguous_wild.metrics import lpips  # imports torch

    now = {name for name, reason in lpips.available().items() if reason is None}
    listed = list(results)
    lacking = {name for r in listed for name, why in r["missing"].items() if lpips.TOO_SMALL not in why}
    return sorted(lacking & now | {name for r in listed for name in own() if lacks(r, name)})


def lacks(result: RunResult, metric: str) -> bool:
    """Whether it is not measured there, or by another state of its file."""
    known, mine = result.get("metrics", {}).get(metric), own().get(metric)
    if mine is not None and known is not None and known["source"] != mine.source:
        return True
    return all(metrics_of(row).get(metric) is None for row in result["per_image"])
