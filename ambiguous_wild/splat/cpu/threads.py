"""Numba's threads and cache, set once before the first kernel is compiled."""

from __future__ import annotations

import os

import numba


def set_threads(n: int) -> None:
    """Use n threads for the kernels of this process, at most as many as Numba started with.

    Results do not depend on n.
    """
    numba.set_num_threads(max(1, min(int(n), numba.config.NUMBA_NUM_THREADS)))


def threads() -> int:
    """Threads the kernels use."""
    return int(numba.get_num_threads())


_ = os
