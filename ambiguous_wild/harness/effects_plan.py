"""Decide which effects a scene needs: evidence against thresholds; plans as JSON files.

Evidence that needs no training: what the sparse model and the photos at its points say.

Every function returns a number, NaN where the scene cannot tell; `decide.py` holds the thresholds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from ambiguous_wild.core import AwError, Camera, Scene
from ambiguous_wild.splat.effects.tracks import TrackColours, log_gains, track_colours
from ambiguous_wild.vision.sparse_surface import has_surface

LEAST = 50  # observations below which nothing is said
LEAST_VIEWS = 6  # of a point, to fit four numbers to its colour
OUTLYING = 4.5  # median deviations from a point's median colour: three standard deviations of noise
RELIT = 0.5  # share of a photo's points that are far from their medians: more, and its light is another one
LEAST_APART = 1e-3  # spread of cameras over the depth they look at; below, they stand at one place
LEAST_SPREAD = 0.01  # code values, or of the logarithm: the median deviation counts as at least so much
MOST_PHOTOS = 64  # whose uncovered share is taken
MOST = 20_000  # points whose view dependence is fitted; more do not change a median


@dataclass(frozen=True)
class Evidence:
    """What a scene shows, each in the unit of its threshold; NaN = it cannot be told."""

    exposure: float  # spread of the photos' gains, share of a code value
    appearance: float  # spread at a point that a gain per photo leaves, share of a code value
    sampling: float  # ratio of the coarsest photo's pixel to the finest's, on the scene
    view_dependence: float  # median amplitude of what follows the direction, code values in [0, 1]
    reprojection_px: float  # median of points in the train photos, px of the loaded images
    observations: int  # in train photos, usable for colour
    photos: int = 0  # that train; 0 = not counted
    outward: float = math.nan  # spread of what the train cameras look at, over their own
    uncovered: float = math.nan  # share of the train photos where no SfM points lie


def measure(scene: Scene, photos: Sequence[np.ndarray]) -> Evidence:
    """All of it.

    Args:
        scene: with tracks.
        photos: of the train views, [H, W, 3] in [0, 1].
    """
    colours = track_colours(scene, photos)
    gains = log_gains(colours, len(scene.train))
    enough = len(colours.point) >= LEAST
    grey = colours.rgb.mean(axis=1) / np.exp(gains[colours.view].mean(axis=1))
    in_codes, in_logs = (_fit_points(scene, colours, v) for v in (grey, np.log(grey)))
    return Evidence(
        exposure=exposure_spread(colours, gains) if enough else np.nan,
        appearance=remaining_spread(in_logs),
        sampling=sampling_ratio(scene),
        view_dependence=view_dependence(in_codes),
        reprojection_px=reprojection(scene),
        observations=len(colours.point),
        photos=len(scene.train),
        outward=outward(scene),
        uncovered=uncovered(scene),
    )


def has_tracks(scene: Scene) -> bool:
    """Whether any point was seen at a known place of a photo; without, no photo need be read."""
    return bool((scene.points.track_views >= 0).sum() >= LEAST)


def exposure_spread(colours: TrackColours, gains: np.ndarray) -> float:
    """Standard deviation of log gain between the photos that see a same point, rms over channels.

    Not between all photos: along a strip of photos small errors add up from neighbour to neighbour, and
    two photos that share nothing cannot disagree.
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
    """Ratio of the 95th to the 5th percentile, over train photos, of a pixel's size on the points it sees.

    A pixel covers depth / focal length; each photo counts with the median over its points.
    """
    sizes = [depth / (0.5 * (camera.fx + camera.fy)) for camera, depth in _looking_at(scene)]
    if len(sizes) < 3:
        return float("nan")
    low, high = np.percentile(sizes, [5, 95])
    return float(high / low)


