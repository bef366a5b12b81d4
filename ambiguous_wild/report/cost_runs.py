"""Read runs for the cost report: settings, result, and PSNR over time.

Unlike a comparison, this takes many runs of one method on one scene with one seed. They differ in length,
effects or options, and the report measures these differences.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash, flatten
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.harness.labels import shown_names
from ambiguous_wild.harness.result_file import Cost, Options, RunResult, mean_of
from ambiguous_wild.harness.store import (
    BOOKKEEPING,
    ReadConfig,
    check_names,
    checked_result,
    config_section,
    find_runs,
    metric_functions,
    read_config,
)
from ambiguous_wild.harness.timing import Timing, in_reference_seconds, timing_of
from ambiguous_wild.io.files import own_json
from ambiguous_wild.metrics import stats

SETTINGS = ("resolution", "max_gaussians")  # settings of training that are compared like options
NUMBERS = ("ms_per_iteration", "gaussians", "model_mb", "fps")


@dataclass(frozen=True, order=True)
class Length:
    """The length of training that was asked for."""

    budget_s: float  # 0.0: the length is a number of iterations
    iterations: int  # 0: the length is a budget

    @property
    def text(self) -> str:
        if not self.budget_s:
            return f"{self.iterations} iterations"
        minutes = self.budget_s / 60.0
        return (
            f"{minutes:g} min" if self.budget_s % 30.0 == 0.0 and minutes >= 1.0 else f"{self.budget_s:g} s"
        )


@dataclass(frozen=True)
class CostRun:
    """One run, finished or failed."""

    folder: Path
    method: str
    scene: str
    seed: int
    asked: str  # effects as they were asked for: "auto", "all", or their names
    effects: frozenset[str]  # effects that were on
    options: tuple[tuple[str, Any], ...]  # (dotted name, value) of the method's options
    length: Length
    rest: str  # hash of everything else that decides the result: scene, device, code, protocol
    psnr: float  # dB, mean over the test images; NaN: failed or not measured
    images: dict[str, float]  # PSNR by test image
    train_s: float
    setup_s: float  # features and masks before the first step; short if they were cached
    numbers: dict[str, float]  # see NUMBERS, and the user's metrics, as measured; NaN = not measured
    points: tuple[tuple[float, float], ...]  # (seconds of training, PSNR in dB), in order of time
    timing: Timing
    samples: tuple[tuple[float, float], ...] = ()  # (wall seconds of training, seconds of the calibration)
    kernel_reference_s: float = math.nan
    metric_functions: dict[str, str] = field(default_factory=dict)  # of users' metrics, by key
    scene_hash: str = ""
    start: str = ""  # hash of the file that training started from; "" for the scene's points
    factor: str = ""  # downsampling of the photos
    protocol: str = "full"
    reproduce: str = ""  # the command that makes it again; empty in results of earlier versions
    error: str = ""
    unprobed: str = ""  # why PSNR over time is unknown; empty: it was probed, or the run failed
    added_s: float = 0.0  # added to times that are compared: the set-up, if it was asked for
    doubt: str = ""  # whether test photos are truth
    apart: str = ""  # why no run on its scene is ranked: they measured other pixels
    shown: str = ""  # name of the method in tables and plots
    place: int = 0  # of the method among those that are shown
    speed: float = 1.0  # reference seconds in a second of the training; 1: times are wall seconds

    @property
    def minutes(self) -> float:
        """The training time that is compared."""
        return (self.train_s + self.added_s) / 60.0

    @property
    def base(self) -> str:
        """The method's name without the variant of an ablation, method@group-variant."""
        host, at, part = self.method.partition("@")
        return host if at and "=" not in part else self.method

    @property
    def part(self) -> str:
        """The variant of an ablation; empty without one."""
        return self.method.partition("@")[2]


