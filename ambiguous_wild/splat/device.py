"""Where tensors are computed with: the CPU's own kernels, or torch and gsplat on an accelerator.

Everything that differs between the two asks here, so that the accelerator's path can be run on the CPU by
tests: as numbers by saying yes to every device, and without numbers on torch's `meta` device, where whatever
would make the host wait raises.
"""

from __future__ import annotations

import torch


def accelerated(device: torch.device | str) -> bool:
    """Whether what lies there is left to torch and gsplat; reading it back makes the host wait."""
    return torch.device(device).type != "cpu"


def wait(device: torch.device | str) -> None:
    """Until what was launched there is done; elsewhere than on a GPU it is already."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def set_torch_threads(n: int, device: torch.device | str) -> None:
    """Use n threads for torch's own work on the CPU: its sums, and so the bits of a run, depend on n."""
    if not accelerated(device):
        from ambiguous_wild.splat.cpu.compile import threads

        threads()  # starts Numba's pool, which sets the number of OpenMP's threads, torch's with it
    torch.set_num_threads(n)