def outward(scene: Scene) -> float:
    """Spread of the places that train cameras look at, over that of the cameras themselves.

    Near 0 where they stand around something, 1 where they look the same way, large where they stand in the
    middle. A camera looks at its axis, as far away as its points are in the median. NaN if all stand at one
    place.
    """
    looking = _looking_at(scene)
    if len(looking) < 3:
        return float("nan")
    cameras = np.array([camera.center for camera, _ in looking])
    places = cameras + [depth * camera.cam_from_world[2, :3] for camera, depth in looking]
    # the root of the summed variances does not depend on the axes of the world
    apart, between = (float(np.sqrt(a.var(axis=0).sum())) for a in (cameras, places))
    depth = float(np.median([depth for _, depth in looking]))
    return between / apart if apart > LEAST_APART * depth else float("nan")


def uncovered(scene: Scene) -> float:
    """Share of the train photos' pixels with no SfM points around them, in the mean of up to 64 photos.

    There the photos show what SfM did not find, in most scenes the background. Tracks are not needed.
    A photo with too few points for a surface counts as bare; NaN if most photos are such.
    """
    cameras = [view.camera for view in scene.train]
    cameras = cameras[:: max(-(-len(cameras) // MOST_PHOTOS), 1)]
    if not cameras or not len(scene.points):
        return float("nan")
    known = [has_surface(camera, scene.points.sure_xyz) for camera in cameras]
    if 2 * sum(k is None for k in known) > len(known):
        return float("nan")
    return float(np.mean([1.0 if k is None else 1.0 - k.mean() for k in known]))


def _looking_at(scene: Scene) -> list[tuple[Camera, float]]:
    """Train cameras that see five points or more, each with the median depth of its points."""
    owner, found = _owner(scene), []
    for index, view in enumerate(scene.views):
        if view.split == "train":
            pose = view.camera.cam_from_world
            xyz = scene.points.xyz[owner[scene.points.track_views == index]]
            depth = (xyz @ pose[:3, :3].T + pose[:3, 3])[:, 2]
            depth = depth[depth > 0]
            if len(depth) >= 5:
                found.append((view.camera, float(np.median(depth))))
    return found


def reprojection(scene: Scene) -> float:
    """Median distance between where a point was found and where it projects, px of the loaded photos."""
    owner, found = _owner(scene), []
    for index, view in enumerate(scene.views):
        if view.split != "train":
            continue
        rows = np.flatnonzero(scene.points.track_views == index)
        camera = view.camera
        xyz = scene.points.xyz[owner[rows]]
        local = xyz @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        front = local[:, 2] > 1e-6
        local = local[front]
        uv = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        found.append(np.linalg.norm(uv - scene.points.track_xy[rows][front], axis=1))
    errors = np.concatenate(found) if found else np.zeros(0)
    return float(np.median(errors)) if len(errors) >= LEAST else float("nan")


@dataclass(frozen=True)
class _Fits:
    """Of every point seen often enough, the variance of its colour that its viewing direction explains."""

    explained: np.ndarray  # [P] beyond chance; scatters about zero where there is nothing
    left: np.ndarray  # [P] unbiased variance of what it does not


def _fit_points(scene: Scene, colours: TrackColours, values: np.ndarray) -> _Fits:
    """A constant and three numbers linear in the direction, by least squares, for points of six photos on.

    A fit explains noise too: what it explains by chance is subtracted (the adjusted coefficient of
    determination).
    """
    order = np.argsort(colours.point, kind="stable")
    point, view, values = colours.point[order], colours.view[order], values[order]
    starts = np.flatnonzero(np.r_[True, point[1:] != point[:-1]])
    sizes = np.diff(np.r_[starts, len(point)])
    chosen = np.flatnonzero(sizes >= LEAST_VIEWS)
    if len(chosen) > MOST:
        chosen = np.random.default_rng(0).choice(chosen, MOST, replace=False)
    centres = np.array([v.camera.center for v in scene.train])
    groups = [starts[k] + np.arange(sizes[k]) for k in chosen]
    fits = []
    for rows in _usual(groups, values, view):
        if len(rows) < LEAST_VIEWS:
            continue
        direction = centres[view[rows]] - scene.points.xyz[point[rows[0]]]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        fits.append(_fit(direction, values[rows]))
    return _Fits(*np.array(fits).reshape(-1, 2).T)


def _usual(groups: Sequence[np.ndarray], values: np.ndarray, view: np.ndarray) -> list[np.ndarray]:
    """Of each point, the rows whose colour is near the point's median colour.

    A colour far from the median shows something that stands before the point. But where most colours of a
    photo are far, its light is another one, and its rows stay.
    """
    if not groups:
        return []
    far = []
    for rows in groups:
        apart = np.abs(values[rows] - np.median(values[rows]))
        far.append(apart > OUTLYING * max(float(np.median(apart)), LEAST_SPREAD))
    of_photo = view[np.concatenate(groups)]
    count = np.maximum(np.bincount(of_photo), 1)
    relit = np.bincount(of_photo, np.concatenate(far)) > RELIT * count
    return [rows[~outlying | relit[view[rows]]] for rows, outlying in zip(groups, far)]


def _fit(direction: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    n = len(values)
    # directions of a narrow arc are nearly one: what they cannot tell apart is left out of the fit
    axes, spread, _ = np.linalg.svd(direction - direction.mean(axis=0), full_matrices=False)
    rank = int((spread > 0.05 * np.sqrt(n)).sum())
    centred = values - values.mean()
    explained = axes[:, :rank] @ (axes[:, :rank].T @ centred)
    variance = float(((centred - explained) ** 2).sum()) / (n - 1 - rank)
    return float(centred @ centred) / (n - 1) - variance, variance


def view_dependence(fits: _Fits) -> float:
    """Median over points of the amplitude of colour that is linear in the viewing direction."""
    if len(fits.explained) < 10:
        return float("nan")
    return float(np.sqrt(max(np.median(fits.explained), 0.0)))


def remaining_spread(fits: _Fits) -> float:
    """Median over points of what is left between photos once each has its gain and each point its shine."""
    if len(fits.left) < 10:
        return float("nan")
    return float(np.sqrt(np.median(fits.left)))


def _owner(scene: Scene) -> np.ndarray:
    return np.repeat(np.arange(len(scene.points)), np.diff(scene.points.track_offsets))


Answer = Literal["on", "off", "unknown"]
SCHEMA = 1

# Set on tracks with the effect injected and without (tests/harness/test_planning.py) and on the captures of
# docs/notes/effects.md, which says how near to them what was measured lies.
EXPOSURE = 0.05
APPEARANCE = 0.043
# A highlight is not linear in the direction: what is left of it, times its linear part (1.7 at the strongest
# that the tests inject), is no light that differs by place.
OF_SHINE = 1.7
SAMPLING = 1.5
VIEW_DEPENDENCE = 0.015
REPROJECTION_PX = 1.0
# cameras around something have 0.07 to 0.93, a drone's side by side 1.04, those in the middle of a yard 7.1:
# there a dense start of 30 photos paid (docs/notes/effects.md)
OUTWARD = 2.0
# captures of 9 to 20 photos gained SSIM by a dense start, those of 30 did not (docs/notes/effects.md)
LEAST_PHOTOS, FEW_PHOTOS = 3, 24
# simulated courtyards, rooms and yards have 0.01 to 0.05, real captures 0.09 to 0.66 (docs/notes/effects.md)
UNCOVERED = 0.07


@dataclass(frozen=True)
class Decision:
    """One line of the plan."""

    effect: str
    evidence: str  # what was measured, in words
    value: float  # NaN: it could not be
    threshold: float
    unit: str
    decision: Answer
    why: str
    how: str  # what switches it
    cost_ms: float | None = None  # an iteration more; None: not measured
    gain_db: float | None = None  # on pixels left out of training; None: not tried
    error_db: float | None = None  # standard error of that over the photos

    def plain(self) -> dict[str, Any]:
        """For JSON, which has no NaN."""
        value = None if math.isnan(self.value) else self.value
        return {**self.__dict__, "value": value}


@dataclass(frozen=True)
class Cost:
    """What the probes of a plan cost."""

    iterations: int  # of all probes, on their small photos
    seconds: float  # of the process that made the plan; probes that were kept cost nothing again
    share: float  # expected, of the run that the plan is for

    def line(self) -> str:
        """For a terminal."""
        return (
            f"probes: {self.iterations} iterations on small photos, {self.seconds:.0f} s; "
            f"about {100 * self.share:.1f} % of the run (at most 10 %)"
        )


@dataclass(frozen=True)
class Plan:
    """The effects that a scene needs, with the evidence for each."""

    scene: str
    decisions: tuple[Decision, ...]
    probed: bool = False  # masks were decided on too
    cost: Cost | None = None  # None: nothing was tried

    def __repr__(self) -> str:
        return f"Plan({self.scene}: --effects {','.join(self.effects()) or 'none'})"

    def effects(self, among: Iterable[str] | None = None) -> tuple[str, ...]:
        """Names for `--effects`: effects that were decided on, among those allowed.

        A lower SH degree is never among them: it saves no time worth mentioning, and on matt scenes too cost
        a third to half a decibel (docs/notes/effects.md).
        """
        found = [d.how.removeprefix("--effects ") for d in self.decisions if _adds(d)]
        return tuple(name for name in found if among is None or name in tuple(among))

    def plain(self) -> dict[str, Any]:
        """As it is written to files."""
        return {
            "schema": SCHEMA,
            "scene": self.scene,
            "probed": self.probed,
            "cost": None if self.cost is None else asdict(self.cost),
            "effects": list(self.effects()),
            "decisions": [d.plain() for d in self.decisions],
        }

    def with_costs(self, costs: dict[str, float]) -> Plan:
        """The same plan with ms an iteration of each effect, by the name that switches it."""
        lines = (
            replace(d, cost_ms=costs.get(d.how.removeprefix("--effects "), d.cost_ms)) for d in self.decisions
        )
        return replace(self, decisions=tuple(lines))


def _adds(decision: Decision) -> bool:
    own = decision.effect != "SH degree" and decision.how.startswith("--effects ")
    return own and decision.decision == "on"


def answer(value: float, threshold: float) -> Answer:
    """On from the threshold up."""
    if math.isnan(value):
        return "unknown"
    return "on" if value >= threshold else "off"


def decide(scene: str, found: Evidence) -> Plan:
    """The lines that need no training."""
    seen = f"{found.observations} observations of SfM points"
    shine = 0.0 if math.isnan(found.view_dependence) else OF_SHINE * found.view_dependence
    by_place = found.appearance - min(shine, found.appearance)  # NaN stays NaN
    local = answer(by_place, APPEARANCE)
    globally = answer(found.exposure, EXPOSURE)
    by_gain = "a gain per photo explains it" if globally == "on" else "photos agree"
    if local == "on":
        globally_why = "the embedding covers it" if globally == "on" else by_gain
    else:
        globally_why = by_gain
    smooth = answer(found.sampling, SAMPLING)
    bent = answer(found.view_dependence, VIEW_DEPENDENCE)
    moved = answer(found.reprojection_px, REPROJECTION_PX)
    behind = answer(found.uncovered, UNCOVERED)
    lines: tuple[Decision, ...] = (
        Decision(
            "appearance", "spread at a point after gain and shine", by_place,
            APPEARANCE, "of the colour range", local,
            "light differs by place" if local == "on" else "no more than texture and noise",
            "--effects appearance",
        ),
        Decision(
            "exposure", "spread of the photos' gains at the same points", found.exposure, EXPOSURE,
            "of the colour range", "off" if local == "on" and globally == "on" else globally, globally_why,
            "--effects exposure",
        ),
        Decision(
            "antialias", "pixel size on the scene, coarsest over finest photo", found.sampling, SAMPLING,
            "times", smooth,
            "seen from near and far" if smooth == "on" else "all photos resolve about the same",
            "--effects antialias",
        ),
        Decision(
            "SH degree", "colour that follows the viewing direction", found.view_dependence, VIEW_DEPENDENCE,
            "code values", bent,
            "degree 3 has work to do" if bent == "on" else "colours hardly follow the direction",
            "--effects sh1",
        ),
        Decision(
            "poses", "reprojection error of the sparse model", found.reprojection_px,
            REPROJECTION_PX, "px", moved,
            "poses are off by more than the photos can hide" if moved == "on" else "poses fit the photos",
            "--effects poses",
        ),
        Decision(
            "skybox", "share of the photos where no SfM points lie", found.uncovered, UNCOVERED,
            "of the pixels", behind,
            "background, or plain walls" if behind == "on" else "SfM found points nearly everywhere",
            "--effects skybox",
        ),
        _dense_start(found),
    )  # fmt: skip
    missing = {"skybox": "cannot be told: most photos show too few SfM points, or none"}
    lines = tuple(
        replace(d, why=missing.get(d.effect, f"cannot be told from {seen}")) if d.decision == "unknown" else d
        for d in lines
    )
    return Plan(scene, lines)


def _dense_start(found: Evidence) -> Decision:
    """On for few photos, and for those from the middle of a place.

    Exposures must be known: where they differed and nothing said so, test PSNR fell.
    """
    photos, tracks = found.photos, not math.isnan(found.exposure)
    few, middle = photos <= FEW_PHOTOS, found.outward > OUTWARD
    known = tracks and photos >= LEAST_PHOTOS
    decision: Answer = "unknown" if not known else "on" if few or middle else "off"
    if middle and not few:
        return Decision(
            "dense", "spread of what cameras look at, over theirs", found.outward, OUTWARD, "times",
            decision, "cameras look outward", "--effects dense",
        )  # fmt: skip
    return Decision(
        "dense", "train photos; on up to the limit", photos or math.nan, FEW_PHOTOS, "photos",
        decision, "photos leave much to guess" if few else "enough photos see a surface", "--effects dense",
    )  # fmt: skip


def plan_without_training(scene: Scene) -> Plan:
    """Read the train photos at the SfM points and decide; a scene without tracks reads nothing.

    Raises:
        AwError: a photo cannot be read.
    """
    if not has_tracks(scene):
        count, bare = len(scene.train), uncovered(scene)
        nothing = Evidence(*(math.nan,) * 5, observations=0, photos=count, uncovered=bare)
        return decide(scene.name, nothing)
    from ambiguous_wild.io.images import load_image_float

    return decide(scene.name, measure(scene, [load_image_float(v.image_path) for v in scene.train]))


def read_plan(path: Path) -> Plan:
    """A plan that `aw plan` wrote.

    Raises:
        AwError: no such file, or it is none.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["schema"] != SCHEMA:
            raise ValueError(f"schema {data['schema']!r}, not {SCHEMA}")
        rows = [
            row | {"value": math.nan if row["value"] is None else row["value"]} for row in data["decisions"]
        ]
        decisions = msgspec.convert(rows, tuple[Decision, ...])
        cost = msgspec.convert(data.get("cost"), Cost | None)
        return Plan(msgspec.convert(data["scene"], str), decisions, bool(data.get("probed")), cost)
    except FileNotFoundError:
        raise AwError(f"there is no plan {path}; 'aw plan SCENE' makes one") from None
    except (OSError, ValueError, KeyError, TypeError, RecursionError, msgspec.ValidationError) as error:
        raise AwError(f"{path} is no plan of 'aw plan' ({str(error)[:200]!a}); make it again") from None
