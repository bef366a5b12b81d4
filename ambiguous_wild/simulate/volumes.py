"""Statues as signed distance functions, sampled on grids for sphere tracing.

A volume fills the cube [-1, 1]^3 around a shape's centre, z up, foot at z = -0.9; the shape's half size
scales it. Distances of a smooth union of primitives are a lower bound, nearly exact at the surface (Quilez,
"distance functions").
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache

import numpy as np

SIZE = 64  # samples a side
Point = tuple[float, float, float]


@cache
def grid(name: str) -> np.ndarray:
    """Signed distance of the named statue, [SIZE, SIZE, SIZE] float32 indexed z, y, x; read only."""
    axis = np.linspace(-1.0, 1.0, SIZE)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    values = np.asarray(STATUES[name](np.stack([x, y, z], -1)), np.float32)
    values.setflags(write=False)
    return values


def grids(names: Iterable[str]) -> np.ndarray:
    """The named volumes, [V, SIZE, SIZE, SIZE] float32; [0, 1, 1, 1] without names."""
    listed = [grid(name) for name in names]
    return np.stack(listed) if listed else np.zeros((0, 1, 1, 1), np.float32)


def _ball(p: np.ndarray, at: Point, half: Point | float) -> np.ndarray:
    """An ellipsoid, or a ball of one radius."""
    h = np.broadcast_to(np.asarray(half, float), 3)
    q = p - at
    inner = np.linalg.norm(q / h, axis=-1)
    outer = np.linalg.norm(q / h**2, axis=-1)
    return np.where(outer > 1e-9, inner * (inner - 1) / np.maximum(outer, 1e-9), -h.min())


def _rod(p: np.ndarray, start: Point, end: Point, radius: float) -> np.ndarray:
    """A capsule."""
    a, b = np.asarray(start), np.asarray(end)
    along = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(p - a - along[..., None] * (b - a), axis=-1) - radius


def _block(p: np.ndarray, at: Point, half: Point, round_off: float = 0.03) -> np.ndarray:
    """A box with rounded edges."""
    q = np.abs(p - at) - (np.asarray(half) - round_off)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - round_off


def _joined(parts: Iterable[np.ndarray], soft: float = 0.08) -> np.ndarray:
    """The smooth union (polynomial, of width `soft`)."""
    listed = list(parts)
    total = listed[0]
    for part in listed[1:]:
        blend = np.clip(0.5 + 0.5 * (part - total) / soft, 0.0, 1.0)
        total = part + (total - part) * blend - soft * blend * (1 - blend)
    return total


def _bust(p: np.ndarray) -> np.ndarray:
    """Head and shoulders on a foot."""
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


def _knot(p: np.ndarray) -> np.ndarray:
    """A trefoil knot on a slab."""
    t = np.linspace(0, 2 * np.pi, 61)
    curve = 0.2 * np.stack(
        [np.sin(t) + 2 * np.sin(2 * t), -np.sin(3 * t), np.cos(t) - 2 * np.cos(2 * t)], axis=-1
    ) + (0.0, 0.0, 0.12)
    rods = np.stack([_rod(p, tuple(a), tuple(b), 0.13) for a, b in zip(curve[:-1:2], curve[2::2])])
    return _joined([rods.min(0), _block(p, (0, 0, -0.73), (0.4, 0.4, 0.17))])


def _hound(p: np.ndarray) -> np.ndarray:
    """A sitting dog that looks ahead (-y)."""
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


def _spire(p: np.ndarray) -> np.ndarray:
    """A square column that twists and narrows upwards."""
    z = p[..., 2]
    angle, width = 1.8 * z, np.clip(0.38 - 0.17 * z, 0.1, 0.6)
    c, s = np.cos(angle), np.sin(angle)
    x, y = c * p[..., 0] - s * p[..., 1], s * p[..., 0] + c * p[..., 1]
    column = 0.7 * _block(np.stack([x / width, y / width, z / 0.9], -1), (0, 0, 0), (0.8, 0.8, 0.95), 0.1)
    return np.minimum(column * np.minimum(width, 0.9), _block(p, (0, 0, -0.84), (0.36, 0.36, 0.06)))


STATUES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "bust": _bust,
    "knot": _knot,
    "hound": _hound,
    "spire": _spire,
}
