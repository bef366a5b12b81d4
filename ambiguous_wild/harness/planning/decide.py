"""Decide which effects a scene needs: evidence against thresholds; plans as JSON files."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.harness.planning.evidence import Evidence, has_tracks, measure, uncovered

Answer = Literal["on", "off", "unknown"]
SCHEMA = 1

# Set on tracks with the effect injected and without (tests/harness/test_planning.py) and on the captures of
# docs/effects.md, which says how near to them what was measured lies.
EXPOSURE = 0.05
APPEARANCE = 0.043
# A highlight is not linear in the direction: what is left of it, times its linear part (1.7 at the strongest
# that the tests inject), is no light that differs by place.
OF_SHINE = 1.7
SAMPLING = 1.5
VIEW_DEPENDENCE = 0.015
REPROJECTION_PX = 1.0
# cameras around something have 0.07 to 0.93, a drone's side by side 1.04, those in the middle of a yard 7.1:
# there a dense start of 30 photos paid (docs/effects.md)
OUTWARD = 2.0
# captures of 9 to 20 photos gained SSIM by a dense start, those of 30 did not (docs/effects.md)
LEAST_PHOTOS, FEW_PHOTOS = 3, 24
# simulated courtyards, rooms and yards have 0.01 to 0.05, real captures 0.09 to 0.66 (docs/effects.md)
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
        a third to half a decibel (docs/effects.md).
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
