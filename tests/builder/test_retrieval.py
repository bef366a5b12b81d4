"""Pairs by similar features: overlapping photos are found, and their number grows with the photos alone."""

from dataclasses import replace

import numpy as np
import pytest

from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.retrieval import (
    SIMILAR,
    best_pairs,
    most_similar,
    pairs_of_test_set,
    retrieval_pairs,
    shared_features,
    vlad_vectors,
)
from tests.builder.capture_maker import COUNT, SETTINGS


def places(count, per_place, seed=0):
    """Descriptors of photos of several places, shuffled: those of one place share most features."""
    rng = np.random.default_rng(seed)
    stock = [rng.integers(0, 256, (120, 128), dtype=np.uint8) for _ in range(count)]
    place = rng.permutation(np.repeat(np.arange(count), per_place))
    names = [f"p{i:03d}" for i in range(len(place))]
    photos = {}
    for name, k in zip(names, place):
        own = rng.integers(0, 256, (30, 128), dtype=np.uint8)
        shared = stock[k][rng.permutation(120)[:90]].astype(np.int16) + rng.integers(-6, 7, (90, 128))
        photos[name] = np.concatenate([np.clip(shared, 0, 255).astype(np.uint8), own])
    return names, place, photos


def test_photos_of_one_place_find_each_other():
    names, place, photos = places(6, 8)
    vectors = vlad_vectors(photos.__getitem__, names)
    found = most_similar(vectors, range(len(names)), range(len(names)), 7)
    right = np.mean([place[a] == place[b] for a, b in found])
    assert right > 0.95  # by chance: 0.15
    assert np.array_equal(vectors, vlad_vectors(photos.__getitem__, names))


def test_the_number_of_pairs_is_linear():
    names, _, photos = places(13, 8)  # 104: a shortlist is made
    tests = set(names[::8])
    pairs = retrieval_pairs(photos.__getitem__, names, tests, similar=7, neighbours=2)
    assert len(pairs) <= 104 * 9
    assert len(pairs) == len({frozenset(p) for p in pairs})
    assert ("p001", "p002") in pairs and all(a != b for a, b in pairs)
    vectors = vlad_vectors(photos.__getitem__, names)
    of_tests = pairs_of_test_set(vectors, names, tests)
    assert len(of_tests) <= len(tests) * (2 * SIMILAR + SIMILAR // 2)
    assert all(a in tests or b in tests for a, b in of_tests)
    assert {n for p in of_tests for n in p} >= tests


def test_a_photo_without_features_has_neighbours_only():
    names, _, photos = places(2, 4)
    photos[names[0]] = np.zeros((0, 128), np.uint8)
    vectors = vlad_vectors(photos.__getitem__, names)
    assert not vectors[0].any() and np.isfinite(vectors).all()
    assert vlad_vectors(lambda name: np.zeros((0, 128), np.uint8), names).shape == (8, 64 * 128)


def test_a_scene_is_built_from_neighbours(built, tmp_path):
    """With a separate test set, whose partners come from similar features."""
    settings = replace(SETTINGS, matcher="sequential")
    info = build_scene(built / "raw", tmp_path / "scene", settings, jobs=2).info
    assert info["counts"]["registered"] == COUNT
    assert info["chosen"]["matcher"] == "sequential" and 0 < info["counts"]["pairs"] <= 15


@pytest.mark.parametrize("count", [6, 13])  # all pairs are looked at, or a shortlist
def test_pairs_are_those_that_share_features(count):
    names, place, photos = places(count, 8)
    pairs = retrieval_pairs(photos.__getitem__, names, set(), similar=7, neighbours=0, jobs=2)
    of = dict(zip(names, place))
    every = {(a, b) for a in names for b in names if a < b and of[a] == of[b]}
    assert set(pairs) >= every
    assert pairs == retrieval_pairs(photos.__getitem__, names, set(), similar=7, neighbours=0, jobs=1)
    some = retrieval_pairs(photos.__getitem__, names, set(), similar=7, neighbours=1, only={names[0]})
    assert 7 <= len(some) <= 8 and all(names[0] in pair for pair in some)


def test_what_looks_like_chance_is_left_out():
    shared = {(0, 1): 50, (0, 2): 4, (0, 3): 3, (0, 4): 2, (0, 5): 1, (0, 6): 0, (1, 2): 9}
    assert best_pairs(shared, {0: 6}) == {(0, 1), (0, 2), (0, 3), (0, 4)}
    assert best_pairs(shared, {2: 1}) == {(1, 2)}
    assert shared_features({"a": np.zeros((1, 128), np.uint8)}.__getitem__, ["a", "a"], [(0, 1)], 1) == {
        (0, 1): 0
    }


def test_some_partners_are_far_in_a_dense_capture():
    shared = {(a, b): max(100 - 2 * (b - a), 0) for a in range(90) for b in range(a + 1, 90)}
    chain = [b - a for a, b in best_pairs(shared, dict.fromkeys(range(90), 8))]
    spread = [b - a for a, b in best_pairs(shared, dict.fromkeys(range(90), 8), far=0.5)]
    assert max(chain) == 8 and max(spread) == 40  # of 20 matches: fewer are not trusted
    assert len(spread) <= 90 * 8 and spread.count(1) == 89  # the nearest are still partners
    vectors = np.array([[np.cos(k / 50), np.sin(k / 50)] for k in range(90)])
    found = [b for _, b in most_similar(vectors, [0], range(90), 16, 8)]
    assert found[:16] == list(range(1, 17)) and len(found) == 24 and found[-1] == 46
