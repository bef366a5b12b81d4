"""Columns of results: metrics of test images (built in or a user's), masks and cost.

A user's metric is a `Metric` in a file (`--metric-file my_metric.py`) or in a package (entry points
`ambiguous_wild.metrics`). Each result keeps a record of it, so that tables need neither file nor package.
"""

from __future__ import annotations

import importlib.metadata
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Required, TypedDict, cast, get_args

import numpy as np
from msgspec import Meta

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.machine import in_order, photo_threads
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.methods.entry import resolve
from ambiguous_wild.methods.references import error_location, hash_of_package, import_file

if TYPE_CHECKING:
    from ambiguous_wild.core import Scene, View

Better = Literal["higher", "lower", None]  # None: not ranked
_IMAGE = "ambiguous_wild.metrics.image:"
BYTES_A_CODE = 80  # of a picture, while a metric works on it: ten copies in float64
_REGION_DB = 1e-2  # larger, because rounding may move a pixel into or out of a region
# metrics that do not count distractors in test photos: the pixels that they measure
STATIC_PIXELS = {"psnr_valid": "the masks of test photos keep", "psnr_consistent": "other photos show alike"}
MASK_LABELS = {"iou": "IoU", "precision": "precision", "recall": "recall"}
ALWAYS = ("psnr", "ssim", "lpips_alex")  # shown even where missing: the reason stands below the table
COST = ("train_s", "reference_s", "ms_per_iteration", "fps", "gaussians", "model_mb")
# An unknown metric is shown like its family: psnr_distractor like PSNR.
FAMILIES = {"psnr": "psnr", "ssim": "ssim", "lpips": "lpips_alex"}


@dataclass(frozen=True)
class Measure:
    """A column: its label, which direction is better, how many digits are shown."""

    key: str  # as in the result file
    label: str
    better: Better
    digits: int = 3
    per_image: bool = True  # else one number per run
    timed: bool = False  # depends on the load of the machine: ranked only between runs that were alone
    partial: bool = False  # measured on some pixels only: an image without such pixels is left out of a mean
    low: float = -math.inf  # smallest possible value
    high: float = math.inf  # largest possible value

    @property
    def whole_photo(self) -> bool:
        """True if a distractor in a test photo counts as truth."""
        return self.per_image and self.key not in STATIC_PIXELS

    @property
    def range(self) -> float:
        """The largest possible difference of two values."""
        return self.high - self.low

    @property
    def quality(self) -> bool:
        """True for a measure of the result's quality, False for one of its cost."""
        return self.per_image or self.key.startswith("mask_")


@dataclass(frozen=True, kw_only=True)
class Metric(Measure):
    """A measure of a test image, with the function that computes it.

    `function` gets the render and what `needs` names, in that order, and returns a number. Pictures are
    [H, W, 3] uint8. It returns NaN if this image has no value, and raises AwError if no image can have one,
    e.g. for missing weights.
    """

    function: str | Callable[..., float]  # "module:function" for ours
    needs: tuple[Literal["photo", "view", "scene"], ...] = ("photo",)  # () = only the render is needed
    unit: str = ""  # printed after the label
    infinite: bool = False  # inf is the right value for equal pictures
    # allowed difference when a value is verified; None: it is not verified, as that takes a network
    tolerance: float | None = 1e-6
    source: str = ""  # sha256 of its file

    def value(self, render: np.ndarray, photo: np.ndarray, view: View, scene: Scene) -> float:
        """Return the value of one image; raise AwError, with the line in the user's file, if that fails."""
        inputs = {"photo": photo, "view": view, "scene": scene}
        try:
            value = resolve(self.function)(render, *(inputs[name] for name in self.needs))
            if np.ndim(value) or value is None:
                raise AwError(f"the function returned {type(value).__name__}, not one number")
            return float(value)
        except (Exception, SystemExit) as error:  # a user's function may call sys.exit
            if isinstance(self.function, str) or isinstance(error, AwError):
                raise
            raise AwError(f"{type(error).__name__}: {error}{error_location(error)}") from error


def _psnr(key: str, label: str, function: str, **more: Any) -> Metric:
    return Metric(key, label, "higher", 2, function=function, low=0.0, infinite=True, **more)


def _region(key: str, label: str, tolerance: float = 1e-6) -> Metric:
    function = f"ambiguous_wild.harness.regions:{key}"
    return _psnr(key, label, function, needs=("photo", "view", "scene"), partial=True, tolerance=tolerance)


def _lpips(key: str, label: str) -> Metric:
    function = f"ambiguous_wild.metrics.lpips:{key}"
    return Metric(key, label, "lower", function=function, low=0.0, tolerance=None)


