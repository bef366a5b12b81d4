"""Large arrays used again from step to step: fresh pages from the system cost more than filling them."""

from __future__ import annotations

import math
import sys
import threading
from typing import Any

import numpy as np

_LINE = 64  # bytes of a cache line; what starts on one is read and written in whole lines


def _carve(block: np.ndarray, start: int, room: int, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    return block[start : start + room].view(dtype).reshape(shape)


class Pool:
    """Hands out arrays, and the same one again as soon as nobody but the pool holds it.

    A tensor or view made from an array keeps it alive and thereby keeps it out of the pool, so what a
    caller holds never changes under it. At most `keep` arrays a kind are remembered.
    """

    def __init__(self, keep: int = 3) -> None:
        self._keep = keep
        self._blocks: dict[str, list[tuple[np.ndarray, int]]] = {}  # with the byte where a line starts
        self._pairs: dict[tuple[Any, ...], list[tuple[np.ndarray, np.ndarray]]] = {}
        self._lock = threading.Lock()

    def take(
        self, name: str, shape: tuple[int, ...], dtype: Any = np.float32, slack: float = 0.0
    ) -> np.ndarray:
        """An array of that shape with any content; `slack` is room for a somewhat larger need next time."""
        room = np.dtype(dtype).itemsize * math.prod(shape)
        with self._lock:
            blocks = self._blocks.setdefault(name, [])
            for block, start in blocks:
                # References: the pair's, the loop's and the argument of getrefcount.
                if sys.getrefcount(block) <= 3 and room + _LINE <= len(block) <= 2 * room + 1024:
                    return _carve(block, start, room, shape, dtype)
            block = np.empty(int(room * (1 + slack)) + _LINE, np.uint8)
            start = -block.ctypes.data % _LINE
            blocks[:] = [pair for pair in blocks if sys.getrefcount(pair[0]) > 2][: self._keep - 1]
            blocks.append((block, start))
            return _carve(block, start, room, shape, dtype)

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
            self._blocks.clear()
            self._pairs.clear()
