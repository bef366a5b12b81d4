"""From Gaussians to splats: activations, EWA projection, culls and colours, one record of 16 floats each.

The projection is that of gsplat, with opacity-aware extents. The blurred
2D covariance S is stored in a form that needs no difference of large numbers: with ``k = Sxy / Syy``,
``v = det S / Syy`` (variance of x given y) and ``q = 1 / Syy``,

    sigma = u^2 / (2 v) + q dy^2 / 2,    u = dx - k dy,

and ``det S = |f1 x f2|^2 + blur trace + blur^2`` where f1, f2 are the rows of J W R diag(s). So a needle of
aspect 1e6 keeps its shape in float32.

Colours are real spherical harmonics to degree 3; their values are computed where they are needed, forward and
backward, and not stored.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from ambiguous_wild.splat.cpu.compile import fused_inner_kernel, fused_kernel, parallel_kernel
from ambiguous_wild.splat.cpu.simd import (
    LANES,
    at_least,
    at_most,
    bits_of,
    ceiling,
    exp,
    floor,
    load8,
    log,
    magnitude,
    square_root,
    store,
)

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
BLUR = 0.3  # px^2 added to both variances unless a method says otherwise
NEAR = 0.01  # smallest depth that is drawn
MIN_ALPHA = 1.0 / 255.0
CHUNK = 1024  # Gaussians of a work item; records of a chunk are contiguous
GROUP = 64  # Gaussians whose values are transposed together, and then computed eight at a time
RECORD = 16  # floats a record: one cache line
# Fields of a record.
MX, MY, SLANT, CURVE_X, CURVE_Y, LOG2_OPACITY, RED, GREEN, BLUE, DEPTH = range(10)
EXTENT_X, EXTENT_Y, VARIANCE_Y, VARIANCE_X, HALF_WIDTH, OPACITY = range(10, 16)
_LOG2E = 1.4426950408889634
_LOG_255 = math.log(255.0)
_FAR_PX = 1e15  # centres farther out have no accurate position in float32
_HUGE = 1e30
_SHORT = 1e-30  # least norm of a quaternion: its gradient is divided by it, and float32 ends at 3e38


@fused_kernel
def basis(x, y, z, degree, out):
    """Write the harmonics 1 .. (degree + 1)^2 - 1 at a unit direction to `out`, in 3DGS's order and signs."""
    if degree >= 1:
        out[0] = -C1 * y
        out[1] = C1 * z
        out[2] = -C1 * x
    if degree >= 2:
        out[3] = C2[0] * x * y
        out[4] = -C2[0] * y * z
        out[5] = C2[1] * (2.0 * z * z - x * x - y * y)
        out[6] = -C2[0] * x * z
        out[7] = C2[2] * (x * x - y * y)
    if degree >= 3:
        out[8] = -C3[0] * y * (3.0 * x * x - y * y)
        out[9] = C3[1] * x * y * z
        out[10] = -C3[2] * y * (4.0 * z * z - x * x - y * y)
        out[11] = C3[3] * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
        out[12] = -C3[2] * x * (4.0 * z * z - x * x - y * y)
        out[13] = C3[4] * z * (x * x - y * y)
        out[14] = -C3[0] * x * (x * x - 3.0 * y * y)


@fused_inner_kernel
def direction_gradient(x, y, z, degree, d):
    """Return sum_j d[j] * d(basis j)/d(x, y, z), for harmonics as polynomials of three free variables."""
    gx = -C1 * d[2]
    gy = -C1 * d[0]
    gz = C1 * d[1]
    if degree >= 2:
        gx += C2[0] * (y * d[3] - z * d[6]) - 2.0 * C2[1] * x * d[5] + 2.0 * C2[2] * x * d[7]
        gy += C2[0] * (x * d[3] - z * d[4]) - 2.0 * C2[1] * y * d[5] - 2.0 * C2[2] * y * d[7]
        gz += -C2[0] * (y * d[4] + x * d[6]) + 4.0 * C2[1] * z * d[5]
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        gx += (
            -6.0 * C3[0] * x * y * d[8]
            + C3[1] * y * z * d[9]
            + 2.0 * C3[2] * x * y * d[10]
            - 6.0 * C3[3] * x * z * d[11]
            - C3[2] * (4.0 * zz - 3.0 * xx - yy) * d[12]
            + 2.0 * C3[4] * x * z * d[13]
            - 3.0 * C3[0] * (xx - yy) * d[14]
        )
        gy += (
            -3.0 * C3[0] * (xx - yy) * d[8]
            + C3[1] * x * z * d[9]
            - C3[2] * (4.0 * zz - xx - 3.0 * yy) * d[10]
            - 6.0 * C3[3] * y * z * d[11]
            + 2.0 * C3[2] * x * y * d[12]
            - 2.0 * C3[4] * y * z * d[13]
            + 6.0 * C3[0] * x * y * d[14]
        )
        gz += (
            C3[1] * x * y * d[9]
            - 8.0 * C3[2] * y * z * d[10]
            + C3[3] * (6.0 * zz - 3.0 * xx - 3.0 * yy) * d[11]
            - 8.0 * C3[2] * x * z * d[12]
            + C3[4] * (xx - yy) * d[13]
        )
    return gx, gy, gz


