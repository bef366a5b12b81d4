"""Verify a run folder before it is added to a board; each failed check gives a one-line error."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NoReturn, cast

import numpy as np

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.names import plain
from ambiguous_wild.harness.cell_run import EFFECTS, ENVIRONMENT
from ambiguous_wild.harness.chosen_effects import mixed_tests
from ambiguous_wild.harness.measures import ImageRow, Metric, measure, measure_images, metrics
from ambiguous_wild.harness.result_file import (
    FAILED,
    MODEL,
    RENDERS,
    RESULT,
    RunConfig,
    RunResult,
    check_model,
    config_identity,
    mask_scores,
    mean_of,
    metrics_of,
    read_result,
)
from ambiguous_wild.harness.store import (
    contradictions,
    cost_contradictions,
    impossible_values,
    metric_functions,
    read_config,
)
from ambiguous_wild.harness.timing import timing_of
from ambiguous_wild.io.files import own_json, sha256_file
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.report.board import ALONE, COST, FIRST, LAST, Entry, check_text
from ambiguous_wild.report.board_reproduce import (
    Scenes,
    command,
    hardware,
    options_hash,
    preparation,
    setting,
)

REQUIRED = ("psnr", "ssim", "ssim_inria")  # always measurable: they need only the two pictures
RESTORE = "restore the files, or run it again with 'aw bench --overwrite always'"


class Unfinished(AwError):
    """The run has no result yet, which is no fault."""


@dataclass(frozen=True)
class VerifiedRun:
    """A run that passed all checks."""

    entry: Entry
    run: Path
    names: tuple[str, ...]  # of the test images
    psnr: Mapping[str, float]  # by image
    scene: Scene | None  # None: it is not on this machine
    effects: tuple[str, ...] = ()


def verify(run: Path, scenes: Scenes, *, quick: bool = False) -> VerifiedRun:
    """Check a run and make its row.

    Args:
        run: the run folder.
        scenes: finds the run's scene and its dataset.
        quick: recompute only PSNR.

    Raises:
        Unfinished: the run has no result yet.
        AwError: the run failed, was changed, is partial, or not of this program; the error says what to do.
    """
    result, config = _result(run), _config(run)
    _check_identity(run, result, config)
    for key, what in (
        ("continued", "was continued from a shorter run"),
        ("corrections", "has masks corrected by hand"),
    ):
        if config.get(key):
            raise AwError(f"{run} {what}, which no command makes again from the scene: train it anew without")
    renders = _check_files(run, result, ours=not config["source"])
    scene = scenes.find(run, config)
    mixed = str(result["facts"].get("test_photos") or ("" if scene is None else mixed_tests(scene)))
    if mixed:
        raise AwError(
            f"{run}: {mixed}; build the scene with clean photos in test/ or --test-list FILE, and bench again"
        )
    _check_values(run, result, photos=scene is not None)
    if not config["source"]:
        _check_costs(run, result, config)
    if scene is not None:
        half = config.get("protocol", "full") == "half"
        check_photos(run, scene, result["per_image"], renders, half=half, quick=quick)
    dataset = scenes.dataset(run, scene, result["scene_hash"])
    quality, missing = _qualities(run, result)
    cost = {k: float(v) for k, v in result["cost"].items() if isinstance(v, (int, float)) and v == v}
    verdict = timing_of(result["cost"]).verdict
    if verdict != "unknown":
        cost[ALONE] = float(verdict == "alone")
    setting_text, reproduce = _words(run, config, preparation(scene), str(result.get("reproduce", "")))
    entry = Entry(
        dataset=check_text("dataset", dataset),
        scene=check_text(f"scene name of {run}", result["scene"]),
        method=check_text(f"method name of {run}", result["method"]),
        setting=setting_text,
        options=options_hash(config),
        seed=result["seed"],
        images=len(renders),
        quality=quality,
        cost=cost,
        missing=missing,
        device=str(config.get("device", "")),
        hardware=hardware(run / ENVIRONMENT, result),
        version=result["version"],
        source=config["source"],
        code_hash=str(result.get("code_hash", "")),
        config_hash=result["config_hash"],
        scene_hash=result["scene_hash"],
        result_hash=sha256_file(run / RESULT),
        checked="files" if scene is None else "psnr" if quick else "photos",
        reproduce=reproduce,
        metric_functions=", ".join(f"{key} {of}" for key, of in sorted(metric_functions(result).items())),
    )
    scenes.check_name(run, entry)
    psnr = {row["name"]: _or_nan(row.get("psnr")) for row in result["per_image"]}
    return VerifiedRun(entry, run, tuple(sorted(renders)), psnr, scene, tuple(config.get("effects") or ()))


def _changed(run: Path, what: str) -> NoReturn:
    raise AwError(f"{run} was changed: {what}; {RESTORE}")


def _partial(run: Path, what: str) -> NoReturn:
    raise AwError(f"{run} is partial: {what}; {RESTORE}")


def _result(run: Path) -> RunResult:
    if not (run / RESULT).is_file() and not (run / FAILED).is_file():
        raise Unfinished(
            f"{run} has no {RESULT}: still running, or stopped; run the same 'aw bench' again to finish it"
        )
    result = read_result(run / (RESULT if (run / RESULT).is_file() else FAILED))
    if result["status"] != "ok":
        error = plain(" ".join(str(result["error"]).split())[:120])
        raise AwError(f"{run} failed ({error}); a failed run has no numbers: run it again")
    if result["seed"] < 0:
        raise AwError(f"{run / RESULT} has seed {result['seed']}; seeds count from 0")
    return result


def _config(run: Path) -> RunConfig:
    config = read_config(run)
    wrong = [k for k in ("train", "scene", "options") if not isinstance(config.get(k), dict)]
    wrong += [k for k in ("method", "source", "config_hash", "version") if not isinstance(config.get(k), str)]
    if wrong:
        raise AwError(
            f"{run / 'config.yaml'} is absent, damaged or not of 'aw bench' ({shortlist(wrong)}): {RESTORE}"
        )
    return cast(RunConfig, config)


def _words(run: Path, config: RunConfig, before: list[str], recorded: str) -> tuple[str, str]:
    """Return (setting, commands) of a configuration, which a stranger may have written."""
    if config.get("effects") and not (run / EFFECTS).is_file():
        _partial(run, f"it lacks {EFFECTS}, which says who chose its effects")
    by_plan = chosen_by_plan(run)
    try:
        words = check_text(f"setting of {run}", setting(config, by_plan))
        return words, command(config, before, recorded)
    except AwError as error:
        raise AwError(f"{run}: {error}") from None
    except (TypeError, ValueError, AttributeError, KeyError) as error:
        raise AwError(f"{run / 'config.yaml'} was not written by 'aw bench' ({error}): {RESTORE}") from None


def chosen_by_plan(run: Path) -> bool:
    """Return whether the plan of the scene chose the run's effects."""
    return bool(own_json(run / EFFECTS).get("asked") == "auto")


