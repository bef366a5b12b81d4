"""Segments grouped by features: what belongs together is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.vision.segments import (
    GroupConfig,
    GroupedSegments,
    SegmentConfig,
    merge_segments,
    neighbours,
    segment_features,
)


def stripes(count: int, height: int = 24, each: int = 8) -> np.ndarray:
    return np.broadcast_to(np.repeat(np.arange(1, count + 1), each), (height, count * each)).astype(np.int32)


def test_neighbours_share_an_edge_and_are_counted_once() -> None:
    labels = np.array([[1, 1, 2], [3, 3, 2], [4, 3, 2]])
    assert neighbours(labels).tolist() == [[1, 2], [1, 3], [2, 3], [3, 4]]


def test_features_of_a_segment_are_the_mean_over_its_cells() -> None:
    rng = np.random.default_rng(0)
    labels, phi = stripes(4), rng.random((6, 8, 5))  # cells of 4 px
    found = segment_features(labels, phi)
    centred = phi - phi.mean((0, 1))
    for k in range(4):
        assert found[k] == pytest.approx(centred[:, 2 * k : 2 * k + 2].mean((0, 1)))
    thirds = segment_features(stripes(3, 12, 8), rng.random((4, 5, 2)))  # cells that segments share
    assert np.isfinite(thirds).all()


def test_similar_neighbours_merge_first_and_the_rest_stays() -> None:
    directions = np.array([[1, 0], [1, 0.05], [0, 1], [0.05, 1], [-1, 0], [-1, 0.3]], float)
    labels = stripes(6)
    merged = merge_segments(labels, directions, GroupConfig(alike=0.6, fewest=1))
    assert merged[0, ::8].tolist() == [1, 1, 2, 2, 3, 3]
    assert merge_segments(labels, directions, GroupConfig(alike=0.6, fewest=4)).max() == 4
    assert np.array_equal(merge_segments(labels, directions, GroupConfig(alike=0.6, fewest=9)), labels)
    assert merge_segments(labels, directions, GroupConfig(alike=1.0, fewest=2)).max() == 2


def test_like_segments_that_do_not_touch_stay_apart() -> None:
    features = np.array([[1.0, 0], [0, 1], [1, 0], [1, 0.1]])
    merged = merge_segments(stripes(4), features, GroupConfig(alike=0.3, fewest=1))
    assert merged[0, ::8].tolist() == [1, 2, 3, 3]


def test_a_group_is_compared_by_all_of_its_pixels() -> None:
    """A large segment outweighs a small one that it has swallowed."""
    labels = np.repeat([1, 2, 3], [40, 2, 20])[None].repeat(4, 0).astype(np.int32)
    features = np.array([[1.0, 0.0], [0.97, 0.243], [0.0, 1.0]])
    merged = merge_segments(labels, features, GroupConfig(alike=0.5, fewest=1))
    assert merged[0, 0] == merged[0, 41] != merged[0, -1]


def test_one_segment_is_one_group() -> None:
    assert merge_segments(np.ones((5, 6), np.int32), np.ones((1, 3)), GroupConfig()).max() == 1


class Colours:
    """Features that are the colours themselves."""

    name, channels, unit = "colours", 3, 1.0

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        return image[::4, ::4]


def test_photos_give_fewer_groups_than_segments_and_outlines_stay() -> None:
    rng = np.random.default_rng(3)
    small = rng.random((12, 16, 3)).astype(np.float32)
    image = torch.from_numpy(cv2.resize(small, (160, 120), interpolation=cv2.INTER_NEAREST))
    plain = GroupedSegments(Colours(), GroupConfig(alike=0.0, fewest=1))  # type: ignore[arg-type]
    grouped = GroupedSegments(Colours(), GroupConfig(alike=0.5, fewest=5))  # type: ignore[arg-type]
    before, after = plain.labels(image), grouped.labels(image)
    assert after.dtype == np.int32 and after.shape == (120, 160)
    assert 5 <= after.max() < before.max() and set(np.unique(after)) == set(range(1, after.max() + 1))
    owners = {tuple(pair) for pair in np.stack([before.ravel(), after.ravel()], 1)}
    assert len(owners) == before.max()  # each segment lies in one group
    assert np.array_equal(after, grouped.labels(image))
    assert plain.name != grouped.name


def test_impossible_settings_are_refused() -> None:
    for settings in ({"alike": 1.5}, {"fewest": 0}):
        with pytest.raises(AwError, match="grouped segments"):
            GroupConfig(**settings)
    assert GroupConfig(segments=SegmentConfig(fewest=10)).segments.fewest == 10
