import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.vision import weights
from ambiguous_wild.vision.cache import cache_key, cached
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


def test_weights_are_found_where_they_lie(tmp_path, monkeypatch):
    for name in ("AW_WEIGHTS", "HF_HUB_CACHE", "HF_HOME", "TORCH_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert not any(line.present for line in weights.status())
    assert all(line.command for line in weights.status())

    own = tmp_path / "own"
    monkeypatch.setenv("AW_WEIGHTS", str(own))
    (own / "dinov2-small").mkdir(parents=True)
    (own / "dinov2-small" / "config.json").write_text("{}")
    line = next(x for x in weights.status() if x.name == "dinov2-small")
    assert not line.present
    assert "lacks model.safetensors" in line.where
    (own / "dinov2-small" / "model.safetensors").write_bytes(b"")
    line = next(x for x in weights.status() if x.name == "dinov2-small")
    assert line == ("dinov2-small", True, str(own / "dinov2-small"), "")

    hub = tmp_path / "home/.cache/huggingface/hub/models--facebook--dino-vits16"
    (hub / "refs").mkdir(parents=True)
    (hub / "refs" / "main").write_text("../../outside")
    assert not next(x for x in weights.status() if x.name == "dino-vits16").present
    (hub / "refs" / "main").write_text("abc123")
    (hub / "snapshots" / "abc123").mkdir(parents=True)
    for name in ("config.json", "model.safetensors"):
        (hub / "snapshots" / "abc123" / name).write_bytes(b"")
    assert next(x for x in weights.status() if x.name == "dino-vits16").present


def test_weight_status_imports_neither_torch_nor_transformers():
    code = (
        "import sys; from ambiguous_wild.vision import weights; weights.status();"
        "sys.exit(any(m in sys.modules for m in ('torch', 'transformers', 'numpy')))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_old_leftovers_of_killed_writes_are_removed_from_the_cache(tmp_path):
    old, young = tmp_path / ".a.x1.tmp.npz", tmp_path / ".b.x2.tmp.npz"
    other = tmp_path / "segments.npz"
    for path in (old, young, other):
        path.write_bytes(b"half")
    for path in (old, other):
        os.utime(path, (1e9, 1e9))
    cached(tmp_path, "k", {"x": np.int32}, lambda: {"x": np.zeros(1, np.int32)})
    assert sorted(p.name for p in tmp_path.iterdir()) == [young.name, "k.npz", other.name]


def test_the_download_command_can_be_pasted_with_and_without_a_folder(monkeypatch, tmp_path):
    fake_curl = tmp_path / "bin" / "curl"  # writes what it was asked to download
    fake_curl.parent.mkdir()
    fake_curl.write_text('#!/bin/sh\n[ "$1 $2" = "-fL -o" ] && printf %s "$4" > "$3"\n')
    fake_curl.chmod(0o755)
    monkeypatch.setenv("PATH", f"{fake_curl.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("AW_WEIGHTS", raising=False)
    for line in weights.status():
        assert line.command.startswith("export AW_WEIGHTS=~/.cache/ambiguous_wild/weights && ")
    file = next(w for w in weights.KNOWN if w.kind == "file")
    command = next(s.command for s in weights.status() if s.name == file.name)
    assert subprocess.run(["bash", "-c", command], cwd=tmp_path).returncode == 0
    monkeypatch.setenv("AW_WEIGHTS", str(tmp_path / ".cache/ambiguous_wild/weights"))
    folder, _ = weights.find(file)
    assert folder is not None and (folder / file.files[0]).read_text() == file.url
    assert not any("export" in s.command for s in weights.status())