def _check_identity(run: Path, result: RunResult, config: RunConfig) -> None:
    """Check that configuration and result belong together, and that their code is known."""
    from ambiguous_wild.methods.registry import BUILTIN

    try:
        computed = config_identity(config)
    except (TypeError, ValueError) as error:
        raise AwError(f"{run / 'config.yaml'} has no hash ({error}): {RESTORE}") from None
    for where, written in (("config.yaml", config["config_hash"]), (RESULT, result["config_hash"])):
        if written != computed:
            _changed(run, f"config.yaml hashes to {computed[:12]}, {where} says {str(written)[:12]}")
    for contradiction in contradictions(dict(config), result):
        _changed(run, contradiction)
    source, method = config["source"], config["method"]
    # a variant "method@..." has the method's code and another setting
    named = method.split("@")[0] in {entry.name for entry in BUILTIN}
    if not (re.fullmatch(r"[0-9a-f]{64}", source) or (named and not source)):
        raise AwError(
            f"{run}: the code of method {method[:60]!a} is unknown: it is not in this package, and "
            "config.yaml has no hash of it; run it as a file, see docs/extend.md"
        )


def _check_files(run: Path, result: RunResult, *, ours: bool) -> dict[str, Path]:
    """Check that all files of a run are present; return the path of the render by image name."""
    # an external program may write no splats; then its result has no size either
    size = result["cost"].get("model_mb")
    needed = (ENVIRONMENT,) if size is None and not ours else (MODEL, ENVIRONMENT)
    lacking = [name for name in needed if not (run / name).is_file()]
    renders = renders_of(run, result)
    lacking += [str(path.relative_to(run)) for path in renders.values() if not path.is_file()]
    if lacking:
        _partial(run, f"it lacks {shortlist(lacking)}")
    if not renders:
        raise AwError(f"{run} measured no test image: a board takes only scenes with test views")
    unlisted = sorted({p.name for p in set((run / RENDERS).rglob("*.png")) - set(renders.values())})
    if unlisted:
        _partial(run, f"{shortlist(unlisted)} was rendered, but {RESULT} does not list it")
    check_model(run, result)
    model_mb = (run / MODEL).stat().st_size / 1e6 if MODEL in needed else None
    if model_mb is not None and (size is None or not math.isclose(size, model_mb, abs_tol=1e-6)):
        _changed(run, f"the size of {MODEL} differs from that in {RESULT}")
    for path in renders.values():
        read_png_rgb(path)
    return renders


