"""How long runs of the full length will take here, said before they begin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ambiguous_wild.harness.running.cell import Cell, Overwrite
from ambiguous_wild.harness.running.grid import cell_folder
from ambiguous_wild.harness.running.run_folder import is_finished
from ambiguous_wild.harness.running.step_time import LEAST, MOST, expected_s, slowness


def unfinished(cells: Sequence[Cell], output: Path, overwrite: Overwrite) -> list[Cell]:
    """The cells that will be run: not those that are kept."""
    return [cell for cell in cells if not _kept(cell_folder(output, cell), overwrite)]


def _kept(folder: Path, overwrite: Overwrite) -> bool:
    if overwrite == "never":
        return folder.exists()
    return overwrite == "missing" and is_finished(folder)


def expected_line(cells: Sequence[Cell]) -> str:
    """What runs whose length nobody chose take on this machine's CPU; kernels must be compiled."""
    total, slower = 0.0, slowness()
    for cell in cells:
        camera = cell.scene.train[0].camera
        pixels = camera.width * camera.height
        most = min(cell.train.max_gaussians or pixels, pixels)
        total += expected_s(cell.train.iterations, pixels, most) * slower
    runs = "1 run" if len(cells) == 1 else f"{len(cells)} runs"
    return (
        f"no --iterations and no --budget: {runs} of {cells[0].train.iterations} iterations, "
        f"{_words(LEAST * total)} to {_words(MOST * total)} for 3dgs here, other methods up to 3 times that; "
        "--budget 10m ends each after ten minutes"
    )


def _words(seconds: float) -> str:
    if seconds < 5400:
        return f"{max(round(seconds / 60), 1)} min"
    return f"{seconds / 3600:.1f} h"
