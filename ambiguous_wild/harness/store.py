"""Result files: one `metrics.json` a run (`failed.json` where it failed), checked out and in.

Per-image values are kept, never only their mean. JSON has no infinity: it is written as the string
"inf" and read back as a number. A missing value is ``null`` in the file and NaN in the tables, and its
reason stands under "missing".
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pandas as pd

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.measures import PARTIAL
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.atomic import write_json

SCHEMA = 1
RESULT = "metrics.json"
FAILED = "failed.json"  # same schema, status "failed"; counts where there is no metrics.json
CONFIG = "config.yaml"
# key -> type of a result file; a number may also be an int, "inf" or null
FIELDS: dict[str, type | tuple[type, ...]] = {
    "method": str,
    "scene": str,
    "seed": int,
    "status": str,
    "error": (str, type(None)),
    "options": dict,
    "per_image": list,
    "missing": dict,
    "masks": (dict, type(None)),
    "facts": dict,
    "cost": dict,
    "config_hash": str,
    "scene_hash": str,
    "version": str,
}
# Fields that results of earlier versions lack.
OPTIONAL: dict[str, type | tuple[type, ...]] = {"environment": dict, "code_hash": str, "reproduce": str}
MASK_SCORES = ("iou", "precision", "recall")


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
        version, device, the numbers of "cost", and mask_iou, mask_precision, mask_recall.
    missing: one row per run and missing metric: scene, method, seed, metric, reason.
    """

    images: pd.DataFrame
    runs: pd.DataFrame
    missing: pd.DataFrame
    incomplete: tuple[Incomplete, ...] = ()


def write_result(path: Path | str, result: dict[str, Any]) -> None:
    """Check a result and write it atomically.

    Args:
        path: of the file, by custom RUNS/<scene>/<method>/seed<k>/metrics.json.
        result: see `FIELDS`; infinite numbers become "inf", NaN becomes null.

    Raises:
        AwError: the result does not follow the schema.
    """
    encoded = _encode(result)
    _check(encoded, str(path))
    write_json(path, encoded)


