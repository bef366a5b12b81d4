"""The overlap graph against brute force, layouts of known shape, forecasts on tracks that are made up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from ambiguous_wild.builder.overlap_graph import (
    SHARED,
    _oriented,
    best_link_between,
    bridges,
    connected_components,
    graph_layout,
    overlap_graph,
    predict_growth,
    weakly_connected,
)


@pytest.mark.parametrize("seed", range(8))
def test_a_bridge_is_a_link_without_which_a_component_falls_into_two(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends = {tuple(sorted(rng.choice(12, 2, replace=False).tolist())) for _ in range(14)}
    links = [(a, b, 20) for a, b in sorted(ends)]
    components = len(connected_components(overlap_graph(12, links)))
    without = {link[:2]: overlap_graph(12, [k for k in links if k != link]) for link in links}
    wanted = {pair for pair, graph in without.items() if len(connected_components(graph)) > components}
    assert bridges(overlap_graph(12, links)) == wanted and wanted


def test_photos_with_one_or_two_links_are_weakly_connected() -> None:
    full = [(a, b, 20) for a in range(4) for b in range(a + 1, 4)]
    assert weakly_connected(range(6), [*full, (3, 4, 20), (2, 4, 20)]) == [4, 5]
    assert weakly_connected(range(3), [*full[:2], (1, 2, 20)]) == []  # a capture of three has no more


def test_the_best_link_has_most_matches_else_it_is_by_the_order_of_capture() -> None:
    links = [(0, 5, 17), (1, 4, 30), (2, 3, 16)]
    assert best_link_between([0, 1, 2], [3, 4, 5], links) == (1, 4)
    assert best_link_between([3, 4, 5], [0, 1, 2], links) == (4, 1)
    assert best_link_between([0, 1, 2], [4, 5], []) == (2, 4)


def test_a_ring_is_laid_out_as_a_ring_and_a_walk_as_a_line() -> None:
    ring = [(min(k, (k + 1) % 12), max(k, (k + 1) % 12), 50) for k in range(12)]
    xy = graph_layout(12, ring)
    radius = np.linalg.norm(xy - xy.mean(axis=0), axis=1)
    assert radius.std() < 0.05 * radius.mean()
    walk = graph_layout(9, [(k, k + 1, 50) for k in range(8)])
    assert (np.diff(walk[:, 0]) > 0.5).all() and np.ptp(walk[:, 1]) < 0.1


def test_components_and_single_photos_do_not_cover_each_other() -> None:
    links = [(0, 1, 40), (1, 2, 40), (0, 2, 40), (4, 5, 30), (5, 6, 30)]
    xy = graph_layout(9, links)
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=2) + 9 * np.eye(9)
    assert apart.min() > 0.5 and (graph_layout(9, links) == xy).all()
    assert np.isfinite(graph_layout(3, [])).all() and len({tuple(p) for p in graph_layout(3, [])}) == 3


@pytest.mark.parametrize("seed", range(6))
def test_the_nearest_photos_in_order_are_those_of_brute_force(seed: int) -> None:
    order = np.random.default_rng(seed).permutation(30).tolist()
    inside, outside = order[:9], order[12:20]
    pairs = [(a, b) for a in inside for b in outside]
    assert best_link_between(inside, outside, []) == min(pairs, key=lambda p: (abs(p[0] - p[1]), p))


@pytest.mark.parametrize("seed", range(4))
def test_the_orientation_of_a_ring_does_not_depend_on_rounding(seed: int) -> None:
    angles = 2 * np.pi * np.arange(16) / 16
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, 2 * np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = _oriented((ring * [1, rng.choice([-1, 1])] + rng.normal(0, 1e-9, ring.shape)) @ rotation.T)
    assert np.abs(moved - ring * [-1, 1]).max() < 1e-6  # photo 0 left, photo 4 above


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


def test_a_walk_in_which_three_photos_share_enough_is_registered_whole() -> None:
    step = (60 - SHARED) // 2  # a track is in three photos where two steps leave some of it
    growth = predict_growth(9, matches_of(walk(9, step)))
    assert growth.components == [list(range(9))] and growth.others == []
    assert predict_growth(9, matches_of(walk(9, step + 1))).components == []


def test_components_that_only_a_pair_connects_stay_apart_and_the_largest_is_first() -> None:
    seen = [*walk(4, 15), *walk(6, 15, start=100)]  # the last of the first component shares 5 with the second
    assert len(matches_of(seen)[3, 4][0]) == 5
    growth = predict_growth(11, matches_of([*seen, range(5000, 5060)]))
    assert growth.components == [[4, 5, 6, 7, 8, 9], [0, 1, 2, 3]] and growth.others == [10]


def test_photos_without_matches_make_no_component() -> None:
    growth = predict_growth(3, {})
    assert growth.components == [] and growth.others == [0, 1, 2]
