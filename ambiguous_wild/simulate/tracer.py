"""The ray caster: one pass renders the photo with distractors and the clean photo.

The two photos share every static sample, so they differ only where a ray hits a distractor or a moving
shadow falls. Each tile lists the shapes whose bounding sphere its cone of rays can touch, so that a sample
tests few shapes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import cv2
import numba
import numpy as np

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.simulate.kernels import CELLS, FAR, kernel, nearest, reflect, shade

_TILE = 16
_MAX_LEVELS = 12
_FEW_RAYS = 20_000  # of which one thread is as fast


@dataclass(frozen=True)
class Atlas:
    """Mip pyramids of all textures in one flat array; level l of texture t starts at ``offset[t, l]``."""

    texels: np.ndarray  # [N, 3] float32, linear light
    offset: np.ndarray  # [T, L] int64
    width: np.ndarray  # [T, L] int32
    height: np.ndarray  # [T, L] int32
    levels: np.ndarray  # [T] int32
    index: Mapping[str, int]


def build_atlas(textures: Mapping[str, np.ndarray]) -> Atlas:
    """Build mip pyramids by area averaging, in linear light.

    Args:
        textures: name -> [H, W, 3] float32, linear light.
    """
    count = len(textures)
    offset = np.zeros((count, _MAX_LEVELS), np.int64)
    width = np.ones((count, _MAX_LEVELS), np.int32)
    height = np.ones((count, _MAX_LEVELS), np.int32)
    levels = np.zeros(count, np.int32)
    chunks: list[np.ndarray] = []
    used = 0
    for t, image in enumerate(textures.values()):
        level: np.ndarray = np.ascontiguousarray(np.clip(image, 0.0, None), np.float64)
        for k in range(_MAX_LEVELS):
            h, w = level.shape[:2]
            offset[t, k], width[t, k], height[t, k], levels[t] = used, w, h, k + 1
            chunks.append(level.reshape(-1, 3).astype(np.float32))
            used += h * w
            if min(h, w) == 1:
                break
            level = cv2.resize(level, (max(w // 2, 1), max(h // 2, 1)), interpolation=cv2.INTER_AREA)
    index = {name: t for t, name in enumerate(textures)}
    return Atlas(np.concatenate(chunks), offset, width, height, levels, index)


@dataclass(frozen=True)
class ShapeTable:
    """S shapes as columns. A shape's local point is ``rotation @ (world - center)``."""

    kind: np.ndarray  # [S] int32
    rotation: np.ndarray  # [S, 3, 3] float64, local from world
    center: np.ndarray  # [S, 3] float64, m
    half: np.ndarray  # [S, 3] float64, m: half sizes; capsule (radius, radius, half length)
    radius: np.ndarray  # [S] float64, m: bounding sphere
    texture: np.ndarray  # [S] int32
    mapping: np.ndarray  # [S] int32
    uv: np.ndarray  # [S, 4] float64: scale u, scale v (texture sizes a metre), offset u, offset v
    tint: np.ndarray  # [S, 3] float64, linear light
    casts: np.ndarray  # [S] bool: the shape casts a shadow
    owner: np.ndarray  # [S] int32, 0 = static, k = the k-th distractor, -1 = invisible shadow caster
    instant: np.ndarray  # [S] int32, of the exposure at which it is there
    gloss: np.ndarray  # [S, 2] float64: strength and sharpness of the highlight; strength 0 = none
    volume: np.ndarray  # [S] int32, index into `grids`
    grids: np.ndarray  # [V, N, N, N] float32, signed distances

    def columns(self) -> tuple[np.ndarray, ...]:
        """Return the arrays in the order of the kernel's arguments."""
        return tuple(getattr(self, column.name) for column in fields(self))


@dataclass(frozen=True)
class Light:
    """A sun and a sky. Sample k of a pixel is lit from ``sun[k]``; their spread gives soft shadows."""

    sun: np.ndarray  # [K, 3] float64, unit, towards the sun
    sun_colour: np.ndarray  # [3] float64
    sky_colour: np.ndarray  # [3] float64, ambient from above
    ground_colour: np.ndarray  # [3] float64, ambient from below


