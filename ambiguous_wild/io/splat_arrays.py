"""Shared by the splat formats: Gaussians as arrays, quantisation, order along a space-filling curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ambiguous_wild.core import UNMOVED, SceneTransform

Arrays = Mapping[str, np.ndarray]  # raw parameters as `io.ply.read_splat_ply` gives them
SH_C0 = 0.28209479177387814
_NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest")
_OTHERS = np.array([[j for j in range(4) if j != i] for i in range(4)])  # of four components, all but one
_MAX_LOGIT = 15.0  # its sigmoid is 3e-7 below 1; formats that store alpha cannot hold an infinite logit


@dataclass(frozen=True)
class SplatFile:
    """Content of a splat file."""

    gaussians: dict[str, np.ndarray]  # raw parameters, see `io.ply.read_splat_ply`
    transform: SceneTransform = UNMOVED  # transform of the scene in whose coordinates they are
    antialias: bool = False  # whether the file says that it is drawn with Mip-Splatting's filter
    left_out: int = 0  # number of Gaussians with values that are not finite


def finite(gaussians: Arrays) -> dict[str, np.ndarray]:
    """Return the Gaussians that can be drawn, with quaternions of norm 1.

    Rows with a value that is not finite are left out; an opacity of exactly 0 or 1 (infinite logits) stays.
    """
    # exact 0 and 1 as converters of 8-bit alpha write them
    logits = np.nan_to_num(gaussians["opacity_logits"], nan=np.nan, posinf=_MAX_LOGIT, neginf=-_MAX_LOGIT)
    gaussians = {**gaussians, "opacity_logits": logits}
    sound = np.ones(len(gaussians["means"]), bool)
    for name in _NAMES:
        sound &= np.isfinite(gaussians[name]).all(axis=tuple(range(1, gaussians[name].ndim)))
    norm = np.linalg.norm(gaussians["quats"].astype(np.float64), axis=1)
    sound &= norm > 0
    kept = {name: np.asarray(gaussians[name], np.float32) for name in _NAMES}
    if not sound.all():  # else there is nothing to copy
        kept, norm = {name: values[sound] for name, values in kept.items()}, norm[sound]
    kept["quats"] = (kept["quats"] / norm[:, None]).astype(np.float32)
    return kept


def sigmoid(logits: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-logits.astype(np.float64)))


def logit(alpha: np.ndarray) -> np.ndarray:
    """Return the inverse of the sigmoid, clamped to finite values."""
    with np.errstate(divide="ignore"):
        logits = np.log(alpha) - np.log1p(-alpha.astype(np.float64))
    return np.clip(logits, -_MAX_LOGIT, _MAX_LOGIT).astype(np.float32)


def rounded(
    values: np.ndarray,
    most: int,  # largest code
) -> np.ndarray:  # int64 in [0, most]
    """Round to the nearest codes."""
    return np.clip(np.floor(values.astype(np.float64) + 0.5), 0, most).astype(np.int64)


def morton_order(means: np.ndarray) -> np.ndarray:
    """Order rows along a Morton curve of 10 bits an axis: neighbours in space become neighbours in the file.

    The scene comes first, then Gaussians more than 4, 16, 64 times as far out as the median: a format with
    one range for 256 rows would otherwise give rows of the scene the range of a skybox.
    """
    if not len(means):
        return np.zeros(0, np.intp)
    low, high = np.quantile(means.astype(np.float64), (0.25, 0.75), axis=0)
    half = 0.5 * float((high - low).max())
    x = (means - 0.5 * (low + high)) / (half or 1.0)
    out = np.log(np.abs(x).max(axis=1).clip(min=1.0)) / np.log(4.0)
    shell = np.floor(out).clip(max=15.0)
    cells = np.clip((x / 4.0 ** (shell[:, None] + 1.0) + 1.0) * 511.5, 0, 1023).astype(np.uint64)
    code = shell.astype(np.uint64) << np.uint64(30)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def largest_first(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index [N] of the largest component, and the others [N, 3], signed to make it positive."""
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    signed = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    return largest, np.take_along_axis(signed, _OTHERS[largest], axis=1)


def from_largest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the quaternions [N, 4] for a result of `largest_first`."""
    quats = np.empty((len(largest), 4))
    np.put_along_axis(quats, _OTHERS[largest], others, axis=1)
    rest = np.sqrt(np.clip(1.0 - (others**2).sum(axis=1), 0.0, None))
    quats[np.arange(len(largest)), largest] = rest
    return quats


def checked_transform(offset: Sequence[float], scale: float, quat: Sequence[float]) -> SceneTransform:
    """Return the transform that a file records.

    Raises:
        ValueError: the numbers are invalid.
    """
    (x, y, z), (a, b, c, d) = offset, quat
    if not (scale > 0 and np.isfinite([x, y, z, scale, a, b, c, d]).all() and any(quat)):
        raise ValueError("invalid transform")
    return SceneTransform(
        (float(x), float(y), float(z)), float(scale), (float(a), float(b), float(c), float(d))
    )


def transform_record(transform: SceneTransform) -> dict[str, float | list[float]]:
    """Return the transform as written to files: the user's coordinates are positions / scale + offset."""
    if transform == UNMOVED:
        return {}
    rotation = {} if transform.quat == UNMOVED.quat else {"rotation": list(transform.quat)}
    return {"offset": list(transform.centre), "scale": transform.scale, **rotation}


def transform_from(facts: Any) -> SceneTransform:
    """Return the transform for a result of `transform_record`; `UNMOVED` for anything else."""
    try:
        return checked_transform(facts["offset"], facts["scale"], facts.get("rotation", UNMOVED.quat))
    except (KeyError, TypeError, ValueError, AttributeError):
        return UNMOVED
