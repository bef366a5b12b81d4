import os

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.vision.precompute import cache_key, cached
from ambiguous_wild.vision.segments import GraphSegments, SegmentConfig


def patches() -> torch.Tensor:
    """Twelve plain rectangles: what a segmentation has to find is known."""
    rng = np.random.default_rng(3)
    colours = rng.permutation(12)[:, None] / 12.0 * np.array([[1.0, 0.2, 0.6]])
    return torch.from_numpy(
        cv2.resize(colours.reshape(3, 4, 3).astype(np.float32), (160, 96), interpolation=0)
    )


def test_segments_of_plain_rectangles():
    labels = GraphSegments(SegmentConfig(fewest=12, most=12, sigma=0.1)).labels(patches())
    assert labels.dtype == np.int32
    assert sorted(np.unique(labels)) == list(range(1, 13))
    for row in range(3):
        for column in range(4):  # away from the edges each rectangle is one segment
            cell = labels[row * 32 + 4 : row * 32 + 28, column * 40 + 4 : column * 40 + 36]
            assert len(np.unique(cell)) == 1


def test_segment_count_moves_towards_the_wanted_range():
    rng = np.random.default_rng(0)
    small = cv2.resize(rng.random((30, 50, 3)).astype(np.float32), (240, 135), interpolation=cv2.INTER_CUBIC)
    image = torch.from_numpy(small.clip(0, 1))
    few = GraphSegments(SegmentConfig(fewest=5, most=20)).labels(image).max()
    many = GraphSegments(SegmentConfig(fewest=150, most=300, min_size=10)).labels(image).max()
    assert few < many
    assert np.array_equal(GraphSegments().labels(image), GraphSegments().labels(image))


def test_a_plain_photo_is_one_segment():
    assert GraphSegments().labels(torch.full((40, 60, 3), 0.5)).max() == 1


def test_impossible_range_is_refused():
    with pytest.raises(AwError, match="fewest"):
        GraphSegments(SegmentConfig(fewest=10, most=5))


def test_cache_computes_once_and_mends_what_is_broken(tmp_path):
    calls = []

    def compute() -> dict[str, np.ndarray]:
        calls.append(1)
        return {"x": np.arange(5, dtype=np.int32)}

    def fetch() -> np.ndarray:
        return cached(tmp_path, key, {"x": np.int32}, compute)["x"]

    key = cache_key("kind", "backend-1", SegmentConfig(), np.zeros(3))
    assert np.array_equal(fetch(), fetch())
    assert len(calls) == 1
    path = tmp_path / f"{key}.npz"
    whole = path.read_bytes()
    flipped = whole[:70] + bytes([whole[70] ^ 255]) + whole[71:]
    for damage in (b"", whole[:40], b"not an archive", flipped, whole[: len(whole) // 2] * 2):
        path.write_bytes(damage)
        before = len(calls)
        assert np.array_equal(fetch(), np.arange(5))
        assert len(calls) == before + 1
        assert path.read_bytes() == whole
    assert [p.name for p in tmp_path.iterdir()] == [path.name]  # no temporary is left


def test_cache_refuses_pickles_and_other_dtypes(tmp_path):
    key = cache_key("kind", "backend-1", None)
    np.savez(tmp_path / f"{key}.npz", x=np.array([{"a": 1}], dtype=object))
    good = {"x": np.ones(2, np.float32)}
    assert np.array_equal(cached(tmp_path, key, {"x": np.float32}, lambda: good)["x"], good["x"])
    np.savez(tmp_path / f"{key}.npz", x=np.ones(2, np.float64))
    assert cached(tmp_path, key, {"x": np.float32}, lambda: good)["x"].dtype == np.float32


def test_entries_that_changed_places_are_computed_anew(tmp_path):
    def fetch(photo: int) -> int:
        key = cache_key("kind", "backend-1", None, np.full(3, photo))
        labels = cached(tmp_path, key, {"x": np.int32}, lambda: {"x": np.full(2, photo, np.int32)})["x"]
        return int(labels[0])

    assert [fetch(photo) for photo in range(3)] == [0, 1, 2]
    paths = sorted(tmp_path.iterdir())
    for path, data in zip(paths, [p.read_bytes() for p in (*paths[1:], paths[0])]):
        path.write_bytes(data)
    assert [fetch(photo) for photo in range(3)] == [0, 1, 2]
    with np.load(paths[0]) as entry:  # another array under the hash of the first
        np.savez(tmp_path / paths[0].name, sha256=entry["sha256"], x=entry["x"] + 7)
    assert [fetch(photo) for photo in range(3)] == [0, 1, 2]


def test_cache_key_depends_on_everything():
    array = np.zeros((2, 3), np.float32)
    keys = {
        cache_key("a", "b", {"k": 1}, array),
        cache_key("x", "b", {"k": 1}, array),
        cache_key("a", "x", {"k": 1}, array),
        cache_key("a", "b", {"k": 2}, array),
        cache_key("a", "b", {"k": 1}, array + 1),
        cache_key("a", "b", {"k": 1}, array.reshape(3, 2)),
        cache_key("a", "b", {"k": 1}, array.astype(np.float64)),
    }
    assert len(keys) == 7


def test_old_leftovers_of_killed_writes_are_removed_from_the_cache(tmp_path):
    old, young = tmp_path / ".a.x1.tmp.npz", tmp_path / ".b.x2.tmp.npz"
    other = tmp_path / "segments.npz"
    for path in (old, young, other):
        path.write_bytes(b"half")
    for path in (old, other):
        os.utime(path, (1e9, 1e9))
    cached(tmp_path, "k", {"x": np.int32}, lambda: {"x": np.zeros(1, np.int32)})
    assert sorted(p.name for p in tmp_path.iterdir()) == [young.name, "k.npz", other.name]
