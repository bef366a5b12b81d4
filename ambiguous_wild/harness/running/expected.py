"""How long runs of the full length will take here, said before they begin."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

from ambiguous_wild.harness.running.cell import Cell, Overwrite
from ambiguous_wild.harness.running.grid import cell_folder
from ambiguous_wild.harness.running.run_folder import is_finished

# ms of a step of 3dgs on the reference machine (splat/calibration.py): a constant, a part for every 1000 px
# and one for every 1000 Gaussians. Of captures of 240x135 to 480x270 with 32 000 to 60 000 Gaussians; a
# capture's own share is between these:
STEP_MS, PIXELS_MS, GAUSSIANS_MS = 3.0, 0.12, 0.3
LEAST, MOST = 0.67, 1.5


def expected_s(iterations: int, pixels: int, gaussians: int) -> float:
    """Seconds of so many iterations of 3dgs on the reference machine, to within `LEAST` and `MOST`."""
    return 1e-3 * iterations * (STEP_MS + 1e-3 * (PIXELS_MS * pixels + GAUSSIANS_MS * gaussians))


def unfinished(cells: Sequence[Cell], output: Path, overwrite: Overwrite) -> list[Cell]:
    """The cells that our trainer will train: not those of other programs, nor those that are kept."""
    return [
        cell
        for cell in cells
        if cell.method.program is None
        and (overwrite == "always" or not is_finished(cell_folder(output, cell)))
    ]


def expected_line(cells: Sequence[Cell]) -> str:
    """What runs whose length nobody chose take on this machine's CPU; kernels must be compiled."""
    import torch

    from ambiguous_wild.splat.calibration import KERNELS, calibration

    kernel = calibration(torch.device("cpu"))
    slower = statistics.median(kernel.seconds() for _ in range(3)) / KERNELS["cpu"].reference_s
    total = 0.0
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
