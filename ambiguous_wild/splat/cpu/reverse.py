"""From the rows of sums that tiles wrote to gradients of raw parameters, eight Gaussians at a time."""

from __future__ import annotations

import math

import numba
import numpy as np

from ambiguous_wild.splat.cpu.blend import (
    ABS_U,
    ABS_V,
    EXTRA_U,
    EXTRA_Y,
    ROW,
    SUM_BLUE,
    SUM_COUNT,
    SUM_DEPTH,
    SUM_GREEN,
    SUM_H,
    SUM_RED,
    SUM_SQUARED,
)
from ambiguous_wild.splat.cpu.compile import fused_inner_kernel, fused_kernel, parallel_kernel
from ambiguous_wild.splat.cpu.project import (
    BLUE,
    C0,
    CHUNK,
    GREEN,
    GROUP,
    RED,
    basis,
    direction_gradient,
    footprint,
    in_camera,
    shape_of,
    take,
)
from ambiguous_wild.splat.cpu.simd import LANES, exp, load, load8, select, splat, store

_PER_LOG2 = 1.3862943611198906  # 2 / log2(e), because curvatures of the records are for powers of 2


@fused_kernel
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@fused_kernel
def _covariance_gradient(sums, f1, f2, antialias, blur, squared_blur):
    """Return dL/d(u, v) and dL/d(rows f1, f2 of J W R diag(s)) from the sums h to yy over pixels."""
    s_h, s_u, s_uu, s_y, s_uy, s_yy = sums
    sxx = f1[0] * f1[0] + f1[1] * f1[1] + f1[2] * f1[2] + blur
    syy = f2[0] * f2[0] + f2[1] * f2[1] + f2[2] * f2[2] + blur
    sxy = f1[0] * f2[0] + f1[1] * f2[1] + f1[2] * f2[2]
    n = _cross(f1, f2)
    det0 = n[0] * n[0] + n[1] * n[1] + n[2] * n[2]
    det = det0 + blur * (sxx + syy) - squared_blur
    a = syy / det
    q = 1.0 / syy
    k = sxy * q
    du = a * s_u
    dv = q * s_y - k * du
    dk = a * s_uy
    gxx = 0.5 * a * a * s_uu
    gxy = dk * q - 2.0 * gxx * k
    gyy = 0.5 * q * q * s_yy - dk * k * q + gxx * k * k
    d1 = (2.0 * gxx * f1[0] + gxy * f2[0], 2.0 * gxx * f1[1] + gxy * f2[1], 2.0 * gxx * f1[2] + gxy * f2[2])
    d2 = (2.0 * gyy * f2[0] + gxy * f1[0], 2.0 * gyy * f2[1] + gxy * f1[1], 2.0 * gyy * f2[2] + gxy * f1[2])
    if antialias:
        # ln(opacity) holds (ln det0 - ln det) / 2, and d det0 = 2 (f2 x n) df1 + 2 (n x f1) df2.
        e1 = _cross(f2, n)
        e2 = _cross(n, f1)
        near = s_h * (1.0 / det0 - 1.0 / det)
        far = s_h * blur / det
        d1 = (
            d1[0] + near * e1[0] - far * f1[0],
            d1[1] + near * e1[1] - far * f1[1],
            d1[2] + near * e1[2] - far * f1[2],
        )
        d2 = (
            d2[0] + near * e2[0] - far * f2[0],
            d2[1] + near * e2[1] - far * f2[1],
            d2[2] + near * e2[2] - far * f2[2],
        )
    return du, dv, d1, d2, a, q, k


@fused_kernel
def _quaternion_gradient(quat, norm, g):
    """Return dL/d(raw quaternion) from dL/dR (nine values, row by row)."""
    w, x, y, z = quat
    dw = 2.0 * (z * (g[3] - g[1]) + y * (g[2] - g[6]) + x * (g[7] - g[5]))
    dx = 2.0 * (y * (g[1] + g[3]) + z * (g[2] + g[6]) - 2.0 * x * (g[4] + g[8]) + w * (g[7] - g[5]))
    dy = 2.0 * (x * (g[1] + g[3]) + z * (g[5] + g[7]) - 2.0 * y * (g[0] + g[8]) + w * (g[2] - g[6]))
    dz = 2.0 * (x * (g[2] + g[6]) + y * (g[5] + g[7]) - 2.0 * z * (g[0] + g[4]) + w * (g[3] - g[1]))
    along = w * dw + x * dx + y * dy + z * dz
    return (dw - w * along) / norm, (dx - x * along) / norm, (dy - y * along) / norm, (dz - z * along) / norm