@fused_kernel
def _colours_chunk(first, stop, means, sh0, sh_rest, degree, centre, records, ids, radii, base):
    terms = (degree + 1) * (degree + 1) - 1
    values = np.zeros(15, np.float32)
    for slot in range(first, stop):
        i = ids[slot]
        red = np.float32(C0) * sh0[i, 0] + np.float32(0.5)
        green = np.float32(C0) * sh0[i, 1] + np.float32(0.5)
        blue = np.float32(C0) * sh0[i, 2] + np.float32(0.5)
        if degree > 0:
            x = means[i, 0] - centre[0]
            y = means[i, 1] - centre[1]
            z = means[i, 2] - centre[2]
            inv = 1.0 / math.sqrt(x * x + y * y + z * z)
            basis(np.float32(x * inv), np.float32(y * inv), np.float32(z * inv), degree, values)
            for j in range(terms):
                red += values[j] * sh_rest[i, j, 0]
                green += values[j] * sh_rest[i, j, 1]
                blue += values[j] * sh_rest[i, j, 2]
        if not (abs(red) < np.inf and abs(green) < np.inf and abs(blue) < np.inf):
            ids[slot] = -1
            radii[i] = np.float32(0.0)
            continue
        if base is not None:
            base[slot, 0] = red
            base[slot, 1] = green
            base[slot, 2] = blue
        records[slot, RED] = max(red, np.float32(0.0))
        records[slot, GREEN] = max(green, np.float32(0.0))
        records[slot, BLUE] = max(blue, np.float32(0.0))


@parallel_kernel
def colours(means, sh0, sh_rest, degree, centre, records, ids, counts, radii, base):
    """Fill red, green, blue of the records: max(SH(direction) + 0.5, 0).

    A Gaussian whose colour is not finite is not drawn: it gets id -1 and radius 0. `base` [slots, 3] or None
    gets the colours before they are clamped, for a shading function.
    """
    for chunk in numba.prange(counts.shape[0]):
        first = chunk * CHUNK
        _colours_chunk(
            first, first + counts[chunk], means, sh0, sh_rest, degree, centre, records, ids, radii, base
        )


@fused_kernel
def footprint(quat, cam, x, y, z):
    """Return the rows p, q of J W R, those of J W, and R: S and its gradient are computed from these.

    Args:
        quat: w, x, y, z of norm 1, each a vector.
        cam: as in `project`.
        x, y, z: the centre in the camera's coordinates.
    """
    w_, qx, qy, qz = quat
    near = 1.0 / z
    rx = at_most(at_least(x * near, cam[18]), cam[19])
    ry = at_most(at_least(y * near, cam[20]), cam[21])
    gx = cam[12] * near
    gy = cam[13] * near
    a = (gx * (cam[0] - rx * cam[8]), gx * (cam[1] - rx * cam[9]), gx * (cam[2] - rx * cam[10]))
    b = (gy * (cam[4] - ry * cam[8]), gy * (cam[5] - ry * cam[9]), gy * (cam[6] - ry * cam[10]))
    r00 = 1.0 - 2.0 * (qy * qy + qz * qz)
    r01 = 2.0 * (qx * qy - w_ * qz)
    r02 = 2.0 * (qx * qz + w_ * qy)
    r10 = 2.0 * (qx * qy + w_ * qz)
    r11 = 1.0 - 2.0 * (qx * qx + qz * qz)
    r12 = 2.0 * (qy * qz - w_ * qx)
    r20 = 2.0 * (qx * qz - w_ * qy)
    r21 = 2.0 * (qy * qz + w_ * qx)
    r22 = 1.0 - 2.0 * (qx * qx + qy * qy)
    p = (
        a[0] * r00 + a[1] * r10 + a[2] * r20,
        a[0] * r01 + a[1] * r11 + a[2] * r21,
        a[0] * r02 + a[1] * r12 + a[2] * r22,
    )
    q = (
        b[0] * r00 + b[1] * r10 + b[2] * r20,
        b[0] * r01 + b[1] * r11 + b[2] * r21,
        b[0] * r02 + b[1] * r12 + b[2] * r22,
    )
    return p, q, a, b, (r00, r01, r02, r10, r11, r12, r20, r21, r22)


