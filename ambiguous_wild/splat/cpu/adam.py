"""Kernels over flat arrays: Adam in sixteen lanes, and a check that all values are finite.

Adam has one definition for every row, seen or not: a row that no view sees has gradient zero, its moments
decay and it moves on momentum alone. The dense step and the pending steps both run `_moments` and
`_change`, so that postponing changes no bit.
"""

from __future__ import annotations

from collections.abc import Iterable

import numba
import numpy as np
from torch import Tensor

from ambiguous_wild.splat.cpu.compile import inner_kernel, kernel, parallel_kernel, threads
from ambiguous_wild.splat.cpu.simd import (
    any_lane,
    fma,
    load,
    load_some,
    magnitude,
    select,
    splat,
    square_root,
    store,
    store_some,
)

BETAS, EPS = (0.9, 0.999), 1e-15
# 1 - beta is computed in float64, then rounded: with float32(0.999) it would be off by 5e-5 of 0.001.
_BETA1, _REST1, _BETA2, _REST2 = (np.float32(c) for b in BETAS for c in (b, 1 - b))
_EPS = np.float32(EPS)
# Denormal numbers cost a hundred cycles an operation and change nothing: at |m| < 1e-30 a step is below 1e-15
# of the learning rate, even if v is 0 and the denominator is eps = 1e-15.
_TINY_M = np.float32(1e-30)
_TINY_V = np.float32(1.2e-38)
_MAGNITUDE = np.int32(0x7FFFFFFF)  # all bits of a float32 but its sign
_INFINITY = np.int32(0x7F800000)  # as an integer: finite magnitudes are smaller, NaN is larger


@inner_kernel
def _moments(m, v, g):
    m = fma(g, _REST1, m * _BETA1)
    v = fma(g * g, _REST2, v * _BETA2)
    return select(magnitude(m) >= _TINY_M, m, np.float32(0.0)), select(v >= _TINY_V, v, np.float32(0.0))


@inner_kernel
def _change(m, v, rate, root):
    """rate m / (sqrt(v) root + EPS), with rate = lr / bias1 and root = 1 / sqrt(bias2)."""
    return m * rate / fma(square_root(v), root, _EPS)


@inner_kernel
def _read(array, at, count):
    """Read up to 16 values; without a mask if there are 16: a step takes 0.3 ms, with masks 0.6 ms."""
    return load(array, at) if count == 16 else load_some(array, at, count)


@inner_kernel
def _write(array, at, value, count):
    """Write up to 16 values, as `_read`."""
    if count == 16:
        store(array, at, value)
    else:
        store_some(array, at, value, count)


@inner_kernel
def _dense_range(begin, end, p, m, v, g, rate, root):
    """Step the values begin .. end - 1 of flat arrays."""
    for at in range(begin, end, 16):
        count = min(16, end - at)
        mean, square = _moments(_read(m, at, count), _read(v, at, count), _read(g, at, count))
        _write(m, at, mean, count)
        _write(v, at, square, count)
        _write(p, at, _read(p, at, count) - _change(mean, square, rate, root), count)


