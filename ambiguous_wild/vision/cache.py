"""Frozen inputs on disk: computed once a photo, shared between runs, never trusted blindly."""

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
STALE_S = 24 * 3600.0  # age at which a temporary file belongs to nobody any more


def cache_key(kind: str, backend: str, settings: Any, *arrays: np.ndarray) -> str:
    """What an entry is known by: the exact pixels, the back end's name and version, every setting.

    Args:
        kind: what is stored, e.g. ``"segments"``; the first part of the file's name.
        backend: name of the back end, with its version.
        settings: dataclass or plain data; anything that changes the result.
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
    """The arrays stored under `key`, or computed and stored.

    Args:
        folder: of the cache; made when needed.
        key: from `cache_key`.
        expected: name and dtype of every array. An entry that is corrupt or differs is computed anew.
        compute: makes the arrays.
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


@functools.cache  # once a process and folder: it lists every entry
def _tidy(folder: Path) -> None:
    """Remove what killed writes left; a younger one may still be somebody's."""
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
    # np.load, zipfile, zlib and tokenize have a dozen ways to say that an entry is cut or overwritten
    except Exception:
        return None
    # a member that has lost its first bytes comes as bytes, not as an array
    if any(getattr(a, "dtype", None) != np.dtype(expected[name]) for name, a in arrays.items()):
        return None
    return arrays
