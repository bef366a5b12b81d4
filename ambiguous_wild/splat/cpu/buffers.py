"""Large arrays used again from step to step: fresh pages from the system cost more than filling them."""

from __future__ import annotations

import sys
import threading
from typing import Any

import numpy as np


class Pool:
    """Hands out arrays, and the same one again as soon as nobody but the pool holds it.

    A tensor or view made from an array keeps it alive and thereby keeps it out of the pool, so what a
    caller holds never changes under it. At most `keep` arrays a kind are remembered.
    """

    def __init__(self, keep: int = 3) -> None:
        self._keep = keep
        self._arrays: dict[tuple[Any, ...], list[np.ndarray]] = {}
        self._pairs: dict[tuple[Any, ...], list[tuple[np.ndarray, np.ndarray]]] = {}
        self._lock = threading.Lock()

    def take(
        self, name: str, shape: tuple[int, ...], dtype: Any = np.float32, slack: float = 0.0
    ) -> np.ndarray:
        """An array of that shape with any content; `slack` lets a flat one be reused for smaller needs."""
        size = int(np.prod(shape))
        with self._lock:
            arrays = self._arrays.setdefault((name, np.dtype(dtype).str), [])
            for k in range(len(arrays)):
                # References: the list's, and the argument of getrefcount.
                if sys.getrefcount(arrays[k]) <= 2 and size <= arrays[k].size <= (1 + 2 * slack) * size + 64:
                    return arrays[k][:size].reshape(shape)
            flat = np.empty(max(int(size * (1 + slack)), 1), dtype)
            for k in range(len(arrays) - 1, -1, -1):
                if len(arrays) >= self._keep and sys.getrefcount(arrays[k]) <= 2:
                    del arrays[k]
            if len(arrays) < self._keep:
                arrays.append(flat)
            return flat[:size].reshape(shape)

    def take_rows(self, name: str, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """A float32 array whose rows are zero but where the mask given with it, [rows] bool, is set.

        Who writes rows keeps the mask up to date, so that the next one to get the array clears only them.
        """
        with self._lock:
            pairs = self._pairs.setdefault((name, *shape), [])
            for array, dirty in pairs:
                # References: the pair's, the loop's and the argument of getrefcount.
                if sys.getrefcount(array) <= 3:
                    return array[:], dirty
            array, dirty = np.zeros(shape, np.float32), np.zeros(shape[0], np.bool_)
            for key in [key for key in self._pairs if key[0] == name and key != (name, *shape)]:
                del self._pairs[key]
            if len(pairs) < self._keep:
                pairs.append((array, dirty))
            return array[:], dirty

    def clear(self) -> None:
        """Forget every array."""
        with self._lock:
            self._arrays.clear()
            self._pairs.clear()