MEASURES: dict[str, Measure] = {
    m.key: m
    for m in (
        _psnr("psnr", "PSNR", f"{_IMAGE}psnr"),
        Metric("ssim", "SSIM", "higher", function=f"{_IMAGE}ssim", low=-1.0, high=1.0),
        _lpips("lpips_alex", "LPIPS alex"),
        Metric("ssim_inria", "SSIM Inria", "higher", function=f"{_IMAGE}ssim_inria", low=-1.0, high=1.0),
        _lpips("lpips_vgg", "LPIPS vgg"),
        _lpips("lpips_vgg_01", "LPIPS vgg 01"),
        Metric("flip", "FLIP", "lower", function=f"{_IMAGE}flip", low=0.0, high=1.0),
        _psnr("psnr_affine", "PSNR affine", f"{_IMAGE}psnr_affine"),
        _region("psnr_valid", "PSNR valid"),
        _region("psnr_covered", "PSNR covered", _REGION_DB),
        _region("psnr_uncovered", "PSNR uncovered", _REGION_DB),
        _region("psnr_supported", "PSNR supported", _REGION_DB),
        _region("psnr_consistent", "PSNR consistent", _REGION_DB),
        *(
            Measure(f"mask_{k}", f"mask {v}", "higher", per_image=False, low=0.0, high=1.0)
            for k, v in MASK_LABELS.items()
        ),
        Measure("train_s", "train s", "lower", 1, per_image=False, timed=True),
        Measure("reference_s", "ref s", "lower", 1, per_image=False, timed=True),
        Measure("cpu_s", "cpu s", "lower", 1, per_image=False),
        Measure("setup_s", "setup s", "lower", 1, per_image=False, timed=True),
        Measure("iterations", "iterations", None, 0, per_image=False),
        Measure("ms_per_iteration", "ms/iter", "lower", 1, per_image=False, timed=True),
        Measure("fps", "FPS", "higher", 1, per_image=False, timed=True),
        Measure("gaussians", "Gaussians", "lower", 0, per_image=False),
        Measure("model_mb", "MB", "lower", 1, per_image=False),
        Measure("fps_low", "FPS low", "higher", 1, per_image=False, timed=True),
        Measure("fps_high", "FPS high", "higher", 1, per_image=False, timed=True),
        Measure("peak_rss_mb", "peak RSS MB", "lower", 0, per_image=False),
        Measure("peak_cuda_mb", "peak CUDA MB", "lower", 0, per_image=False),
    )
}

# registered, or known only from the record in a result: then without a function
own_metrics: dict[str, Metric] = {}


@cache
def _installed() -> dict[str, Metric]:
    points = importlib.metadata.entry_points(group="ambiguous_wild.metrics")
    return {point.name: replace(point.load(), source=hash_of_package(point)) for point in points}


def metrics() -> dict[str, Metric]:
    """Return every metric that can be computed, by key: built in, registered, installed as entry points."""
    for key, metric in _installed().items():
        if key not in own_metrics or not own_metrics[key].function:
            register(metric)
    return {k: m for k, m in (MEASURES | own_metrics).items() if isinstance(m, Metric) and m.function}


def measure(key: str) -> Measure:
    """Return the column of that key; an unknown key is shown like its family."""
    if key not in MEASURES and key not in own_metrics:
        metrics()  # an installed package may have it
    if key in MEASURES or key in own_metrics:
        return MEASURES.get(key) or own_metrics[key]
    family = FAMILIES.get(key.partition("_")[0])
    return replace(MEASURES[family], key=key, label=key) if family else Measure(key, key, None)


def register(metric: Metric) -> Metric:
    """Add a metric; raise AwError if its key is unfit for a table or taken, or a field is wrong."""
    if not isinstance(metric, Metric):
        raise AwError(f"{metric!r} is no Metric: see 'Your own metric' in docs/metrics.md")
    if not re.fullmatch(r"[a-z][a-z0-9_.]{0,60}", metric.key) or metric.key.startswith("cost_"):
        raise AwError(f"{metric.key[:60]!a} cannot name a metric: lower case, digits, '_' and '.'")
    if metric.key in MEASURES:
        raise AwError(f"metric {metric.key!r} is built in: give yours another key")
    for field, value, right, form in (
        ("better", metric.better, metric.better in get_args(Better), "'higher', 'lower' or None"),
        (
            "digits",
            metric.digits,
            type(metric.digits) is int and metric.digits in range(100),
            "a whole number",
        ),
        (
            "needs",
            metric.needs,
            type(metric.needs) is tuple and {*metric.needs} <= {"photo", "view", "scene"},
            "a tuple of 'photo', 'view', 'scene', e.g. ('photo',)",
        ),
    ):
        if not right:
            raise AwError(f"metric {metric.key!r}: {field} is {value!r}: write {form}")
    own_metrics[metric.key] = replace(metric, label=f"{metric.label} {metric.unit}".strip(), unit="")
    return metric


