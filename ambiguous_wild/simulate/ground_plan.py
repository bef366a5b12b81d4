"""Size of each place. World axes: x right, y away from the walk, z up; metres; the ground is z = 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

SURFACE_NAMES = ("ground", "wall_back", "wall_left", "wall_right", "wall_front")


@dataclass(frozen=True)
class GroundPlan:
    """A rectangle with walls."""

    ground_m: tuple[float, float]  # of the ground's texture, centred on the origin
    x_m: tuple[float, float]  # of the inside
    y_m: tuple[float, float]
    wall_m: float  # height
    walls: tuple[str, ...] = SURFACE_NAMES[1:]
    ceiling: bool = False

    @property
    def surfaces(self) -> Mapping[str, tuple[float, float]]:
        """Width and height of the ground and of each wall; a texture covers each once."""
        across, along = self.x_m[1] - self.x_m[0], self.y_m[1] - self.y_m[0]
        width = {"wall_back": across, "wall_front": across, "wall_left": along, "wall_right": along}
        return {"ground": self.ground_m} | {name: (width[name], self.wall_m) for name in self.walls}

    @property
    def middle(self) -> tuple[float, float]:
        """Centre of the inside."""
        return (self.x_m[0] + self.x_m[1]) / 2, (self.y_m[0] + self.y_m[1]) / 2

    @property
    def highest_m(self) -> float:
        """Of a camera."""
        return self.wall_m - 0.3 if self.ceiling else 3.3

    def gap(self, x: float, y: float) -> float:
        """Distance to the nearest wall, m; the open side of the courtyard counts as one. Negative outside."""
        return min(x - self.x_m[0], self.x_m[1] - x, y - self.y_m[0], self.y_m[1] - y)


PLANS: Mapping[str, GroundPlan] = {
    "courtyard": GroundPlan((16.0, 14.0), (-5.6, 5.6), (-6.0, 4.2), 3.4, SURFACE_NAMES[1:4]),  # open in front
    "room": GroundPlan((7.2, 6.0), (-3.6, 3.6), (-3.0, 3.0), 2.7, ceiling=True),
    "yard": GroundPlan((18.0, 16.0), (-9.0, 9.0), (-8.0, 8.0), 5.0),
}
