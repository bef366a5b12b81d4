"""A damaged entry of any cache is made anew: never an error, never used."""

import importlib.util
import io
import os
import zipfile

import numpy as np
import pytest

from ambiguous_wild.io import numba_cache
from ambiguous_wild.vision.precompute import cached


def zip_of(name, data):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr(name, data)
    return out.getvalue()


DAMAGE = {
    "empty": lambda data: b"",
    "cut": lambda data: data[: len(data) // 2],
    "garbage": lambda data: np.random.default_rng(0).bytes(len(data)),
    "a member that is no array": lambda data: zip_of("labels.npy", b"no array"),
    "another archive": lambda data: b"PK\x05\x06" + bytes(18),
}
LABELS = np.arange(12, dtype=np.int32).reshape(3, 4)


@pytest.mark.parametrize("how", DAMAGE)
def test_features_and_instance_masks_are_computed_anew(tmp_path, how):
    calls = []

    def compute():
        calls.append(how)
        return {"labels": LABELS}

    expected = {"labels": np.int32}
    cached(tmp_path, "segments-1", expected, compute)
    entry = tmp_path / "segments-1.npz"
    whole = entry.read_bytes()
    entry.write_bytes(DAMAGE[how](whole))
    assert np.array_equal(cached(tmp_path, "segments-1", expected, compute)["labels"], LABELS)
    assert len(calls) == 2
    assert np.array_equal(cached(tmp_path, "segments-1", expected, compute)["labels"], LABELS)
    assert len(calls) == 2  # the entry was mended
    assert os.listdir(tmp_path) == ["segments-1.npz"]


@pytest.mark.parametrize("how", ["empty", "cut", "garbage"])
@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_compiled_kernels_are_compiled_anew(tmp_path, monkeypatch, how, suffix):
    monkeypatch.setattr(numba_cache, "cache_in_use", lambda: tmp_path / "kernels")
    source = tmp_path / "doubling.py"
    source.write_text(
        "from ambiguous_wild.splat.cpu.compile import kernel\n@kernel\ndef double(x):\n    return 2 * x\n"
    )

    def double():
        spec = importlib.util.spec_from_file_location("doubling", source)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        assert module.double(3.5) == 7.0
        return sum(module.double.stats.cache_hits.values())

    assert double() == 0
    assert double() == 1
    (entry,) = (tmp_path / "kernels").rglob("*" + suffix)
    entry.write_bytes(DAMAGE[how](entry.read_bytes()))
    assert double() == 0
    assert double() == 1


def test_kernels_run_where_nothing_can_be_kept(tmp_path, monkeypatch):
    (tmp_path / "kernels").write_text("a file where the folder should be")
    monkeypatch.setattr(numba_cache, "cache_in_use", lambda: tmp_path / "kernels")
    assert numba_cache.cached_njit(_triple)(2) == 6


def _triple(x):
    return 3 * x
