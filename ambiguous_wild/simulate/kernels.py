"""Inner kernels of the ray caster: intersection, texture lookup and shading.

Arguments: a table is `ShapeTable.columns()` and its `tracer.shadow_grid`, an atlas `(texels, offset, width,
height, levels)`, a light `(sun directions, sun colour, sky colour, ground colour)`, a sample `(index of its
sun direction, instant)`; points and directions are tuples of three.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ambiguous_wild.io.numba_cache import cached_njit

QUAD, BOX, ELLIPSOID, CAPSULE, CYLINDER, VOLUME = range(6)
PLANAR, BY_FACE, DOME = range(3)  # texture mapping
INSTANTS = 4  # of an exposure; each of four neighbouring rays is traced at another one
ALWAYS = -1  # instant of what is there during the whole exposure
CELLS = 40  # a side of the grid of shadow casters
GLASS = 0.08  # share of the light that a pane reflects at a right angle, on both of its surfaces
FAR = 1e30
_STEPS = 128
_NEAR_M = 4e-4  # distance at which a ray has reached the surface


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles with these options of Numba, for functions that make no arrays.

    References to arrays are not counted: these atomic operations took half of the time of tracing.
    """
    return lambda function: cached_njit(function, _nrt=False, **options)


@kernel(inline="never")
def distance(volume, x, y, z):
    """Interpolate `volume` [N, N, N] trilinearly at a point of the cube [-1, 1]^3, clamped to it."""
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


@kernel(inline="always")
def _slabs(o, d, h):
    """Return t where the ray o + t d enters and leaves the box of half sizes `h`; FAR, -FAR if it misses."""
    near, away = -FAR, FAR
    for axis in range(3):
        oa = o[0] if axis == 0 else (o[1] if axis == 1 else o[2])
        da = d[0] if axis == 0 else (d[1] if axis == 1 else d[2])
        ha = h[0] if axis == 0 else (h[1] if axis == 1 else h[2])
        if abs(da) >= 1e-12:
            t0, t1 = (-ha - oa) / da, (ha - oa) / da
            near, away = max(near, min(t0, t1)), min(away, max(t0, t1))
        elif abs(oa) > ha:
            near, away = FAR, -FAR
    return near, away


@kernel(inline="never")
def sphere_trace(volume, o, d, size, far):
    """Return the distance along the local ray o + t d, |d| = 1, to the volume's surface, or `far`."""
    near, away = _slabs(o, d, (size, size, size))
    t, end = max(1e-6, near), min(far, away)
    for _ in range(_STEPS):
        if t >= end:
            return far
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        gap = size * distance(volume, x / size, y / size, z / size)
        if gap < _NEAR_M:
            return t
        t += max(0.8 * gap, _NEAR_M)
    return far


@kernel(inline="never")
def surface_normal(volume, p, size, d):
    """Return the unit normal at the local point by central differences, turned against the ray."""
    x, y, z = p[0] / size, p[1] / size, p[2] / size
    e = 2.0 / (volume.shape[0] - 1)
    nx = distance(volume, x + e, y, z) - distance(volume, x - e, y, z)
    ny = distance(volume, x, y + e, z) - distance(volume, x, y - e, z)
    nz = distance(volume, x, y, z + e) - distance(volume, x, y, z - e)
    scale = 1.0 / max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
    if nx * d[0] + ny * d[1] + nz * d[2] > 0:
        scale = -scale
    return nx * scale, ny * scale, nz * scale


