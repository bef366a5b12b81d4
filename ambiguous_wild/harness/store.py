"""Read run folders into tidy tables. A missing value is NaN, and its reason has a row."""

from __future__ import annotations

import math
import os
import shlex
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash, flatten
from ambiguous_wild.core.errors import counted, similar_path, unknown
from ambiguous_wild.harness.command_lines import length_text
from ambiguous_wild.harness.labels import IN_FOLDER, shown_names
from ambiguous_wild.harness.measures import MASK_LABELS, MEASURES, Metric, measure, users_metrics
from ambiguous_wild.harness.result_file import (
    CONFIG,
    FAILED,
    MODEL,
    RESULT,
    Environment,
    Options,
    RunFacts,
    RunResult,
    config_identity,
    mask_scores,
    metrics_of,
    read_result,
)
from ambiguous_wild.harness.timing import timing_of
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.photos import PHOTO_SUFFIXES
from ambiguous_wild.io.ply import splat_count

if TYPE_CHECKING:
    import pandas as pd

# Columns of `Runs.runs` that hold words, beside scene and method.
TEXT_OF_RUNS = (
    "status", "error", "folder", "device", "version", "code_hash", "config_hash", "scene_hash", "source",
    "options_hash", "training", "unrecorded", "timing", "timing_reason", "timing_kernel", "hardware",
    "effects", "fit", "length", "features", "test_photos", "no_masks", "start", "metric_functions",
)  # fmt: skip
FolderResult = tuple[Path, RunResult]  # a run folder and its result
# config.yaml as read: absent keys and wrong types are possible, as the file may be old, damaged or edited
ReadConfig = dict[str, Any]
ROUNDING = 1e-9  # by which a share computed in floats may leave its range
# settings of training that are compared on their own, or decide nothing
BOOKKEEPING = ("seed", "iterations", "budget_s", "checkpoint_every_s", "probes", "on_nonfinite")


@dataclass(frozen=True)
class Incomplete:
    """A run folder without a usable result, and why."""

    folder: Path
    reason: str
    method: str
    scene: str


@dataclass(frozen=True)
class Runs:
    """All results below a folder, as tidy tables.

    images: one row per run, image and metric: scene, method, seed, image, metric, value (NaN = missing).
    runs: one row per run: scene, method, seed, status, error, folder, images, config_hash, scene_hash,
        version, code_hash, source (hash of the method's own file, or empty), options_hash, fit (what was done
        with test photos, see report/notes.py), effects, length, features and other settings of the training
        (words; features are empty if the method has none), test_photos (a warning about them, or empty),
        no_masks (why, or empty), device, the numbers of "cost", timing ("alone", "contended", "unknown"),
        timing_reason, timing_kernel, hardware, and mask_iou, mask_precision, mask_recall.
    missing: one row per run and missing metric: scene, method, seed, metric, reason.
    methods: the name under which a method is shown (the column "method" everywhere) -> the method, with its
        folder where it is of one of several; in the order of rows.
    """

    images: pd.DataFrame
    runs: pd.DataFrame
    missing: pd.DataFrame
    incomplete: tuple[Incomplete, ...] = ()
    methods: dict[str, str] = field(default_factory=dict)

    def method_of(self, shown: str) -> str:
        """Return the method that is shown under a name, without its folder."""
        return self.methods.get(shown, shown).partition(IN_FOLDER)[0]

    def rows(self) -> list[str]:
        """Return the names of the methods that have a finished or failed run, in the order of rows."""
        present, order = set(self.runs["method"]), list(self.methods)
        return [name for name in order if name in present] or sorted(present)

    def __repr__(self) -> str:
        counts = [counted(self.runs[key].nunique(), key) for key in ("method", "scene")]
        return f"Runs({counted(len(self.runs), 'run')} of {' on '.join(counts)})"


