"""What a figure of runs shows: its photos, its zooms and its pictures, equal for all methods.

What is not given is found by one rule: where the mean squared errors of the methods differ most. Which method
is better does not enter. Where test photos may hold distractors, only static pixels are measured.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.core.errors import shortlist, unknown
from ambiguous_wild.core.scene import find_view
from ambiguous_wild.harness.measures import STATIC_PIXELS
from ambiguous_wild.harness.result_file import (
    RESTORE,
    RESULT,
    RunResult,
    check_render,
    metrics_of,
    read_result,
)
from ambiguous_wild.harness.store import Runs, check_names
from ambiguous_wild.harness.trained_models import MASKS, open_scene
from ambiguous_wild.io.images import read_gray, read_png_rgb
from ambiguous_wild.io.palette import MASKED, tint
from ambiguous_wild.metrics.image import psnr_from_mse

PHOTO = "Photo"  # head of the first column
ROWS = 3  # photos, where none is named; of more scenes, each has one
ZOOM = 4  # a found zoom has 1/4 of the photo's width and height
LEAST = 8  # px of its sides, of small photos

Box = tuple[int, int, int, int]  # left, top, width, height in px
Crop = tuple[float, float, float, float]  # the same, or in shares of the photo if none is above 1


@dataclass(frozen=True)
class FigureRow:
    """A test photo and its renders, or a train photo and its masks."""

    scene: str
    photo: str  # its name
    masks: bool  # it shows masks
    pictures: tuple[np.ndarray, ...]  # [H, W, 3] uint8; the photo first, then a picture for each method
    texts: tuple[str, ...]  # below each picture
    box: Box | None  # what is shown enlarged below
    errors: tuple[
        np.ndarray, ...
    ] = ()  # for each method [H, W] float32: |render - photo|, mean over channels
    pixels: np.ndarray | None = None  # [H, W] bool, those that are measured; None: all


@dataclass(frozen=True)
class RunsFigure:
    """A figure before it is drawn."""

    methods: tuple[str, ...]  # as they are shown
    rows: tuple[FigureRow, ...]
    notes: tuple[str, ...]  # what was left out, and why

    @property
    def group_sizes(self) -> dict[tuple[str, bool], int]:
        """The number of rows of renders, and of masks, of each scene."""
        return Counter((row.scene, row.masks) for row in self.rows)


@dataclass(frozen=True)
class _SceneRuns:
    """The runs of one scene, one of each method."""

    scene: Scene
    folders: tuple[Path, ...]
    results: tuple[RunResult, ...]
    methods: tuple[str, ...]  # as they are shown

    @cached_property
    def doubt(self) -> str:
        """Why test photos may hold distractors; empty if they hold none."""
        return next(filter(None, (str(r["facts"].get("test_photos", "")) for r in self.results)), "")

    @cached_property
    def metric(self) -> str:
        """The metric below renders: that of static pixels, where test photos may hold distractors."""
        measured = [
            {key for row in result["per_image"] for key in metrics_of(row)} for result in self.results
        ]
        static = (key for key in STATIC_PIXELS if all(key in keys for keys in measured))
        return next(static, "psnr") if self.doubt else "psnr"

    def psnr(self, k: int, view: View) -> float:
        """Return the value in dB of `metric` that run k was measured to have; NaN where it has none."""
        rows = {row["name"]: metrics_of(row) for row in self.results[k]["per_image"]}
        value = rows.get(view.name, {}).get(self.metric)
        return math.nan if value is None else float(value)

    @cached_property
    def pixels(self) -> dict[str, np.ndarray]:
        """The pixels that `metric` measures, [H, W] bool by the name of a test photo; absent: all."""
        if self.metric == "psnr":
            return {}
        from ambiguous_wild.harness.regions import static_pixels  # imports torch

        found = static_pixels(self.scene, self.metric)
        return {} if isinstance(found, str) else found

    def notes(self) -> list[str]:
        """Return what the PSNR of doubtful test photos is of."""
        if not self.doubt:
            return []
        if self.metric == "psnr":
            return [f"scene {self.scene.name}: {self.doubt}"]
        return [f"scene {self.scene.name}: dB over the pixels that {STATIC_PIXELS[self.metric]}"]

    def renders(self, view: View) -> list[np.ndarray]:
        paths = [check_render(run, result, view.name) for run, result in zip(self.folders, self.results)]
        return [read_png_rgb(path) for path in paths]

    def masked(self, view: View) -> list[np.ndarray | None]:
        """Return what each method masks in a train photo, [H, W] bool; None without a mask."""
        paths = [folder / MASKS / Path(view.name).with_suffix(".png") for folder in self.folders]
        masks = [read_gray(path) < 128 if path.is_file() else None for path in paths]
        for path, mask in zip(paths, masks):
            if mask is not None and mask.shape != (view.camera.height, view.camera.width):
                raise AwError(f"{path} has another size than its photo: {RESTORE}")
        return masks

    def first_column(self, view: View) -> int:
        """Return the first column that is measured: of the half-image protocol, the middle one."""
        halves = any(result["facts"].get("protocol") == "half" for result in self.results)
        return view.camera.width // 2 if halves else 0


def runs_figure(
    runs: Runs,
    *,
    scenes: Sequence[str] = (),
    photos: Sequence[str] = (),
    crops: Sequence[Crop | None] = (),
    errors: bool = False,
    masks: bool = False,
) -> RunsFigure:
    """Choose photos and zooms, and read renders and masks of the first seed that all methods have.

    Args:
        runs: runs from `read_runs`.
        scenes: names of scenes; empty: all that every method has a run of.
        photos: names of test photos, and of train photos, whose masks are shown; empty: those where methods
            differ most.
        crops: what is enlarged: one for every photo, or one for each of `photos`; None: nothing. Empty: the
            box of each test photo in which methods differ most.
        errors: also take error maps.
        masks: also take train photos with the masks, those where the masks differ most.

    Raises:
        AwError: no finished run, no scene that all methods have, a scene that differs between runs or was
            moved or changed, an unknown photo, a crop outside of its photo, or a run that lacks its renders.
    """
    if len(crops) > 1 and len(crops) != len(photos):
        raise AwError(
            f"--crop is given {len(crops)} times and --photo {len(photos)} times: give one --crop for every "
            "photo, or one after each --photo"
        )
    groups, notes = _groups(runs, scenes)
    rows: list[FigureRow] = []
    count = -(-ROWS // len(groups))
    for group in groups:
        chosen = [(k, view) for k, name in enumerate(photos) if (view := _view(group.scene, name))]
        if not photos:
            chosen = [(0, view) for view in _most_different(group)[:count]]
        for k, view in chosen:
            crop = crops[min(k, len(crops) - 1)] if crops else None
            box = None if crop is None else _box(crop, view)
            rows.append(_row(group, view, box, find=not crops, errors=errors))
        if masks:
            masked = _most_masked(group)[:count]
            rows += [_row(group, view, None, find=False, errors=False) for view in masked]
            notes += [] if masked else [f"scene {group.scene.name}: no method has masks"]
        notes += group.notes()
    for name in photos:
        if not any(_view(group.scene, name) for group in groups):
            raise unknown("photo", name, [view.name for group in groups for view in group.scene.views])
    if not rows:
        raise AwError("there is no test photo to show; --with-masks shows train photos")
    return RunsFigure(groups[0].methods, tuple(rows), tuple(notes))


def _groups(runs: Runs, scenes: Sequence[str]) -> tuple[list[_SceneRuns], list[str]]:
    """Return the runs of each scene that all methods have a finished run of, and what is left out."""
    check_names("scene", scenes, sorted(runs.runs["scene"].unique()))
    asked = runs.runs[runs.runs["scene"].isin(scenes)] if scenes else runs.runs
    finished = asked[asked["status"] == "ok"]
    if finished.empty:
        raise AwError("no finished run to show; 'aw table' lists what is there")
    having = finished.groupby(["scene", "seed"])["method"].transform("nunique")  # methods with this seed
    best = finished.assign(lacking=-having).sort_values(["lacking", "seed"])
    first = best.drop_duplicates(["scene", "method"])
    finished_methods = set(first["method"])
    methods = tuple(method for method in runs.rows() if method in finished_methods)
    begun = {run.method for run in runs.incomplete if not scenes or run.scene in scenes}
    unfinished = sorted((begun | set(asked["method"])) - finished_methods)
    owners: dict[str, list[str]] = {}
    for scene, method in zip(first["scene"].astype(str), first["method"].astype(str)):
        owners.setdefault(scene, []).append(method)
    lacking = {scene: sorted(set(methods) - set(owners[scene])) for scene in sorted(owners)}
    if all(lacking.values()):
        has = "; ".join(f"{scene}: {', '.join(sorted(owners[scene]))}" for scene in lacking)
        raise AwError(
            f"no scene has a run of every method ({has}): give runs of one scene, or name it with --only"
        )
    notes = [f"{method} is left out: it has no finished run" for method in unfinished]
    notes += [
        f"scene {scene} is left out: no run of {shortlist(lack)}" for scene, lack in lacking.items() if lack
    ]
    groups = []
    for scene in (scene for scene, lack in lacking.items() if not lack):
        rows = first[first["scene"] == scene].set_index("method").loc[list(methods)]
        if rows["scene_hash"].nunique() > 1:
            raise AwError(f"scene {scene!r} differs between these runs: run them again on one")
        if rows["seed"].nunique() > 1:
            seeds = ", ".join(f"{method} {seed}" for method, seed in rows["seed"].items())
            notes.append(f"scene {scene}: no seed of which every method has a finished run; shown: {seeds}")
        folders = tuple(Path(str(folder)) for folder in rows["folder"])
        results = tuple(read_result(folder / RESULT) for folder in folders)
        groups.append(_SceneRuns(open_scene(folders[0]), folders, results, methods))
    return groups, notes


def _view(scene: Scene, name: str) -> View | None:
    """Find a view by its name, its file's name or its stem; test photos come first."""
    return find_view(scene.test, name) or find_view(scene.train, name)


