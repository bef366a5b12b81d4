"""A pose that a photo may have, the evidence for it, and what is asked of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ambiguous_wild.builder.motions import Pair

AGREE = 2  # smallest number of partners that agree with a photo's place
AGREE_NEW = 3  # the same for a photo that is not placed yet, if less than `AREA_NEW` of it agrees
RIVAL = 0.7  # relative weight of a second place from which on a photo has two places
LEAST_AREA = 0.2  # share of a photo that must agree: a smaller part may be a distractor
# The same if all placed photos that share a motion with it agree, and the matches are spread over the photo
# at least so much of what as many features drawn at random would be: those of a distractor are crowded.
LITTLE_AREA, LITTLE_SPREAD = 0.05, 0.2
CROWDED = 0.28  # spread of matches below which `AREA_NEW` of a photo must agree
AREA_NEW = 0.3  # share of a photo that is not placed yet, from which on two partners are enough


@dataclass(frozen=True)
class PoseHypothesis:
    """A possible pose of a photo, and the evidence for it."""

    pose: np.ndarray | None  # [3, 4] camera from world; None: only its rotation is known
    partners: frozenset[int]  # placed photos that agree with it
    area: float  # share of the photo's textured part that their matches cover
    spread: float = 1.0  # cells with matches, relative to as many features drawn at random
    evidence: Mapping[tuple[Pair, int], np.ndarray] = field(default_factory=dict)  # motion -> its features

    @property
    def weight(self) -> float:
        """Partners times area, because a distractor may have partners but covers little of the photo."""
        return len(self.partners) * self.area

    @property
    def crowded(self) -> bool:
        """Whether the matches are all in a small part of the photo: they may show a distractor."""
        return self.area < LITTLE_AREA or self.spread < LITTLE_SPREAD


def reason_against(best: PoseHypothesis, rival: PoseHypothesis, needed: int) -> str | None:
    """Return why a photo cannot stay at its best place; None if it can."""
    if not best.partners:
        return "no placed photo agrees with it on a place"
    if len(best.partners) == 1 < needed:
        return "only one placed photo agrees with it on a place"
    if len(best.partners) < needed:
        return f"only {len(best.partners)} placed photos agree with it on a place"
    if best.area < LEAST_AREA or (best.area < AREA_NEW and best.spread < CROWDED):
        part = f"{best.area:.0%}, spread {best.spread:.2f}"
        return f"only a small part of it agrees with {len(best.partners)} placed photos ({part})"
    if len(rival.partners) >= AGREE and rival.weight > RIVAL * best.weight:
        return f"two places: {len(best.partners)} photos agree on one, {len(rival.partners)} on another"
    return None
