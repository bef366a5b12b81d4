"""Primitives, and objects made of them: figure, pole, barrier, banner."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ambiguous_wild.simulate.kernels import BOX, BY_FACE, CAPSULE, CYLINDER, ELLIPSOID, QUAD
from ambiguous_wild.simulate.tracer import Atlas, ShapeTable
from ambiguous_wild.simulate.volumes import grids

UNSEEN = -1  # owner of an invisible shadow caster
SHEET_M = 2.0  # side of the square that an object's texture covers before it is mirrored

Vector = tuple[float, float, float]
Axes = tuple[Vector, ...]


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
    gloss: tuple[float, float] = (0.0, 0.0)  # strength and sharpness of the highlight
    volume: str = ""  # name of the statue, for VOLUME


def bounding_radius(kind: int, half: Sequence[float]) -> float:
    """Radius of the bounding sphere around the shape's centre, m."""
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
    """The shapes as columns for the ray caster."""
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
        gloss=np.array([s.gloss for s in listed], np.float64).reshape(count, 2),
        volume=np.array([names.index(s.volume) if s.volume else 0 for s in listed], np.int32),
        grids=grids(names),
    )


def between(
    start: Sequence[float],
    end: Sequence[float],
    radius: float,
    texture: str,
    kind: int = CAPSULE,
    **more: Any,
) -> Shape:
    """A capsule (or cylinder) from one point to another."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    z = (b - a) / np.linalg.norm(b - a)
    x = np.cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0), z)
    x /= np.linalg.norm(x)
    axes = tuple(vector(row) for row in (x, np.cross(z, x), z))
    middle = vector((a + b) / 2)
    half = (radius, radius, float(np.linalg.norm(b - a)) / 2)
    return Shape(kind, middle, half, texture, axes, **more)


def vector(values: Iterable[float]) -> Vector:
    """Three numbers as a tuple of floats."""
    x, y, z = (float(v) for v in values)
    return x, y, z


def placed(shapes: Iterable[Shape], at: Sequence[float], yaw_deg: float, size: float = 1.0) -> list[Shape]:
    """The shapes turned about z, scaled and moved to `at`, with their textures."""
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = []
    for shape in shapes:
        center = size * (turn @ np.asarray(shape.center)) + np.asarray(at, float)
        axes = np.asarray(shape.axes) @ turn.T
        moved.append(
            replace(
                shape,
                center=vector(center),
                half=vector(size * v for v in shape.half),
                axes=tuple(vector(row) for row in axes),
            )
        )
    return moved


def figure(body: str, head: str, stride: float = 0.1, lift: float = 0.0, tint: float = 1.0) -> list[Shape]:
    """A standing person, 1.75 m, facing -y, feet at the origin.

    Args:
        body: texture of clothes and limbs.
        head: texture of head and hands.
        stride: half the distance between the feet, m.
        lift: height of the right arm, 0 (hanging) to 1 (pointing forward).
        tint: brightness of the legs relative to the coat.
    """
    legs: dict[str, Any] = {"tint": (tint, tint, tint)}
    hand = (0.32, -0.12 - 0.42 * lift, 0.82 + 0.5 * lift)
    elbow = (0.34, -0.02 - 0.15 * lift, 1.12)
    return [
        between((-0.1, 0, 0.85), (-0.11, -stride, 0.09), 0.085, body, **legs),
        between((0.1, 0, 0.85), (0.11, stride, 0.09), 0.085, body, **legs),
        Shape(ELLIPSOID, (-0.11, -stride - 0.06, 0.06), (0.065, 0.15, 0.065), body, tint=(tint * 0.7,) * 3),
        Shape(ELLIPSOID, (0.11, stride - 0.06, 0.06), (0.065, 0.15, 0.065), body, tint=(tint * 0.7,) * 3),
        Shape(ELLIPSOID, (0, 0, 0.86), (0.23, 0.18, 0.34), body, offset=(0.62, 0.45)),
        Shape(ELLIPSOID, (0, 0, 1.2), (0.235, 0.155, 0.32), body),
        between((-0.2, 0, 1.4), (0.2, 0, 1.4), 0.085, body),
        between((-0.26, 0, 1.38), (-0.33, 0.03, 1.1), 0.068, body, offset=(0.35, 0.6)),
        between((-0.33, 0.03, 1.1), (-0.3, -0.1, 0.84), 0.06, body, offset=(0.3, 0.35)),
        between((0.26, 0, 1.38), elbow, 0.068, body, offset=(0.7, 0.6)),
        between(elbow, hand, 0.06, body, offset=(0.6, 0.4)),
        Shape(ELLIPSOID, hand, (0.055, 0.055, 0.07), head),
        Shape(ELLIPSOID, (-0.3, -0.11, 0.79), (0.05, 0.055, 0.07), head),
        between((0, 0, 1.4), (0, -0.01, 1.55), 0.06, head),
        Shape(ELLIPSOID, (0, -0.02, 1.635), (0.093, 0.112, 0.13), head, offset=(0.4, 0.55)),
        Shape(ELLIPSOID, (0, 0.015, 1.665), (0.102, 0.112, 0.115), body, tint=(0.35 * tint,) * 3),
    ]


def pole(texture: str) -> list[Shape]:
    """A pole of 2 m, 5 cm thick, on a small foot."""
    foot = Shape(BOX, (0, 0, 0.02), (0.14, 0.14, 0.02), texture)
    return [between((0, 0, 0.03), (0, 0, 2.0), 0.025, texture), foot]


def barrier(texture: str) -> list[Shape]:
    """Two posts of 1 m, 1.5 m apart, and a rope of 3 cm that sags between them."""
    posts = [between((x, 0, 0.02), (x, 0, 1.0), 0.022, texture) for x in (-0.75, 0.75)]
    feet = [Shape(BOX, (x, 0, 0.015), (0.12, 0.12, 0.015), texture) for x in (-0.75, 0.75)]
    x = np.linspace(-0.75, 0.75, 9)
    knots = np.stack([x, np.zeros(9), 0.65 + 0.3 * (x / 0.75) ** 2], axis=1)
    rope = [between(a, b, 0.015, texture) for a, b in pairwise(knots)]
    return [*posts, *feet, *rope]


def banner(texture: str) -> list[Shape]:
    """A strip of cloth, 1.3 x 0.26 m, held up by two sticks of 2 cm."""
    sticks = [between((x, 0, 0.02), (x, 0, 1.75), 0.012, texture) for x in (-0.62, 0.62)]
    return [Shape(BOX, (0, 0, 1.6), (0.65, 0.008, 0.13), texture), *sticks]
