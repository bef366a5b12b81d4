"""How long a step of 3DGS takes on the reference machine, from the sizes of its photos and its model."""

from __future__ import annotations

import statistics

# ms of a step of 3dgs on the reference machine (splat/calibration.py): a constant, a part for every 1000 px
# and one for every 1000 Gaussians. Of captures of 240x134 to 480x268 with 32 000 to 102 000 Gaussians; a
# capture's own share is between these:
STEP_MS, PIXELS_MS, GAUSSIANS_MS = 2.2, 0.09, 0.22
LEAST, MOST = 0.67, 1.5


def expected_s(iterations: int, pixels: int, gaussians: int) -> float:
    """Seconds of so many iterations of 3dgs on the reference machine, to within `LEAST` and `MOST`."""
    return 1e-3 * iterations * (STEP_MS + 1e-3 * (PIXELS_MS * pixels + GAUSSIANS_MS * gaussians))


def slowness(device: str = "cpu") -> float:
    """How many times longer than on the reference machine this one takes now; kernels must be compiled."""
    import torch

    from ambiguous_wild.splat.calibration import KERNELS, calibration

    kernel = calibration(torch.device(device))
    return statistics.median(kernel.seconds() for _ in range(3)) / KERNELS[device].reference_s
