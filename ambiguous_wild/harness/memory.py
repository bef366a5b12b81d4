"""Peak memory of one run, not of the process's whole life."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

_PROC = Path("/proc/self")


def reset_peak(device: str = "cpu") -> None:
    """Forget the peaks so far: of the process where the system can (Linux), and of a GPU."""
    if device.startswith("cuda"):
        import torch

        torch.cuda.reset_peak_memory_stats(device)
    try:
        (_PROC / "clear_refs").write_text("5")
    except OSError:
        return


def peak_memory(device: str = "cpu") -> dict[str, float]:
    """peak_rss_mb, and on a GPU peak_cuda_mb: the most its tensors held at once since `reset_peak`."""
    peaks = {"peak_rss_mb": peak_rss_mb()}
    if device.startswith("cuda"):
        import torch

        peaks["peak_cuda_mb"] = torch.cuda.max_memory_allocated(device) / 1e6
    return peaks


def peak_rss_mb() -> float:
    """Largest resident memory since `reset_peak` (elsewhere than on Linux: since the process began), MB."""
    try:
        for line in (_PROC / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    except OSError:
        pass
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6  # bytes there, KiB elsewhere
