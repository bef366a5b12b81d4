"""What a run was like over time: a row a hundredth of it."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from ambiguous_wild.io.atomic import write_text

if TYPE_CHECKING:
    from ambiguous_wild.splat.clock import Clock

ROWS = 100


class Timeline:
    """Collects the loss between two rows; rows are plain dicts, see `add`."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self.loss_sum: float | Tensor = 0.0  # since the last row
        self.loss_count = 0
        self.before_s = 0.0  # seconds of earlier trainings that belong to this one

    def loss(self, value: float | Tensor) -> None:
        """Take the loss of one iteration; NaN (a photo left out) does not count.

        A tensor is added up where it is: nobody waits for it.
        """
        if isinstance(value, Tensor) or not math.isnan(value):
            self.loss_sum, self.loss_count = self.loss_sum + value, self.loss_count + 1

    def add(self, iteration: int, gaussians: int, clock: Clock) -> dict[str, Any]:
        """A new row; returns it, with room for the PSNR of the test views."""
        row: dict[str, Any] = {
            "wall_s": round(self.before_s + clock.now(), 3),
            "iteration": iteration,
            "loss": float(self.loss_sum) / max(self.loss_count, 1),
            "gaussians": gaussians,
            "psnr_probe": None,
        }
        self.loss_sum, self.loss_count = 0.0, 0
        parts = clock.parts_s.items()
        row |= {f"ms_{name.replace(' ', '_')}": 1e3 * s / max(iteration, 1) for name, s in parts}
        self.rows.append(row)
        return row

    def write(self, path: Path) -> None:
        """timeline.csv: one line a row; empty cells where nothing was measured."""
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, names, lineterminator="\n", restval="")
        writer.writeheader()
        writer.writerows({k: "" if v is None else v for k, v in row.items()} for row in self.rows)
        write_text(path, text.getvalue())