@fused_inner_kernel
def _reverse_eight(given, at, cam, antialias, gradients):
    """Compute gradients [16, GROUP] from the sums of columns at .. at + 7 of `given` [18, GROUP].

    Rows of `given`: as `take` fills them, then the sums h to yy and that of depth. Rows of `gradients`: means
    without the part from colours, quats, log scales, opacity logit, screen u and v, 1 / v, 1 / Syy, slant.
    """
    x, y, z = in_camera(given, at, cam)
    quat, norm, s = shape_of(given, at)
    p, q, a, b, rot = footprint(quat, cam, x, y, z)
    f1 = (p[0] * s[0], p[1] * s[1], p[2] * s[2])
    f2 = (q[0] * s[0], q[1] * s[1], q[2] * s[2])
    s_h = load8(given, 11 * GROUP + at)
    sums = (
        s_h,
        load8(given, 12 * GROUP + at),
        load8(given, 13 * GROUP + at),
        load8(given, 14 * GROUP + at),
        load8(given, 15 * GROUP + at),
        load8(given, 16 * GROUP + at),
    )
    du, dv, g1, g2, inv_v, inv_y, slant = _covariance_gradient(sums, f1, f2, antialias, cam[22], cam[23])
    opacity = 1.0 / (1.0 + exp(0.0 - load8(given, 10 * GROUP + at)))
    store(gradients, 7 * GROUP + at, g1[0] * f1[0] + g2[0] * f2[0])
    store(gradients, 8 * GROUP + at, g1[1] * f1[1] + g2[1] * f2[1])
    store(gradients, 9 * GROUP + at, g1[2] * f1[2] + g2[2] * f2[2])
    store(gradients, 10 * GROUP + at, s_h * (1.0 - opacity))
    store(gradients, 11 * GROUP + at, du)
    store(gradients, 12 * GROUP + at, dv)
    store(gradients, 13 * GROUP + at, inv_v)
    store(gradients, 14 * GROUP + at, inv_y)
    store(gradients, 15 * GROUP + at, slant)

    gp = (g1[0] * s[0], g1[1] * s[1], g1[2] * s[2])
    gq = (g2[0] * s[0], g2[1] * s[1], g2[2] * s[2])
    gr = (
        a[0] * gp[0] + b[0] * gq[0], a[0] * gp[1] + b[0] * gq[1], a[0] * gp[2] + b[0] * gq[2],
        a[1] * gp[0] + b[1] * gq[0], a[1] * gp[1] + b[1] * gq[1], a[1] * gp[2] + b[1] * gq[2],
        a[2] * gp[0] + b[2] * gq[0], a[2] * gp[1] + b[2] * gq[1], a[2] * gp[2] + b[2] * gq[2],
    )  # fmt: skip
    dw, dx, dy, dz = _quaternion_gradient(quat, norm, gr)
    store(gradients, 3 * GROUP + at, dw)
    store(gradients, 4 * GROUP + at, dx)
    store(gradients, 5 * GROUP + at, dy)
    store(gradients, 6 * GROUP + at, dz)

    # a = (fx / z) (W0 - rx W2), b likewise; rx is constant where the frustum clamp holds it.
    ga0 = gp[0] * rot[0] + gp[1] * rot[1] + gp[2] * rot[2]
    ga1 = gp[0] * rot[3] + gp[1] * rot[4] + gp[2] * rot[5]
    ga2 = gp[0] * rot[6] + gp[1] * rot[7] + gp[2] * rot[8]
    gb0 = gq[0] * rot[0] + gq[1] * rot[1] + gq[2] * rot[2]
    gb1 = gq[0] * rot[3] + gq[1] * rot[4] + gq[2] * rot[5]
    gb2 = gq[0] * rot[6] + gq[1] * rot[7] + gq[2] * rot[8]
    near = 1.0 / z
    rx = x * near
    ry = y * near
    cx = du * cam[12] * near
    cy = dv * cam[13] * near
    cz = load8(given, 17 * GROUP + at) - (cx * x + cy * y) * near
    cz = cz - (ga0 * a[0] + ga1 * a[1] + ga2 * a[2] + gb0 * b[0] + gb1 * b[1] + gb2 * b[2]) * near
    slope = -cam[12] * near * near * (ga0 * cam[8] + ga1 * cam[9] + ga2 * cam[10])
    slope = select((rx >= cam[18]) & (rx <= cam[19]), slope, 0.0)
    cx = cx + slope
    cz = cz - slope * rx
    slope = -cam[13] * near * near * (gb0 * cam[8] + gb1 * cam[9] + gb2 * cam[10])
    slope = select((ry >= cam[20]) & (ry <= cam[21]), slope, 0.0)
    cy = cy + slope
    cz = cz - slope * ry
    store(gradients, at, cam[0] * cx + cam[4] * cy + cam[8] * cz)
    store(gradients, GROUP + at, cam[1] * cx + cam[5] * cy + cam[9] * cz)
    store(gradients, 2 * GROUP + at, cam[2] * cx + cam[6] * cy + cam[10] * cz)


