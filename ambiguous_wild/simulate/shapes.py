"""Shapes: primitives, objects made of them (figure, barrier), and statues.

Statues are signed distance functions, sampled on grids for sphere tracing. A grid fills the cube [-1, 1]^3
around a shape's centre, z up, foot at z = -0.9; the shape's half size scales it. Distances of a smooth union
of primitives are a lower bound, nearly exact at the surface (Quilez, "distance functions").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from ambiguous_wild.simulate.kernels import ALWAYS, BOX, BY_FACE, CAPSULE, CYLINDER, ELLIPSOID, QUAD
from ambiguous_wild.simulate.tracer import Atlas, ShapeTable

SIZE = 64  # samples a side
Vector = tuple[float, float, float]
Axes = tuple[Vector, ...]
UNSEEN = -1  # owner of an invisible shadow caster
_HIP_M = 0.92  # height at which a figure bends
SHEET_M = 2.0  # side of the square that an object's texture covers before it repeats mirrored
STATUES: dict[str, Callable[[np.ndarray], np.ndarray]] = {}  # signed distance of points [..., 3], by name


def _statue(distance: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """Decorate the signed distance of a statue: registers it by the function's name."""
    STATUES[distance.__name__.removeprefix("_")] = distance
    return distance


@cache
def grid(name: str) -> np.ndarray:
    """Sample the named statue's signed distance, [SIZE, SIZE, SIZE] float32 indexed z, y, x; read-only."""
    axis = np.linspace(-1.0, 1.0, SIZE)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    values = np.asarray(STATUES[name](np.stack([x, y, z], -1)), np.float32)
    values.setflags(write=False)
    return values


def grids(names: Iterable[str]) -> np.ndarray:
    """Stack the grids of named statues, [V, SIZE, SIZE, SIZE] float32; [0, 1, 1, 1] without names."""
    listed = [grid(name) for name in names]
    return np.stack(listed) if listed else np.zeros((0, 1, 1, 1), np.float32)


def _ball(p: np.ndarray, at: Vector, half: Vector | float) -> np.ndarray:
    """Distance to an ellipsoid, or to a ball of one radius."""
    h = np.broadcast_to(np.asarray(half, float), 3)
    q = p - at
    inner = np.linalg.norm(q / h, axis=-1)
    outer = np.linalg.norm(q / h**2, axis=-1)
    return np.where(outer > 1e-9, inner * (inner - 1) / np.maximum(outer, 1e-9), -h.min())