@kernel
def _dense_part(part, parts, p, m, v, g, rate, root):
    """Step slice number `part` of `parts` slices of flat arrays."""
    blocks = (p.shape[0] + 15) // 16
    begin = part * blocks // parts * 16
    end = min((part + 1) * blocks // parts * 16, p.shape[0])
    _dense_range(begin, end, p, m, v, g, rate, root)


@parallel_kernel
def dense(p, m, v, g, rate, root, parts):
    """Step flat arrays."""
    for part in numba.prange(parts):
        _dense_part(0 + part, parts, p, m, v, g, rate, root)


@inner_kernel
def _advance(p, m, v, at, count, first, last, rates, roots):
    """Take steps first .. last - 1, with gradient zero, for up to 16 values from flat index `at`."""
    value = _read(p, at, count)
    mean = _read(m, at, count)
    square = _read(v, at, count)
    zero = splat(np.float32(0.0))
    moving = any_lane(magnitude(mean) > np.float32(0.0))
    for k in range(first, last):
        mean, square = _moments(mean, square, zero)
        if moving:
            change = _change(mean, square, rates[k], roots[k])
            value = value - change
            # The change shrinks by beta1 / sqrt(beta2) a step: once a thousand times it would be lost in
            # rounding, later ones are too, unless the rate rises a thousandfold.
            if k & 7 == 7:
                far = magnitude(change) * np.float32(1024.0)
                moving = any_lane(magnitude(value + far - value) > np.float32(0.0)) or any_lane(
                    magnitude(value - far - value) > np.float32(0.0)
                )
    _write(p, at, value, count)
    _write(m, at, mean, count)
    _write(v, at, square, count)


@inner_kernel
def _row_catch_up(row, width, p, m, v, last, now, rates, roots):
    if last[row] < now:
        for at in range(row * width, row * width + width, 16):
            count = min(16, row * width + width - at)
            _advance(p, m, v, at, count, last[row], now, rates, roots)
        last[row] = now


@parallel_kernel
def catch_up(rows, width, p, m, v, last, now, rates, roots, parts):
    """Bring rows up to step `now`. last[row] counts a row's steps; flat arrays have `width` values a row."""
    n = rows.shape[0]
    for part in numba.prange(parts):
        for k in range(part * n // parts, (part + 1) * n // parts):
            _row_catch_up(np.int64(rows[k]), width, p, m, v, last, now, rates, roots)


@parallel_kernel
def sparse(visible, width, p, m, v, g, last, now, rates, roots, parts):
    """Take step `now` (counted from 0) of the visible rows; the others are pending."""
    n = visible.shape[0]
    for part in numba.prange(parts):
        row = part * n // parts
        stop = (part + 1) * n // parts
        while row < stop:
            begin = row
            while row < stop and visible[row]:
                _row_catch_up(row, width, p, m, v, last, now, rates, roots)
                last[row] = now + 1
                row += 1
            # neighbouring rows are stepped together: a single row ends in a vector that is not full
            _dense_range(begin * width, row * width, p, m, v, g, rates[now], roots[now])
            row += 1


def flat(parameter: Tensor, moments: tuple[Tensor, Tensor]) -> tuple[np.ndarray, ...]:
    """Return a parameter and its moments as flat arrays on the same memory.

    Raises:
        RuntimeError: the parameter is not contiguous.
    """
    if not parameter.is_contiguous():
        raise RuntimeError(f"a parameter {list(parameter.shape)} is not contiguous: Adam changes it in place")
    return tuple(tensor.detach().numpy().reshape(-1) for tensor in (parameter, *moments))


def step_size(rate: float, steps: int) -> tuple[np.float32, np.float32]:
    """Return lr / bias1 and 1 / sqrt(bias2) of step number `steps`, counted from 1."""
    return np.float32(rate / (1 - BETAS[0] ** steps)), np.float32((1 - BETAS[1] ** steps) ** -0.5)


def dense_step(
    parameter: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rate: float, steps: int
) -> None:
    """Step every value in place; arguments as for `Backend.adam_step`."""
    arrays = *flat(parameter, moments), gradient.numpy().reshape(-1)
    dense(*arrays, *step_size(rate, steps), 8 * threads())


@kernel
def _largest(arrays):
    """Return the largest magnitude as an integer; as integers magnitudes have the same order."""
    largest = np.int32(0)
    for bits in arrays:
        for i in range(bits.shape[0]):
            largest = max(largest, bits[i] & _MAGNITUDE)
    return largest


def all_finite(tensors: Iterable[Tensor]) -> bool:
    """Whether every value of these contiguous float32 tensors on the CPU is a finite number."""
    bits = tuple([t.numpy().reshape(-1).view(np.int32) for t in tensors])
    return bool(_largest(bits) < _INFINITY)
