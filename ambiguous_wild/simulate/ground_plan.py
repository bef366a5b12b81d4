"""Size of the courtyard. World axes: x right, y away from the camera's walk, z up; metres."""

from __future__ import annotations

GROUND_M = (16.0, 14.0)
WALL_HEIGHT_M = 3.4
HALF_WIDTH_M, BACK_M, FRONT_M = 5.6, 4.2, -6.0  # side walls at x = +-5.6, back wall at y = 4.2

# Width and height of the surfaces; the texture covers each once.
SURFACES = {
    "ground": GROUND_M,
    "wall_back": (2 * HALF_WIDTH_M, WALL_HEIGHT_M),
    "wall_left": (BACK_M - FRONT_M, WALL_HEIGHT_M),
    "wall_right": (BACK_M - FRONT_M, WALL_HEIGHT_M),
}
