"""Real spherical harmonics to degree 3: colours of the splats and the way back, without a basis in memory."""

from __future__ import annotations

import math

import numba
import numpy as np

from ambiguous_wild.splat.cpu.compile import fused_kernel, parallel_kernel
from ambiguous_wild.splat.cpu.project import BLUE, CHUNK, GREEN, RED

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


@fused_kernel
def basis(x, y, z, degree, out):
    """Values of the harmonics 1 .. (degree + 1)^2 - 1 at a unit direction, in 3DGS's order and signs."""
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


@fused_kernel
def direction_gradient(x, y, z, degree, d):
    """sum_j d[j] * d(basis j)/d(x, y, z), the harmonics taken as polynomials of three free variables."""
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

    A colour that is not finite takes its Gaussian out of the picture: id -1 and radius 0. `base` [slots, 3]
    or None takes the colours before they are clamped, for a shading function.
    """
    for chunk in numba.prange(counts.shape[0]):
        first = chunk * CHUNK
        _colours_chunk(
            first, first + counts[chunk], means, sh0, sh_rest, degree, centre, records, ids, radii, base
        )
