"""GrowthForecast of parts on tracks that are made up, so that what each photo shares is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambiguous_wild.builder.growth import SHARED, predict_growth

Matches = dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]


def matches_of(seen: Sequence[range]) -> Matches:
    """Matches of photos that see these tracks; a feature is numbered by its position in the range."""
    matches: Matches = {}
    for a, first in enumerate(seen):
        for b in range(a + 1, len(seen)):
            both = sorted(set(first) & set(seen[b]))
            if both:
                matches[a, b] = (
                    np.array([k - first[0] for k in both]),
                    np.array([k - seen[b][0] for k in both]),
                )
    return matches


def walk(count: int, step: int, start: int = 0) -> list[range]:
    """Tracks seen by photos of a walk: 60 each, `step` new ones a photo."""
    return [range(start + step * k, start + step * k + 60) for k in range(count)]


def test_a_walk_in_which_three_photos_share_enough_is_placed_whole() -> None:
    step = (60 - SHARED) // 2  # a track is in three photos where two steps leave some of it
    growth = predict_growth(9, matches_of(walk(9, step)))
    assert growth.parts == [list(range(9))] and growth.others == []
    assert predict_growth(9, matches_of(walk(9, step + 1))).parts == []


def test_parts_that_only_a_pair_joins_stay_apart_and_the_largest_is_first() -> None:
    seen = [*walk(4, 15), *walk(6, 15, start=100)]  # the last of the first part shares 5 with the second
    assert len(matches_of(seen)[3, 4][0]) == 5
    growth = predict_growth(11, matches_of([*seen, range(5000, 5060)]))
    assert growth.parts == [[4, 5, 6, 7, 8, 9], [0, 1, 2, 3]] and growth.others == [10]


def test_photos_without_matches_make_no_part() -> None:
    growth = predict_growth(3, {})
    assert growth.parts == [] and growth.others == [0, 1, 2]
