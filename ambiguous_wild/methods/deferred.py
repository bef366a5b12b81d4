"""Numbers of a step that are read later: at the run's end, in a panel or in a checkpoint."""

from __future__ import annotations

from torch import Tensor

from ambiguous_wild.splat import device


def deferred(value: Tensor) -> float | Tensor:
    """The number in a 0-d tensor; on an accelerator a float64 tensor, which `float(...)` reads later.

    Reading it at once would make the host wait for all work that the accelerator has queued.
    """
    return value.detach().double() if device.accelerated(value.device) else float(value.detach())
