"""Decide on effects from paired probes: which are tried, and what follows. Imports no torch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambiguous_wild.harness.effects_plan import (
    APPEARANCE,
    EXPOSURE,
    REPROJECTION_PX,
    SAMPLING,
    Decision,
    Plan,
)
from ambiguous_wild.splat.effects import check_effects

LEAST_PHOTOS = 4  # fewer give no useful standard error
LEAST_DB = 0.05  # an effect that gains less is not worth its time
# Probes grow no Gaussians and understate what masks give: static captures -0.02 to +0.01 dB, captures with
# distractors from 0.05 dB (docs/notes/effects.md)
LEAST_DB_MASKS = 0.02


@dataclass(frozen=True)
class ProbeResult:
    """The PSNR of one probe on the held-back pixels of every measured photo."""

    psnr: Mapping[str, float]  # dB, mean over visits, by the photo's name


@dataclass(frozen=True)
class Gain:
    """The gain of an effect on the held-back pixels of the same photos."""

    db: float  # mean over photos
    error_db: float  # standard error of that mean

    def pays(self, least_db: float = LEAST_DB) -> bool:
        """Return whether the gain is above its standard error and above `least_db`."""
        return self.db >= least_db and self.db > self.error_db


def compare(arm: ProbeResult, base: ProbeResult) -> Gain | None:
    """Return the gain of `arm` over `base`, photo by photo; None if they share too few photos."""
    names = [name for name in base.psnr if name in arm.psnr]
    if len(names) < LEAST_PHOTOS:
        return None
    difference = np.array([arm.psnr[name] - base.psnr[name] for name in names])
    error = float(difference.std(ddof=1) / np.sqrt(len(difference)))
    return Gain(float(difference.mean()), error)


# An effect is tried from its limit on. The evidence for appearance depends on the size of the photos
# (`time-of-day`: 0.027 at 256 px, above 0.043 at 480 px), so it is tried from half its limit on.
TRIED_FROM = {
    "exposure": EXPOSURE,
    "appearance": APPEARANCE / 2,
    "antialias": SAMPLING,
    "poses": REPROJECTION_PX,
}
# Effects that a limit alone does not switch on: test photos of real captures lost up to 0.8 dB by that.
ONLY_IF_TRIED = ("antialias", "poses")
MASK_LINES = ("masks", "masks, local", "masks, global", "entropy density")
PAYS, PAYS_NOT = "improves held-back pixels", "does not improve held-back pixels"
GUESSED = "the gain is within the noise; the limit decides"
COVERED = "the appearance embedding includes it"
STATIC = "static: leaving out the patches does not improve held-back pixels"
# Share of unexplained pixels: static captures have 0.0 to 0.9 %, captures with distractors 0.6 % or more.
CERTAIN = 0.03

Train = Callable[[tuple[str, ...]], ProbeResult]  # trains a probe with these effects


def name_of(decision: Decision) -> str:
    """Return the effect's name for `--effects`; "" for other lines of a plan."""
    name = decision.how.removeprefix("--effects ")
    return name if name in TRIED_FROM else ""


def candidates(plan: Plan) -> tuple[str, ...]:
    """Return the effects to probe, in the order in which they are tried; with appearance also exposure."""
    names = []
    for decision in plan.decisions:
        name = name_of(decision)
        if name and not math.isnan(decision.value) and decision.value >= TRIED_FROM[name]:
            names.append(name)
    return check_effects([*names, *(["exposure"] if "appearance" in names else [])])


def untried(plan: Plan, reason: str) -> Plan:
    """Return the plan of the limits, with effects off that need a probe to be switched on."""

    def line(decision: Decision) -> Decision:
        if decision.decision != "on" or not name_of(decision):
            return decision
        answer = "off" if name_of(decision) in ONLY_IF_TRIED else decision.decision
        return replace(decision, decision=answer, why=f"{decision.why}; not tried: {reason}")

    return replace(plan, decisions=tuple(line(d) for d in plan.decisions))


def try_effects(
    plan: Plan, names: Sequence[str], train: Train, costs: Mapping[str, float], say: Callable[[str], None]
) -> Plan:
    """Try one effect after the other, each together with those that were accepted.

    The appearance embedding replaces exposure; it is on where it gains more than exposure.

    Args:
        plan: the plan of the limits.
        names: effects to try, from `candidates`.
        train: trains a probe.
        costs: extra ms per iteration of each effect.
        say: gets a line for every decision.
    """
    on: tuple[str, ...] = ()
    gains: dict[str, Gain] = {}
    lines = {name_of(decision): decision for decision in plan.decisions}
    covered = False
    for name in names:
        beside = tuple(e for e in on if name != "appearance" or e != "exposure")
        base = train(on)
        gain = compare(train(check_effects([*beside, name])), base)
        if gain is None:
            return untried(plan, "too few photos to hold pixels back")
        gains[name] = gain
        accepted = gain.pays() or (beside == on and guessed(lines[name], gain))
        if accepted:
            covered = covered or beside != on
            on = check_effects([*beside, name])
        say(f"{plan.scene}: {name} {'on' if accepted else 'off'}: {format_gain(gain)}, {costs[name]:+.1f} ms")
    decisions = tuple(_line(d, gains.get(name_of(d)), on, covered) for d in plan.decisions)
    return replace(plan, decisions=decisions).with_costs(dict(costs))


def guessed(decision: Decision, gain: Gain) -> bool:
    """Return whether the limit switches on an effect whose gain is within the noise, as with few photos.

    Example, nine photos of a real capture: +0.08 +- 0.14 dB in the probe, +1.7 dB on test photos.
    """
    allowed = name_of(decision) not in ONLY_IF_TRIED and decision.value >= decision.threshold
    return allowed and gain.db >= LEAST_DB


def _line(decision: Decision, gain: Gain | None, on: Iterable[str], covered: bool) -> Decision:
    name = name_of(decision)
    if gain is None:
        return replace(decision, decision="off") if name and decision.decision == "on" else decision
    if name in on:
        why = PAYS if gain.pays() else GUESSED
    else:
        why = COVERED if covered and name == "exposure" else PAYS_NOT
    return with_gain(replace(decision, decision="on" if name in on else "off", why=why), gain)


def with_gain(decision: Decision, gain: Gain) -> Decision:
    """Return the line with the gain that the probe measured."""
    return replace(decision, gain_db=gain.db, error_db=gain.error_db)


def format_gain(gain: Gain) -> str:
    """Return the gain as text."""
    return f"{gain.db:+.2f} ± {gain.error_db:.2f} dB on held-back pixels"


def with_masks_tried(plan: Plan, gain: Gain | None) -> Plan:
    """Return the plan with masks off if few pixels are unexplained and leaving them out does not help.

    Training on a distractor worsens other photos of the same place; a detail that is hard to learn does not.
    From `CERTAIN` on masks stay on: a sparse model of few points is too coarse to show the difference.

    Args:
        plan: a plan with the lines of `with_occlusion`.
        gain: gain of training without the patches; None = too few photos.
    """
    masks = next(d for d in plan.decisions if d.effect == "masks")
    if gain is None or masks.decision != "on":
        return plan
    static = masks.value < CERTAIN and not gain.pays(LEAST_DB_MASKS)

    def line(decision: Decision) -> Decision:
        if static and decision.effect in MASK_LINES:
            decision = replace(decision, decision="off", why=STATIC)
        return with_gain(decision, gain) if decision.effect == "masks" else decision

    return replace(plan, decisions=tuple(line(d) for d in plan.decisions))