@fused_inner_kernel
def _reverse_harmonics(i, colour, means, sh_rest, degree, centre, values, weights, d_sh_rest):
    """Chain dL/d(red, green, blue) to the harmonics of Gaussian i; returns their part of dL/dmean."""
    terms = (degree + 1) * (degree + 1) - 1
    red, green, blue = colour
    for j in range(terms, d_sh_rest.shape[1]):
        d_sh_rest[i, j] = 0.0
    if degree == 0:
        return 0.0, 0.0, 0.0
    x = means[i, 0] - centre[0]
    y = means[i, 1] - centre[1]
    z = means[i, 2] - centre[2]
    inv = 1.0 / math.sqrt(x * x + y * y + z * z)
    x *= inv
    y *= inv
    z *= inv
    basis(x, y, z, degree, values)
    for j in range(terms):
        weights[j] = red * sh_rest[i, j, 0] + green * sh_rest[i, j, 1] + blue * sh_rest[i, j, 2]
        d_sh_rest[i, j, 0] = values[j] * red
        d_sh_rest[i, j, 1] = values[j] * green
        d_sh_rest[i, j, 2] = values[j] * blue
    wx, wy, wz = direction_gradient(x, y, z, degree, weights)
    along = wx * x + wy * y + wz * z
    return (wx - along * x) * inv, (wy - along * y) * inv, (wz - along * z) * inv


@fused_kernel
def _mark(first, stop, n, ids, sh, dirty):
    """Zero the harmonics' gradients of Gaussians of a chunk that were seen before, but are not now."""
    seen = np.zeros(CHUNK, np.bool_)
    for slot in range(first, stop):
        if ids[slot] >= 0:
            seen[ids[slot] - first] = True
    for i in range(first, min(first + CHUNK, n)):
        if dirty[i] and not seen[i - first]:
            sh[i] = 0.0
        dirty[i] = seen[i - first]


@fused_inner_kernel
def _write(
    i, k, total, gradients, colour, screen, screen_extra, screen_abs, tally, d_means, d_quats, d_log_scales,
    d_opacity_logits, d_sh0,
):  # fmt: skip
    """Write column k of `gradients` and the other sums to the rows of Gaussian i, except harmonics."""
    d_means[i, 0] = gradients[0, k]
    d_means[i, 1] = gradients[1, k]
    d_means[i, 2] = gradients[2, k]
    d_quats[i, 0] = gradients[3, k]
    d_quats[i, 1] = gradients[4, k]
    d_quats[i, 2] = gradients[5, k]
    d_quats[i, 3] = gradients[6, k]
    d_log_scales[i, 0] = gradients[7, k]
    d_log_scales[i, 1] = gradients[8, k]
    d_log_scales[i, 2] = gradients[9, k]
    d_opacity_logits[i] = gradients[10, k]
    d_sh0[i, 0] = np.float32(C0) * colour[0]
    d_sh0[i, 1] = np.float32(C0) * colour[1]
    d_sh0[i, 2] = np.float32(C0) * colour[2]
    du = gradients[11, k]
    dv = gradients[12, k]
    if screen_extra is not None:
        eu = gradients[13, k] * total[EXTRA_U]
        ev = gradients[14, k] * total[EXTRA_Y] - gradients[15, k] * eu
        screen_extra[i, 0] = eu
        screen_extra[i, 1] = ev
        du -= eu
        dv -= ev
    screen[i, 0] = du
    screen[i, 1] = dv
    if screen_abs is not None:
        screen_abs[i, 0] = gradients[13, k] * total[ABS_U]
        screen_abs[i, 1] = _PER_LOG2 * total[ABS_V]
    if tally is not None:
        tally[i, 0] = _PER_LOG2 * _PER_LOG2 * total[SUM_SQUARED]
        tally[i, 1] = total[SUM_COUNT]


