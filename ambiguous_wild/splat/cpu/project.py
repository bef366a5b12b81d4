"""Gaussians to splats: activations, EWA projection and culls, one record of 16 floats for each that is seen.

Card gsplat.md eq. 1 to 6 with opacity-aware extents (fast-training.md eq. 1). The blurred 2D covariance
S is kept in the form that needs no difference of large numbers: with ``k = Sxy / Syy``,
``v = det S / Syy`` (variance of x given y) and ``q = 1 / Syy``,

    sigma = u^2 / (2 v) + q dy^2 / 2,    u = dx - k dy,

and ``det S = |f1 x f2|^2 + blur trace + blur^2`` where f1, f2 are the rows of J W R diag(s). A needle
of aspect 1e6 keeps its shape in float32 that way.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from ambiguous_wild.splat.cpu.compile import fused_kernel, parallel_kernel

BLUR = 0.3  # px^2 added to both variances unless a method says otherwise
NEAR = 0.01  # smallest depth that is drawn
MIN_ALPHA = 1.0 / 255.0
CHUNK = 1024  # Gaussians a work item; records of a chunk are contiguous
RECORD = 16  # floats a record: one cache line

# Fields of a record.
MX, MY, SLANT, CURVE_X, CURVE_Y, LOG2_OPACITY, RED, GREEN, BLUE, DEPTH = range(10)
EXTENT_X, EXTENT_Y, VARIANCE_Y, VARIANCE_X, HALF_WIDTH, OPACITY = range(10, 16)

_LOG2E = 1.4426950408889634
_FAR_PX = 1e15  # a centre so far out is no place in float32 any more
_HUGE = 1e30
_SHORT = 1e-30  # norm of a quaternion: its gradient is divided by it, and float32 ends at 3e38


@fused_kernel
def sigmoid(x: float) -> float:
    """1 / (1 + exp(-x)) without overflow."""
    if x >= 0.0:
        return 1.0 / (1.0 + math.exp(-x))
    e = math.exp(x)
    return e / (1.0 + e)


@fused_kernel
def footprint(mean, quat, scale, cam, x, y, z):
    """Rows f1, f2 of J W R diag(s), the clamped ray and the rotation: what S and its gradient are made of."""
    w_, qx, qy, qz = quat[0], quat[1], quat[2], quat[3]
    rx = min(max(x / z, cam[18]), cam[19])
    ry = min(max(y / z, cam[20]), cam[21])
    gx = cam[12] / z
    gy = cam[13] / z
    a0 = gx * (cam[0] - rx * cam[8])
    a1 = gx * (cam[1] - rx * cam[9])
    a2 = gx * (cam[2] - rx * cam[10])
    b0 = gy * (cam[4] - ry * cam[8])
    b1 = gy * (cam[5] - ry * cam[9])
    b2 = gy * (cam[6] - ry * cam[10])
    r00 = 1.0 - 2.0 * (qy * qy + qz * qz)
    r01 = 2.0 * (qx * qy - w_ * qz)
    r02 = 2.0 * (qx * qz + w_ * qy)
    r10 = 2.0 * (qx * qy + w_ * qz)
    r11 = 1.0 - 2.0 * (qx * qx + qz * qz)
    r12 = 2.0 * (qy * qz - w_ * qx)
    r20 = 2.0 * (qx * qz - w_ * qy)
    r21 = 2.0 * (qy * qz + w_ * qx)
    r22 = 1.0 - 2.0 * (qx * qx + qy * qy)
    p0 = a0 * r00 + a1 * r10 + a2 * r20
    p1 = a0 * r01 + a1 * r11 + a2 * r21
    p2 = a0 * r02 + a1 * r12 + a2 * r22
    q0 = b0 * r00 + b1 * r10 + b2 * r20
    q1 = b0 * r01 + b1 * r11 + b2 * r21
    q2 = b0 * r02 + b1 * r12 + b2 * r22
    rot = (r00, r01, r02, r10, r11, r12, r20, r21, r22)
    return (p0, p1, p2), (q0, q1, q2), (a0, a1, a2), (b0, b1, b2), rot, rx, ry


@fused_kernel
def _project_chunk(first, means, quats, log_scales, opacity_logits, cam, antialias, records, ids, radii):
    slot = first
    blur = cam[22]
    for i in range(first, min(first + CHUNK, means.shape[0])):
        radii[i] = np.float32(0.0)
        m0 = np.float64(means[i, 0])
        m1 = np.float64(means[i, 1])
        m2 = np.float64(means[i, 2])
        z = cam[8] * m0 + cam[9] * m1 + cam[10] * m2 + cam[11]
        # Comparisons are written so that NaN fails them: a broken Gaussian is culled.
        if not (z >= NEAR and z < _HUGE):
            continue
        x = cam[0] * m0 + cam[1] * m1 + cam[2] * m2 + cam[3]
        y = cam[4] * m0 + cam[5] * m1 + cam[6] * m2 + cam[7]
        logit = np.float64(opacity_logits[i])
        if not (logit > -5.6):  # sigmoid below 1/255
            continue
        u = cam[12] * x / z + cam[14]
        v = cam[13] * y / z + cam[15]
        w_ = np.float64(quats[i, 0])
        qx = np.float64(quats[i, 1])
        qy = np.float64(quats[i, 2])
        qz = np.float64(quats[i, 3])
        norm = math.sqrt(w_ * w_ + qx * qx + qy * qy + qz * qz)
        if not (norm > _SHORT and norm < _HUGE):
            continue
        inv = 1.0 / norm
        s0 = math.exp(np.float64(log_scales[i, 0]))
        s1 = math.exp(np.float64(log_scales[i, 1]))
        s2 = math.exp(np.float64(log_scales[i, 2]))
        quat = (w_ * inv, qx * inv, qy * inv, qz * inv)
        p, q, _, _, _, _, _ = footprint((m0, m1, m2), quat, (s0, s1, s2), cam, x, y, z)
        p0, p1, p2 = p[0] * s0, p[1] * s1, p[2] * s2
        q0, q1, q2 = q[0] * s0, q[1] * s1, q[2] * s2
        sxx = p0 * p0 + p1 * p1 + p2 * p2
        syy = q0 * q0 + q1 * q1 + q2 * q2
        sxy = p0 * q0 + p1 * q1 + p2 * q2
        n0 = p1 * q2 - p2 * q1
        n1 = p2 * q0 - p0 * q2
        n2 = p0 * q1 - p1 * q0
        det0 = n0 * n0 + n1 * n1 + n2 * n2
        det = det0 + blur * (sxx + syy) + cam[23]
        sxx += blur
        syy += blur
        if not (sxx < _HUGE and syy < _HUGE and det < _HUGE):
            continue
        opacity = sigmoid(logit)
        if antialias:
            opacity *= math.sqrt(det0 / det)
        if not (opacity >= MIN_ALPHA):
            continue
        tau = 2.0 * math.log(255.0 * opacity)
        ex = math.sqrt(tau * sxx)
        ey = math.sqrt(tau * syy)
        # in floats first: a pixel far out has no whole number (compiled ceil and floor give int64)
        if not (abs(u) < _FAR_PX and abs(v) < _FAR_PX):
            continue
        if not (u - ex < cam[16] and u + ex > 0.0 and v - ey < cam[17] and v + ey > 0.0):
            continue
        if not (
            math.ceil(max(u - ex - 0.5, 0.0)) <= math.floor(min(u + ex, cam[16]) - 0.5)
            and math.ceil(max(v - ey - 0.5, 0.0)) <= math.floor(min(v + ey, cam[17]) - 0.5)
        ):
            continue
        half = 0.5 * (sxx - syy)
        radii[i] = math.sqrt(tau * (0.5 * (sxx + syy) + math.sqrt(half * half + sxy * sxy)))
        ids[slot] = i
        records[slot, MX] = u
        records[slot, MY] = v
        records[slot, SLANT] = sxy / syy
        records[slot, CURVE_X] = -0.5 * _LOG2E * syy / det
        records[slot, CURVE_Y] = -0.5 * _LOG2E / syy
        records[slot, LOG2_OPACITY] = math.log(opacity) * _LOG2E
        records[slot, DEPTH] = z
        records[slot, EXTENT_X] = ex
        records[slot, EXTENT_Y] = ey
        records[slot, VARIANCE_Y] = syy
        records[slot, VARIANCE_X] = sxx
        records[slot, HALF_WIDTH] = math.sqrt(tau * det / syy)
        records[slot, OPACITY] = opacity
        slot += 1
    return slot - first


@parallel_kernel
def project(means, quats, log_scales, opacity_logits, cam, antialias, records, ids, counts, radii):
    """Write the record of every Gaussian that passes the culls, compacted within its chunk.

    Args:
        means, quats, log_scales, opacity_logits: raw parameters, float32.
        cam: [24] float64: rows of W with t as columns 3 (0-11), fx, fy, cx, cy (12-15), width, height
            (16, 17), limits of x/z and y/z (18-21), the blur in px^2 and its square (22, 23).
        antialias: 1 scales the opacity by sqrt(det S0 / det S).
        records: [N, 16] float32 out; chunk i starts at row i * CHUNK.
        ids: [N] int32 out: the Gaussian of each record.
        counts: [chunks] int32 out.
        radii: [N] float32 out: largest half extent of the 1/255 contour, 0 where culled.
    """
    for chunk in numba.prange(counts.shape[0]):
        counts[chunk] = _project_chunk(
            chunk * CHUNK, means, quats, log_scales, opacity_logits, cam, antialias, records, ids, radii
        )
