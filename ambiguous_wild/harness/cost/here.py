"""How fast this machine is, against the one that reference seconds are of."""

from __future__ import annotations

import statistics
from collections.abc import Callable

from ambiguous_wild.harness.cost.read import Found

TIMES = 3


def speed_here(found: Found, say: Callable[[str], None] = lambda text: None) -> float:
    """Reference seconds in a second of this machine, by the calibration that the runs were timed with.

    Args:
        found: the runs; their kernel says on which device.
        say: told when kernels have to be compiled first.

    Raises:
        AwError: the runs are of a GPU, and there is none here that can be used.
    """
    import torch

    from ambiguous_wild.harness.running.prepare import prepare_cpu
    from ambiguous_wild.splat.calibration import KERNELS, calibration
    from ambiguous_wild.splat.readiness import choose

    kernels = {run.timing.kernel for run in found.runs if not run.error}
    name = next((device for device, size in KERNELS.items() if size.name in kernels), "cpu")
    if name == "cpu":
        prepare_cpu(None, say)
        torch.set_num_threads(1)
    else:
        choose("cuda", say)
    kernel = calibration(torch.device(name))
    return KERNELS[name].reference_s / statistics.median(kernel.seconds() for _ in range(TIMES))
