"""How much structure from motion works for a model: first little, then, if that loses photos, much."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ambiguous_wild.builder.pairs import EXHAUSTIVE_LIMIT, FAST_EXHAUSTIVE_LIMIT
from ambiguous_wild.builder.records import PhotoRecord
from ambiguous_wild.builder.settings import BuildSettings

FAST_SIDE = 800  # px; below it SIFT needs the doubled photo to find enough
# Median over photos. 560 place 16 of the 66 photos of a smooth skull; 2100 all 11 of a facade.
FEW_FEATURES = 1200


@dataclass(frozen=True)
class SfmPlan:
    """What an attempt does; `benchmarks/results/build-scene.md` compares them on real captures."""

    name: str  # "fast" or "thorough"
    first_octave: int  # of SIFT; -1 doubles each photo first, which takes three quarters of its time
    matcher: str  # "exhaustive", "retrieval" or "sequential"
    similar: int  # photos that each is matched with, for "retrieval"
    neighbours: int  # next photos in the order of capture, for "retrieval"
    growth: float  # all cameras are adjusted when the model has grown so many times
    refinements: int  # rounds of such an adjustment, at most


def plans(photos: Sequence[PhotoRecord], settings: BuildSettings) -> list[SfmPlan]:
    """The attempts in order; the next is made where one leaves photos out."""
    thorough = _thorough(len(photos), settings)
    if settings.sfm == "thorough":
        return [thorough]
    fast = _fast(photos, settings)
    return [fast] if settings.sfm == "fast" else [fast, thorough]


def few_features(counts: Iterable[int]) -> bool:
    """Whether photos at their own size show too little; the doubled ones have two to four times as many."""
    return statistics.median(counts) < FEW_FEATURES


def _fast(photos: Sequence[PhotoRecord], settings: BuildSettings) -> SfmPlan:
    side = min((min(max(p["width"], p["height"]), settings.max_side) for p in photos), default=0)
    octave = 0 if side >= FAST_SIDE else -1
    matcher = _matcher(len(photos), settings, FAST_EXHAUSTIVE_LIMIT)
    many = len(photos) > EXHAUSTIVE_LIMIT
    return SfmPlan("fast", octave, matcher, 16 if many else 12, 5 if many else 2, 1.4, 2)


def _thorough(count: int, settings: BuildSettings) -> SfmPlan:
    return SfmPlan("thorough", -1, _matcher(count, settings, EXHAUSTIVE_LIMIT), 16, 5, 1.1, 5)


def _matcher(count: int, settings: BuildSettings, limit: int) -> str:
    if settings.matcher != "auto":
        return settings.matcher
    return "exhaustive" if count <= limit else "retrieval"
