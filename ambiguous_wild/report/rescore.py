"""Add metrics that a run lacks, computed from its saved pictures; nothing is trained.

Before anything is added, every number of the result is computed again from renders and photos. If one
differs, a file was changed since, and the run is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

from ambiguous_wild import __version__
from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.harness.cell import code_hash
from ambiguous_wild.harness.evaluate import kernel_threads
from ambiguous_wild.harness.measures import ImageRow, Metric, measure_images, metrics, records
from ambiguous_wild.harness.result_file import (
    RESULT,
    RunResult,
    config_identity,
    metrics_of,
    read_result,
    write_result,
)
from ambiguous_wild.harness.store import find_runs, lacks_metric, read_config
from ambiguous_wild.harness.trained_models import Opened, open_scene
from ambiguous_wild.io.files import folder_lock
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.report.board_verify import check_photos, renders_of

Outcome = Literal["rescored", "complete", "unfinished", "refused"]


@dataclass(frozen=True)
class Rescored:
    """The outcome of one run."""

    run: Path
    outcome: Outcome
    added: tuple[str, ...] = ()  # metrics that were added
    missing: tuple[str, ...] = ()  # metrics that are still missing
    error: str = ""


def rescore(folders: Sequence[Path], *, scene: Path | None = None) -> list[Rescored]:
    """Add the metrics that can be measured now to every run below the folders.

    Args:
        folders: outputs of `aw bench`, or folders of them.
        scene: where the scene lies now; None = where each run says.

    Raises:
        AwError: no such folder, or no run in it.
    """
    outcomes, opened = [], Opened()
    for run in find_runs(folders):
        try:
            outcomes.append(_rescore(run, scene, opened))
        except AwError as error:
            outcomes.append(Rescored(run, "refused", error=str(error)))
    return outcomes


def _rescore(run: Path, folder: Path | None, opened: Opened) -> Rescored:
    with folder_lock(run, "aw rescore"):
        if not (run / RESULT).is_file():
            return Rescored(run, "unfinished", error=f"no {RESULT}: failed, running or stopped")
        result, config = read_result(run / RESULT), read_config(run)
        try:
            identity = config_identity(config)
        except (KeyError, TypeError, ValueError, AttributeError):
            identity = ""
        if identity != result["config_hash"]:
            raise AwError(f"{run}: config.yaml is absent, or not that of {RESULT}; restore both files")
        if not result["per_image"]:
            return Rescored(run, "complete", missing=tuple(sorted(result["missing"])))
        half = config.get("protocol", "full") == "half"
        scene = open_scene(run, folder, opened=opened)
        renders = renders_of(run, result)
        if lacking := shortlist(path.name for path in renders.values() if not path.is_file()):
            raise AwError(f"{run} lacks its renders {lacking}: restore them, or run it again")
        wanted = [metric for key, metric in metrics().items() if lacks_metric(result, key)]
        for row in result["per_image"]:
            for metric in wanted:
                row.pop(metric.key, None)  # type: ignore[misc]  # from another version of its file
        check_photos(run, scene, result["per_image"], renders, half=half)
        added = _add(result, scene, wanted, renders, half=half)
        missing = tuple(sorted(result["missing"]))
        if not added:
            return Rescored(run, "complete", missing=missing)
        record = {"metrics": list(added), "version": __version__, "code_hash": code_hash()}
        write_result(run / RESULT, {**result, "rescored": [*result.get("rescored", []), record]})
    return Rescored(run, "rescored", added, missing)


def _add(
    result: RunResult, scene: Scene, wanted: Sequence[Metric], renders: dict[str, Path], *, half: bool
) -> tuple[str, ...]:
    """Add metrics to the result; return those added. Metrics without a value in any image stay missing."""
    photos = {view.name: view.image_path for view in scene.test}
    pictures = ((name, read_png_rgb(path), read_png_rgb(photos[name])) for name, path in renders.items())
    rows, missing = measure_images(pictures, wanted, scene, half=half, around=kernel_threads)
    result["per_image"] = [cast(ImageRow, {**old, **new}) for old, new in zip(result["per_image"], rows)]
    added = {key for row in rows for key in metrics_of(row)}
    result["missing"] = {key: why for key, why in (result["missing"] | missing).items() if key not in added}
    result["metrics"] = {**result.get("metrics", {}), **records(added)}
    return tuple(sorted(added))
