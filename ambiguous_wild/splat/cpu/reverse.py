"""From the rows of sums of the tiles to gradients of the raw parameters, one Gaussian after the other."""

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
    SUM_U,
    SUM_UU,
    SUM_UY,
    SUM_Y,
    SUM_YY,
)
from ambiguous_wild.splat.cpu.compile import fused_kernel, parallel_kernel
from ambiguous_wild.splat.cpu.harmonics import C0, basis, direction_gradient
from ambiguous_wild.splat.cpu.project import BLUE, CHUNK, GREEN, RED, footprint, sigmoid
from ambiguous_wild.splat.cpu.simd import load, splat, store

_PER_LOG2 = 1.3862943611198906  # 2 / log2(e): curvatures of the records are of 2 to the power


@fused_kernel
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@fused_kernel
def _covariance_gradient(sums, f1, f2, antialias, blur, squared_blur):
    """dL/d(u, v) and dL/d(rows f1, f2 of J W R diag(s)) from the sums over pixels."""
    sxx = f1[0] * f1[0] + f1[1] * f1[1] + f1[2] * f1[2] + blur
    syy = f2[0] * f2[0] + f2[1] * f2[1] + f2[2] * f2[2] + blur
    sxy = f1[0] * f2[0] + f1[1] * f2[1] + f1[2] * f2[2]
    n = _cross(f1, f2)
    det0 = n[0] * n[0] + n[1] * n[1] + n[2] * n[2]
    det = det0 + blur * (sxx + syy) - squared_blur
    a = syy / det
    q = 1.0 / syy
    k = sxy * q
    du = a * sums[SUM_U]
    dv = q * sums[SUM_Y] - k * du
    dk = a * sums[SUM_UY]
    gxx = 0.5 * a * a * sums[SUM_UU]
    gxy = dk * q - 2.0 * gxx * k
    gyy = 0.5 * q * q * sums[SUM_YY] - dk * k * q + gxx * k * k
    d1 = (2.0 * gxx * f1[0] + gxy * f2[0], 2.0 * gxx * f1[1] + gxy * f2[1], 2.0 * gxx * f1[2] + gxy * f2[2])
    d2 = (2.0 * gyy * f2[0] + gxy * f1[0], 2.0 * gyy * f2[1] + gxy * f1[1], 2.0 * gyy * f2[2] + gxy * f1[2])
    if antialias:
        # ln(opacity) holds (ln det0 - ln det) / 2, and d det0 = 2 (f2 x n) df1 + 2 (n x f1) df2.
        e1 = _cross(f2, n)
        e2 = _cross(n, f1)
        near = sums[SUM_H] * (1.0 / det0 - 1.0 / det)
        far = sums[SUM_H] * blur / det
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
    """dL/d(raw quaternion) from dL/dR (nine values, row by row)."""
    w, x, y, z = quat
    dw = 2.0 * (z * (g[3] - g[1]) + y * (g[2] - g[6]) + x * (g[7] - g[5]))
    dx = 2.0 * (y * (g[1] + g[3]) + z * (g[2] + g[6]) - 2.0 * x * (g[4] + g[8]) + w * (g[7] - g[5]))
    dy = 2.0 * (x * (g[1] + g[3]) + z * (g[5] + g[7]) - 2.0 * y * (g[0] + g[8]) + w * (g[2] - g[6]))
    dz = 2.0 * (x * (g[2] + g[6]) + y * (g[5] + g[7]) - 2.0 * z * (g[0] + g[4]) + w * (g[3] - g[1]))
    along = w * dw + x * dx + y * dy + z * dz
    return (dw - w * along) / norm, (dx - x * along) / norm, (dy - y * along) / norm, (dz - z * along) / norm