@kernel(inline="never")
def _intersect(kind, o, d, h, far):
    """Return the distance along the local ray o + t d, or `far`; an ellipsoid is also hit from inside."""
    ox, oy, oz = o
    dx, dy, dz = d
    hx, hy, hz = h
    if kind == QUAD:
        if abs(dz) < 1e-12:
            return far
        t = -oz / dz
        if t > 1e-6 and t < far and abs(ox + t * dx) <= hx and abs(oy + t * dy) <= hy:
            return t
        return far
    if kind == BOX:
        near, away = _slabs(o, d, h)
        if near <= away and near > 1e-6 and near < far:
            return near
        return far
    if kind == ELLIPSOID:
        px, py, pz, qx, qy, qz = ox / hx, oy / hy, oz / hz, dx / hx, dy / hy, dz / hz
        a = qx * qx + qy * qy + qz * qz
        b = px * qx + py * qy + pz * qz
        root = b * b - a * (px * px + py * py + pz * pz - 1.0)
        if root < 0.0:
            return far
        root = math.sqrt(root)
        t = (-b - root) / a
        if t < 1e-6:
            t = (-b + root) / a
        return t if t > 1e-6 and t < far else far
    # Capsule and capped cylinder have the same tube around local z.
    a = dx * dx + dy * dy
    b = ox * dx + oy * dy
    c = ox * ox + oy * oy - hx * hx
    best = far
    root = b * b - a * c
    if a > 1e-12 and root >= 0.0:
        t = (-b - math.sqrt(root)) / a
        if t > 1e-6 and t < best and abs(oz + t * dz) <= hz:
            best = t
    for end in (-1.0, 1.0):
        if kind == CAPSULE:
            cz = oz - end * hz
            bb = ox * dx + oy * dy + cz * dz
            root = bb * bb - (ox * ox + oy * oy + cz * cz - hx * hx)  # d has unit length
            if root >= 0.0:
                t = -bb - math.sqrt(root)
                if t > 1e-6 and t < best and end * (cz + t * dz) >= 0.0:
                    best = t
        elif abs(dz) > 1e-12:
            t = (end * hz - oz) / dz
            x, y = ox + t * dx, oy + t * dy
            if t > 1e-6 and t < best and x * x + y * y <= hx * hx:
                best = t
    return best


@kernel(inline="always")
def _local(table, s, px, py, pz, shift):
    r, c = table[1], table[2]
    if shift:
        px, py, pz = px - c[s, 0], py - c[s, 1], pz - c[s, 2]
    return (
        r[s, 0, 0] * px + r[s, 0, 1] * py + r[s, 0, 2] * pz,
        r[s, 1, 0] * px + r[s, 1, 1] * py + r[s, 1, 2] * pz,
        r[s, 2, 0] * px + r[s, 2, 1] * py + r[s, 2, 2] * pz,
    )


@kernel(inline="always")
def _hit(table, s, o, d, far):
    """Return the distance along the ray o + t d to shape s, or `far`."""
    kind, half = table[0][s], table[3]
    h = (half[s, 0], half[s, 1], half[s, 2])
    lo, ld = _local(table, s, o[0], o[1], o[2], True), _local(table, s, d[0], d[1], d[2], False)
    if kind == VOLUME:
        return sphere_trace(table[14][table[13][s]], lo, ld, h[0], far)
    return _intersect(kind, lo, ld, h, far)


@kernel(inline="never")
def nearest(table, which, count, o, d, far, instant):
    """Return the nearest hit among the listed shapes at an instant: (distance, shape or -1)."""
    best, hit = far, -1
    center, radius, instants = table[2], table[4], table[11]
    for k in range(count):
        s = which[k]
        if instants[s] != ALWAYS and instants[s] != instant:
            continue
        qx, qy, qz = center[s, 0] - o[0], center[s, 1] - o[1], center[s, 2] - o[2]
        along = qx * d[0] + qy * d[1] + qz * d[2]
        if qx * qx + qy * qy + qz * qz - along * along > radius[s] * radius[s]:
            continue
        if along - radius[s] > best:
            continue
        t = _hit(table, s, o, d, best)
        if t < best:
            best, hit = t, s
    return best, hit