def _box(crop: Crop, view: View) -> Box:
    """Return the box in px; raise AwError where it is not inside the photo."""
    width, height = view.camera.width, view.camera.height
    scale = (width, height, width, height) if max(crop) <= 1.0 else (1, 1, 1, 1)
    left, top, wide, high = (round(value * size) for value, size in zip(crop, scale))
    if min(left, top) < 0 or min(wide, high) < 1 or left + wide > width or top + high > height:
        shown = ",".join(f"{value:g}" for value in crop)
        raise AwError(f"--crop {shown} does not lie inside photo {view.name} ({width} x {height} px)")
    return left, top, wide, high


def _most_different(group: _SceneRuns) -> list[View]:
    """Return the test views, those first where the mean squared errors of the methods differ most.

    Of a single method, those first where its error is largest.
    """

    def spread(view: View) -> float:
        errors = [10.0 ** (-group.psnr(k, view) / 10.0) for k in range(len(group.methods))]
        errors = [error for error in errors if math.isfinite(error)]
        return max(errors, default=0.0) - (min(errors) if len(errors) > 1 else 0.0)

    return sorted(group.scene.test, key=lambda view: -spread(view))


def _most_masked(group: _SceneRuns) -> list[View]:
    """Return the train views with a mask, those first where the methods' masks differ in most pixels."""
    differing: dict[str, float] = {}
    for view in group.scene.train:
        masks = [mask for mask in group.masked(view) if mask is not None]
        if masks:
            differs = np.logical_or.reduce(masks)
            if 1 < len(masks) == len(group.methods):  # where one has no mask, all that others mask differs
                differs &= ~np.logical_and.reduce(masks)
            differing[view.name] = float(differs.mean())
    views = [view for view in group.scene.train if view.name in differing]
    return sorted(views, key=lambda view: -differing[view.name])