@fused_inner_kernel
def take(given, k, i, means, quats, log_scales, opacity_logits):
    """Put Gaussian i into column k of `given` [>= 11, GROUP]."""
    given[0, k] = means[i, 0]
    given[1, k] = means[i, 1]
    given[2, k] = means[i, 2]
    given[3, k] = quats[i, 0]
    given[4, k] = quats[i, 1]
    given[5, k] = quats[i, 2]
    given[6, k] = quats[i, 3]
    given[7, k] = log_scales[i, 0]
    given[8, k] = log_scales[i, 1]
    given[9, k] = log_scales[i, 2]
    given[10, k] = opacity_logits[i]


@fused_kernel
def in_camera(given, at, cam):
    """Return the centres of columns at .. at + 7 in the camera's coordinates."""
    m0 = load8(given, at)
    m1 = load8(given, GROUP + at)
    m2 = load8(given, 2 * GROUP + at)
    return (
        cam[0] * m0 + cam[1] * m1 + cam[2] * m2 + cam[3],
        cam[4] * m0 + cam[5] * m1 + cam[6] * m2 + cam[7],
        cam[8] * m0 + cam[9] * m1 + cam[10] * m2 + cam[11],
    )


@fused_kernel
def shape_of(given, at):
    """Return unit quaternion, norm before normalisation, and scales of columns at .. at + 7."""
    w_ = load8(given, 3 * GROUP + at)
    qx = load8(given, 4 * GROUP + at)
    qy = load8(given, 5 * GROUP + at)
    qz = load8(given, 6 * GROUP + at)
    norm = square_root(w_ * w_ + qx * qx + qy * qy + qz * qz)
    inv = 1.0 / norm
    scales = (
        exp(load8(given, 7 * GROUP + at)),
        exp(load8(given, 8 * GROUP + at)),
        exp(load8(given, 9 * GROUP + at)),
    )
    return (w_ * inv, qx * inv, qy * inv, qz * inv), norm, scales


