"""Predict which photos structure from motion will place, from the features that they share.

A mapper starts from two photos. It places another one by its features that two placed photos show, because
only these have a point.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

SHARED = 8  # features of a photo that two placed photos show, from which on it is placed
SMALLEST = 3  # photos of a part


@dataclass(frozen=True)
class GrowthForecast:
    """Prediction for a capture."""

    parts: list[list[int]]  # photos of each part, the largest first; the first is what will be built
    others: list[int]  # photos of no part


def predict_growth(
    count: int,  # photos
    matches: Mapping[tuple[int, int], tuple[np.ndarray, np.ndarray]],  # features of both photos, [M] each
) -> GrowthForecast:
    """Grow parts from the pairs with the most matches, until no photo can be added."""
    features = [0] * count
    for pair, ends in matches.items():
        for photo, rows in zip(pair, ends):
            features[photo] = max(features[photo], int(rows.max(initial=-1)) + 1)
    pairs: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for pair in matches:
        for photo in pair:
            pairs[photo].append(pair)
    strongest_first = sorted(matches, key=lambda pair: (-len(matches[pair][0]), pair))
    free, parts = set(range(count)), []
    while True:
        grown: set[int] = set()
        for start in strongest_first:
            if free.issuperset(start):
                grown = _grow(start, free, pairs, matches, features)
                if len(grown) >= SMALLEST:
                    break
        if len(grown) < SMALLEST:
            break
        parts.append(sorted(grown))
        free -= grown
    parts.sort(key=lambda part: (-len(part), part))
    return GrowthForecast(parts, sorted(free))


def _grow(
    start: tuple[int, int],
    free: set[int],
    pairs: list[list[tuple[int, int]]],
    matches: Mapping[tuple[int, int], tuple[np.ndarray, np.ndarray]],
    features: list[int],
) -> set[int]:
    """Return the photos that a part reaches from two photos."""
    has_point = [np.zeros(0, bool)] * len(features)  # features that two placed photos show
    placed: set[int] = set()

    def place(photo: int) -> None:
        placed.add(photo)
        has_point[photo] = np.zeros(features[photo], bool)
        for pair in pairs[photo]:
            if placed.issuperset(pair):
                for end, rows in zip(pair, matches[pair]):
                    has_point[end][rows] = True

    def shared(photo: int) -> int:
        seen = np.zeros(features[photo], bool)
        for pair in pairs[photo]:
            side = pair.index(photo)
            if pair[1 - side] in placed:
                own, other = matches[pair][side], matches[pair][1 - side]
                seen[own[has_point[pair[1 - side]][other]]] = True
        return int(seen.sum())

    for photo in start:
        place(photo)
    added = set(start)
    while added:
        near = {end for photo in added for pair in pairs[photo] for end in pair}
        # A new photo gives points to its placed partners, which their partners may need.
        near |= {end for photo in near & placed for pair in pairs[photo] for end in pair}
        added = {photo for photo in sorted((near & free) - placed) if shared(photo) >= SHARED}
        for photo in sorted(added):
            place(photo)
    return placed