def shadow_grid(table: ShapeTable, sun: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List the shapes that may lie between a point and the sun, by where the point's line to the sun runs.

    Args:
        table: shapes; those that cast shadows are listed.
        sun: [K, 3] directions, each with a grid of its own across it.

    Returns:
        frame [K, 9] float64, two axes of the grid, its corner, m, and cells per m; start [K, cells + 1] int32
        and members [M] int32: cell c of direction k holds ``members[start[k, c]:start[k, c + 1]]``.
    """
    which = np.flatnonzero(table.casts).astype(np.int32)
    frame = np.zeros((len(sun), 9))
    if not len(which):
        return frame, np.zeros((len(sun), CELLS**2 + 1), np.int32), which
    radius = table.radius[which]
    listed = []
    for k, direction in enumerate(sun):
        first = np.cross(direction, (1.0, 0.0, 0.0) if abs(direction[0]) < 0.9 else (0.0, 1.0, 0.0))
        first /= np.linalg.norm(first, axis=-1)
        axes = np.stack([first, np.cross(direction, first)])
        middle = (table.center[which][:, None] * axes).sum(-1)
        low = (middle - radius[:, None]).min(0)
        scale = (CELLS - 1e-6) / max(float(((middle + radius[:, None]).max(0) - low).max()), 1e-9)
        frame[k] = [*axes.ravel(), *low, scale]
        begin, end = (((middle + side * radius[:, None] - low) * scale).astype(int) for side in (-1, 1))
        for s, (a, b), (c, d) in zip(which, begin, end):
            cells = (np.arange(b, d + 1)[:, None] * CELLS + np.arange(a, c + 1)).ravel()
            listed.append((k * CELLS**2 + cells, np.full(len(cells), s, np.int32)))
    cells = np.concatenate([cell for cell, _ in listed])
    shapes = np.concatenate([s for _, s in listed])
    counts = np.bincount(cells, minlength=len(sun) * CELLS**2)
    edges = np.concatenate([[0], np.cumsum(counts)])
    start = np.stack([edges[k * CELLS**2 : (k + 1) * CELLS**2 + 1] for k in range(len(sun))])
    return frame, start.astype(np.int32), shapes[np.argsort(cells, kind="stable")]


@dataclass(frozen=True)
class TracedPhoto:
    """The images of one camera, in linear light."""

    clean: np.ndarray  # [H, W, 3] float32
    distracted: np.ndarray  # [H, W, 3] float32
    # [H, W] bool: changed by a shadow, or by what a pane reflects; None: neither shadow casters nor panes
    shadow: np.ndarray | None
    # [H, W] uint8: first distractor that a sample of the pixel hits, also in a mirror, 0 = none
    owner: np.ndarray
    # [H, W] float32: z of the static surface, a mirror's own, behind a pane; mean over the samples
    depth_m: np.ndarray


def trace(
    camera: Camera,
    static: ShapeTable,
    movers: ShapeTable,
    atlas: Atlas,
    light: Light,
    shadow_casters: ShapeTable | None = None,
    mirrors: ShapeTable | None = None,
) -> TracedPhoto:
    """Render the static world and the distractors, with one sample a pixel per sun direction.

    Args:
        camera: OpenCV axes; pixel centres at +0.5.
        static: the static world.
        movers: the distractors of this photo.
        atlas: textures.
        light: ``len(light.sun)`` must be a square number (the samples lie on a regular grid).
        shadow_casters: their shadow falls on the static world in the distracted image only.
        mirrors: mirrors, and panes (tint 0), which reflect once; nothing else of them is seen.
    """
    side = math.isqrt(len(light.sun))
    shape = (camera.height, camera.width)
    clean, distracted = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
    owner, depth = np.zeros(shape, np.uint8), np.zeros(shape, np.float32)
    darkened = np.zeros(shape, np.bool_)
    nothing = replace(static, **{c.name: getattr(static, c.name)[:0] for c in fields(static)})
    every = np.arange(len(static.kind), dtype=np.int32), np.arange(len(movers.kind), dtype=np.int32)
    world = (
        (
            np.ascontiguousarray(camera.cam_from_world[:3, :3]),
            camera.center,
            np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            side,
        ),
        static.columns() + shadow_grid(static, light.sun),
        movers.columns() + shadow_grid(movers, light.sun),
        *(
            table.columns() + shadow_grid(table, light.sun)
            for table in (shadow_casters or nothing, replace(mirrors or nothing, casts=np.zeros(0, np.bool_)))
        ),
        every,
        (atlas.texels, atlas.offset, atlas.width, atlas.height, atlas.levels),
        (light.sun, light.sun_colour, light.sky_colour, light.ground_colour),
        (clean, distracted, owner, depth, darkened),
    )
    tops = range(0, camera.height, _TILE)

    def row(top: int) -> None:
        near = tuple(np.empty(len(t.kind) if t else 0, np.int32) for t in (static, movers, mirrors))
        _tiles(top, near, *world)

    if camera.height * camera.width * len(light.sun) < _FEW_RAYS:
        for top in tops:
            row(top)
    else:
        # Threads of Python, as a kernel with threads of its own takes twice as long to compile.
        with ThreadPoolExecutor(numba.get_num_threads()) as threads:
            list(threads.map(row, tops))
    panes = mirrors is not None and bool((mirrors.tint[:, 0] == 0).any())
    changed = darkened if panes or shadow_casters is not None else None
    return TracedPhoto(clean, distracted, changed, owner, depth)


def first_hits(
    camera: Camera, table: ShapeTable, behind_m: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Find the shape in the middle of every pixel, without mirrors and light.

    Args:
        camera: OpenCV axes.
        table: shapes.
        behind_m: [H, W] z of what hides the shapes behind it, m; None: nothing does.

    Returns:
        Index of the shape, [H, W] int32, -1 where there is none; its z, [H, W] float64, m.
    """
    shape = (camera.height, camera.width)
    which, depth_m = (
        np.full(shape, -1, np.int32),
        np.full(shape, FAR) if behind_m is None else behind_m.copy(),
    )
    _first_hits(
        np.ascontiguousarray(camera.cam_from_world[:3, :3]),
        camera.center,
        np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        np.empty(len(table.kind), np.int32),
        table.columns() + shadow_grid(replace(table, casts=np.zeros(0, np.bool_)), np.zeros((1, 3))),
        which,
        depth_m,
    )
    return which, depth_m


@kernel(inline="never")
def _cull(table, o, axis, spread, keep):
    """List the shapes whose bounding sphere meets the cone around `axis`, and return their number."""
    center, radius = table[2], table[4]
    count = 0
    for s in range(len(radius)):
        if table[10][s] < 0:
            continue
        qx, qy, qz = center[s, 0] - o[0], center[s, 1] - o[1], center[s, 2] - o[2]
        distance = math.sqrt(qx * qx + qy * qy + qz * qz)
        if distance > radius[s]:
            cosine = (qx * axis[0] + qy * axis[1] + qz * axis[2]) / distance
            angle = math.acos(min(max(cosine, -1.0), 1.0))
            if angle > spread + math.asin(radius[s] / distance):
                continue
        keep[count] = s
        count += 1
    return count


@kernel(inline="always")
def _mixed(mirrored, through, behind):
    """Add what is seen behind a pane to what it mirrors."""
    if through == 1.0:
        return behind
    return (
        mirrored[0] + through * behind[0],
        mirrored[1] + through * behind[1],
        mirrored[2] + through * behind[2],
    )


@kernel(inline="always")
def _ray(rotation, k, u, v):
    x, y = (u - k[2]) / k[0], (v - k[3]) / k[1]
    scale = 1.0 / math.sqrt(x * x + y * y + 1.0)
    x, y, z = x * scale, y * scale, scale
    return (
        rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z,
        rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z,
        rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z,
    ), z


@kernel(inline="always")
def _cone(rotation, k, x0, y0, x1, y1):
    """Return the axis of the cone around a tile's rays, and its half angle."""
    axis, _ = _ray(rotation, k, 0.5 * (x0 + x1), 0.5 * (y0 + y1))
    cone = 0.0
    for corner in range(4):
        edge, _ = _ray(rotation, k, float(x0 if corner % 2 else x1), float(y0 if corner // 2 else y1))
        cosine = axis[0] * edge[0] + axis[1] * edge[1] + axis[2] * edge[2]
        cone = max(cone, math.acos(min(max(cosine, -1.0), 1.0)))
    return axis, cone + 1e-6  # acos near 1 is coarse; a sphere that touches the corner must stay in the list


@kernel(nogil=True)
def _first_hits(rotation, eye, k, near, table, which, depth):
    """Write the nearest shape of each pixel, and its z, where it is nearer than the z that is there."""
    height, width = which.shape
    o = (eye[0], eye[1], eye[2])
    for y0 in range(0, height, _TILE):
        for x0 in range(0, width, _TILE):
            x1, y1 = min(x0 + _TILE, width), min(y0 + _TILE, height)
            axis, cone = _cone(rotation, k, x0, y0, x1, y1)
            count = _cull(table, o, axis, cone, near)
            for i in range(y0, y1 if count > 0 else y0):
                for j in range(x0, x1):
                    d, z = _ray(rotation, k, j + 0.5, i + 0.5)
                    t, s = nearest(table, near, count, o, d, depth[i, j] / z, i % 2 * 2 + j % 2)
                    if s >= 0:
                        which[i, j], depth[i, j] = s, t * z


@kernel(nogil=True)
def _tiles(y0, near, view, static, movers, shadow_casters, mirrors, every, atlas, light, frame):
    """Render a row of tiles; `near` is room for the numbers of a tile's shapes: static, moving, mirrors."""
    height, width = frame[2].shape
    for x0 in range(0, width, _TILE):
        box = (x0, y0, min(x0 + _TILE, width), min(y0 + _TILE, height))
        _tile(view, box, near, static, movers, shadow_casters, mirrors, every, atlas, light, frame)


@kernel(inline="never")
def _tile(view, box, near, static, movers, shadow_casters, mirrors, every, atlas, light, frame):
    rotation, eye, k, side = view
    x0, y0, x1, y1 = box
    clean, distracted, owner, depth, darkened = frame
    o = (eye[0], eye[1], eye[2])
    spread = 1.0 / (k[0] * side)
    share = 1.0 / (side * side)
    axis, cone = _cone(rotation, k, x0, y0, x1, y1)
    near_static, near_movers, near_mirrors = near
    static_count = _cull(static, o, axis, cone, near_static)
    mover_count = _cull(movers, o, axis, cone, near_movers)
    mirror_count = _cull(mirrors, o, axis, cone, near_mirrors)
    for i in range(y0, y1):
        for j in range(x0, x1):
            cr, cg, cb, sr, sg, sb, mr, mg, mb = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            z_sum = 0.0
            hit = 0
            for n in range(side * side):
                u, v = j + (n % side + 0.5) / side, i + (n // side + 0.5) / side
                instant = (side * i + n // side) % 2 * 2 + (side * j + n % side) % 2
                sample = (n, instant)
                d, z = _ray(rotation, k, u, v)
                t, s = nearest(static, near_static, static_count, o, d, FAR, instant)
                seen, bright = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
                through, mirrored, found, pane = 1.0, (0.0, 0.0, 0.0), 0, FAR
                if mirror_count > 0:
                    pane, g = nearest(mirrors, near_mirrors, mirror_count, o, d, t, instant)
                    if g >= 0:
                        part, mirrored, clear, mirrored_owner = reflect(
                            mirrors, g, pane, o, d, spread, atlas, light, sample, static, movers,
                            shadow_casters, every,
                        )  # fmt: skip
                        through = 1.0 - part
                        mirrored = (part * mirrored[0], part * mirrored[1], part * mirrored[2])
                        bright = (part * clear[0], part * clear[1], part * clear[2])
                        seen = mirrored
                        if mirrors[8][g, 0] > 0.0:  # nothing is seen behind a mirror
                            t, s = pane, -1
                            z_sum += t * z
                            found = mirrored_owner
                if s >= 0:
                    lit, clear = shade(
                        static, s, t, o, d, spread, atlas, light, sample, static, static, shadow_casters
                    )
                    seen = _mixed(seen, through, lit)
                    bright = _mixed(bright, through, clear)
                    z_sum += t * z
                cr, cg, cb = cr + bright[0], cg + bright[1], cb + bright[2]
                sr, sg, sb = sr + seen[0], sg + seen[1], sb + seen[2]
                if mover_count > 0:
                    tm, m = nearest(movers, near_movers, mover_count, o, d, t, instant)
                    if m >= 0:
                        lit, _ = shade(
                            movers, m, tm, o, d, spread, atlas, light, sample, static, movers, shadow_casters
                        )
                        seen = _mixed(mirrored, through, lit) if tm > pane else lit
                        found = movers[10][m]
                hit = found if hit == 0 else hit
                mr, mg, mb = mr + seen[0], mg + seen[1], mb + seen[2]
            clean[i, j, 0], clean[i, j, 1], clean[i, j, 2] = cr * share, cg * share, cb * share
            # Copied, not computed, so that the bits are equal where there is no distractor.
            distracted[i, j, 0], distracted[i, j, 1] = sr * share, sg * share
            distracted[i, j, 2] = sb * share
            for a in range(3):
                darkened[i, j] |= distracted[i, j, a] != clean[i, j, a]
            if hit > 0:
                distracted[i, j, 0], distracted[i, j, 1] = mr * share, mg * share
                distracted[i, j, 2] = mb * share
            depth[i, j] = z_sum * share
            owner[i, j] = hit