def _row(group: _SceneRuns, view: View, box: Box | None, *, find: bool, errors: bool) -> FigureRow:
    """Read a row; `find` a box for it if it shows renders."""
    photo = read_png_rgb(view.image_path)
    if view.split == "train":
        masks = group.masked(view)
        shown = [photo if mask is None else tint(photo, mask, MASKED) for mask in masks]
        texts = ["no mask" if mask is None else f"{100 * mask.mean():.0f} % masked" for mask in masks]
        return FigureRow(group.scene.name, view.name, True, (photo, *shown), ("train photo", *texts), box)
    renders = group.renders(view)
    values = [group.psnr(k, view) for k in range(len(renders))]
    texts = ["no PSNR" if math.isnan(value) else f"{value:.2f} dB" for value in values]
    pixels = group.pixels.get(view.name)
    if find:
        squared = [_difference(render, photo, 2) for render in renders]
        squared = squared if pixels is None else [error * pixels for error in squared]
        box = most_different_box(squared, group.first_column(view))
    maps = tuple(_difference(render, photo, 1) for render in renders) if errors else ()
    return FigureRow(group.scene.name, view.name, False, (photo, *renders), ("", *texts), box, maps, pixels)


def _difference(render: np.ndarray, photo: np.ndarray, power: int) -> np.ndarray:
    """Return |render - photo| ** power, mean over channels, [H, W] float32 of colours in [0, 1]."""
    return ((np.abs(render.astype(np.float32) - photo) / np.float32(255.0)) ** power).mean(axis=2)