@kernel(inline="never")
def _shadowed(table, o, d, sample):
    """Return whether a shape of the point's cell of the grid lies between the point and the sun."""
    center, radius, instants = table[2], table[4], table[11]
    frame, start, members = table[15], table[16], table[17]
    n, instant = sample
    a = (frame[n, 0] * o[0] + frame[n, 1] * o[1] + frame[n, 2] * o[2] - frame[n, 6]) * frame[n, 8]
    b = (frame[n, 3] * o[0] + frame[n, 4] * o[1] + frame[n, 5] * o[2] - frame[n, 7]) * frame[n, 8]
    if not (0.0 <= a < CELLS and 0.0 <= b < CELLS):
        return False
    cell = int(b) * CELLS + int(a)
    for k in range(start[n, cell], start[n, cell + 1]):
        s = members[k]
        if instants[s] != ALWAYS and instants[s] != instant:
            continue
        qx, qy, qz = center[s, 0] - o[0], center[s, 1] - o[1], center[s, 2] - o[2]
        along = qx * d[0] + qy * d[1] + qz * d[2]
        if along < -radius[s] or qx * qx + qy * qy + qz * qz - along * along > radius[s] * radius[s]:
            continue
        if _hit(table, s, o, d, FAR) < FAR:
            return True
    return False


@kernel(inline="never")
def _normal(kind, p, h, d):
    """Return the unit normal at the local point, turned against the local ray."""
    x, y, z = p
    if kind == QUAD:
        nx, ny, nz = 0.0, 0.0, 1.0
    elif kind == BOX:
        ax, ay, az = abs(x / h[0]), abs(y / h[1]), abs(z / h[2])
        nx, ny, nz = 0.0, 0.0, 0.0
        if ax >= ay and ax >= az:
            nx = math.copysign(1.0, x)
        elif ay >= az:
            ny = math.copysign(1.0, y)
        else:
            nz = math.copysign(1.0, z)
    elif kind == ELLIPSOID:
        nx, ny, nz = x / h[0] ** 2, y / h[1] ** 2, z / h[2] ** 2
    elif kind == CAPSULE:
        nx, ny, nz = x, y, z - min(max(z, -h[2]), h[2])
    elif h[2] - abs(z) < 1e-6:
        nx, ny, nz = 0.0, 0.0, math.copysign(1.0, z)
    else:
        nx, ny, nz = x, y, 0.0
    scale = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    if nx * d[0] + ny * d[1] + nz * d[2] > 0:
        scale = -scale
    return nx * scale, ny * scale, nz * scale


@kernel(inline="always")
def _fold(u, size):
    """Map a texture coordinate to a texel, mirrored at the borders without a seam."""
    u = u - 2.0 * math.floor(0.5 * u)
    u = 2.0 - u if u > 1.0 else u
    return min(max(u * size - 0.5, 0.0), size - 1.0)


@kernel(inline="never")
def _bilinear(atlas, t, level, u, v):
    texels, offset, width, height = atlas[0], atlas[1], atlas[2], atlas[3]
    w, h, base = width[t, level], height[t, level], offset[t, level]
    x, y = _fold(u, w), _fold(v, h)
    x0, y0 = int(x), int(y)
    x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
    fx, fy = x - x0, y - y0
    a, b, c, e = base + y0 * w + x0, base + y0 * w + x1, base + y1 * w + x0, base + y1 * w + x1
    wa, wb, wc, we = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    return (
        wa * texels[a, 0] + wb * texels[b, 0] + wc * texels[c, 0] + we * texels[e, 0],
        wa * texels[a, 1] + wb * texels[b, 1] + wc * texels[c, 1] + we * texels[e, 1],
        wa * texels[a, 2] + wb * texels[b, 2] + wc * texels[c, 2] + we * texels[e, 2],
    )


@kernel(inline="never")
def _sample(atlas, t, u, v, lod):
    """Look a texture up trilinearly: blend the two mip levels around `lod`."""
    top = atlas[4][t] - 1
    lod = min(max(lod, 0.0), float(top))
    level = int(lod)
    f = lod - level
    r0, g0, b0 = _bilinear(atlas, t, level, u, v)
    if f < 1e-3:
        return r0, g0, b0
    r1, g1, b1 = _bilinear(atlas, t, min(level + 1, top), u, v)
    return r0 + f * (r1 - r0), g0 + f * (g1 - g0), b0 + f * (b1 - b0)