@dataclass(frozen=True)
class CostRuns:
    """All runs below some folders. Times are reference seconds if every finished run was calibrated."""

    runs: tuple[CostRun, ...]
    notes: tuple[str, ...]  # runs that could not be read, failed or are not finished
    reference: bool = False  # times are reference seconds; False: wall seconds


def read_cost_runs(
    folders: Sequence[Path], *, scenes: Sequence[str] = (), labels: Sequence[str] = ()
) -> CostRuns:
    """Read every run below the folders, each once.

    Args:
        folders: outputs of `aw bench` or `aw ablate`, or folders of them.
        scenes: names of the scenes to read; empty = all.
        labels: names and order of methods, see `labels.shown_names`.

    Raises:
        AwError: no such folder, no finished run, an unknown scene, a wrong label, or two copies of a run.
    """
    runs: list[CostRun] = []
    notes: list[str] = []
    for folder in find_runs(folders):
        try:
            runs.append(_run(folder, checked_result(folder)))
        except AwError as error:
            notes.append(f"left out: {folder}: {error}")
    check_names("scene", scenes, sorted({run.scene for run in runs}))
    runs = [run for run in runs if not scenes or run.scene in scenes]
    if all(math.isnan(run.psnr) for run in runs):
        raise AwError(
            "no finished run with a PSNR below "
            + ", ".join(str(f) for f in folders)
            + ": 'aw bench --method NAME --scene SCENE -o RUNS' makes one"
        )
    _refuse_twice(runs)
    shown = shown_names(labels, [run.method for run in runs])
    places = {method: place for place, method in enumerate(shown)}
    runs = [replace(run, shown=shown[run.method], place=places[run.method]) for run in runs]
    notes += [f"failed: {r.method} on {r.scene}, seed {r.seed}: {r.error}" for r in runs if r.error]
    runs = _without_mixed_metrics(runs, notes)
    for scene in sorted({run.scene for run in runs}):
        of = [run for run in runs if run.scene == scene and not run.error]
        if differ := _differ(of):
            apart = f"runs on {scene} differ in {' and '.join(differ)}"
            notes.append(f"not comparable: {apart}")
            runs = [replace(run, apart=apart) if run.scene == scene else run for run in runs]
        notes += _unequal_methods(scene, of)
        doubts = dict.fromkeys(run.doubt for run in of if run.doubt)
        notes += [f"{doubt} ({scene}): a model that draws distractors gains PSNR by it" for doubt in doubts]
    runs = _with_effects_of_plans(runs)
    reference = _all_calibrated(runs)
    if not reference and any(math.isfinite(run.timing.reference_s) for run in runs):
        notes.append(
            "times are wall seconds: some runs were not calibrated, or ran on another kind of device"
        )
    return CostRuns(tuple(map(_in_reference, runs) if reference else runs), tuple(notes), reference)


def _differ(runs: Sequence[CostRun]) -> list[str]:
    """Return in what runs on a scene differ that no setting of a method explains."""
    values: dict[str, set[Hashable]] = {
        "the scene's version": {run.scene_hash for run in runs},
        "protocol": {run.protocol for run in runs},
        "test images": {tuple(sorted(run.images)) for run in runs},
        "downsampling": {run.factor for run in runs},
        "start": {run.start for run in runs},
    }
    return [what for what, of in values.items() if len(of) > 1]


def _unequal_methods(scene: str, runs: Sequence[CostRun]) -> list[str]:
    """Return a note where no effects, or no limit of Gaussians, are common to all methods."""
    notes = []
    for what, value in (
        ("effects", lambda run: ", ".join(sorted(run.effects)) or "none"),
        ("limits of Gaussians", lambda run: str(dict(run.options).get("max_gaussians", "auto"))),
    ):
        by_method = {
            method: {value(run) for run in of} for method, of in grouped(runs, attrgetter("base")).items()
        }
        if len(by_method) > 1 and not set.intersection(*by_method.values()):
            each = "; ".join(f"{method}: {', '.join(sorted(of))}" for method, of in by_method.items())
            notes.append(f"methods on {scene} differ in their {what} ({each})")
    return notes


