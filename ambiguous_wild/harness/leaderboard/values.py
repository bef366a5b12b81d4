"""Refuse numbers that no measurement can give, and results that lack a required number."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.harness.running.records import RunResult, metrics_of
from ambiguous_wild.harness.running.result_file import RESULT
from ambiguous_wild.harness.running.store import MASK_SCORES
from ambiguous_wild.metrics.image import METRICS

# Lowest and highest value by the first word of a metric's name; PSNR of pictures in [0, 1] is not negative.
RANGES = {
    "psnr": (0.0, math.inf),
    "ssim": (-1.0, 1.0),
    "flip": (0.0, 1.0),
    "lpips": (0.0, math.inf),
}
ROUNDING = 1e-9  # by which a share computed in floats may leave its range


def check_values(run: Path, result: RunResult, *, photos: bool) -> None:
    """Refuse what cannot have been measured.

    Args:
        run: the run folder, for messages.
        result: of the run.
        photos: the test photos are at hand, and tell whether an infinite PSNR is right.

    Raises:
        AwError: a metric of every run that is not there, a number outside its range, or a cost below zero.
    """
    rows = result["per_image"]
    for metric in METRICS:
        # No reason excuses it: these need nothing but the two pictures.
        lacking = [row["name"] for row in rows if metrics_of(row).get(metric) is None]
        if lacking:
            raise AwError(
                f"{run} is partial: no {metric} of {shortlist(lacking)}, which every run measures; restore "
                f"{RESULT}, or run it again with 'aw bench --overwrite always'"
            )
    for row in rows:
        for metric, value in metrics_of(row).items():
            if value is not None:
                _check_metric(run, f"{metric} of {row['name']}", metric, value, photos)
    masks: Mapping[str, Any] = result["masks"] or {}
    for name in MASK_SCORES:
        if masks.get(name) is not None and not 0.0 <= masks[name] <= 1.0 + ROUNDING:
            _impossible(run, f"masks.{name}", masks[name], "is a share, from 0 to 1")
    for name, amount in result["cost"].items():
        if isinstance(amount, (int, float)) and not (math.isfinite(amount) and amount >= 0):
            _impossible(run, f"cost.{name}", amount, "is finite and not below 0")


def _check_metric(run: Path, what: str, metric: str, value: float, photos: bool) -> None:
    family = metric.partition("_")[0]
    low, high = RANGES.get(family, (-math.inf, math.inf))
    if not low - ROUNDING <= value <= high + ROUNDING:
        _impossible(run, what, value, f"lies between {low:g} and {high:g}")
    if math.isinf(value) and not (family == "psnr" and photos):
        why = (
            "is infinite only where picture and photo are equal, and the photos are not at hand: name them "
            "with --scenes"
            if family == "psnr"
            else "is finite"
        )
        _impossible(run, what, value, why)


def _impossible(run: Path, what: str, value: float, why: str) -> NoReturn:
    raise AwError(
        f"{run} was changed: {what} is {value:g} in {RESULT}, such a number {why}; restore {RESULT}, or "
        "run it again with 'aw bench --overwrite always'"
    )
