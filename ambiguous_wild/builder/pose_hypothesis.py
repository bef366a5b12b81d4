"""Pose hypotheses: their evidence, and the conditions for accepting one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ambiguous_wild.builder.relative_poses import Pair

MIN_SUPPORT = 2  # covisible photos that must support a photo's pose
MIN_SUPPORT_NEW = 3  # the same for a photo that is not registered yet, if inliers cover under `AREA_NEW`
COMPETING_WEIGHT = 0.7  # relative weight of a competing hypothesis from which on neither is accepted
MIN_AREA = 0.2  # share of a photo that inliers must cover: what is smaller may be a distractor
# The same if all registered photos that share a relative pose with it support the hypothesis, and the least
# coverage of the inliers, relative to as many features drawn at random: those of a distractor are clustered.
LITTLE_AREA, LITTLE_COVERAGE = 0.05, 0.2
MIN_COVERAGE = 0.28  # coverage of the inliers below which they must cover `AREA_NEW` of a photo
TWO_POSES = "two poses"  # begins the reason against a photo whose covisible photos contradict each other
AREA_NEW = 0.3  # share of a photo that is not registered yet, from which on the support of two is enough


@dataclass(frozen=True)
class PoseHypothesis:
    """A possible pose of a photo, and the evidence for it."""

    pose: np.ndarray | None  # [3, 4] camera from world; None: only its rotation is known
    support: frozenset[int]  # registered photos with enough inliers under it
    area: float  # share of the grid cells with features that hold inliers
    coverage: float = 1.0  # cells with inliers, over those of as many features drawn at random
    # Relative pose -> its inliers.
    evidence: Mapping[tuple[Pair, int], np.ndarray] = field(default_factory=dict)

    @property
    def weight(self) -> float:
        """Support times area, because a distractor may have support but covers little of the photo."""
        return len(self.support) * self.area

    @property
    def clustered(self) -> bool:
        """Whether the inliers are all in a small part of the photo: they may show a distractor."""
        return self.area < LITTLE_AREA or self.coverage < LITTLE_COVERAGE


def rejection_reason(best: PoseHypothesis, competing: PoseHypothesis, needed: int) -> str | None:
    """Return why the best hypothesis is not accepted; None if it is."""
    if not best.support:
        return "no registered photo agrees with it on a pose"
    if len(best.support) == 1 < needed:
        return "only one registered photo agrees with it on a pose"
    if len(best.support) < needed:
        return f"only {len(best.support)} registered photos agree with it on a pose"
    if best.area < MIN_AREA or (best.area < AREA_NEW and best.coverage < MIN_COVERAGE):
        part = f"{best.area:.0%}, coverage {best.coverage:.2f}"
        return f"only a small part of it agrees with {len(best.support)} registered photos ({part})"
    if len(competing.support) >= MIN_SUPPORT and competing.weight > COMPETING_WEIGHT * best.weight:
        return f"{TWO_POSES}: {len(best.support)} photos agree on one, {len(competing.support)} on another"
    return None