def read_runs(*folders: Path | str, labels: Sequence[str] = ()) -> Runs:
    """Read every result below folders of runs, at any depth.

    A run is a folder with config.yaml, metrics.json or failed.json in it. A run without a result (still
    running, or stopped) or with a damaged one is listed under `incomplete`, not dropped. If two folders have
    a method for the same scene and seed, it is called "METHOD in FOLDER".

    Args:
        folders: folders of runs, or run folders.
        labels: names and order of methods, see `labels.shown_names`.

    Raises:
        AwError: no such folder, no run in it, two results in it for the same method, scene and seed, or a
            wrong label.
    """
    known: set[Path] = set()  # runs of a folder given before, as one may be inside another
    read = [(Path(folder), *_read_folder(Path(folder), known)) for folder in folders]
    owners = Counter((r["scene"], r["method"], r["seed"]) for _, members, _ in read for _, r in members)
    shared = {method for (_, method, _), count in owners.items() if count > 1}
    results: list[FolderResult] = []
    incomplete: list[Incomplete] = []
    for root, members, begun in read:
        apart = {method: f"{method}{IN_FOLDER}{root}" for method in shared}
        for run, result in members:
            result["method"] = apart.get(result["method"], result["method"])
            results.append((run, result))
        incomplete += [replace(run, method=apart.get(run.method, run.method)) for run in begun]
    shown = shown_names(labels, [*(r["method"] for _, r in results), *(run.method for run in incomplete)])
    for _, result in results:
        result["method"] = shown[result["method"]]
    incomplete = [replace(run, method=shown[run.method]) for run in incomplete]
    starts: dict[str, str] = {}  # hash of a file -> its first name: the same file may have several
    for _, result in results:
        if hashed := start_hash(result["facts"]):
            result["facts"]["start"] = starts.setdefault(hashed, str(result["facts"]["start"]))
    return Runs(
        images=_frame(_image_rows(results), ["scene", "method", "seed", "image", "metric", "value"]),
        runs=_frame(
            (_run_row(run, result) for run, result in results),
            ["scene", "method", "seed", "status", "error", "folder", "images"],
        ),
        missing=_frame(_missing_rows(results), ["scene", "method", "seed", "metric", "reason"]),
        incomplete=tuple(incomplete),
        methods={name: method for method, name in shown.items()},
    )


def _read_folder(root: Path, known: set[Path]) -> tuple[list[FolderResult], list[Incomplete]]:
    """Read (results, runs without a result) below one folder but for `known` runs, and add them to these."""
    results: list[FolderResult] = []
    incomplete: list[Incomplete] = []
    for run in (run for run in find_runs([root]) if run.resolve() not in known):
        known.add(run.resolve())
        try:
            results.append((run, checked_result(run)))
        except AwError as error:
            incomplete.append(Incomplete(run, str(error), *_method_and_scene(run)))
    _refuse_duplicates(results)
    return results, incomplete


def checked_result(run: Path) -> RunResult:
    """Read the result of a run; raise AwError if there is none, or if it or config.yaml was changed."""
    path = next((run / name for name in (RESULT, FAILED) if (run / name).exists()), None)
    if path is None:
        raise AwError(f"no {RESULT}: still running, or stopped; run the same command again to finish it")
    result = read_result(path)
    config = read_config(run)
    for contradiction in (*contradictions(config, result), *cost_contradictions(run, result, config)):
        raise AwError(f"{run} was changed: {contradiction}")
    if "config_hash" in config and config["config_hash"] != config_identity(config):
        raise AwError(f"{run} was changed: {CONFIG} has another hash than it states")
    for what, value, why in impossible_values(result):
        raise AwError(f"{path} was changed: {what} is {value:g}, but such a number {why}")
    return result


