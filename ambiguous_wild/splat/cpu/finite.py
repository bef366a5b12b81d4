"""Whether tensors hold a NaN or an infinity, in one call and without writing a tensor of its own."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from torch import Tensor

from ambiguous_wild.splat.cpu.compile import kernel

_MAGNITUDE = np.int32(0x7FFFFFFF)  # all of a float32 but its sign
_INFINITY = np.int32(0x7F800000)  # as an integer: every finite magnitude lies below, every NaN above


@kernel
def _largest(arrays):
    """The largest magnitude as an integer, in which magnitudes order as they do as numbers."""
    largest = np.int32(0)
    for bits in arrays:
        for i in range(bits.shape[0]):
            largest = max(largest, bits[i] & _MAGNITUDE)
    return largest


def all_finite(tensors: Iterable[Tensor]) -> bool:
    """Whether every value of these contiguous float32 tensors on the CPU is a finite number."""
    bits = tuple([t.numpy().reshape(-1).view(np.int32) for t in tensors])
    return bool(_largest(bits) < _INFINITY)
