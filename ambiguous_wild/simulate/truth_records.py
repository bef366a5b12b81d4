"""Records that the simulator writes as JSON, with the keys below."""

from __future__ import annotations

from typing import NotRequired, TypedDict

import numpy as np

from ambiguous_wild.core.scene import Evaluation

Summary = dict[str, float]  # mean, min and max of a figure over the training photos


class DrawnEffects(TypedDict, total=False):
    """Random values of the effects of one photo; effects that the spec does not name are absent."""

    time_of_day: dict[str, float]  # hour: -1 morning, 0 noon, 1 evening
    specular: dict[str, float]  # empty: the same in all photos
    moving_shadow: dict[str, list[list[float]]]  # lobes, each x, y, radius, m
    lens_distortion: dict[str, float]  # k1, k2, as in COLMAP's RADIAL camera
    rolling_shutter: dict[str, list[float] | float]  # deg_s in camera axes, readout_s
    motion_blur: dict[str, float]  # exposure_s, length_px
    defocus: dict[str, float]  # radius_px; 0 = sharp
    vignetting: dict[str, float]  # falloff
    exposure_drift: dict[str, float]  # stops
    white_balance: dict[str, list[float]]  # gains: red, green, blue
    iso_noise: dict[str, float]  # iso
    jpeg: dict[str, int]  # quality


class PlacedDistractor(TypedDict):
    """One distractor in one photo: `distractors.DistractorPose` with its name and its share of the photo."""

    distractor: str
    occlusion: float
    which: int
    x_m: float
    y_m: float
    yaw_deg: float
    pose: float


class PhotoTruth(TypedDict):
    """Truth of one training photo."""

    occlusion: float  # share of the pixels that show a distractor
    distractors: list[PlacedDistractor]
    shadow: NotRequired[float]  # share of the pixels that a moving shadow darkens
    effects: NotRequired[DrawnEffects]


def summary(shares: list[float]) -> Summary:
    """Summarise a share over the training photos."""
    return {"mean": float(np.mean(shares)), "min": min(shares), "max": max(shares)}


class CaptureTruth(TypedDict):
    """truth/capture.json."""

    schema: int
    preset: str
    seed: int
    identity: str  # hash of spec, seed and code
    version: dict[str, str]
    spec: dict[str, object]  # as in a YAML spec
    designed: dict[str, object]  # `spec.ExpectedAmbiguity`
    mask: str  # what the masks mark, in words
    clean: str
    test: str
    occlusion: Summary
    objects: list[str]  # static objects, numbered from 1 in truth/objects
    photos: dict[str, PhotoTruth]
    licence: str
    evaluation: NotRequired[Evaluation]  # of captures whose photos differ in colour
    files: NotRequired[dict[str, str]]  # path -> sha256, added last


class SimulatedCapture(CaptureTruth):
    """`CaptureTruth`, and whether an existing capture was reused."""

    reused: bool