def contradictions(config: ReadConfig, result: RunResult) -> Iterator[str]:
    """Yield in what a result differs from the settings of its run, of those that config.yaml holds."""
    train, scene = config_section(config, "train"), config_section(config, "scene")
    facts = result["facts"]
    pairs = {
        "method": (config.get("method"), result["method"]),
        "scene": (scene.get("name"), result["scene"]),
        "scene hash": (scene.get("sha256"), result["scene_hash"]),
        "seed": (train.get("seed"), result["seed"]),
        "options": (config.get("options"), result["options"]),
        "version": (config.get("version"), result["version"]),
        "protocol": (config.get("protocol"), facts.get("protocol", "full")),
        "hash of the settings": (config.get("config_hash"), result["config_hash"]),
        "start": (str(config_section(config, "start").get("sha256", ""))[:8] or None, start_hash(facts)),
    }
    if config.get("effects") and result["status"] == "ok":  # a failure states none
        pairs["effects"] = config["effects"], facts.get("effects")
    for what, (configured, recorded) in pairs.items():
        if configured is not None and configured != recorded:
            yield f"{what} is {str(configured)[:40]!a} in {CONFIG} and {str(recorded)[:40]!a} in {RESULT}"


def start_hash(facts: RunFacts) -> str:
    """Return the first digits of the hash of the file that a run started from; "" for the scene's points."""
    return str(facts.get("start", "")).rpartition("(")[2].rstrip(")")


def cost_contradictions(run: Path, result: RunResult, config: ReadConfig) -> Iterator[str]:
    """Yield in what costs differ from the model and the settings of the run; times are believed."""
    cost, train = result["cost"], config_section(config, "train")
    if result["status"] != "ok" or config.get("source"):  # a program of its own may write other files
        return
    if "gaussians" in cost and (run / MODEL).is_file() and cost["gaussians"] != splat_count(run / MODEL):
        yield f"{RESULT} has {cost['gaussians']} Gaussians, {MODEL} {splat_count(run / MODEL)}"
    steps, configured = cost.get("iterations"), train.get("iterations")
    if steps is not None and isinstance(configured, int) and not train.get("budget_s") and steps < configured:
        yield f"{RESULT} has {steps} iterations, {CONFIG} asks for {configured}"


def impossible_values(result: RunResult) -> Iterator[tuple[str, float, str]]:
    """Yield each number that no measurement can give: its name, its value, and the rule that it breaks."""
    for row in result["per_image"]:
        for metric, value in metrics_of(row).items():
            about = measure(metric)
            if value is None or not isinstance(about, Metric):
                continue
            if not about.low - ROUNDING <= value <= about.high + ROUNDING:
                yield f"{metric} of {row['name']}", value, f"lies between {about.low:g} and {about.high:g}"
    for name, score in mask_scores(result).items():
        if not 0.0 <= score <= 1.0 + ROUNDING:
            yield f"masks.{name}", score, "is a share, from 0 to 1"
    for name, amount in result["cost"].items():
        if not isinstance(amount, (int, float)):
            continue
        # integers in JSON have any size
        number = float(amount) if abs(amount) <= sys.float_info.max else math.inf
        if not (math.isfinite(number) and number >= 0):
            yield f"cost.{name}", number, "is finite and not below 0"


def _no_run(root: Path) -> AwError:
    """Return the error for a folder without runs; it says what the folder holds, where that is clear."""
    named = shlex.quote(str(root))
    within = [root, *(child for child in root.iterdir() if child.is_dir())]
    if (root / "scene.json").exists() or (root / "sparse").is_dir():
        return AwError(
            f"{root} is a scene, not runs: 'aw bench --method NAME --scene {named} -o runs' makes some"
        )
    if any(path.suffix.lower() in PHOTO_SUFFIXES for folder in within for path in folder.iterdir()):
        return AwError(
            f"{root} holds photos, not runs: 'aw build-scene {named} -o scene' makes a scene of them, and "
            "'aw bench --method NAME --scene scene -o runs' makes runs"
        )
    return AwError(f"no run in {root}: 'aw bench --method NAME --scene SCENE -o {named}' makes one")


