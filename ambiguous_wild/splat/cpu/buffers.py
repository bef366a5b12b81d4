"""Large arrays that are reused from step to step: fresh pages from the system cost more than filling them."""

from __future__ import annotations

import math
import threading
import weakref
from typing import Any

import numpy as np

_LINE = 64  # bytes of a cache line, on which arrays start so that they are accessed in whole lines


class _Memory:
    """A block of bytes that is lent out as one array at a time.

    The lease is an array directly on the bytes. All that is made of it (views, tensors, views of tensors)
    keeps it alive: numpy lets a view refer to the first array whose memory is no other array's. That is the
    lease, because its memory is a memoryview's. So when the lease is gone, nothing can read the bytes.
    """

    __slots__ = ("_bytes", "_lease", "_start")

    def __init__(self, block: np.ndarray, start: int = 0) -> None:
        """
        Args:
            block: [bytes] uint8 that nothing else refers to.
            start: first byte of a lease.
        """
        self._bytes, self._start = memoryview(block), start
        self._lease: weakref.ref[np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self._bytes)

    @property
    def lent(self) -> bool:
        """Whether the last lease, or anything made of it, still exists."""
        return self._lease is not None and self._lease() is not None

    def lend(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """Return an array on the bytes as they are; call it only if nothing is lent."""
        lease = np.frombuffer(self._bytes, dtype, math.prod(shape), self._start)
        self._lease = weakref.ref(lease)
        return lease.reshape(shape)


class BufferPool:
    """Lends arrays, and lends their memory again as soon as nothing refers to an array any more.

    A tensor or view of an array keeps it lent, so the values that a caller holds never change. At most `keep`
    blocks are remembered for each name.
    """

    def __init__(self, keep: int = 3) -> None:
        self._keep = keep
        self._blocks: dict[str, list[_Memory]] = {}
        self._rows: dict[tuple[Any, ...], list[tuple[_Memory, np.ndarray]]] = {}  # each with its mask
        self._lock = threading.Lock()

    def take(
        self, name: str, shape: tuple[int, ...], dtype: Any = np.float32, slack: float = 0.0
    ) -> np.ndarray:
        """Return an array of any content; `slack` is the share of room added for a larger shape next time."""
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
        """Return a float32 array and a mask [rows] bool; rows outside of the mask are zero.

        Code that writes rows updates the mask, so that the next user of the array clears only those.
        """
        with self._lock:
            pairs = self._rows.setdefault((name, *shape), [])
            for memory, dirty in pairs:
                if not memory.lent:
                    return memory.lend(shape, np.float32), dirty
            memory = _Memory(np.zeros(4 * math.prod(shape), np.uint8))
            dirty = np.zeros(shape[0], np.bool_)
            for key in [key for key in self._rows if key[0] == name and key != (name, *shape)]:
                del self._rows[key]
            if len(pairs) < self._keep:
                pairs.append((memory, dirty))
            return memory.lend(shape, np.float32), dirty

    def clear(self) -> None:
        """Forget every array."""
        with self._lock:
            self._blocks.clear()
            self._rows.clear()