def _with_effects_of_plans(runs: list[CostRun]) -> list[CostRun]:
    """Name the effects of runs where plans of one scene chose different ones: they are no seeds of a cell."""
    planned = grouped((run for run in runs if run.asked == "auto"), lambda run: (run.method, run.scene))
    mixed = {key for key, of in planned.items() if len({run.effects for run in of if not run.error}) > 1}
    return [
        replace(run, asked=", ".join(sorted(run.effects)) or "none")
        if run.asked == "auto" and (run.method, run.scene) in mixed
        else run
        for run in runs
    ]


def _without_mixed_metrics(runs: list[CostRun], notes: list[str]) -> list[CostRun]:
    """Leave out the values of users' metrics that runs measured by different functions."""
    pairs = {pair for run in runs for pair in run.metric_functions.items()}
    mixed = {key: math.nan for key, count in Counter(key for key, _ in pairs).items() if count > 1}
    if not mixed:
        return runs
    notes.append(f"not comparable, left out: {', '.join(sorted(mixed))} comes from different functions")
    return [replace(run, numbers={k: mixed.get(k, v) for k, v in run.numbers.items()}) for run in runs]


def _all_calibrated(runs: Iterable[CostRun]) -> bool:
    done = [run for run in runs if not run.error]
    calibrated = all(math.isfinite(run.timing.reference_s) for run in done)
    return calibrated and len({run.timing.kernel for run in done}) == 1


def _in_reference(run: CostRun) -> CostRun:
    """Return the run with its training, set-up and probes in seconds of the reference machine."""
    if run.error:
        return run
    total = run.timing.reference_s
    early = ratio = total / run.train_s if run.train_s > 0.0 else 1.0
    walls = [at for at, _ in run.points]
    times = np.array(walls) * ratio
    if run.samples:
        early = run.kernel_reference_s / run.samples[0][1]
        times = in_reference_seconds(run.samples, run.kernel_reference_s, walls)
    points = tuple((float(at), psnr) for at, (_, psnr) in zip(times, run.points))
    return replace(run, train_s=total, setup_s=run.setup_s * early, points=points, speed=ratio)


def why_unranked(runs: Iterable[CostRun]) -> str:
    """Return why these runs are not ranked: a run was not alone or is not comparable; empty if they are."""
    runs = list(runs)
    if apart := next((run.apart for run in runs if run.apart), ""):
        return apart
    timings = [run.timing for run in runs if not run.error]
    wrong = [timing for timing in timings if timing.verdict != "alone"]
    return f"{len(wrong)} of {len(timings)} runs {wrong[0].verdict}: {wrong[0].reason}" if wrong else ""


def _run(folder: Path, result: RunResult) -> CostRun:
    config = read_config(folder)
    train, scene = config_section(config, "train"), config_section(config, "scene")
    cost, record = result["cost"], config_section(dict(result["cost"]), "timing")
    images = {row["name"]: _number(row.get("psnr")) for row in result["per_image"]}
    psnr, train_s = stats.mean(list(images.values())), _number(cost.get("train_s"))
    effects = config.get("effects") or result["facts"].get("effects") or []
    rest = {
        "scene": result["scene_hash"],
        "factor": scene.get("factor"),
        "train": {k: v for k, v in train.items() if k not in (*BOOKKEEPING, *SETTINGS)},
        "device": config.get("device", cost.get("device")),
        "protocol": config.get("protocol", "full"),
        "start": config_section(config, "start").get("sha256"),
        "code": [config.get("source"), result["version"], result.get("code_hash")],
        "images": sorted(images),
    }
    points, damage = _points(folder / "timeline.csv", train_s, psnr)
    no_probes = f"too few probes in {folder / 'timeline.csv'}" if len(points) < 2 else ""
    return CostRun(
        folder=folder,
        method=result["method"],
        scene=result["scene"],
        seed=result["seed"],
        asked=_asked(folder) or ", ".join(effects),
        effects=frozenset(map(str, effects)),
        options=tuple(sorted((_options(result["options"]) | _settings(train)).items())),
        length=_length(train, cost),
        rest=config_hash(rest),
        start=str(rest["start"] or ""),
        factor=str(rest["factor"]),
        protocol=str(rest["protocol"]),
        psnr=psnr,
        images=images,
        train_s=train_s,
        setup_s=_number(cost.get("setup_s")),
        numbers={name: _number(cost.get(name)) for name in NUMBERS}
        | {key: mean_of(result, key) for key in result.get("metrics", {})},
        points=points,
        timing=timing_of(cost),
        samples=tuple((float(at), float(kernel)) for at, kernel in record.get("samples", ())),
        kernel_reference_s=_number(record.get("kernel_reference_s")),
        metric_functions=metric_functions(result),
        scene_hash=result["scene_hash"],
        reproduce=str(result.get("reproduce", "")),
        error=result["error"] or "",
        doubt=str(result["facts"].get("test_photos", "")),
        unprobed="" if result["error"] else damage or no_probes,
    )


