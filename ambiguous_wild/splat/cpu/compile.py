"""How kernels are compiled, and on which threads they run; where they are kept: `io/numba_cache.py`.

The layer is OpenMP where Numba finds it. It shares two cores with torch's threads without loss: a step of 11
ms and torch work of 7 ms took 20 ms one after the other. Numba's work queue took 35 to 80 ms, because torch's
threads wait on the core that its worker needs. The queue is used where there is no OpenMP. It allows one
caller at a time, so parallel kernels run under a lock. OpenMP does not survive a fork: start processes anew.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numba
from numba.extending import intrinsic as _intrinsic

from ambiguous_wild.io.numba_cache import cached_njit

LAYERS = ["omp", "tbb", "workqueue"]  # threading layers; the first that is installed is used
_config: Any = numba.config
_lock = threading.RLock()
_FUSED = {"contract", "arcp"}  # a product into a sum, a division into a product


if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    _config.THREADING_LAYER_PRIORITY = LAYERS


def intrinsic(function: Callable[..., Any]) -> Any:
    """Decorate with Numba's `intrinsic`; untyped, because callers do not pass the typing context."""
    return _intrinsic(function)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile for one thread. Every operation is rounded as written."""
    return cached_njit(function)


def inner_kernel(function: Callable[..., Any]) -> Any:
    """Like `kernel`, for what a kernel calls often; it may not make arrays.

    References to arrays are not counted: two atomic operations for each array of a call took 40 % of Adam.
    """
    return cached_njit(function, _nrt=False)


def fused_kernel(function: Callable[..., Any]) -> Any:
    """Like `kernel`, but a product may be fused into a sum and a division turned into a product.

    NaN and infinity keep their meaning. Do not use it for values that must round alike in two kernels.
    """
    return cached_njit(function, fastmath=_FUSED)


def fused_inner_kernel(function: Callable[..., Any]) -> Any:
    """Like `fused_kernel` and `inner_kernel`, and compiled into its caller."""
    return cached_njit(function, fastmath=_FUSED, _nrt=False, forceinline=True)


class _Serialized:
    """A parallel kernel that only one thread of the process runs at a time."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.compiled = cached_njit(function, parallel=True)
        self.__doc__ = function.__doc__
        self.__name__ = function.__name__

    def __call__(self, *args: Any) -> Any:
        with _lock:
            return self.compiled(*args)


def parallel_kernel(function: Callable[..., Any]) -> Any:
    """Compile with `numba.prange` over threads.

    Its index is unsigned. Where an inner kernel gets it as it is, `0 + index` makes it signed, because Numba
    would compile the inner kernel for both.
    """
    return _Serialized(function)


def set_threads(n: int) -> None:
    """Use n threads for the kernels of this process, at most as many as Numba started with.

    Results do not depend on n.
    """
    numba.set_num_threads(max(1, min(int(n), _config.NUMBA_NUM_THREADS)))


def threads() -> int:
    """Return the number of threads that the kernels use."""
    return int(numba.get_num_threads())


@contextmanager
def one_thread() -> Iterator[None]:
    """Run kernels on one thread inside of the context."""
    before = threads()
    set_threads(1)
    try:
        yield
    finally:
        set_threads(before)


@contextmanager
def torch_threads(count: int | None = None) -> Iterator[None]:
    """Let torch use this many threads inside of the context; None = as many as the kernels.

    Their number decides the last bits of sums and matrix products, but not of what is computed element by
    element. With Numba's work queue torch would wait for its own threads, so there it keeps one.
    """
    import torch

    before = torch.get_num_threads()
    if count is None:
        count = threads()  # it also starts the layer that is asked for next
        count = before if numba.threading_layer() == "workqueue" else count
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