def run_folders(root: Path) -> Iterator[Path]:
    """Yield the folders that hold a result or the settings of a run, in the order of their paths.

    The name of a folder does not matter: a scene may be called seed1.
    """
    for name, folders, files in os.walk(root):
        # names of caches and half-written folders begin with a dot
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        if not {RESULT, FAILED, CONFIG}.isdisjoint(files):
            folders.clear()
            yield Path(name)


def check_names(kind: str, names: Iterable[str], present: Sequence[str]) -> None:
    """Raise AwError for the first of the names of methods, scenes or metrics that no run has."""
    for name in names:
        if name not in present:
            raise unknown(kind, name, present)


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """Return the run folders below, each once, as one of the given folders may be inside another.

    Raises:
        AwError: no such folder, or no run in one.
    """
    runs: dict[Path, Path] = {}
    for root in folders:
        if not root.is_dir():
            raise AwError(
                f"no folder of runs {root}: give the folder that 'aw bench -o' wrote{similar_path(root)}"
            )
        below = {run.resolve(): run for run in run_folders(root)}
        if not below:
            raise _no_run(root)
        runs |= below
    return list(runs.values())


def read_config(run: Path) -> ReadConfig:
    """Return the run's config.yaml; empty where it is absent or damaged."""
    try:
        return plain_yaml.read_mapping(run / CONFIG)
    except AwError:
        return {}


def config_section(config: ReadConfig, name: str) -> ReadConfig:
    """Return a part of config.yaml; empty where it is absent or no mapping."""
    part = config.get(name)
    return part if isinstance(part, dict) else {}


def _method_and_scene(run: Path) -> tuple[str, str]:
    """Return method and scene of a run without a result: from its settings, else from its path."""
    config, method_folder = read_config(run), run.absolute().parent
    name = config_section(config, "scene").get("name")
    return str(config.get("method") or method_folder.name), str(name or method_folder.parent.name)


def _refuse_duplicates(results: list[FolderResult]) -> None:
    seen: dict[tuple[str, str, int], tuple[Path, str]] = {}
    for run, result in results:
        key = (result["scene"], result["method"], result["seed"])
        if key in seen:
            other, settings = seen[key]
            # two runs with the same settings are copies, which `aw cost` refuses too
            both = " ('aw cost' takes both)" if settings != result["config_hash"] else ""
            raise AwError(
                f"two results for method {key[1]!r} on scene {key[0]!r} with seed {key[2]}: {other} and "
                f"{run}; give one of their folders, or move one of them elsewhere{both}"
            )
        seen[key] = run, result["config_hash"]


TableRow = dict[str, object]  # by column


def _key(result: RunResult) -> TableRow:
    return {"scene": result["scene"], "method": result["method"], "seed": result["seed"]}


def _image_rows(results: list[FolderResult]) -> Iterator[TableRow]:
    for _, result in results:
        # a metric that one image or the whole run lacks has a row with NaN; one never measured has no row
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


def _run_row(run: Path, result: RunResult) -> TableRow:
    masks = mask_scores(result)
    cost = {k: v for k, v in result["cost"].items() if not isinstance(v, (dict, list))}
    timing, config = timing_of(result["cost"]), read_config(run)
    return (
        _key(result)
        | {
            "status": result["status"],
            "error": result["error"],
            "config_hash": result["config_hash"],
            "scene_hash": result["scene_hash"],
            "version": result["version"],
            "code_hash": str(result.get("code_hash", "")),
            "source": str(config.get("source", "")),
            "options_hash": config_hash(result["options"]),
            "training": _training(config),
            "unrecorded": "" if config else result["config_hash"],
            "fit": _fit(result["facts"]),
            "effects": effects_of(result["facts"]),
            "length": str(result["facts"].get("length") or _length(config)),
            "test_photos": str(result["facts"].get("test_photos", "")),
            "no_masks": str(result["facts"].get("no_masks", "")),
            "features": _features(result["options"]),
            "start": str(result["facts"].get("start", "the scene's points")),
        }
        | {"folder": str(run), "images": len(result["per_image"])}
        | cost
        | {"timing": timing.verdict, "timing_reason": timing.reason, "timing_kernel": timing.kernel}
        | {"hardware": _hardware(result)}
        | {"metric_functions": metric_functions(result)}
        | {f"mask_{k}": masks.get(k, math.nan) for k in MASK_LABELS}
    )