def _settings(train: ReadConfig) -> Options:
    """Return resolution and number of Gaussians if config.yaml has them; None becomes "auto"."""
    present = {name: train[name] for name in SETTINGS if name in train}
    return {name: "auto" if value is None else value for name, value in present.items()}


def _length(train: ReadConfig, cost: Cost) -> Length:
    budget = _number(train.get("budget_s"))
    if budget > 0.0:
        return Length(budget, 0)
    iterations = _number(train.get("iterations", cost.get("iterations")))
    return Length(0.0, 0 if math.isnan(iterations) else int(iterations))


def _asked(folder: Path) -> str:
    """Return the word given to --effects (auto, all), with which effects differ between scenes; else ""."""
    asked = own_json(folder / "effects.json").get("asked", "")
    return asked if asked in ("auto", "all") else ""


def _points(path: Path, train_s: float, psnr: float) -> tuple[tuple[tuple[float, float], ...], str]:
    """Read the probes of a timeline, followed by the measured PSNR; and a message if the file is damaged."""
    points, damage = [], ""
    try:
        with open(path, newline="", encoding="utf-8") as f:
            table = csv.DictReader(f)
            columns = table.fieldnames or ()
            if absent := [name for name in ("wall_s", "psnr_probe") if name not in columns]:
                raise ValueError(f"no column {' and '.join(absent)}")
            for row in table:
                at, value = _number(row.get("wall_s")), _number(row.get("psnr_probe"))
                if math.isfinite(at) and math.isfinite(value):
                    points.append((at, value))
    except OSError:  # an external program leaves none
        points = []
    except (ValueError, csv.Error) as error:
        points, damage = [], f"{path} is damaged ({error})"
    if math.isfinite(train_s) and math.isfinite(psnr):
        # The timeline rounds to milliseconds. Its last probe is the result itself, before it was saved.
        points = [p for p in points if p[0] < train_s - 0.002] + [(train_s, psnr)]
    return tuple(sorted(points)), damage


def _refuse_twice(runs: Iterable[CostRun]) -> None:
    same = grouped(runs, lambda r: (r.method, r.scene, r.seed, r.effects, r.options, r.length, r.rest))
    for run, other in (copies[:2] for copies in same.values() if len(copies) > 1):
        raise AwError(
            f"two runs of {run.method} on {run.scene} with seed {run.seed} and the same settings: "
            f"{run.folder} and {other.folder}; leave one of them out"
        )


def _number(value: Any) -> float:
    try:
        return math.nan if value is None or isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return math.nan


def _options(tree: Options) -> Options:
    """Return options by their dotted names, with lists as tuples, which can be hashed."""
    return {k: tuple(map(str, v)) if isinstance(v, list) else v for k, v in flatten(tree).items()}
