"""Sphere tracing of a signed distance grid: intersection with a ray, and surface normal."""

from __future__ import annotations

import math

import numba

from ambiguous_wild.io.numba_cache import rebuild_damaged_cache

_STEPS = 128
_NEAR_M = 4e-4  # distance at which a ray has reached the surface


@rebuild_damaged_cache
@numba.njit(cache=True, error_model="numpy", inline="never")
def distance(volume, x, y, z):
    """Trilinear value of `volume` [N, N, N] at a point of the cube [-1, 1]^3, clamped to it."""
    n = volume.shape[0]
    gx = min(max((x + 1.0) * 0.5 * (n - 1), 0.0), n - 1.001)
    gy = min(max((y + 1.0) * 0.5 * (n - 1), 0.0), n - 1.001)
    gz = min(max((z + 1.0) * 0.5 * (n - 1), 0.0), n - 1.001)
    i, j, k = int(gz), int(gy), int(gx)
    c, b, a = gz - i, gy - j, gx - k
    low = (1 - b) * ((1 - a) * volume[i, j, k] + a * volume[i, j, k + 1]) + b * (
        (1 - a) * volume[i, j + 1, k] + a * volume[i, j + 1, k + 1]
    )
    high = (1 - b) * ((1 - a) * volume[i + 1, j, k] + a * volume[i + 1, j, k + 1]) + b * (
        (1 - a) * volume[i + 1, j + 1, k] + a * volume[i + 1, j + 1, k + 1]
    )
    return (1 - c) * low + c * high


@rebuild_damaged_cache
@numba.njit(cache=True, error_model="numpy", inline="never")
def sphere_trace(volume, o, d, size, far):
    """Distance along the local ray o + t d, d of unit length, to the volume's surface, or `far`."""
    start, end = 1e-6, far
    for axis in range(3):
        oa = o[0] if axis == 0 else (o[1] if axis == 1 else o[2])
        da = d[0] if axis == 0 else (d[1] if axis == 1 else d[2])
        if abs(da) < 1e-12:
            if abs(oa) > size:
                return far
            continue
        t0, t1 = (-size - oa) / da, (size - oa) / da
        start, end = max(start, min(t0, t1)), min(end, max(t0, t1))
    t = start
    for _ in range(_STEPS):
        if t >= end:
            return far
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        gap = size * distance(volume, x / size, y / size, z / size)
        if gap < _NEAR_M:
            return t
        t += max(0.8 * gap, _NEAR_M)
    return far


@rebuild_damaged_cache
@numba.njit(cache=True, error_model="numpy", inline="never")
def surface_normal(volume, p, size, d):
    """Unit normal at the local point by central differences over one cell, turned against the ray."""
    x, y, z = p[0] / size, p[1] / size, p[2] / size
    e = 2.0 / (volume.shape[0] - 1)
    nx = distance(volume, x + e, y, z) - distance(volume, x - e, y, z)
    ny = distance(volume, x, y + e, z) - distance(volume, x, y - e, z)
    nz = distance(volume, x, y, z + e) - distance(volume, x, y, z - e)
    scale = 1.0 / max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
    if nx * d[0] + ny * d[1] + nz * d[2] > 0:
        scale = -scale
    return nx * scale, ny * scale, nz * scale