@kernel(inline="never")
def _gloss(strength, sharpness, n, d, sun, sunlit, light):
    """Compute specular light of a polished surface: the sun's highlight (Blinn), the sky's (Schlick)."""
    facing = -(n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
    lobe = 0.0
    if sunlit:
        hx, hy, hz = sun[0] - d[0], sun[1] - d[1], sun[2] - d[2]
        cosine = (n[0] * hx + n[1] * hy + n[2] * hz) / math.sqrt(max(hx * hx + hy * hy + hz * hz, 1e-12))
        lobe = strength * max(cosine, 0.0) ** sharpness
    mirrored_up = 0.5 + 0.5 * (d[2] + 2.0 * facing * n[2])
    sheen = min(strength, 1.0) * (0.04 + 0.96 * (1.0 - min(max(facing, 0.0), 1.0)) ** 5)
    sun_colour, sky, ground = light[1], light[2], light[3]
    return (
        lobe * sun_colour[0] + sheen * (mirrored_up * sky[0] + (1 - mirrored_up) * ground[0]),
        lobe * sun_colour[1] + sheen * (mirrored_up * sky[1] + (1 - mirrored_up) * ground[1]),
        lobe * sun_colour[2] + sheen * (mirrored_up * sky[2] + (1 - mirrored_up) * ground[2]),
    )


@kernel(inline="never")
def shade(table, s, t, o, d, spread, atlas, light, sample, static, movers, shadow_casters):
    """Compute the colour of shape s at distance t: texture, sun with shadow, sky light from above and below.

    Distractors shade each other, and the scene where they are among the `shadow_casters`. Returns the colour
    with and without the shadows of these, equal where none falls.
    """
    kind, half, mapping, uv, tint = table[0][s], table[3], table[6][s], table[7], table[8]
    lo, ld = _local(table, s, o[0], o[1], o[2], True), _local(table, s, d[0], d[1], d[2], False)
    p = (lo[0] + t * ld[0], lo[1] + t * ld[1], lo[2] + t * ld[2])
    h = (half[s, 0], half[s, 1], half[s, 2])
    n = surface_normal(table[14][table[13][s]], p, h[0], ld) if kind == VOLUME else _normal(kind, p, h, ld)
    cosine = -(n[0] * ld[0] + n[1] * ld[1] + n[2] * ld[2])
    texture = table[5][s]
    if mapping == DOME:
        u = math.atan2(p[1], p[0]) / (2 * math.pi) + 0.5
        v = math.asin(min(max(p[2] / h[2], 0.0), 1.0)) / (0.5 * math.pi)
        lod = math.log2(max(spread * atlas[2][texture, 0] / (2 * math.pi), 1e-6))
        r, g, b = _sample(atlas, texture, u, v, lod)
        sky = (r * tint[s, 0], g * tint[s, 1], b * tint[s, 2])
        return sky, sky
    a, b_ = p[0], p[1]
    if mapping == BY_FACE:
        ax, ay, az = abs(n[0]), abs(n[1]), abs(n[2])
        if ax >= ay and ax >= az:
            a, b_ = p[1], p[2]
        elif ay >= az:
            a, b_ = p[0], p[2]
    u, v = a * uv[s, 0] + uv[s, 2], b_ * uv[s, 1] + uv[s, 3]
    # Footprint of a sample on the surface, the geometric mean of its short and long side.
    footprint = t * spread / math.sqrt(max(cosine, 0.04))
    density = max(uv[s, 0] * atlas[2][texture, 0], uv[s, 1] * atlas[3][texture, 0])
    r, g, b = _sample(atlas, texture, u, v, math.log2(max(footprint * density, 1e-6)))
    rot = table[1]
    wx = rot[s, 0, 0] * n[0] + rot[s, 1, 0] * n[1] + rot[s, 2, 0] * n[2]
    wy = rot[s, 0, 1] * n[0] + rot[s, 1, 1] * n[1] + rot[s, 2, 1] * n[2]
    wz = rot[s, 0, 2] * n[0] + rot[s, 1, 2] * n[1] + rot[s, 2, 2] * n[2]
    sun = (light[0][sample[0], 0], light[0][sample[0], 1], light[0][sample[0], 2])
    lit = wx * sun[0] + wy * sun[1] + wz * sun[2]
    darkened = False
    if lit > 0.0:
        lift = 2e-3
        q = (o[0] + t * d[0] + lift * wx, o[1] + t * d[1] + lift * wy, o[2] + t * d[2] + lift * wz)
        if _shadowed(static, q, sun, sample) or (table[10][s] > 0 and _shadowed(movers, q, sun, sample)):
            lit = 0.0
        else:
            darkened = _shadowed(shadow_casters, q, sun, sample)
    else:
        lit = 0.0
    base, tone, normal = (r, g, b), (tint[s, 0], tint[s, 1], tint[s, 2]), (wx, wy, wz)
    polish = (table[12][s, 0], table[12][s, 1])
    bright = _lit(base, tone, polish, normal, d, sun, lit, light)
    if darkened:
        return _lit(base, tone, polish, normal, d, sun, 0.0, light), bright
    return bright, bright


@kernel(inline="never")
def _lit(base, tone, polish, n, d, sun, lit, light):
    """Compute the colour of a surface under the share `lit` of the sun and the whole sky."""
    up = 0.5 + 0.5 * n[2]
    sun_colour, sky, ground = light[1], light[2], light[3]
    gr, gg, gb = 0.0, 0.0, 0.0
    if polish[0] > 0.0:
        gr, gg, gb = _gloss(polish[0], polish[1], n, d, sun, lit > 0.0, light)
    return (
        gr + base[0] * tone[0] * (lit * sun_colour[0] + up * sky[0] + (1 - up) * ground[0]),
        gg + base[1] * tone[1] * (lit * sun_colour[1] + up * sky[1] + (1 - up) * ground[1]),
        gb + base[2] * tone[2] * (lit * sun_colour[2] + up * sky[2] + (1 - up) * ground[2]),
    )


@kernel(inline="never")
def reflect(mirrors, g, t, o, d, spread, atlas, light, sample, static, movers, shadow_casters, every):
    """Compute what mirror or pane g, at distance t of the ray, reflects.

    Args:
        every: the numbers of all static shapes and of all movers.

    Returns:
        The share of the light that is reflected, the reflection with and without distractors, the owner of
        the distractor in it, or 0.
    """
    axes, tint = mirrors[1], mirrors[8]
    nx, ny, nz = axes[g, 2, 0], axes[g, 2, 1], axes[g, 2, 2]
    along = d[0] * nx + d[1] * ny + d[2] * nz
    r = (d[0] - 2 * along * nx, d[1] - 2 * along * ny, d[2] - 2 * along * nz)
    lift = -2e-3 if along > 0 else 2e-3
    q = (o[0] + t * d[0] + lift * nx, o[1] + t * d[1] + lift * ny, o[2] + t * d[2] + lift * nz)
    share = tint[g, 0]
    if share <= 0.0:  # a pane: Schlick 1994
        share = GLASS + (1.0 - GLASS) * (1.0 - min(abs(along), 1.0)) ** 5
    seen, bright, owner = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0
    far, s = nearest(static, every[0], len(every[0]), q, r, FAR, sample[1])
    if s >= 0:
        wide = spread * (t + far) / far  # the footprint grows along the whole path
        seen, bright = shade(static, s, far, q, r, wide, atlas, light, sample, static, static, shadow_casters)
    near, m = nearest(movers, every[1], len(every[1]), q, r, far, sample[1])
    if m >= 0:
        wide = spread * (t + near) / near
        seen, _ = shade(movers, m, near, q, r, wide, atlas, light, sample, static, movers, shadow_casters)
        owner = movers[10][m]
    return share, seen, bright, owner
