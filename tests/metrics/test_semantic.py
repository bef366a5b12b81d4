"""The semantic score against plain loops, planted twins and strangers, and the edges."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics import semantic as sem


def regions(*means: list[float], pixels: int = 10) -> sem.RegionFeatures:
    table = np.array(means, float) if means else np.zeros((0, 2))
    return sem.RegionFeatures(np.arange(1, len(means) + 1), table, np.full(len(means), float(pixels)))


def test_region_means_equal_a_loop() -> None:
    rng = np.random.default_rng(5)
    features, labels = rng.normal(size=(3, 4, 5)), rng.integers(0, 4, (11, 17))
    got = sem.region_means(features, labels)
    for name, mean, count in zip(got.labels, got.means, got.pixels):
        cells = [features[i * 3 // 11, j * 4 // 17] for i, j in zip(*np.nonzero(labels == name))]
        np.testing.assert_allclose(mean, np.mean(cells, axis=0))
        assert count == len(cells)
    least = sorted(got.pixels)[1] / labels.size
    assert len(sem.region_means(features, labels, min_share=least)) == len(got) - 1
    assert len(sem.region_means(features, 0 * labels)) == 0


def test_a_twin_is_found_in_another_photo_and_never_in_its_own() -> None:
    x, y, z = np.eye(3).tolist()
    distractors = [regions(x), regions(z)]
    statics = [regions(x, y), regions(y, [0.6, 0.0, 0.8])]
    first, second = sem.matches(distractors, statics)
    assert (first[0].photo, first[0].static_label) == (1, 2) and first[0].cosine == pytest.approx(0.6)
    assert second[0].cosine == pytest.approx(0.0) and second[0].photo == 0
    alone = sem.matches([regions(x)], [regions(y, x)])
    assert (alone[0][0].photo, alone[0][0].static_label) == (0, 2) and alone[0][0].cosine == pytest.approx(1)


def test_scores_of_a_photo() -> None:
    found = [sem.RegionMatch(1, 30, 0.2, 0, 1), sem.RegionMatch(2, 10, 0.8, 0, 1)]
    assert sem.photo_cosine(found) == 0.8
    assert sem.mean_cosine(found) == pytest.approx((30 * 0.2 + 10 * 0.8) / 40)
    assert math.isnan(sem.photo_cosine([])) and math.isnan(sem.mean_cosine([]))


def test_edges_have_no_match() -> None:
    nobody, zero = regions(), regions([0.0, 0.0])
    assert sem.matches([regions([1.0, 0.0]), regions()], [nobody, nobody]) == [[], []]
    assert sem.matches([zero, zero], [regions([1.0, 0.0]), regions([1.0, 0.0])]) == [[], []]
    assert sem.matches([regions([1.0, 0.0])] * 2, [zero, zero]) == [[], []]
    with pytest.raises(AwError, match="2 photos of distractors, 1"):
        sem.matches([nobody, nobody], [nobody])


def test_anchors_are_the_means_over_other_photos() -> None:
    rng = np.random.default_rng(2)
    statics = [regions(*rng.normal(size=(4, 6)).tolist()) for _ in range(3)]
    best, every = [], []
    for k, own in enumerate(statics):
        for a in own.means:
            cosines = [
                a @ b / np.linalg.norm(a) / np.linalg.norm(b)
                for j, s in enumerate(statics)
                if j != k
                for b in s.means
            ]
            best.append(max(cosines))
            every.append(np.mean(cosines))
    got = sem.anchors(statics)
    assert got.same == pytest.approx(np.mean(best)) and got.different == pytest.approx(np.mean(every))
    assert got.calibrated(got.same) == pytest.approx(1) and got.calibrated(got.different) == pytest.approx(0)
    few = [sem.RegionFeatures(s.labels[:1], s.means[:1], s.pixels[:1]) for s in statics]
    named = sem.anchors(few, statics)
    units = [[m / np.linalg.norm(m) for m in s.means] for s in statics]
    assert named.same == sem.anchors(few).same
    pairs = [[a @ u[0] for j, v in enumerate(units) if j != k for a in v] for k, u in enumerate(units)]
    assert named.different == pytest.approx(np.mean(pairs))
    assert math.isnan(sem.anchors(statics[:1]).same)
    assert math.isnan(sem.Anchors(0.5, 0.5).calibrated(0.5))


def test_whitened_channels_have_mean_zero_and_no_correlation() -> None:
    rng = np.random.default_rng(1)
    mix = np.array([[2.0, 1.5, 0.0, 0.0], [0.0, 0.1, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 7.0]])
    grids = [np.array([5.0, -3.0, 2.0, 1.0]) + rng.normal(size=(6, 5, 4)) @ mix for _ in range(30)]
    statistics = sem.ChannelStatistics()
    for grid in grids:
        statistics.add(grid)
    mean, whiten = statistics.whitening()
    flat = np.concatenate([(g - mean).reshape(-1, 4) @ whiten for g in grids])
    np.testing.assert_allclose(flat.mean(0), 0, atol=1e-9)
    covariance = np.cov(flat.T, bias=True)
    # the third channel is constant, and stays out of every direction
    np.testing.assert_allclose(np.sort(np.diag(covariance)), [0, 1, 1, 1], atol=1e-6)
    np.testing.assert_allclose(covariance, np.diag(np.diag(covariance)), atol=1e-6)
    assert not whiten[2].any()
    # Means are linear: whitening regions is whitening features.
    labels = rng.integers(0, 3, (6, 5))
    one = sem.region_means(grids[0], labels).whitened(mean, whiten)
    np.testing.assert_allclose(
        one.means, sem.region_means((grids[0] - mean) @ whiten, labels).means, atol=1e-9
    )


def test_noise_is_not_blown_up() -> None:
    rng = np.random.default_rng(3)
    base = rng.normal(size=(200, 1))
    statistics = sem.ChannelStatistics()
    statistics.add(np.hstack([base, base + 1e-6 * rng.normal(size=(200, 1))])[None])
    _, whiten = statistics.whitening()
    assert np.abs(whiten).max() < 1e2


def test_the_usual_match_is_the_twentieth_of_static_regions() -> None:
    rng = np.random.default_rng(4)
    statics = [regions(*rng.normal(size=(5, 3)).tolist()) for _ in range(4)]
    units = [[m / np.linalg.norm(m) for m in s.means] for s in statics]
    best = [
        max(a @ b for j, v in enumerate(units) if j != k for b in v) for k, u in enumerate(units) for a in u
    ]
    assert sem.usual_match(statics) == pytest.approx(np.quantile(best, 0.05))
    assert math.isnan(sem.usual_match(statics[:1]))
