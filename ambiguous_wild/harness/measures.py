"""What can be measured of a run, as data: metrics of test images, built in or of one's own, masks and cost.

A metric of one's own is a `Metric` in a file (`--metric-file my_metric.py`) or of a package (entry points
`ambiguous_wild.metrics`). Its record is kept in each result, so that tables need neither.
"""

from __future__ import annotations

import importlib.metadata
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Required, TypedDict, cast, get_args

import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.methods.entry import resolve
from ambiguous_wild.methods.references import import_file, place_of

if TYPE_CHECKING:
    from ambiguous_wild.core import Scene

Better = Literal["higher", "lower", None]  # None: not ranked


@dataclass(frozen=True)
class Measure:
    """A column: how it is called, which way is better, how many digits are shown."""

    key: str  # as in the result file
    label: str
    better: Better
    digits: int = 3
    per_image: bool = True  # else one number a run
    timed: bool = False  # a busy machine changes it: ranked only between runs that were alone
    partial: bool = False  # of some pixels: an image without such has no value, and is no gap in a mean

    @property
    def quality(self) -> bool:
        """Whether it says how good the result is; the others say what it costs."""
        return self.per_image or self.key.startswith("mask_")


@dataclass(frozen=True, kw_only=True)
class Metric(Measure):
    """A measure of a test image, with the function that computes it.

    `function` gets the render and what `needs` names, in that order, and returns a number. Pictures are
    [H, W, 3] uint8. NaN = this image has none. An AwError says why no image has one, e.g. missing weights.
    """

    function: str | Callable[..., float]  # "module:function" for ours
    needs: tuple[Literal["photo", "view", "scene"], ...] = ("photo",)  # () = judges the render alone
    unit: str = ""  # stands behind the label
    low: float = -math.inf  # of its range
    high: float = math.inf
    infinite: bool = False  # inf for equal pictures is right
    # by which a value may differ when it is computed again; None: it is not, as that takes a network
    tolerance: float | None = 1e-6
    source: str = ""  # sha256 of its file

    def value(self, render: np.ndarray, given: Mapping[str, Any]) -> float:
        """Of one image; `given`: its photo, view and scene. AwError: it cannot have it; names the line."""
        try:
            value = resolve(self.function)(render, *(given[name] for name in self.needs))
            if np.ndim(value) or value is None:
                raise AwError(f"it returned {type(value).__name__}, not one number")
            return float(value)
        except Exception as error:
            if isinstance(self.function, str) or isinstance(error, AwError):
                raise
            raise AwError(f"{type(error).__name__}: {error}{place_of(error)}") from error


def _psnr(key: str, label: str, function: str, **more: Any) -> Metric:
    return Metric(key, label, "higher", 2, function=function, low=0.0, infinite=True, **more)


def _region(key: str, label: str, tolerance: float = 1e-6) -> Metric:
    function = f"ambiguous_wild.harness.regions:{key}"
    return _psnr(key, label, function, needs=("photo", "view", "scene"), partial=True, tolerance=tolerance)


def _lpips(key: str, label: str) -> Metric:
    function = f"ambiguous_wild.metrics.lpips:{key}"
    return Metric(key, label, "lower", function=function, low=0.0, tolerance=None)


_IMAGE = "ambiguous_wild.metrics.image:"
# dB. Which pixels are covered is computed too: rounding may move one over the threshold.
_REGION_DB = 1e-2

MASK_LABELS = {"iou": "IoU", "precision": "precision", "recall": "recall"}
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
        *(Measure(f"mask_{k}", f"mask {v}", "higher", per_image=False) for k, v in MASK_LABELS.items()),
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
ALWAYS = ("psnr", "ssim", "lpips_alex")  # shown even where missing: the reason stands below the table
COST = ("train_s", "reference_s", "ms_per_iteration", "fps", "gaussians", "model_mb")
# A metric that is not known takes everything but its name from its family: psnr_distractor is a PSNR.
FAMILIES = {"psnr": "psnr", "ssim": "ssim", "lpips": "lpips_alex"}

own_metrics: dict[str, Metric] = {}  # registered; without a function: as a result that was read describes it


@cache
def _installed() -> dict[str, Metric]:
    return {
        point.name: point.load() for point in importlib.metadata.entry_points(group="ambiguous_wild.metrics")
    }


def metrics() -> dict[str, Metric]:
    """Every metric that can be computed, by key: built in, registered, installed as entry points."""
    for key, metric in _installed().items():
        if key not in own_metrics or not own_metrics[key].function:  # what a result describes has none
            register(metric)
    return {k: m for k, m in (MEASURES | own_metrics).items() if isinstance(m, Metric) and m.function}


