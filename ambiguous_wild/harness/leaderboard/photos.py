"""Metrics computed again from the saved renders and the scene's test photos."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.harness.measures import PARTIAL
from ambiguous_wild.harness.running.regions import find_regions
from ambiguous_wild.harness.running.result_file import ImageRow, metrics_of
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.metrics.full_image import FULL_IMAGE

TOLERANCE = 1e-6  # the same arithmetic on the same 8-bit pixels; another CPU may round otherwise
RESTORE = "restore the files, or run it again with 'aw bench --overwrite always'"
# dB. Which pixels are covered is itself computed: where rounding moves a pixel over the threshold, the mean
# over thousands of them moves a little.
REGION_TOLERANCE = {"psnr_covered": 1e-2, "psnr_uncovered": 1e-2, "psnr_supported": 1e-2}


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
        scene: with the test photos, opened with `verify`: its files are those that its hash was made of.
        rows: metrics of each image.
        renders: PNG by image name.
        half: the right half was measured.
        quick: PSNR of the whole picture alone.

    Raises:
        AwError: an image left out or added, a number that does not follow, or a render that is the photo
            itself.
    """
    views = {view.name: view for view in scene.test}
    if set(views) != set(renders):
        odd = sorted(set(views) ^ set(renders))
        raise AwError(
            f"{run} is partial: measured are {len(renders)} images, scene {scene.root} has {len(views)} test "
            f"photos ({shortlist(odd)} in one of them only); a mean over a part is no result"
        )
    known = ("psnr",) if quick else tuple(FULL_IMAGE)
    for metric in known:
        lacking = [row["name"] for row in rows if metric not in row]
        if lacking and len(lacking) < len(rows):
            raise AwError(f"{run} is partial: no {metric} of {shortlist(lacking)}, but of the other images")
    said = {metric for metric in PARTIAL if any(metric in row for row in rows)}
    regions = None if quick or not said else find_regions(scene)
    copies = []
    for row in rows:
        name = row["name"]
        render, photo = read_png_rgb(renders[name]), read_png_rgb(views[name].image_path)
        if render.shape != photo.shape:
            raise AwError(f"{renders[name]} is not of the size of {views[name].image_path}: it was changed")
        if half:
            right = slice(photo.shape[1] // 2, None)
            render, photo = (np.ascontiguousarray(picture[:, right]) for picture in (render, photo))
        values = metrics_of(row)
        for metric in known:
            if metric in values:
                _compare(run, name, metric, values[metric], FULL_IMAGE[metric](render, photo))
        if regions is not None:
            # A run of before a metric was kept has it of no image; one that has it, has it of all.
            computed = regions.psnr(name, render, photo)
            _compare_regions(run, row, {k: v for k, v in computed.items() if k in said})
        if np.array_equal(render, photo):
            copies.append(name)
    if copies:
        raise AwError(
            f"{run} shows the test photos themselves: every pixel of {shortlist(copies)} is its photo's, "
            "which no model renders; render from the model: 'aw bench --overwrite always'"
        )


def _compare_regions(run: Path, row: ImageRow, computed: dict[str, float]) -> None:
    """PSNR on parts of a picture: there where the scene has such pixels, and nowhere else."""
    name, values = row["name"], metrics_of(row)
    for metric in PARTIAL:
        if metric in values and metric not in computed:
            raise AwError(
                f"{run} was changed: {metric} of {name} is in metrics.json, and its scene has no such pixel "
                f"in that picture; {RESTORE}"
            )
        if metric in computed and metric not in values:
            raise AwError(
                f"{run} is partial: no {metric} of {name}, though its scene has such pixels there; {RESTORE}"
            )
        if metric in values:
            tolerance = REGION_TOLERANCE.get(metric, TOLERANCE)
            _compare(run, name, metric, values[metric], computed[metric], tolerance)


def _compare(
    run: Path, name: str, metric: str, said: float | None, computed: float, tolerance: float = TOLERANCE
) -> None:
    value = math.nan if said is None else float(said)
    both_missing = math.isnan(value) and math.isnan(computed)
    if not (value == computed or abs(value - computed) <= tolerance or both_missing):
        raise AwError(
            f"{run} was changed: {metric} of {name} is {value:.6f} in metrics.json, render and photo give "
            f"{computed:.6f}; {RESTORE}"
        )