@fused_kernel
def _reverse_chunk(
    first, stop, means, quats, log_scales, opacity_logits, sh_rest, degree, cam, centre, antialias,
    records, ids, offsets, instances, sums, d_means, d_quats, d_log_scales, d_opacity_logits, d_sh0,
    d_sh_rest, dirty, screen, screen_extra, screen_abs, tally, d_base,
):  # fmt: skip
    n = means.shape[0]
    terms = (degree + 1) * (degree + 1) - 1
    values = np.zeros(15, np.float32)
    weights = np.zeros(15, np.float32)
    total = np.zeros(ROW, np.float32)
    slot = first
    for i in range(first, min(first + CHUNK, n)):
        while slot < stop and ids[slot] < 0:
            slot += 1
        screen[i, 0] = 0.0
        screen[i, 1] = 0.0
        if screen_extra is not None:
            screen_extra[i, 0] = 0.0
            screen_extra[i, 1] = 0.0
        if screen_abs is not None:
            screen_abs[i, 0] = 0.0
            screen_abs[i, 1] = 0.0
        if tally is not None:
            tally[i, 0] = 0.0
            tally[i, 1] = 0.0
        seen = slot < stop and ids[slot] == i
        if dirty[i] and not seen:
            d_sh_rest[i] = 0.0
        dirty[i] = seen
        if not seen:
            d_means[i] = 0.0
            d_quats[i] = 0.0
            d_log_scales[i] = 0.0
            d_opacity_logits[i] = 0.0
            d_sh0[i] = 0.0
            continue
        record = records[slot]
        row = splat(np.float32(0.0))
        for at in range(offsets[slot], offsets[slot] + instances[slot]):
            row = row + load(sums, at * ROW)
        store(total, 0, row)
        slot += 1

        m0 = np.float64(means[i, 0])
        m1 = np.float64(means[i, 1])
        m2 = np.float64(means[i, 2])
        x = cam[0] * m0 + cam[1] * m1 + cam[2] * m2 + cam[3]
        y = cam[4] * m0 + cam[5] * m1 + cam[6] * m2 + cam[7]
        z = cam[8] * m0 + cam[9] * m1 + cam[10] * m2 + cam[11]
        qw = np.float64(quats[i, 0])
        qx = np.float64(quats[i, 1])
        qy = np.float64(quats[i, 2])
        qz = np.float64(quats[i, 3])
        norm = math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        quat = (qw / norm, qx / norm, qy / norm, qz / norm)
        s0 = math.exp(np.float64(log_scales[i, 0]))
        s1 = math.exp(np.float64(log_scales[i, 1]))
        s2 = math.exp(np.float64(log_scales[i, 2]))
        p, q, a, b, rot, _, _ = footprint((m0, m1, m2), quat, (s0, s1, s2), cam, x, y, z)
        f1 = (p[0] * s0, p[1] * s1, p[2] * s2)
        f2 = (q[0] * s0, q[1] * s1, q[2] * s2)
        du, dv, g1, g2, inv_v, inv_y, slant = _covariance_gradient(total, f1, f2, antialias, cam[22], cam[23])

        d_opacity_logits[i] = total[SUM_H] * (1.0 - sigmoid(np.float64(opacity_logits[i])))
        d_log_scales[i, 0] = g1[0] * f1[0] + g2[0] * f2[0]
        d_log_scales[i, 1] = g1[1] * f1[1] + g2[1] * f2[1]
        d_log_scales[i, 2] = g1[2] * f1[2] + g2[2] * f2[2]

        gp0, gp1, gp2 = g1[0] * s0, g1[1] * s1, g1[2] * s2
        gq0, gq1, gq2 = g2[0] * s0, g2[1] * s1, g2[2] * s2
        gr = (
            a[0] * gp0 + b[0] * gq0, a[0] * gp1 + b[0] * gq1, a[0] * gp2 + b[0] * gq2,
            a[1] * gp0 + b[1] * gq0, a[1] * gp1 + b[1] * gq1, a[1] * gp2 + b[1] * gq2,
            a[2] * gp0 + b[2] * gq0, a[2] * gp1 + b[2] * gq1, a[2] * gp2 + b[2] * gq2,
        )  # fmt: skip
        dw, dx, dy, dz = _quaternion_gradient(quat, norm, gr)
        d_quats[i, 0] = dw
        d_quats[i, 1] = dx
        d_quats[i, 2] = dy
        d_quats[i, 3] = dz

        # a = (fx / z) (W0 - rx W2), b likewise; rx is constant where the frustum clamp holds it.
        ga0 = gp0 * rot[0] + gp1 * rot[1] + gp2 * rot[2]
        ga1 = gp0 * rot[3] + gp1 * rot[4] + gp2 * rot[5]
        ga2 = gp0 * rot[6] + gp1 * rot[7] + gp2 * rot[8]
        gb0 = gq0 * rot[0] + gq1 * rot[1] + gq2 * rot[2]
        gb1 = gq0 * rot[3] + gq1 * rot[4] + gq2 * rot[5]
        gb2 = gq0 * rot[6] + gq1 * rot[7] + gq2 * rot[8]
        cx = du * cam[12] / z
        cy = dv * cam[13] / z
        cz = total[SUM_DEPTH] - (cx * x + cy * y) / z
        cz -= (ga0 * a[0] + ga1 * a[1] + ga2 * a[2] + gb0 * b[0] + gb1 * b[1] + gb2 * b[2]) / z
        if cam[18] <= x / z <= cam[19]:
            slope = -cam[12] / z * (ga0 * cam[8] + ga1 * cam[9] + ga2 * cam[10])
            cx += slope / z
            cz -= slope * x / (z * z)
        if cam[20] <= y / z <= cam[21]:
            slope = -cam[13] / z * (gb0 * cam[8] + gb1 * cam[9] + gb2 * cam[10])
            cy += slope / z
            cz -= slope * y / (z * z)

        if d_base is None:
            red = total[SUM_RED] if record[RED] > 0.0 else 0.0
            green = total[SUM_GREEN] if record[GREEN] > 0.0 else 0.0
            blue = total[SUM_BLUE] if record[BLUE] > 0.0 else 0.0
        else:  # through the shading function, clamp included
            red = np.float64(d_base[slot - 1, 0])
            green = np.float64(d_base[slot - 1, 1])
            blue = np.float64(d_base[slot - 1, 2])
        d_sh0[i, 0] = C0 * red
        d_sh0[i, 1] = C0 * green
        d_sh0[i, 2] = C0 * blue
        wx = 0.0
        wy = 0.0
        wz = 0.0
        if degree > 0:
            ox = m0 - centre[0]
            oy = m1 - centre[1]
            oz = m2 - centre[2]
            inv = 1.0 / math.sqrt(ox * ox + oy * oy + oz * oz)
            ox *= inv
            oy *= inv
            oz *= inv
            basis(ox, oy, oz, degree, values)
            for j in range(terms):
                weights[j] = red * sh_rest[i, j, 0] + green * sh_rest[i, j, 1] + blue * sh_rest[i, j, 2]
                d_sh_rest[i, j, 0] = values[j] * red
                d_sh_rest[i, j, 1] = values[j] * green
                d_sh_rest[i, j, 2] = values[j] * blue
            wx, wy, wz = direction_gradient(ox, oy, oz, degree, weights)
            along = wx * ox + wy * oy + wz * oz
            wx = (wx - along * ox) * inv
            wy = (wy - along * oy) * inv
            wz = (wz - along * oz) * inv
        for j in range(terms, d_sh_rest.shape[1]):
            d_sh_rest[i, j] = 0.0
        d_means[i, 0] = wx + cam[0] * cx + cam[4] * cy + cam[8] * cz
        d_means[i, 1] = wy + cam[1] * cx + cam[5] * cy + cam[9] * cz
        d_means[i, 2] = wz + cam[2] * cx + cam[6] * cy + cam[10] * cz

        if screen_extra is not None:
            eu = inv_v * total[EXTRA_U]
            ev = inv_y * total[EXTRA_Y] - slant * eu
            screen_extra[i, 0] = eu
            screen_extra[i, 1] = ev
            du -= eu
            dv -= ev
        screen[i, 0] = du
        screen[i, 1] = dv
        if screen_abs is not None:
            screen_abs[i, 0] = inv_v * total[ABS_U]
            screen_abs[i, 1] = _PER_LOG2 * total[ABS_V]
        if tally is not None:
            tally[i, 0] = _PER_LOG2 * _PER_LOG2 * total[SUM_SQUARED]
            tally[i, 1] = total[SUM_COUNT]


@parallel_kernel
def reverse(
    means, quats, log_scales, opacity_logits, sh_rest, degree, cam, centre, antialias,
    records, ids, counts, offsets, instances, sums,
    d_means, d_quats, d_log_scales, d_opacity_logits, d_sh0, d_sh_rest, dirty,
    screen, screen_extra, screen_abs, tally, d_base,
):  # fmt: skip
    """Add each Gaussian's rows and chain them to its raw parameters; Gaussians not seen get zeros.

    Args:
        offsets, instances: [N] int64 and int32, first row in `sums` and number of rows of each record.
        sums: [I * 16] float32.
        dirty: [N] bool, rows of `d_sh_rest` that are not zero before; updated.
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
    """dL/dcolour [slots, 3] of every record, 0 where the colour was clamped; for shading functions.

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