def measure(key: str) -> Measure:
    """The column of that key; of one that is not known what its family tells."""
    if key not in MEASURES and key not in own_metrics:
        metrics()  # an installed package may have it
    if key in MEASURES or key in own_metrics:
        return MEASURES.get(key) or own_metrics[key]
    family = FAMILIES.get(key.partition("_")[0])
    return replace(MEASURES[family], key=key, label=key) if family else Measure(key, key, None)


def register(metric: Metric) -> Metric:
    """Add a metric; AwError where its key cannot stand in a table or is taken, or a field is wrong."""
    if not isinstance(metric, Metric):
        raise AwError(f"{metric!r} is no Metric: see 'Your own metric' in docs/metrics.md")
    if not re.fullmatch(r"[a-z][a-z0-9_.]{0,60}", metric.key) or metric.key.startswith("cost_"):
        raise AwError(f"{metric.key[:60]!a} cannot name a metric: lower case, digits, '_' and '.'")
    if metric.key in MEASURES:
        raise AwError(f"metric {metric.key!r} is one of ours: give yours another key")
    for field, value, right, form in (
        ("better", metric.better, metric.better in get_args(Better), "'higher', 'lower' or None"),
        ("digits", metric.digits, type(metric.digits) is int and metric.digits >= 0, "a whole number"),
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


def load_metrics(path: Path) -> None:
    """Register every `Metric` of a Python file; AwError where it has none, or one that is refused."""
    found = [value for value in vars(import_file(path)).values() if isinstance(value, Metric)]
    if not found:
        raise AwError(f"{path} holds no Metric: see 'Your own metric' in docs/metrics.md")
    for metric in found:
        register(replace(metric, source=sha256_file(path)))


def own() -> dict[str, Metric]:
    """Metrics that can be computed here and are not of this package."""
    return {key: m for key, m in metrics().items() if key not in MEASURES}


def try_own(scene: Scene) -> None:
    """Raise AwError if a metric of one's own fails on a test photo against itself, before training."""
    for view in scene.test[:1] if (mine := own()) else ():
        photo = read_png_rgb(view.image_path)
        for key, why in measure_images([(view.name, photo, photo)], mine.values(), scene)[1].items():
            raise AwError(f"metric {key}: {why}")


class MetricRecord(TypedDict):
    """What a result keeps of a metric that is not of this package."""

    label: str
    better: Better
    digits: int
    partial: bool
    source: str  # sha256 of its file; empty for a package's


def records(keys: Iterable[str]) -> dict[str, MetricRecord]:
    """Of the own metrics among these."""
    fields, mine = MetricRecord.__annotations__, own()
    return {k: cast(MetricRecord, {f: getattr(mine[k], f) for f in fields}) for k in keys if k in mine}


def remember(known: Mapping[str, MetricRecord]) -> None:
    """Name the columns of a result's metrics as the run that measured them did."""
    for key in known.keys() - MEASURES:
        own_metrics.setdefault(key, Metric(key, function="", **known[key]))


class ImageRow(TypedDict, total=False):
    """Metrics of one test image, PSNR and others (see `metrics_of`); None = undefined there."""

    name: Required[str]  # of the test view
    psnr: float | None


def measure_images(
    pictures: Iterable[tuple[str, np.ndarray, np.ndarray]],
    metrics: Collection[Metric],
    scene: Scene,
    *,
    half: bool = False,
    around: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> tuple[list[ImageRow], dict[str, str]]:
    """Rows of metrics, and why a metric that refuses one image is missing for all; measured in `around()`.

    `pictures`: name of a test view, render, photo, [H, W, 3] uint8; `half`: their right halves alone.
    """
    views = {view.name: view for view in scene.test}
    rows: list[dict[str, Any]] = []
    missing: dict[str, str] = {}
    for name, *pair in pictures:
        if pair[0].shape != pair[1].shape:
            raise AwError(f"the render of {name} is not of its photo's size: render at the photo's size")
        left = pair[1].shape[1] // 2 if half else 0
        render, photo = (np.ascontiguousarray(picture[:, left:]) for picture in pair)
        given = {"photo": photo, "view": views[name], "scene": scene}
        rows.append({"name": name})
        for metric in metrics:
            try:
                with around():
                    value = math.nan if metric.key in missing else metric.value(render, given)
            except AwError as error:
                missing[metric.key] = str(error)
            else:
                if not (metric.partial and math.isnan(value)):
                    rows[-1][metric.key] = value
    return [cast(ImageRow, {k: v for k, v in row.items() if k not in missing}) for row in rows], missing
