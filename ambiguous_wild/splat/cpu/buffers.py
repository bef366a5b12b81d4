"""Large arrays used again from step to step: fresh pages from the system cost more than filling them."""

from __future__ import annotations

import math
import threading
import weakref
from typing import Any

import numpy as np

_LINE = 64  # bytes of a cache line; what starts on one is read and written in whole lines


class _Memory:
    """A block of bytes that is lent out as one array at a time.

    The lease is an array right on the bytes. Whatever is made of it (views, tensors, views of tensors) keeps
    the lease alive: numpy shortens a chain of views to the first array that does not lie in another array,
    which is the lease, because it lies in a memoryview. So when the lease is gone, nobody can see the bytes.
    """

    __slots__ = ("_bytes", "_lease", "_start")

    def __init__(self, block: np.ndarray, start: int = 0) -> None:
        """
        Args:
            block: [bytes] uint8, held by nobody else.
            start: byte where leases begin.
        """
        self._bytes, self._start = memoryview(block), start
        self._lease: weakref.ref[np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self._bytes)

    @property
    def lent(self) -> bool:
        """Whether somebody still holds the last lease, or anything made of it."""
        return self._lease is not None and self._lease() is not None

    def lend(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """An array with the content that the bytes have; only where nothing is lent."""
        lease = np.frombuffer(self._bytes, dtype, math.prod(shape), self._start)
        self._lease = weakref.ref(lease)
        return lease.reshape(shape)


class Pool:
    """Hands out arrays, and the same memory again as soon as nobody holds the array.

    A tensor or view made from an array keeps it lent and thereby keeps its memory out of the pool, so what a
    caller holds never changes under it. At most `keep` blocks a kind are remembered.
    """

    def __init__(self, keep: int = 3) -> None:
        self._keep = keep
        self._blocks: dict[str, list[_Memory]] = {}
        self._rows: dict[tuple[Any, ...], list[tuple[_Memory, np.ndarray]]] = {}  # with the mask of each
        self._lock = threading.Lock()

    def take(
        self, name: str, shape: tuple[int, ...], dtype: Any = np.float32, slack: float = 0.0
    ) -> np.ndarray:
        """An array of that shape with any content; `slack` is room for a somewhat larger need next time."""
        room = np.dtype(dtype).itemsize * math.prod(shape)
        with self._lock:
            blocks = self._blocks.setdefault(name, [])
            for memory in blocks:
                if room + _LINE <= len(memory) <= 2 * room + 1024 and not memory.lent:
                    return memory.lend(shape, dtype)
            block = np.empty(int(room * (1 + slack)) + _LINE, np.uint8)
            memory = _Memory(block, -block.ctypes.data % _LINE)
            blocks[:] = [other for other in blocks if other.lent][: self._keep - 1]
            blocks.append(memory)
            return memory.lend(shape, dtype)

    def take_rows(self, name: str, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """A float32 array whose rows are zero but where the mask given with it, [rows] bool, is set.

        Who writes rows keeps the mask up to date, so that the next one to get the array clears only them.
        """
        with self._lock:
            known = self._rows.setdefault((name, *shape), [])
            for memory, dirty in known:
                if not memory.lent:
                    return memory.lend(shape, np.float32), dirty
            memory = _Memory(np.zeros(4 * math.prod(shape), np.uint8))
            dirty = np.zeros(shape[0], np.bool_)
            for key in [key for key in self._rows if key[0] == name and key != (name, *shape)]:
                del self._rows[key]
            if len(known) < self._keep:
                known.append((memory, dirty))
            return memory.lend(shape, np.float32), dirty

    def clear(self) -> None:
        """Forget every array."""
        with self._lock:
            self._blocks.clear()
            self._rows.clear()