def _rod(p: np.ndarray, start: Vector, end: Vector, radius: float) -> np.ndarray:
    """Distance to a capsule."""
    a, b = np.asarray(start), np.asarray(end)
    along = np.clip(((p - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(), 0.0, 1.0)
    return np.linalg.norm(p - a - along[..., None] * (b - a), axis=-1) - radius


def _block(p: np.ndarray, at: Vector, half: Vector, round_off: float = 0.03) -> np.ndarray:
    """Distance to a box with rounded edges."""
    q = np.abs(p - at) - (np.asarray(half) - round_off)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - round_off


def _joined(parts: Iterable[np.ndarray], soft: float = 0.08) -> np.ndarray:
    """Distance to the smooth union of parts (polynomial, of width `soft`)."""
    listed = list(parts)
    total = listed[0]
    for part in listed[1:]:
        blend = np.clip(0.5 + 0.5 * (part - total) / soft, 0.0, 1.0)
        total = part + (total - part) * blend - soft * blend * (1 - blend)
    return total


@_statue
def _bust(p: np.ndarray) -> np.ndarray:
    """Distance to head and shoulders on a foot."""
    return _joined(
        [
            _block(p, (0, 0, -0.78), (0.3, 0.26, 0.12)),
            _rod(p, (0, 0, -0.7), (0, 0, -0.45), 0.15),
            _ball(p, (0, 0.02, -0.3), (0.52, 0.27, 0.28)),
            _rod(p, (0, 0.02, -0.2), (0, -0.03, 0.2), 0.14),
            _ball(p, (0, 0, 0.45), (0.25, 0.3, 0.36)),
            _ball(p, (0, 0.08, 0.58), (0.29, 0.29, 0.28)),
            _rod(p, (0, -0.28, 0.5), (0, -0.36, 0.38), 0.045),
            _ball(p, (0, -0.26, 0.2), (0.1, 0.08, 0.07)),
            _ball(p, (-0.26, 0.02, 0.42), (0.05, 0.08, 0.1)),
            _ball(p, (0.26, 0.02, 0.42), (0.05, 0.08, 0.1)),
        ]
    )


@_statue
def _knot(p: np.ndarray) -> np.ndarray:
    """Distance to a trefoil knot on a slab."""
    t = np.linspace(0, 2 * np.pi, 61)
    curve = 0.2 * np.stack(
        [np.sin(t) + 2 * np.sin(2 * t), -np.sin(3 * t), np.cos(t) - 2 * np.cos(2 * t)], axis=-1
    ) + (0.0, 0.0, 0.12)
    rods = np.stack([_rod(p, tuple(a), tuple(b), 0.13) for a, b in zip(curve[:-1:2], curve[2::2])])
    return _joined([rods.min(0), _block(p, (0, 0, -0.73), (0.4, 0.4, 0.17))])


@_statue
def _hound(p: np.ndarray) -> np.ndarray:
    """Distance to a sitting dog that looks ahead (-y)."""
    legs = [_rod(p, (x, -0.28, -0.1), (x, -0.3, -0.75), 0.075) for x in (-0.15, 0.15)]
    thighs = [_ball(p, (x, 0.2, -0.55), (0.13, 0.3, 0.24)) for x in (-0.22, 0.22)]
    ears = [_rod(p, (x, -0.16, 0.62), (1.3 * x, -0.1, 0.8), 0.05) for x in (-0.13, 0.13)]
    return _joined(
        [
            _block(p, (0, 0, -0.82), (0.36, 0.45, 0.08)),
            _rod(p, (0, 0.22, -0.5), (0, -0.18, 0.12), 0.24),
            *legs,
            *thighs,
            _rod(p, (0, -0.2, 0.2), (0, -0.22, 0.5), 0.15),
            _ball(p, (0, -0.25, 0.55), (0.18, 0.21, 0.18)),
            _rod(p, (0, -0.38, 0.5), (0, -0.56, 0.46), 0.085),
            *ears,
            _rod(p, (0, 0.42, -0.7), (0.3, 0.62, -0.55), 0.06),
        ]
    )


@_statue
def _spire(p: np.ndarray) -> np.ndarray:
    """Distance to a square column that twists and narrows upwards."""
    z = p[..., 2]
    angle, width = 1.8 * z, np.clip(0.38 - 0.17 * z, 0.1, 0.6)
    c, s = np.cos(angle), np.sin(angle)
    x, y = c * p[..., 0] - s * p[..., 1], s * p[..., 0] + c * p[..., 1]
    column = 0.7 * _block(np.stack([x / width, y / width, z / 0.9], -1), (0, 0, 0), (0.8, 0.8, 0.95), 0.1)
    return np.minimum(column * np.minimum(width, 0.9), _block(p, (0, 0, -0.84), (0.36, 0.36, 0.06)))


@dataclass(frozen=True)
class Shape:
    """One primitive; the rows of `axes` are its local axes in the world."""

    kind: int
    center: tuple[float, float, float]  # m
    half: tuple[float, float, float]  # m
    texture: str
    axes: Axes = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    mapping: int = BY_FACE
    scale: tuple[float, float] = (1.0 / SHEET_M, 1.0 / SHEET_M)  # textures per m
    offset: tuple[float, float] = (0.5, 0.5)  # the middle of the texture, far from the mirrored border
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    casts: bool = True
    owner: int = 0  # 0: the static world, k: the k-th distractor, UNSEEN
    instant: int = ALWAYS  # of the exposure at which it is there
    thing: str = ""  # name of the static object that a distractor may be taken for; empty: part of the place
    gloss: tuple[float, float] = (0.0, 0.0)  # strength and sharpness of the highlight
    volume: str = ""  # name of the statue, for VOLUME


def bounding_radius(kind: int, half: Sequence[float]) -> float:
    """Return the radius of the bounding sphere around the shape's centre, m."""
    if kind == QUAD:
        return float(np.hypot(half[0], half[1]))
    if kind == ELLIPSOID:
        return float(max(half))
    if kind == CAPSULE:
        return float(half[0] + half[2])
    if kind == CYLINDER:
        return float(np.hypot(half[0], half[2]))
    return float(np.linalg.norm(half))


def shape_table(shapes: Iterable[Shape], atlas: Atlas) -> ShapeTable:
    """Convert shapes to columns for the ray caster."""
    listed = list(shapes)
    count = len(listed)
    names = sorted({s.volume for s in listed if s.volume})
    return ShapeTable(
        kind=np.array([s.kind for s in listed], np.int32),
        rotation=np.array([s.axes for s in listed], np.float64).reshape(count, 3, 3),
        center=np.array([s.center for s in listed], np.float64).reshape(count, 3),
        half=np.array([s.half for s in listed], np.float64).reshape(count, 3),
        radius=np.array([bounding_radius(s.kind, s.half) + 1e-6 for s in listed], np.float64),
        texture=np.array([atlas.index[s.texture] for s in listed], np.int32),
        mapping=np.array([s.mapping for s in listed], np.int32),
        uv=np.array([(*s.scale, *s.offset) for s in listed], np.float64).reshape(count, 4),
        tint=np.array([s.tint for s in listed], np.float64).reshape(count, 3),
        casts=np.array([s.casts for s in listed], np.bool_),
        owner=np.array([s.owner for s in listed], np.int32),
        instant=np.array([s.instant for s in listed], np.int32),
        gloss=np.array([s.gloss for s in listed], np.float64).reshape(count, 2),
        volume=np.array([names.index(s.volume) if s.volume else 0 for s in listed], np.int32),
        grids=grids(names),
    )


def capsule_between(
    start: Sequence[float],
    end: Sequence[float],
    radius: float,
    texture: str,
    kind: int = CAPSULE,
    **more: Any,
) -> Shape:
    """Make a capsule (or cylinder) from one point to another."""
    a, b = vector(start), vector(end)
    length = math.dist(a, b)
    z = ((b[0] - a[0]) / length, (b[1] - a[1]) / length, (b[2] - a[2]) / length)
    # perpendicular to z, and to the y or the x axis
    side = (z[2], 0.0, -z[0]) if abs(z[1]) < 0.9 else (0.0, -z[2], z[1])
    norm = math.hypot(*side)
    x = (side[0] / norm, side[1] / norm, side[2] / norm)
    y = (z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0])
    middle = ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2)
    return Shape(kind, middle, (radius, radius, length / 2), texture, (x, y, z), **more)