_files: dict[str, Path] = {}  # key of a user's metric -> the file that it was loaded from


def load_metrics(path: Path) -> None:
    """Register every `Metric` of a Python file; raise AwError if it has none, or a wrong one."""
    module, digest = import_file(path)
    in_file = [value for value in vars(module).values() if isinstance(value, Metric)]
    if not in_file:
        raise AwError(f"{path} holds no Metric: see 'Your own metric' in docs/metrics.md")
    for metric in in_file:
        known, other = own_metrics.get(metric.key), _files.get(metric.key)
        if known is not None and known.function and other not in (None, path.resolve()):
            raise AwError(f"{other} and {path} both hold a metric {metric.key!r}: give one another key")
        _files[metric.key] = path.resolve()
        register(replace(metric, source=digest))


def users_metrics() -> dict[str, Metric]:
    """Return the user's metrics that can be computed, by key."""
    return {key: m for key, m in metrics().items() if key not in MEASURES}


def check_user_metrics(scene: Scene) -> None:
    """Raise AwError if a user's metric fails on a test photo against itself; called before training."""
    for view in scene.test[:1] if (mine := users_metrics()) else ():
        photo = read_png_rgb(view.image_path)
        for key, why in measure_images([(view.name, photo, photo)], mine.values(), scene)[1].items():
            raise AwError(f"metric {key}: {why}")


class MetricRecord(TypedDict):
    """The record of a user's metric in a result."""

    label: str
    better: Better
    digits: Annotated[int, Meta(ge=0, le=99)]
    partial: bool
    source: str  # sha256 of its file; empty for a package's


def records(keys: Iterable[str]) -> dict[str, MetricRecord]:
    """Return the records of the user's metrics among these keys."""
    fields, mine = MetricRecord.__annotations__, users_metrics()
    return {k: cast(MetricRecord, {f: getattr(mine[k], f) for f in fields}) for k in keys if k in mine}


def register_columns(in_result: Mapping[str, MetricRecord]) -> None:
    """Register the columns of a result's own metrics from their records, without functions."""
    for key in in_result.keys() - MEASURES:
        fields = {k: v for k, v in in_result[key].items() if k in MetricRecord.__annotations__}
        own_metrics.setdefault(key, Metric(key, function="", **fields))  # type: ignore[arg-type]


class ImageRow(TypedDict, total=False):
    """Metrics of one test image, PSNR and others (see `metrics_of`); None = undefined there."""

    name: Required[str]  # of the test view
    psnr: float | None


def _value_or_error(metric: Metric, **image: Any) -> float | AwError:
    try:
        return metric.value(**image)
    except AwError as error:
        return error


def measure_images(
    pictures: Iterable[tuple[str, np.ndarray, np.ndarray]],
    metrics: Collection[Metric],
    scene: Scene,
    *,
    half: bool = False,
    around: Callable[[], AbstractContextManager[int]] = lambda: nullcontext(1),
) -> tuple[list[ImageRow], dict[str, str]]:
    """Measure pictures; return their rows, and why metrics are missing: after an AwError, for all images.

    Args:
        pictures: (name of a test view, render, photo), both [H, W, 3] uint8.
        metrics: what to measure.
        scene: the scene of the test views.
        half: measure the right halves alone.
        around: context in which the metrics of a picture are computed; it says how many at a time, where the
            memory allows it.

    Raises:
        AwError: a render differs from its photo in size.
    """
    views = {view.name: view for view in scene.test}
    rows: list[dict[str, str | float]] = []
    missing: dict[str, str] = {}
    for name, *pair in pictures:
        if pair[0].shape != pair[1].shape:
            raise AwError(f"the render of {name} differs from its photo in size: render at the photo's size")
        left = pair[1].shape[1] // 2 if half else 0
        render, photo = (np.ascontiguousarray(picture[:, left:]) for picture in pair)
        wanted = [metric for metric in metrics if metric.key not in missing]
        value = partial(_value_or_error, render=render, photo=photo, view=views[name], scene=scene)
        with around() as threads:
            values = list(in_order(value, wanted, min(threads, photo_threads(photo.size, BYTES_A_CODE))))
        rows.append({"name": name})
        for metric, result in zip(wanted, values):
            if isinstance(result, AwError):
                missing[metric.key] = str(result)
            elif not (metric.partial and math.isnan(result)):
                rows[-1][metric.key] = result
    return [cast(ImageRow, {k: v for k, v in row.items() if k not in missing}) for row in rows], missing