@fused_kernel
def _reverse_chunk(
    first, stop, means, quats, log_scales, opacity_logits, sh_rest, degree, cam, centre, antialias,
    records, ids, offsets, instances, sums, d_means, d_quats, d_log_scales, d_opacity_logits, d_sh0,
    d_sh_rest, dirty, screen, screen_extra, screen_abs, tally, d_base,
):  # fmt: skip
    n = means.shape[0]
    end = min(first + CHUNK, n)
    _mark(first, stop, n, ids, d_sh_rest, dirty)
    d_means[first:end] = 0.0
    d_quats[first:end] = 0.0
    d_log_scales[first:end] = 0.0
    d_opacity_logits[first:end] = 0.0
    d_sh0[first:end] = 0.0
    screen[first:end] = 0.0
    if screen_extra is not None:
        screen_extra[first:end] = 0.0
    if screen_abs is not None:
        screen_abs[first:end] = 0.0
    if tally is not None:
        tally[first:end] = 0.0
    values = np.zeros(15, np.float32)
    weights = np.zeros(15, np.float32)
    given = np.zeros((18, GROUP), np.float32)
    gradients = np.empty((16, GROUP), np.float32)
    totals = np.empty((GROUP, ROW), np.float32)
    slots = np.empty(GROUP, np.int64)
    slot = first
    while slot < stop:
        count = 0
        while slot < stop and count < GROUP:
            if ids[slot] >= 0:
                row = splat(np.float32(0.0))
                for at in range(offsets[slot], offsets[slot] + instances[slot]):
                    row = row + load(sums, at * ROW)
                store(totals, count * ROW, row)
                take(given, count, ids[slot], means, quats, log_scales, opacity_logits)
                for k in range(6):
                    given[11 + k, count] = totals[count, SUM_H + k]
                given[17, count] = totals[count, SUM_DEPTH]
                slots[count] = slot
                count += 1
            slot += 1
        for at in range(0, count, LANES):
            _reverse_eight(given, at, cam, antialias, gradients)
        for k in range(count):
            i = ids[slots[k]]
            total = totals[k]
            if d_base is None:
                record = records[slots[k]]
                colour = (
                    total[SUM_RED] if record[RED] > 0.0 else np.float32(0.0),
                    total[SUM_GREEN] if record[GREEN] > 0.0 else np.float32(0.0),
                    total[SUM_BLUE] if record[BLUE] > 0.0 else np.float32(0.0),
                )
            else:  # through the shading function, clamp included
                colour = (d_base[slots[k], 0], d_base[slots[k], 1], d_base[slots[k], 2])
            _write(
                i, k, total, gradients, colour, screen, screen_extra, screen_abs, tally, d_means, d_quats,
                d_log_scales, d_opacity_logits, d_sh0,
            )  # fmt: skip
            wx, wy, wz = _reverse_harmonics(
                i, colour, means, sh_rest, degree, centre, values, weights, d_sh_rest
            )
            d_means[i, 0] += wx
            d_means[i, 1] += wy
            d_means[i, 2] += wz


@parallel_kernel
def reverse(
    means, quats, log_scales, opacity_logits, sh_rest, degree, cam, centre, antialias,
    records, ids, counts, offsets, instances, sums,
    d_means, d_quats, d_log_scales, d_opacity_logits, d_sh0, d_sh_rest, dirty,
    screen, screen_extra, screen_abs, tally, d_base,
):  # fmt: skip
    """Add each Gaussian's rows and chain them to its raw parameters; Gaussians that are not seen get zeros.

    Args:
        offsets, instances: [N] int64 and int32, first row in `sums` and number of rows of each record.
        sums: [I * 16] float32.
        dirty: [N] bool, rows of `d_sh_rest` that were written before; it is updated.
        screen_extra, screen_abs: [N, 2] or None.
        tally: [N, 2] squared sums and pixel counts, or None.
        d_base: [slots, 3] dL/d(SH colour) of each record where colours are shaded, or None.
        others: as in `project` and `colours`; d_* are written in full.
    """
    for chunk in numba.prange(counts.shape[0]):
        _reverse_chunk(
            chunk * CHUNK, chunk * CHUNK + counts[chunk], means, quats, log_scales, opacity_logits, sh_rest,
            degree, cam, centre, antialias, records, ids, offsets, instances, sums, d_means, d_quats,
            d_log_scales, d_opacity_logits, d_sh0, d_sh_rest, dirty, screen, screen_extra, screen_abs, tally,
            d_base,
        )  # fmt: skip


@parallel_kernel
def colour_sums(records, ids, counts, offsets, instances, sums, d_colours):
    """Write dL/dcolour [slots, 3] of every record, 0 where the colour was clamped; for shading functions.

    Args:
        ids: [N] int32, -1 where a record is not drawn; its row is not written.
        others: as in `reverse`.
    """
    for chunk in numba.prange(counts.shape[0]):
        for slot in range(chunk * CHUNK, chunk * CHUNK + counts[chunk]):
            if ids[slot] < 0:
                continue
            red, green, blue = 0.0, 0.0, 0.0
            for at in range(offsets[slot], offsets[slot] + instances[slot]):
                red += sums[at * ROW + SUM_RED]
                green += sums[at * ROW + SUM_GREEN]
                blue += sums[at * ROW + SUM_BLUE]
            d_colours[slot, 0] = red if records[slot, RED] > 0.0 else 0.0
            d_colours[slot, 1] = green if records[slot, GREEN] > 0.0 else 0.0
            d_colours[slot, 2] = blue if records[slot, BLUE] > 0.0 else 0.0