def vector(values: Iterable[float]) -> Vector:
    """Convert three numbers to a tuple of floats."""
    x, y, z = (float(v) for v in values)
    return x, y, z


def transformed(
    shapes: Iterable[Shape], at: Sequence[float], yaw_deg: float, size: float = 1.0, **more: Any
) -> list[Shape]:
    """Turn shapes about z, scale them and move them to `at`, with their textures; `more`: fields to set."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    left, ahead, up = vector(at)

    def turned(v: Vector) -> Vector:
        return c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]

    moved = []
    for shape in shapes:
        x, y, z = turned(shape.center)
        a, b, d = shape.half
        moved.append(
            replace(
                shape,
                center=(size * x + left, size * y + ahead, size * z + up),
                half=(size * a, size * b, size * d),
                axes=tuple(turned(row) for row in shape.axes),
                **more,
            )
        )
    return moved


def bend_forward(shapes: Iterable[Shape], angle_deg: float, hinge_m: float) -> list[Shape]:
    """Turn shapes forwards, towards -y, about the x axis at a height."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))

    def turned(v: Vector, hinge: float = 0.0) -> Vector:
        up = v[2] - hinge
        return v[0], c * v[1] - s * up, s * v[1] + c * up + hinge

    return [
        replace(shape, center=turned(shape.center, hinge_m), axes=tuple(turned(row) for row in shape.axes))
        for shape in shapes
    ]