def read_result(path: Path | str) -> dict[str, Any]:
    """Read and check a result file.

    Returns:
        The result with numbers decoded: "inf" is ``math.inf`` again; null stays None.

    Raises:
        AwError: no such file, no JSON, another schema version, or a field that is absent or of the wrong
            type; names the file and the field.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_constant)
    except FileNotFoundError:
        raise AwError(f"no result file {path}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise AwError(f"{path} is damaged ({error}); run 'aw bench' again to replace it") from None
    _check(data, str(path))
    data["per_image"] = [
        {k: v if k == "name" else _decode(v) for k, v in row.items()} for row in data["per_image"]
    ]
    data["cost"] = {k: _decode(v) for k, v in data["cost"].items()}
    if data["masks"] is not None:
        data["masks"] = {k: _decode(v) for k, v in data["masks"].items()}
    return data


def read_runs(folder: Path | str) -> Runs:
    """Every result below a folder of runs, at any depth.

    A run is a folder with config.yaml, metrics.json or failed.json in it. One without a result (still
    running, or stopped) and a damaged result are listed under `incomplete`, not dropped.

    Raises:
        AwError: no such folder, no run in it, or two results for the same method, scene and seed.
    """
    root = Path(folder)
    if not root.is_dir():
        raise AwError(f"no folder of runs {root}: give the folder that 'aw bench -o' wrote")
    results: list[tuple[Path, dict[str, Any]]] = []
    incomplete: list[Incomplete] = []
    for run in run_folders(root):
        paths = [run / name for name in (RESULT, FAILED) if (run / name).exists()]
        try:
            if not paths:
                raise AwError(
                    f"no {RESULT}: still running, or stopped; run the same command again to finish it"
                )
            results.append((run, read_result(paths[0])))
        except AwError as error:
            incomplete.append(Incomplete(run, str(error), *_method_and_scene(run)))
    if not results and not incomplete:
        raise AwError(f"no run in {root}: 'aw bench --method NAME --scene SCENE -o {root}' makes one")
    _refuse_duplicates(results)
    return Runs(
        images=_frame(_image_rows(results), ["scene", "method", "seed", "image", "metric", "value"]),
        runs=_frame(
            (_run_row(run, result) for run, result in results),
            ["scene", "method", "seed", "status", "error", "folder", "images"],
        ),
        missing=_frame(_missing_rows(results), ["scene", "method", "seed", "metric", "reason"]),
        incomplete=tuple(incomplete),
    )


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


def _method_and_scene(run: Path) -> tuple[str, str]:
    """Whose run it is, for one without a result: by its settings, else by its path."""
    config, method_folder = read_config(run), run.absolute().parent
    scene = config.get("scene")
    name = scene.get("name") if isinstance(scene, dict) else None
    return str(config.get("method") or method_folder.name), str(name or method_folder.parent.name)


def _refuse_duplicates(results: list[tuple[Path, dict[str, Any]]]) -> None:
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


def _key(result: dict[str, Any]) -> dict[str, Any]:
    return {k: result[k] for k in ("scene", "method", "seed")}


def _image_rows(results: list[tuple[Path, dict[str, Any]]]) -> Iterator[dict[str, Any]]:
    for _, result in results:
        # A metric that one image lacks, or the whole run, has a row of its own: NaN is not "not asked".
        metrics = dict.fromkeys(k for row in result["per_image"] for k in row if k != "name")
        metrics |= dict.fromkeys(result["missing"])
        for row in result["per_image"]:
            for metric in metrics:
                if metric in PARTIAL and metric not in row:
                    continue
                value = row.get(metric)
                yield _key(result) | {
                    "image": row["name"],
                    "metric": metric,
                    "value": math.nan if value is None else float(value),
                }


def _run_row(run: Path, result: dict[str, Any]) -> dict[str, Any]:
    masks = result["masks"] or {}
    cost = {k: v for k, v in result["cost"].items() if not isinstance(v, (dict, list))}
    return (
        _key(result)
        | {k: result[k] for k in ("status", "error", "config_hash", "scene_hash", "version")}
        | {"folder": str(run), "images": len(result["per_image"])}
        | cost
        | {f"mask_{k}": math.nan if masks.get(k) is None else masks[k] for k in MASK_SCORES}
    )


def _missing_rows(results: list[tuple[Path, dict[str, Any]]]) -> Iterator[dict[str, Any]]:
    for _, result in results:
        for metric, reason in result["missing"].items():
            yield _key(result) | {"metric": metric, "reason": reason}


def _frame(rows: Iterator[dict[str, Any]], columns: list[str]) -> pd.DataFrame:
    listed = list(rows)
    return pd.DataFrame(listed) if listed else pd.DataFrame(columns=columns)


def _check(data: Any, where: str) -> None:
    if not isinstance(data, dict):
        _wrong(where, "it must hold one JSON object")
    if data.get("schema") != SCHEMA:
        _wrong(where, f"schema version {data.get('schema')!r}, this version reads {SCHEMA}")
    for name, kind in FIELDS.items():
        if name not in data:
            _wrong(where, f"{name!r} is absent")
        if not isinstance(data[name], kind) or (kind is int and isinstance(data[name], bool)):
            _wrong(where, f"{name!r} has the wrong type: {_short(data[name])}")
    for name, kind in OPTIONAL.items():
        if name in data and not isinstance(data[name], kind):
            _wrong(where, f"{name!r} has the wrong type: {_short(data[name])}")
    for name in ("method", "scene"):
        if not data[name].strip():
            _wrong(where, f"{name!r} is empty")
    if data["status"] not in ("ok", "failed"):
        _wrong(where, f"'status' must be 'ok' or 'failed', not {_short(data['status'])}")
    if data["status"] == "failed" and not data["error"]:
        _wrong(where, "a failed run must say its error")
    if not all(isinstance(reason, str) for reason in data["missing"].values()):
        _wrong(where, "'missing' must map a metric to a reason")
    _check_images(data["per_image"], where)
    for name, value in (data["masks"] or {}).items():
        _check_number(value, f"masks.{name}", where)
    for name, value in data["cost"].items():
        if name not in ("device", "ms_parts"):
            _check_number(value, f"cost.{name}", where)


def _check_images(rows: list[Any], where: str) -> None:
    names = set()
    for row in rows:
        if not isinstance(row, dict) or not isinstance(row.get("name"), str):
            _wrong(where, f"an entry of 'per_image' has no name: {_short(row)}")
        if row["name"] in names:
            _wrong(where, f"image {row['name']!r} is there twice")
        names.add(row["name"])
        for metric, value in row.items():
            if metric != "name":
                _check_number(value, f"{metric} of {row['name']}", where)


def _check_number(value: Any, what: str, where: str) -> None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    # JSON's whole numbers have no end, floats have
    number = number and (isinstance(value, float) or abs(value) < 2**1000)
    if not number and value is not None and value not in ("inf", "-inf"):
        _wrong(where, f"{what} is no number: {_short(value)}")


def _wrong(where: str, what: str) -> NoReturn:
    raise AwError(f"{where} is no result file of ours: {what}; run 'aw bench' again to replace it")


def _short(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # a whole number of thousands of digits
        text = "a number without end"
    return text if len(text) <= 60 else text[:57] + "..."


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


def _encode(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _encode(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_encode(v) for v in value]
    if isinstance(value, (np.bool_, np.integer, np.floating)):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    return value


def _decode(value: Any) -> Any:
    return float(value) if value in ("inf", "-inf") else value
