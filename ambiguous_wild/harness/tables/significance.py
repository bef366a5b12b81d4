"""Methods that do not differ significantly from the best: a paired bootstrap over the test images.

The same pictures are drawn for both methods, scene by scene, so that a hard picture affects both alike.
Seeds are averaged before; no correction is made for the number of methods that are compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from ambiguous_wild.harness.running.store import Runs
from ambiguous_wild.harness.tables.table import Row, Table

LEVEL = 0.95
RESAMPLES = 2000


def difference_interval(
    differences: Sequence[np.ndarray],  # one a scene: [n], a method less another on the same images
    *,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean over scenes of the mean over images.

    Images are drawn within their scene. NaN where a value is missing or a scene has fewer than two images.
    """
    if not differences or any(len(d) < 2 or not np.isfinite(d).all() for d in differences):
        return math.nan, math.nan
    rng = np.random.default_rng(seed)
    total = np.zeros(resamples)
    for values in differences:
        total += values[rng.integers(0, len(values), size=(resamples, len(values)))].mean(axis=1)
    means, tail = np.sort(total / len(differences)), (1.0 - level) / 2.0
    return (
        float(means[math.floor(tail * (resamples - 1))]),
        float(means[math.ceil((1.0 - tail) * (resamples - 1))]),
    )


class Ties:
    """Values by image of every method, gathered where they are asked for."""

    def __init__(self, runs: Runs) -> None:
        self._rows = dict(iter(runs.images.groupby(["scene", "metric"])))
        self._values: dict[tuple[str, str], pd.DataFrame] = {}

    def values(self, scene: str, metric: str) -> pd.DataFrame:
        """A row an image, a column a method: means over seeds, NaN where a seed has none."""
        key = (scene, metric)
        if key not in self._values:
            if key not in self._rows:
                return pd.DataFrame()
            cells = self._rows[key].groupby(["image", "method"])["value"].agg(["mean", "count", "size"])
            means = cells["mean"].where(cells["count"] == cells["size"])
            self._values[key] = means.unstack("method")
        return self._values[key]

    def marked(self, tables: Sequence[Table], scenes: Sequence[str]) -> list[Table]:
        """Tables of `comparison` with the cells marked that do not differ from the best of their column.

        `scenes`: that a mean is over.
        """
        return [
            replace(table, rows=tuple(self._marked(row, table, scenes) for row in table.rows))
            for table in tables
        ]

    def _marked(self, row: Row, table: Table, scenes: Sequence[str]) -> Row:
        cells = []
        for i, (column, cell) in enumerate(zip(table.columns, row.cells)):
            best = [other.name for other in table.rows if other.cells[i].rank == 1]
            of = (column.scene,) if column.scene else scenes
            tie = (
                row.ranked and cell.state == "ok" and column.measure.per_image
                and bool(best) and row.name not in best
                and self.tied(best[0], row.name, of, column.measure.key)
            )  # fmt: skip
            cells.append(replace(cell, tie=tie))
        return replace(row, cells=tuple(cells))

    def tied(self, best: str, other: str, scenes: Sequence[str], metric: str) -> bool:
        """Whether the interval of their difference holds zero; False where it is not known."""
        differences = []
        for scene in scenes:
            values = self.values(scene, metric)
            if best not in values or other not in values:
                return False
            a, b = values[best].to_numpy(float), values[other].to_numpy(float)
            with np.errstate(invalid="ignore"):  # inf less inf: both are perfect
                differences.append(np.where(a == b, 0.0, a - b))
        low, high = difference_interval(differences)
        return low <= 0.0 <= high
