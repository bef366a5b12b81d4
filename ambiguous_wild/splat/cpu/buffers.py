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

    def clear(self) -> None:
        """Forget every array."""
        with self._lock:
            self._arrays.clear()