def renders_of(run: Path, result: RunResult) -> dict[str, Path]:
    """Return the path of each image's render, by the image's name."""
    return {row["name"]: run / RENDERS / _inside(run, row["name"]) for row in result["per_image"]}


def _inside(run: Path, name: str) -> str:
    pure = PurePosixPath(name)
    if pure.is_absolute() or ".." in pure.parts or not pure.name or "\\" in name:
        raise AwError(f"{run} names a test image outside of its folder: {name[:60]!a}; {RESTORE}")
    return str(pure.with_suffix(".png"))


def _check_values(run: Path, result: RunResult, *, photos: bool) -> None:
    """Refuse numbers that no measurement can give, and results that lack a required number.

    `photos`: the test photos are on this machine, so that an infinite PSNR can be verified.
    """
    rows = result["per_image"]
    for metric in REQUIRED:
        lacking = [row["name"] for row in rows if metrics_of(row).get(metric) is None]
        if lacking:
            _partial(run, f"it has no {metric} of {shortlist(lacking)}, which every run measures")
    for impossible in impossible_values(result):
        _impossible(run, *impossible)
    for row in rows:
        for metric, value in metrics_of(row).items():
            about = measure(metric)
            if value is None or not isinstance(about, Metric):
                continue
            if math.isinf(value) and not (about.infinite and photos):
                why = "is infinite only if picture and photo are equal, and the photos are not at hand: "
                why = f"{why}name their scene with --scene" if about.infinite else "is finite"
                _impossible(run, f"{metric} of {row['name']}", value, why)


def _check_costs(run: Path, result: RunResult, config: RunConfig) -> None:
    """Compare costs with the model, the settings and each other; what is left of times is believed."""
    for contradiction in cost_contradictions(run, result, dict(config)):
        _changed(run, contradiction)
    cost = result["cost"]
    steps, train_s, ms = cost.get("iterations"), cost.get("train_s"), cost.get("ms_per_iteration")
    if steps is not None and train_s is not None and ms is not None:
        taken = steps * ms / 1000
        if not math.isclose(train_s, taken, rel_tol=0.01):
            _changed(run, f"train_s is {train_s:g}, but {steps} iterations of {ms:g} ms take {taken:g} s")
    fps = [cost[key] for key in ("fps_low", "fps", "fps_high") if cost.get(key) is not None]
    if fps != sorted(fps):
        _changed(run, f"{RESULT} has fps_low, fps and fps_high out of order: {shortlist(map(str, fps))}")
    if train_s is not None and ms is None:
        _partial(run, f"{RESULT} has train_s but no ms_per_iteration, which every training measures")


