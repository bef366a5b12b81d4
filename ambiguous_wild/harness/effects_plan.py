"""Decide which effects a scene needs, from evidence that needs no training, and keep the plan as JSON.

The evidence comes from the sparse model and the colours of the photos at its points. Every function that
measures it returns a number, NaN where the scene has too little data; `decide` compares them with thresholds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from ambiguous_wild.core import AwError, Camera, Scene
from ambiguous_wild.splat.effects.tracks import TrackColours, log_gains, track_colours

MIN_OBSERVATIONS = 50  # observations; fewer give no evidence
MIN_VIEWS = 6  # photos of a point, to fit four numbers to its colour
OUTLYING = 4.5  # median deviations from a point's median colour: three standard deviations of noise
RELIT = 0.5  # share of a photo's points far from their median colours above which it counts as relit
MIN_APART = 1e-3  # spread of cameras over the depth they look at; below, they are all at one place
MIN_SPREAD = 0.01  # of the colour range, or of the logarithm: smallest median deviation that is used
MAX_FITTED_POINTS = 20_000  # number of points whose view dependence is fitted; more do not change a median
SCHEMA = 1
# Thresholds, set on tracks with and without the injected effect (tests/harness/test_planning.py), on
# presets and on real captures.
EXPOSURE = 0.05
APPEARANCE = 0.043
# A highlight is not linear in the direction. Its remainder, up to 1.7 times its linear part in the tests,
# must not be taken for light that differs by place.
OF_SHINE = 1.7
SAMPLING = 1.5
# cameras around an object have 0.07 to 0.93, a drone's side by side 1.04, those in the middle of a yard 7.1;
# for the last a dense start of 30 photos was better
OUTWARD = 2.0
# captures of 9 to 20 photos gained SSIM by a dense start, those of 30 did not
MIN_PHOTOS, FEW_PHOTOS = 3, 24


@dataclass(frozen=True)
class Evidence:
    """The measurements of a scene, each in the unit of its threshold; NaN = too little data."""

    exposure: float  # spread of the photos' gains, as a share of the colour range
    appearance: float  # spread at a point after a gain per photo, as a share of the colour range
    sampling: float  # size of a pixel on the scene, coarsest photo over finest
    view_dependence: float  # median amplitude of colour that follows the direction, of the colour range
    observations: int  # number in train photos that are usable for colour
    photos: int = 0  # number of train photos; 0 = not counted
    outward: float = math.nan  # spread of the places that train cameras look at, over that of the cameras


def measure_evidence(scene: Scene, photos: Iterable[np.ndarray]) -> Evidence:
    """Measure all evidence.

    Args:
        scene: a scene with tracks.
        photos: the photos of its train views, [H, W, 3] in [0, 1].
    """
    colours = track_colours(scene, photos)
    gains = log_gains(colours, len(scene.train))
    enough = len(colours.point) >= MIN_OBSERVATIONS
    grey = colours.rgb.mean(axis=1) / np.exp(gains[colours.view].mean(axis=1))
    # variances in the colour range and in logarithms, explained by direction and left
    (in_codes, _), (_, in_logs) = (_fit_points(scene, colours, v) for v in (grey, np.log(grey)))
    return Evidence(
        exposure=exposure_spread(colours, gains) if enough else np.nan,
        appearance=_typical_spread(in_logs),
        sampling=sampling_ratio(scene),
        view_dependence=_typical_spread(in_codes),
        observations=len(colours.point),
        photos=len(scene.train),
        outward=outward_ratio(scene),
    )


def has_tracks(scene: Scene) -> bool:
    """Return whether enough observations of points are known; without them no photo need be read."""
    return bool((scene.points.track_views >= 0).sum() >= MIN_OBSERVATIONS)


def exposure_spread(colours: TrackColours, gains: np.ndarray) -> float:
    """Return the standard deviation of log gain between photos that see the same point, rms over channels.

    Photos without a common point are not compared: along a strip of photos small errors add up from
    neighbour to neighbour.
    """
    counts = np.bincount(colours.point)
    rows = counts[colours.point] >= 2
    if not rows.any():
        return float("nan")
    point, values = colours.point[rows], gains[colours.view[rows]]
    n = counts[point][:, None]
    mean = np.stack([np.bincount(point, values[:, c], len(counts))[point] for c in range(3)], axis=1) / n
    return float(np.sqrt(((values - mean) ** 2 * n / (n - 1)).mean()))


def sampling_ratio(scene: Scene) -> float:
    """Return the 95th over the 5th percentile, over train photos, of the size of a pixel on the scene.

    A pixel covers depth / focal length; the depth of a photo is the median over its points.
    """
    sizes = [depth / (0.5 * (camera.fx + camera.fy)) for camera, depth in _looking_at(scene)]
    if len(sizes) < 3:
        return float("nan")
    low, high = np.percentile(sizes, [5, 95])
    return float(high / low)


def outward_ratio(scene: Scene) -> float:
    """Return the spread of the places that train cameras look at, over that of the cameras themselves.

    It is near 0 for cameras around an object, 1 for cameras that look the same way, and large for cameras in
    the middle of a place. A camera looks at the point of its axis at the median depth of its points. NaN if
    all cameras are at one place.
    """
    looking = _looking_at(scene)
    if len(looking) < 3:
        return float("nan")
    cameras = np.array([camera.center for camera, _ in looking])
    places = cameras + [depth * camera.cam_from_world[2, :3] for camera, depth in looking]
    # the root of the summed variances does not depend on the axes of the world
    apart, between = (float(np.sqrt(a.var(axis=0).sum())) for a in (cameras, places))
    depth = float(np.median([depth for _, depth in looking]))
    return between / apart if apart > MIN_APART * depth else float("nan")


def _looking_at(scene: Scene) -> list[tuple[Camera, float]]:
    """Return the train cameras that see five points or more, each with the median depth of its points."""
    owner, cameras = scene.points.owners, []
    for index, view in enumerate(scene.views):
        if view.split == "train":
            xyz = scene.points.xyz[owner[scene.points.track_views == index]]
            depth = view.camera.to_camera(xyz)[:, 2]
            depth = depth[depth > 0]
            if len(depth) >= 5:
                cameras.append((view.camera, float(np.median(depth))))
    return cameras


def _fit_points(scene: Scene, colours: TrackColours, values: np.ndarray) -> np.ndarray:
    """Fit colour as linear in the viewing direction, by least squares, for points in six photos or more.

    A fit explains some noise too; that share is subtracted (adjusted coefficient of determination).

    Returns:
        [2, P]: the variance that the direction explains beyond chance, about zero without view dependence;
        the unbiased variance of the rest.
    """
    order = np.argsort(colours.point, kind="stable")
    point, view, values = colours.point[order], colours.view[order], values[order]
    starts = np.flatnonzero(np.r_[True, point[1:] != point[:-1]])
    sizes = np.diff(np.r_[starts, len(point)])
    chosen = np.flatnonzero(sizes >= MIN_VIEWS)
    if len(chosen) > MAX_FITTED_POINTS:
        chosen = np.random.default_rng(0).choice(chosen, MAX_FITTED_POINTS, replace=False)
    centres = np.array([v.camera.center for v in scene.train])
    groups = [starts[k] + np.arange(sizes[k]) for k in chosen]
    fits = []
    for rows in _without_outliers(groups, values, view):
        if len(rows) < MIN_VIEWS:
            continue
        direction = centres[view[rows]] - scene.points.xyz[point[rows[0]]]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        fits.append(_fit(direction, values[rows]))
    return np.array(fits).reshape(-1, 2).T


def _without_outliers(groups: Sequence[np.ndarray], values: np.ndarray, view: np.ndarray) -> list[np.ndarray]:
    """Return for each point the rows whose colour is near the point's median colour.

    A colour far from the median shows something in front of the point. But if most colours of a photo are
    far, the light of that photo differs, and its rows are kept.
    """
    if not groups:
        return []
    far = []
    for rows in groups:
        apart = np.abs(values[rows] - np.median(values[rows]))
        far.append(apart > OUTLYING * max(float(np.median(apart)), MIN_SPREAD))
    of_photo = view[np.concatenate(groups)]
    count = np.maximum(np.bincount(of_photo), 1)
    relit = np.bincount(of_photo, np.concatenate(far)) > RELIT * count
    return [rows[~outlying | relit[view[rows]]] for rows, outlying in zip(groups, far)]


def _fit(direction: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    n = len(values)
    # directions within a narrow arc are nearly equal: axes that they do not span are left out of the fit
    axes, spread, _ = np.linalg.svd(direction - direction.mean(axis=0), full_matrices=False)
    rank = int((spread > 0.05 * np.sqrt(n)).sum())
    centred = values - values.mean()
    explained = axes[:, :rank] @ (axes[:, :rank].T @ centred)
    variance = float(((centred - explained) ** 2).sum()) / (n - 1 - rank)
    return float(centred @ centred) / (n - 1) - variance, variance


def _typical_spread(variances: np.ndarray) -> float:
    """Return the root of the median over points; NaN for fewer than ten."""
    return float(np.sqrt(max(np.median(variances), 0.0))) if len(variances) >= 10 else float("nan")


DecisionState = Literal["on", "off", "unknown"]


@dataclass(frozen=True)
class Decision:
    """One line of the plan."""

    effect: str
    evidence: str  # what was measured, in words
    value: float  # NaN: it could not be measured
    threshold: float
    unit: str  # empty: another decision decides
    decision: DecisionState
    why: str
    how: str  # the option that switches the effect
    cost_ms: float | None = None  # extra ms per iteration; None: not measured
    gain_db: float | None = None  # on pixels left out of training; None: not tried
    error_db: float | None = None  # standard error of the gain over the photos

    def plain(self) -> dict[str, object]:
        """Return the fields for JSON, with None instead of NaN."""
        value = None if math.isnan(self.value) else self.value
        return {**self.__dict__, "value": value}


@dataclass(frozen=True)
class EffectsPlan:
    """The effects that a scene needs, with the evidence for each."""

    scene: str
    decisions: tuple[Decision, ...]
    probed: bool = False  # a render was made, so the plan has lines on masks
    scene_hash: str = ""  # `scene_identity`; "": not recorded

    def __repr__(self) -> str:
        return f"Plan({self.scene}: --effects {','.join(self.effects()) or 'none'})"

    def effects(self, among: Iterable[str] | None = None) -> tuple[str, ...]:
        """Return the names of effects to switch on, for `--effects`; with `among`, only those in it."""
        on = [d for d in self.decisions if d.decision == "on" and d.how.startswith("--effects ")]
        names = [d.how.removeprefix("--effects ") for d in on]
        return tuple(name for name in names if among is None or name in tuple(among))

    def plain(self) -> dict[str, object]:
        """Return the plan as it is written to files."""
        return {
            "schema": SCHEMA,
            "scene": self.scene,
            "scene_hash": self.scene_hash,
            "probed": self.probed,
            "effects": list(self.effects()),
            "decisions": [d.plain() for d in self.decisions],
        }

    def with_costs(self, costs: dict[str, float]) -> EffectsPlan:
        """Return the plan with the extra ms per iteration of each effect, by its name for `--effects`."""
        lines = (
            replace(d, cost_ms=costs.get(d.how.removeprefix("--effects "), d.cost_ms)) for d in self.decisions
        )
        return replace(self, decisions=tuple(lines))


def decision_for(value: float, threshold: float) -> DecisionState:
    """Return "on" from the threshold up, "off" below it, "unknown" for NaN."""
    if math.isnan(value):
        return "unknown"
    return "on" if value >= threshold else "off"


def decide(scene: str, evidence: Evidence) -> EffectsPlan:
    """Return the plan that follows from the evidence alone."""
    shine = 0.0 if math.isnan(evidence.view_dependence) else OF_SHINE * evidence.view_dependence
    by_place = evidence.appearance - min(shine, evidence.appearance)  # NaN stays NaN
    appearance = decision_for(by_place, APPEARANCE)
    exposure = decision_for(evidence.exposure, EXPOSURE)
    exposure_why = (
        "a gain per photo explains it" if exposure == "on" else "the photos are about equally bright"
    )
    if appearance == exposure == "on":
        exposure_why = "the appearance embedding includes it"
    antialias = decision_for(evidence.sampling, SAMPLING)
    dense = _dense_start(evidence)
    lines: tuple[Decision, ...] = (
        Decision(
            "appearance", "spread at a point after gain and shine", by_place,
            APPEARANCE, "of the colour range", appearance,
            "light differs by place" if appearance == "on" else "not above texture and noise",
            "--effects appearance",
        ),
        Decision(
            "exposure", "spread of the photos' gains at the same points", evidence.exposure, EXPOSURE,
            "of the colour range", "off" if appearance == exposure == "on" else exposure, exposure_why,
            "--effects exposure",
        ),
        Decision(
            "antialias", "pixel size on the scene, coarsest over finest photo", evidence.sampling, SAMPLING,
            "times", antialias,
            "photos from near and far" if antialias == "on" else "all photos have about the same resolution",
            "--effects antialias",
        ),
        _skybox(dense),
        dense,
    )  # fmt: skip
    too_few = f"{evidence.observations} observations of SfM points are too few to decide"
    lines = tuple(replace(d, why=too_few) if d.decision == "unknown" else d for d in lines)
    return EffectsPlan(scene, lines)


def _dense_start(evidence: Evidence) -> Decision:
    """Decide on a dense start: on for few photos, and for cameras in the middle of a place.

    It is unknown without a measured exposure: where exposures differed unnoticed, test PSNR fell.
    """
    photos = evidence.photos
    few, middle = photos <= FEW_PHOTOS, evidence.outward > OUTWARD
    measured = photos >= MIN_PHOTOS and not math.isnan(evidence.exposure)
    decision: DecisionState = "unknown" if not measured else "on" if few or middle else "off"
    if middle and not few:
        return Decision(
            "dense", "spread of the places looked at, over that of the cameras", evidence.outward, OUTWARD,
            "times", decision, "the cameras look outward", "--effects dense",
        )  # fmt: skip
    why = (
        "few photos leave gaps between points, which plane sweeps fill"
        if few
        else "enough photos show each surface"
    )
    return Decision("dense", "number of train photos", photos or math.nan, FEW_PHOTOS, "photos",
                    decision, why, "--effects dense")  # fmt: skip


def _skybox(dense: Decision) -> Decision:
    """Decide on a skybox: on without a dense start, because both fill the room for first Gaussians.

    It gains in courtyards and rooms too, where SfM found points nearly everywhere.
    """
    taken = dense.decision == "on"
    why = (
        "a dense start fills the room for first Gaussians"
        if taken
        else "haze must not explain what lies behind"
    )
    evidence = "a dense start" if taken else "no dense start"
    return Decision("skybox", evidence, float(taken), 0.0, "",
                    "off" if taken else "on", why, "--effects skybox")  # fmt: skip


def plan_effects(scene: Scene) -> EffectsPlan:
    """Measure the train photos at the SfM points and decide; without tracks no photo is read.

    Raises:
        AwError: a photo cannot be read.
    """
    if not has_tracks(scene):
        nothing = Evidence(*(math.nan,) * 4, observations=0, photos=len(scene.train))
        return decide(scene.name, nothing)
    from ambiguous_wild.io.images import load_image_float

    return decide(scene.name, measure_evidence(scene, (load_image_float(v.image_path) for v in scene.train)))


def read_plan(path: Path) -> EffectsPlan:
    """Read a plan that `aw plan` wrote.

    Raises:
        AwError: there is no such file, or it is no plan.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["schema"] != SCHEMA:
            raise ValueError(f"schema {data['schema']!r}, not {SCHEMA}")
        rows = [
            row | {"value": math.nan if row["value"] is None else row["value"]} for row in data["decisions"]
        ]
        decisions = msgspec.convert(rows, tuple[Decision, ...])
        name, identity = msgspec.convert([data["scene"], data["scene_hash"]], tuple[str, str])
        return EffectsPlan(name, decisions, bool(data.get("probed")), identity)
    except FileNotFoundError:
        raise AwError(f"there is no plan {path}; 'aw plan SCENE' makes one") from None
    except (OSError, ValueError, KeyError, TypeError, RecursionError, msgspec.ValidationError) as error:
        raise AwError(f"{path} is no plan of 'aw plan' ({str(error)[:200]!a}); make it again") from None