def metric_functions(result: RunResult) -> dict[str, str]:
    """Return the identity of each metric that is not of this package: of its file, and what it claims."""
    records = result.get("metrics", {})
    measured = {key for row in result["per_image"] for key in metrics_of(row)} - MEASURES.keys()
    unknown = dict.fromkeys(measured, f"unknown {result['config_hash']}")
    return unknown | {key: f"{r['source']} {r['better']}" for key, r in records.items()}


def effects_of(facts: RunFacts) -> str:
    """Return the effects that a run was trained with, as text."""
    names = facts.get("effects")
    if facts.get("no_effects"):
        return f"none: {facts['no_effects']}"
    return ", ".join(map(str, names)) if isinstance(names, list) and names else "none"


def _length(config: ReadConfig) -> str:
    """Return `length_text` of config.yaml, for results of earlier versions; empty if it is not there."""
    settings = config_section(config, "train")
    return length_text(settings.get("iterations"), settings.get("budget_s"))


def _training(config: ReadConfig) -> str:
    """Return the other settings of training that config.yaml holds, as text."""
    own = (*BOOKKEEPING, "torch_threads")
    settings = sorted(
        (key, value) for key, value in config_section(config, "train").items() if key not in own
    )
    if not settings:
        return "not recorded"
    return ", ".join(f"{key} {'auto' if value is None else value}" for key, value in settings)


def _features(options: Options) -> str:
    """Return the values of all options called `features`, whichever part of the method has them."""
    features = {str(v) for key, v in flatten(options).items() if key.rpartition(".")[2] == "features"}
    return ", ".join(sorted(features))


def _hardware(result: RunResult) -> str:
    """Return the GPU, or the processor and the threads; empty where they are not known."""
    machine: Environment = result.get("environment") or {}
    if machine.get("gpu"):
        return machine["gpu"]
    threads = result["cost"].get("threads")
    return f"{machine['cpu']}, {threads} threads" if machine.get("cpu") and threads else ""


def _fit(facts: RunFacts) -> str:
    """Return what the method did with test photos, a key of `notes.FITTED`."""
    if facts.get("protocol", "full") != "half":
        return "full"
    fitted = facts.get("fitted")
    if not isinstance(fitted, dict):
        return "unknown"
    return "fitted" if fitted.get("steps") else "read" if fitted.get("read_by") else "plain"


def _missing_rows(results: list[FolderResult]) -> Iterator[TableRow]:
    for _, result in results:
        for metric, reason in result["missing"].items():
            yield _key(result) | {"metric": metric, "reason": reason}


def _frame(rows: Iterator[TableRow], columns: list[str]) -> pd.DataFrame:
    import pandas as pd

    listed = list(rows)
    return pd.DataFrame(listed) if listed else pd.DataFrame(columns=columns)


def computable_metrics(results: Iterable[RunResult]) -> list[str]:
    """Return the metrics that these results lack and that can be measured now, own metrics included."""
    from ambiguous_wild.metrics import lpips  # imports torch

    now = {name for name, reason in lpips.available().items() if reason is None}
    listed = list(results)
    lacking = {name for r in listed for name, why in r["missing"].items() if lpips.TOO_SMALL not in why}
    return sorted(lacking & now | {name for r in listed for name in users_metrics() if lacks_metric(r, name)})


def lacks_metric(result: RunResult, metric: str) -> bool:
    """Return whether the result lacks the metric, or has it from another version of the metric's file."""
    record, mine = result.get("metrics", {}).get(metric), users_metrics().get(metric)
    if mine is not None and record is not None and record["source"] != mine.source:
        return True
    return all(metrics_of(row).get(metric) is None for row in result["per_image"])