def most_different_box(errors: Sequence[np.ndarray], first_column: int = 0) -> Box:
    """Find the box in which the mean squared errors of methods differ most, from the largest to the smallest.

    Args:
        errors: for each method [H, W] its squared error, at least one. Of one method alone, and where no
            method differs, the error itself counts.
        first_column: columns before it are not measured.

    Returns:
        A box of 1/4 of the width and height, at least 8 px.
    """
    height, width = errors[0].shape
    wide = min(max(width // ZOOM, LEAST), width - first_column)
    high = min(max(height // ZOOM, LEAST), height)
    means = np.stack([_box_means(error, wide, high)[:, first_column:] for error in errors])
    spread = np.ptp(means, axis=0) if len(errors) > 1 else means[0]
    if not spread.any():
        spread = means[0]
    top, left = np.unravel_index(int(spread.argmax()), spread.shape)
    return int(left) + first_column, int(top), wide, high


def _box_means(values: np.ndarray, wide: int, high: int) -> np.ndarray:
    """Return the mean over the box of each upper left corner, [H - high + 1, W - wide + 1] float64."""
    sums = cv2.integral(values, sdepth=cv2.CV_64F)
    boxes = sums[high:, wide:] - sums[:-high, wide:] - sums[high:, :-wide] + sums[:-high, :-wide]
    return boxes / (wide * high)


def in_words(figure: RunsFigure) -> list[str]:
    """Return a line for each row: photo and crop as options, and the PSNR of each method inside the crop."""
    lines = []
    scenes = len({row.scene for row in figure.rows})
    for row in figure.rows:
        line = (f"{row.scene}: " if scenes > 1 else "") + f"--photo {row.photo}"
        if row.box is not None:
            line += f" --crop {','.join(map(str, row.box))}"
        if row.box is not None and not row.masks:
            photo, *renders = (cut(picture, row.box) for picture in row.pictures)
            pixels = np.ones(photo.shape[:2], bool) if row.pixels is None else cut(row.pixels, row.box)
            if pixels.any():
                errors = (_difference(r, photo, 2)[pixels].mean(dtype=np.float64) for r in renders)
                inside = zip(figure.methods, (psnr_from_mse(float(error)) for error in errors))
                line += ", inside: " + ", ".join(f"{method} {value:.2f} dB" for method, value in inside)
        lines.append(line)
    return [*lines, *figure.notes]


def cut(picture: np.ndarray, box: Box) -> np.ndarray:
    """Return the part of [H, W, ...] in the box."""
    left, top, wide, high = box
    return picture[top : top + high, left : left + wide]