def _impossible(run: Path, what: str, value: float, why: str) -> NoReturn:
    _changed(run, f"{what} is {value:g} in {RESULT}, but such a number {why}")


def _qualities(run: Path, result: RunResult) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return (mean over the images by metric, metrics that some image lacks)."""
    rows = [metrics_of(row) for row in result["per_image"]]
    names = {metric for row in rows for metric in row} | set(result["missing"])
    for name in sorted(names):
        taken = name in (*FIRST, *LAST) or name.startswith(COST)
        if taken or not re.fullmatch(r"[a-z][a-z0-9_.]{0,60}", name):
            raise AwError(f"{run}: {name[:60]!a} cannot name a metric: lower case, digits, '_' and '.'")
    means = {name: mean_of(result, name) for name in names}
    means |= {f"mask_{name}": float(score) for name, score in mask_scores(result).items()}
    missing = tuple(sorted(k for k, v in means.items() if math.isnan(v)))
    return {k: v for k, v in means.items() if not math.isnan(v)}, missing


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def check_photos(
    run: Path,
    scene: Scene,
    rows: list[ImageRow],
    renders: Mapping[str, Path],
    *,
    half: bool = False,
    quick: bool = False,
) -> None:
    """Compare every image's metrics with those of its render and photo.

    Args:
        run: the run folder, for messages.
        scene: the scene with the test photos, opened with `verify`, so that its files match its hash.
        rows: metrics of each image.
        renders: path of the PNG by image name.
        half: the right half was measured.
        quick: recompute only PSNR.

    Raises:
        AwError: an image was left out or added, a number differs, or a render is the photo itself.
    """
    views = {view.name: view for view in scene.test}
    if set(views) != set(renders):
        odd = sorted(set(views) ^ set(renders))
        raise AwError(
            f"{run} is partial: {len(renders)} images were measured, scene {scene.root} has {len(views)} "
            f"test photos (only one of them has {shortlist(odd)}); a mean over a part of them is no result"
        )
    verifiable = [m for m in metrics().values() if m.key == "psnr" or not (quick or m.tolerance is None)]
    compared = [m for m in verifiable if any(m.key in row for row in rows)]
    copies = []
    for row in rows:
        name = row["name"]
        render, photo = read_png_rgb(renders[name]), read_png_rgb(views[name].image_path)
        if render.shape != photo.shape:
            raise AwError(f"{renders[name]} differs from {views[name].image_path} in size: it was changed")
        (computed,), _ = measure_images([(name, render, photo)], compared, scene, half=half)
        for metric in compared:
            _compare(run, row, metric, metrics_of(computed))
        right = slice(photo.shape[1] // 2 if half else 0, None)
        if np.array_equal(render[:, right], photo[:, right]):
            copies.append(name)
    if copies:
        raise AwError(
            f"{run} shows the test photos themselves: every pixel of {shortlist(copies)} equals the photo's, "
            "which no model achieves; render from the model: 'aw bench --overwrite always'"
        )


def _compare(run: Path, row: ImageRow, metric: Metric, computed: Mapping[str, float | None]) -> None:
    """Check one metric of one image against the computed value; a run may lack a metric as a whole."""
    key, name, values = metric.key, row["name"], metrics_of(row)
    if key in values and key not in computed:
        _changed(run, f"{RESULT} has {key} of {name}, but that picture has no such pixel")
    if key in computed and key not in values:
        why = "although the picture has such pixels" if metric.partial else "but of the other images"
        _partial(run, f"it has no {key} of {name}, {why}")
    if key not in values:
        return
    value, correct = _or_nan(values[key]), _or_nan(computed[key])
    both_missing = math.isnan(value) and math.isnan(correct)
    if not (value == correct or abs(value - correct) <= (metric.tolerance or 0.0) or both_missing):
        _changed(run, f"{key} of {name} is {value:.6f} in {RESULT}, render and photo give {correct:.6f}")
