"""L1 and SSIM of two pictures with the gradient to the first, fused: two passes over rows of sixteen lanes.

The window is a Gaussian of 11 taps and sigma 1.5, with zero padding, for each channel separately (as in
Inria's code). The gradient is the closed form: with S = A1 A2 / (B1 B2) and w the weight of a pixel, the maps
w dS/dmean, w dS/dE[xx], w dS/dE[xy] are blurred by the same window and multiplied by x and y. Rows of a
picture are stored channel-interleaved, so that a tap to the right is three floats away.
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.splat.cpu.buffers import BufferPool
from ambiguous_wild.splat.cpu.compile import kernel, parallel_kernel, threads
from ambiguous_wild.splat.cpu.simd import fma, load, select, splat, store, sum_lanes

RADIUS = 5
C1 = 0.01**2
C2 = 0.03**2
PAD = 16  # floats on either side of a row buffer, at least 3 * RADIUS
_NONE = np.empty((0, 0), np.float32)  # not given; None would compile another variant


def window() -> np.ndarray:
    """Return the taps [11] float32 of the Gaussian window, sum 1."""
    taps = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    return (taps / taps.sum()).astype(np.float32)


def stride(width: int) -> int:
    """Return the number of floats in a padded row of `width` RGB pixels."""
    return -(-3 * width // 16) * 16


@parallel_kernel
def pack(image, keep, out):
    """Copy [H, W, 3] into rows of whole vectors [H, stride], times keep [H, W] unless it is empty."""
    height, width = image.shape[0], image.shape[1]
    weighted = keep.shape[0] > 0
    for y in numba.prange(height):
        out[y, 3 * width :] = np.float32(0.0)
        for x in range(width):
            for c in range(3):
                value = image[y, x, c]
                if weighted:
                    value *= keep[y, x]
                out[y, 3 * x + c] = value


@kernel
def _statistics_row(
    y, height, width, x_rows, y_rows, taps, keep, scale, buffers, maps, weights, ssim, totals
):
    """Compute row y of the statistics: sums of w |x - y| and w (1 - S), and the three maps times `scale`."""
    length = x_rows.shape[1]
    flat_x = x_rows.reshape(-1)
    flat_y = y_rows.reshape(-1)
    step = length + 2 * PAD
    first = max(0, y - RADIUS)
    last = min(height - 1, y + RADIUS)
    zero = splat(np.float32(0.0))
    for x in range(width):
        w = np.float32(1.0)
        if keep.shape[0] > 0:
            w = keep[y, x]
        weights[3 * x] = w
        weights[3 * x + 1] = w
        weights[3 * x + 2] = w
    for at in range(0, length, 16):
        mx = zero
        my = zero
        xx = zero
        yy = zero
        xy = zero
        for row in range(first, last + 1):
            tap = taps[row - y + RADIUS]
            a = load(flat_x, row * length + at)
            b = load(flat_y, row * length + at)
            ta = a * tap
            tb = b * tap
            mx = mx + ta
            my = my + tb
            xx = fma(ta, a, xx)
            yy = fma(tb, b, yy)
            xy = fma(ta, b, xy)
        store(buffers, PAD + at, mx)
        store(buffers, step + PAD + at, my)
        store(buffers, 2 * step + PAD + at, xx)
        store(buffers, 3 * step + PAD + at, yy)
        store(buffers, 4 * step + PAD + at, xy)
    sum_l1 = zero
    sum_ssim = zero
    flat_maps = maps.reshape(-1)
    for at in range(0, length, 16):
        mx = zero
        my = zero
        xx = zero
        yy = zero
        xy = zero
        for k in range(2 * RADIUS + 1):
            tap = taps[k]
            here = PAD + at + 3 * (k - RADIUS)
            mx = fma(load(buffers, here), tap, mx)
            my = fma(load(buffers, step + here), tap, my)
            xx = fma(load(buffers, 2 * step + here), tap, xx)
            yy = fma(load(buffers, 3 * step + here), tap, yy)
            xy = fma(load(buffers, 4 * step + here), tap, xy)
        mxx = mx * mx
        myy = my * my
        mxy = mx * my
        a1 = fma(mxy, 2.0, C1)
        a2 = fma(xy - mxy, 2.0, C2)
        b1 = mxx + myy + C1
        b2 = (xx - mxx) + (yy - myy) + C2
        inverse = 1.0 / (b1 * b2)
        s = a1 * a2 * inverse
        weight = load(weights, at)
        difference = load(flat_x, y * length + at) - load(flat_y, y * length + at)
        sum_l1 = fma(weight, select(difference > 0.0, difference, zero - difference), sum_l1)
        sum_ssim = fma(weight, 1.0 - s, sum_ssim)
        if ssim.shape[0] > 0:
            store(ssim.reshape(-1), y * length + at, s)
        # dS/dxy, dS/dxx, and dS/dmean with E[xx], E[xy] held fixed.
        d_xy = a1 * inverse * 2.0
        d_xx = zero - s * b1 * inverse
        d_mx = my * (a2 * inverse * 2.0 - d_xy) - mx * (s * b2 * inverse + d_xx) * 2.0
        weight = weight * scale
        store(flat_maps, y * length + at, d_mx * weight)
        store(flat_maps, (height + y) * length + at, d_xx * weight)
        store(flat_maps, (2 * height + y) * length + at, d_xy * weight)
    row_sums = np.empty(16, np.float32)
    store(row_sums, 0, sum_lanes((sum_l1, sum_ssim)))
    totals[y, 0] = row_sums[0]
    totals[y, 1] = row_sums[1]


@kernel
def _gradient_row(y, height, width, x_rows, y_rows, taps, keep, outer, l1_scale, buffers, maps, weights, out):
    """Compute row y of the gradient: the blurred maps plus l1_scale times the sign, times `outer`."""
    length = x_rows.shape[1]
    flat_x = x_rows.reshape(-1)
    flat_y = y_rows.reshape(-1)
    flat = maps.reshape(-1)
    step = length + 2 * PAD
    zero = splat(np.float32(0.0))
    for at in range(0, length, 16):
        m = zero
        xx = zero
        xy = zero
        for row in range(max(0, y - RADIUS), min(height - 1, y + RADIUS) + 1):
            tap = taps[row - y + RADIUS]
            m = fma(load(flat, row * length + at), tap, m)
            xx = fma(load(flat, (height + row) * length + at), tap, xx)
            xy = fma(load(flat, (2 * height + row) * length + at), tap, xy)
        store(buffers, PAD + at, m)
        store(buffers, step + PAD + at, xx)
        store(buffers, 2 * step + PAD + at, xy)
    for x in range(width):
        w = np.float32(1.0)
        if keep.shape[0] > 0:
            w = keep[y, x]
        weights[3 * x] = w
        weights[3 * x + 1] = w
        weights[3 * x + 2] = w
    for at in range(0, length, 16):
        m = zero
        xx = zero
        xy = zero
        for k in range(2 * RADIUS + 1):
            tap = taps[k]
            here = PAD + at + 3 * (k - RADIUS)
            m = fma(load(buffers, here), tap, m)
            xx = fma(load(buffers, step + here), tap, xx)
            xy = fma(load(buffers, 2 * step + here), tap, xy)
        a = load(flat_x, y * length + at)
        b = load(flat_y, y * length + at)
        gradient = m + (a + a) * xx + b * xy
        sign = select(a > b, np.float32(1.0), select(b > a, np.float32(-1.0), np.float32(0.0)))
        gradient = gradient + sign * load(weights, at) * l1_scale
        store(buffers, 3 * step + PAD + at, gradient)
    base = 3 * step + PAD
    for x in range(width):
        chain = np.float32(1.0)
        if outer.shape[0] > 0:
            chain = outer[y, x]
        for c in range(3):
            out[y, x, c] = buffers[base + 3 * x + c] * chain


@parallel_kernel
def photometric(x_rows, y_rows, width, taps, keep, outer, lam, parts, maps, ssim, totals, out):
    """Fill totals [H, 2] float64 (sums of w |x - y| and w (1 - S) a row) and out [H, W, 3], dL/dx.

    Args:
        x_rows, y_rows: [H, stride], from `pack`.
        taps: [11] float32.
        keep: [H, W] weight w; empty for one.
        outer: [H, W] factor chained onto the gradient (the pictures were multiplied by it), or empty.
        lam: share of 1 - SSIM.
        parts: work items; the result does not depend on it.
        maps: [3, H, stride] scratch.
        ssim: [H, stride] out, or empty.
        out: [H, W, 3] out, or empty for the sums alone.
    """
    height, length = x_rows.shape
    scale = np.float32(-lam / (3.0 * height * width))
    l1_scale = np.float32((1.0 - lam) / (3.0 * height * width))
    for part in numba.prange(parts):
        buffers = np.zeros(5 * (length + 2 * PAD), np.float32)
        weights = np.zeros(length, np.float32)
        for y in range(part * height // parts, (part + 1) * height // parts):
            _statistics_row(
                y, height, width, x_rows, y_rows, taps, keep, scale, buffers, maps, weights, ssim, totals
            )
    if out.shape[0] > 0:
        for part in numba.prange(parts):
            buffers = np.zeros(5 * (length + 2 * PAD), np.float32)
            weights = np.zeros(length, np.float32)
            for y in range(part * height // parts, (part + 1) * height // parts):
                _gradient_row(
                    y, height, width, x_rows, y_rows, taps, keep, outer, l1_scale, buffers, maps, weights, out
                )


_pool = BufferPool()
_taps = window()


def _plain(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to(torch.float32).contiguous().numpy()


def _packed(name: str, image: Tensor, keep: np.ndarray) -> np.ndarray:
    rows = _pool.take(name, (image.shape[0], stride(image.shape[1])))
    pack(_plain(image), keep, rows)
    return rows


def photometric_cpu(
    render: Tensor, photo: Tensor, keep: Tensor | None, lambda_dssim: float, weighting: str
) -> tuple[float, float, Tensor]:
    """Return L1, 1 - SSIM and the gradient of their mix; arguments as for `losses.photometric`."""
    height, width = render.shape[:2]
    mask = _NONE if keep is None else _plain(keep)
    inside, outside = (mask, _NONE) if weighting == "images" else (_NONE, mask)
    x_rows = _packed("render", render, inside)
    y_rows = _packed("photo", photo, inside)
    maps = _pool.take("maps", (3, *x_rows.shape))
    totals = np.empty((height, 2), np.float64)
    out = np.empty((height, width, 3), np.float32)
    photometric(
        x_rows, y_rows, width, _taps, outside, inside, float(lambda_dssim), min(height, threads()), maps,
        _NONE, totals, out,
    )  # fmt: skip
    # One serial sum over rows, so that its order, and so the bits, do not depend on the threads.
    l1, dssim = (totals.cumsum(axis=0)[-1] / (3 * height * width)).tolist()
    return l1, dssim, torch.from_numpy(out)


def ssim_map_cpu(a: Tensor, b: Tensor) -> Tensor:
    """Return SSIM of every pixel and channel, [H, W, 3]."""
    height, width = a.shape[:2]
    x_rows = _packed("render", a, _NONE)
    y_rows = _packed("photo", b, _NONE)
    maps = _pool.take("maps", (3, *x_rows.shape))
    out = np.empty(x_rows.shape, np.float32)
    totals = np.empty((height, 2), np.float64)
    parts = min(height, threads())
    photometric(x_rows, y_rows, width, _taps, _NONE, _NONE, 0.0, parts, maps, out, totals, _NONE[..., None])
    return torch.from_numpy(out[:, : 3 * width].reshape(height, width, 3))