def figure(
    body: str, head: str, stride: float = 0.1, lift: float = 0.0, tint: float = 1.0, bend_deg: float = 0.0
) -> list[Shape]:
    """Make a standing person, 1.75 m, facing -y, feet at the origin.

    Args:
        body: texture of clothes and limbs.
        head: texture of head and hands.
        stride: half the distance between the feet, m.
        lift: height of the right arm, 0 (hanging) to 1 (pointing forward).
        tint: brightness of the legs relative to the coat.
        bend_deg: bend of the trunk at the hip.
    """
    legs: dict[str, Any] = {"tint": (tint, tint, tint)}
    hand = (0.32, -0.12 - 0.42 * lift, 0.82 + 0.5 * lift)
    elbow = (0.34, -0.02 - 0.15 * lift, 1.12)
    lower = [
        capsule_between((-0.1, 0, 0.85), (-0.11, -stride, 0.09), 0.085, body, **legs),
        capsule_between((0.1, 0, 0.85), (0.11, stride, 0.09), 0.085, body, **legs),
        Shape(ELLIPSOID, (-0.11, -stride - 0.06, 0.06), (0.065, 0.15, 0.065), body, tint=(tint * 0.7,) * 3),
        Shape(ELLIPSOID, (0.11, stride - 0.06, 0.06), (0.065, 0.15, 0.065), body, tint=(tint * 0.7,) * 3),
        Shape(ELLIPSOID, (0, 0, 0.86), (0.23, 0.18, 0.34), body, offset=(0.62, 0.45)),
    ]
    upper = [
        Shape(ELLIPSOID, (0, 0, 1.2), (0.235, 0.155, 0.32), body),
        capsule_between((-0.2, 0, 1.4), (0.2, 0, 1.4), 0.085, body),
        capsule_between((-0.26, 0, 1.38), (-0.33, 0.03, 1.1), 0.068, body, offset=(0.35, 0.6)),
        capsule_between((-0.33, 0.03, 1.1), (-0.3, -0.1, 0.84), 0.06, body, offset=(0.3, 0.35)),
        capsule_between((0.26, 0, 1.38), elbow, 0.068, body, offset=(0.7, 0.6)),
        capsule_between(elbow, hand, 0.06, body, offset=(0.6, 0.4)),
        Shape(ELLIPSOID, hand, (0.055, 0.055, 0.07), head),
        Shape(ELLIPSOID, (-0.3, -0.11, 0.79), (0.05, 0.055, 0.07), head),
        capsule_between((0, 0, 1.4), (0, -0.01, 1.55), 0.06, head),
        Shape(ELLIPSOID, (0, -0.02, 1.635), (0.093, 0.112, 0.13), head, offset=(0.4, 0.55)),
        Shape(ELLIPSOID, (0, 0.015, 1.665), (0.102, 0.112, 0.115), body, tint=(0.35 * tint,) * 3),
    ]
    return [*lower, *(bend_forward(upper, bend_deg, _HIP_M) if bend_deg else upper)]


def barrier(texture: str) -> list[Shape]:
    """Make two posts of 1 m, 1.5 m apart, and a rope of 3 cm that sags between them."""
    posts = [capsule_between((x, 0, 0.02), (x, 0, 1.0), 0.022, texture) for x in (-0.75, 0.75)]
    feet = [Shape(BOX, (x, 0, 0.015), (0.12, 0.12, 0.015), texture) for x in (-0.75, 0.75)]
    x = np.linspace(-0.75, 0.75, 9)
    knots = np.stack([x, np.zeros(9), 0.65 + 0.3 * (x / 0.75) ** 2], axis=1)
    rope = [capsule_between(a, b, 0.015, texture) for a, b in pairwise(knots)]
    return [*posts, *feet, *rope]
