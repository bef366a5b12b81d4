"""Numbers of a step that nobody reads before a run's end, a panel or a checkpoint."""

from __future__ import annotations

from torch import Tensor

from ambiguous_wild.splat import device


def later(value: Tensor) -> float | Tensor:
    """The number in a 0-d tensor; on an accelerator a float64 tensor, for `float(...)` to read later.

    Reading it in the step that made it would make the host wait for all that the accelerator still has to do.
    """
    return value.detach().double() if device.accelerated(value.device) else float(value.detach())