@fused_kernel
def _project_eight(given, at, cam, antialias, splats):
    """Project columns at .. at + 7 into `splats` [14, GROUP]; returns which pass the culls, as bits."""
    blur = cam[22]
    x, y, z = in_camera(given, at, cam)
    # Comparisons are written so that NaN fails them: a broken Gaussian is culled.
    seen = (z >= NEAR) & (z < _HUGE)
    logit = load8(given, 10 * GROUP + at)
    seen = seen & (logit > -5.6)  # sigmoid below 1/255
    quat, norm, scales = shape_of(given, at)
    seen = seen & (norm > _SHORT) & (norm < _HUGE)
    p, q, _, _, _ = footprint(quat, cam, x, y, z)
    p0, p1, p2 = p[0] * scales[0], p[1] * scales[1], p[2] * scales[2]
    q0, q1, q2 = q[0] * scales[0], q[1] * scales[1], q[2] * scales[2]
    sxx = p0 * p0 + p1 * p1 + p2 * p2
    syy = q0 * q0 + q1 * q1 + q2 * q2
    sxy = p0 * q0 + p1 * q1 + p2 * q2
    n0 = p1 * q2 - p2 * q1
    n1 = p2 * q0 - p0 * q2
    n2 = p0 * q1 - p1 * q0
    det0 = n0 * n0 + n1 * n1 + n2 * n2
    det = det0 + blur * (sxx + syy) + cam[23]
    sxx = sxx + blur
    syy = syy + blur
    seen = seen & (sxx < _HUGE) & (syy < _HUGE) & (det < _HUGE)
    opacity = 1.0 / (1.0 + exp(0.0 - logit))
    if antialias:
        opacity = opacity * square_root(det0 / det)
    seen = seen & (opacity >= MIN_ALPHA)
    strength = log(opacity)
    tau = 2.0 * (strength + _LOG_255)
    ex = square_root(tau * sxx)
    ey = square_root(tau * syy)
    u = cam[12] * x / z + cam[14]
    v = cam[13] * y / z + cam[15]
    seen = seen & (magnitude(u) < _FAR_PX) & (magnitude(v) < _FAR_PX)
    seen = seen & (u - ex < cam[16]) & (u + ex > 0.0) & (v - ey < cam[17]) & (v + ey > 0.0)
    seen = seen & (ceiling(at_least(u - ex - 0.5, 0.0)) <= floor(at_most(u + ex, cam[16]) - 0.5))
    seen = seen & (ceiling(at_least(v - ey - 0.5, 0.0)) <= floor(at_most(v + ey, cam[17]) - 0.5))
    half = 0.5 * (sxx - syy)
    store(splats, at, u)
    store(splats, GROUP + at, v)
    store(splats, 2 * GROUP + at, sxy / syy)
    store(splats, 3 * GROUP + at, -0.5 * _LOG2E * syy / det)
    store(splats, 4 * GROUP + at, -0.5 * _LOG2E / syy)
    store(splats, 5 * GROUP + at, strength * _LOG2E)
    store(splats, 6 * GROUP + at, z)
    store(splats, 7 * GROUP + at, ex)
    store(splats, 8 * GROUP + at, ey)
    store(splats, 9 * GROUP + at, syy)
    store(splats, 10 * GROUP + at, sxx)
    store(splats, 11 * GROUP + at, square_root(tau * det / syy))
    store(splats, 12 * GROUP + at, opacity)
    widest = 0.5 * (sxx + syy) + square_root(half * half + sxy * sxy)  # variance along the long axis
    store(splats, 13 * GROUP + at, square_root(tau * widest))
    return bits_of(seen)


@fused_kernel
def _project_chunk(first, means, quats, log_scales, opacity_logits, cam, antialias, records, ids, radii):
    slot = first
    stop = min(first + CHUNK, means.shape[0])
    given = np.zeros((11, GROUP), np.float32)
    splats = np.empty((14, GROUP), np.float32)
    for begin in range(first, stop, GROUP):
        count = min(GROUP, stop - begin)
        for k in range(count):
            take(given, k, begin + k, means, quats, log_scales, opacity_logits)
        for at in range(0, count, LANES):
            seen = _project_eight(given, at, cam, antialias, splats)
            for k in range(at, min(at + LANES, count)):
                if not (seen >> (k - at)) & 1:
                    radii[begin + k] = np.float32(0.0)
                    continue
                ids[slot] = begin + k
                record = records[slot]
                record[MX] = splats[0, k]
                record[MY] = splats[1, k]
                record[SLANT] = splats[2, k]
                record[CURVE_X] = splats[3, k]
                record[CURVE_Y] = splats[4, k]
                record[LOG2_OPACITY] = splats[5, k]
                record[DEPTH] = splats[6, k]
                record[EXTENT_X] = splats[7, k]
                record[EXTENT_Y] = splats[8, k]
                record[VARIANCE_Y] = splats[9, k]
                record[VARIANCE_X] = splats[10, k]
                record[HALF_WIDTH] = splats[11, k]
                record[OPACITY] = splats[12, k]
                radii[begin + k] = splats[13, k]
                slot += 1
    return slot - first


@parallel_kernel
def project(means, quats, log_scales, opacity_logits, cam, antialias, records, ids, counts, radii):
    """Write the record of every Gaussian that passes the culls, compacted within its chunk.

    Args:
        means, quats, log_scales, opacity_logits: raw parameters, float32.
        cam: [24] float64: rows of W with t as columns 3 (0-11), fx, fy, cx, cy (12-15), width, height
            (16, 17), limits of x/z and y/z (18-21), the blur in px^2 and its square (22, 23).
        antialias: 1 = scale the opacity by sqrt(det S0 / det S).
        records: [N, 16] float32 out; chunk i starts at row i * CHUNK.
        ids: [N] int32 out: the Gaussian of each record.
        counts: [chunks] int32 out.
        radii: [N] float32 out: largest half extent of the 1/255 contour, 0 where culled.
    """
    for chunk in numba.prange(counts.shape[0]):
        counts[chunk] = _project_chunk(
            chunk * CHUNK, means, quats, log_scales, opacity_logits, cam, antialias, records, ids, radii
        )
