"""Cache of features and masks on disk: computed once a photo, shared between runs, checked when read."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core.config import to_plain
from ambiguous_wild.io.atomic import atomic_path
from ambiguous_wild.io.hashing import sha256_array

Arrays = dict[str, np.ndarray]
STALE_S = 24 * 3600.0  # older temporary files are leftovers of a killed process


def cache_key(kind: str, backend: str, settings: Any, *arrays: np.ndarray) -> str:
    """Key of an entry: hash of the pixels, the back end's name and version, and every setting.

    Args:
        kind: of the content, e.g. ``"segments"``; the first part of the file's name.
        backend: name of the back end, with its version.
        settings: dataclass or plain data; everything that changes the result.
        arrays: the inputs, hashed with shape and dtype.
    """
    digest = hashlib.sha256()
    digest.update(json.dumps([kind, backend, to_plain(settings)], sort_keys=True).encode())
    for array in arrays:
        digest.update(sha256_array(array).encode())
    return f"{kind}-{digest.hexdigest()[:32]}"


def cached(
    folder: Path, key: str, expected: Mapping[str, type | str], compute: Callable[[], Arrays]
) -> Arrays:
    """Load the arrays stored under `key`, else compute and store them.

    Args:
        folder: of the cache; created if needed.
        key: from `cache_key`.
        expected: name and dtype of every array. A damaged or different entry is computed again.
        compute: computes the arrays.
    """
    _tidy(folder)
    path = folder / f"{key}.npz"
    found = _load(path, expected)
    if found is not None:
        return found
    arrays = compute()
    with atomic_path(path) as temporary, open(temporary, "wb") as f:
        np.savez_compressed(f, **arrays)  # type: ignore[arg-type]
    return arrays


@functools.cache  # once per process and folder, because it lists every entry
def _tidy(folder: Path) -> None:
    """Remove temporary files of killed processes; a recent one may still be in use."""
    for left in folder.glob(".*.tmp*"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > STALE_S:
                left.unlink()


def _load(path: Path, expected: Mapping[str, type | str]) -> Arrays | None:
    try:
        with np.load(path, allow_pickle=False) as entry:
            if set(entry.files) != set(expected):
                return None
            arrays = {name: entry[name] for name in entry.files}
    # np.load, zipfile, zlib and tokenize raise many types for a damaged entry
    except Exception:
        return None
    # np.load returns a member with damaged first bytes as bytes, not as an array
    if any(getattr(a, "dtype", None) != np.dtype(expected[name]) for name, a in arrays.items()):
        return None
    return arrays
