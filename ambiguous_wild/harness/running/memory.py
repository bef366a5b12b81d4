"""Peak memory of one run, not of the process's whole life."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.running.records import Cost

_PROC = Path("/proc/self")
_NO_MEMORY = ("CUDA out of memory", "CUDA error: out of memory")


def reset_peak(device: str = "cpu") -> None:
    """Forget the peaks so far: of the process where the system can (Linux), and of a GPU."""
    if device.startswith("cuda"):
        import torch

        torch.cuda.reset_peak_memory_stats(device)
    try:
        (_PROC / "clear_refs").write_text("5")
    except OSError:
        return


def peak_memory(device: str = "cpu") -> Cost:
    """peak_rss_mb, and on a GPU peak_cuda_mb: the most its tensors held at once since `reset_peak`."""
    rss = peak_rss_mb()
    peaks: Cost = {"peak_rss_mb": rss} if math.isfinite(rss) else {}
    if device.startswith("cuda"):
        import torch

        peaks["peak_cuda_mb"] = torch.cuda.max_memory_allocated(device) / 1e6
    return peaks


def peak_rss_mb() -> float:
    """Largest resident memory since `reset_peak` in MB.

    Elsewhere than on Linux since the process began; NaN on Windows.
    """
    try:
        for line in (_PROC / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    except OSError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return math.nan
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6  # bytes there, KiB elsewhere


def is_out_of_gpu_memory(error: BaseException) -> bool:
    """Whether a GPU had no memory left; gsplat's kernels say so by a RuntimeError of another name."""
    import torch

    if isinstance(error, torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _NO_MEMORY)


def out_of_gpu_memory(error: BaseException, gaussians: int | None, factor: int | None) -> AwError:
    """The error as one line with what helps.

    Args:
        error: what torch raised.
        gaussians: how many the model had then; None = it was not made yet.
        factor: which images_N it trained on; None = not known.
    """
    wanted = re.search(r"Tried to allocate [\d.]+ \w+", str(error))
    asked = f", {wanted[0][0].lower()}{wanted[0][1:]}" if wanted else ""
    had = f" with {gaussians:,} Gaussians" if gaussians else ""
    helps = []
    if gaussians:
        helps.append(f"--max-gaussians {max(gaussians // 2, 4)}")
    helps.append(f"--factor {2 * (factor or 1)} (smaller photos, where the scene has them)")
    return AwError(
        f"out of GPU memory{had}{asked}; what helps: {', '.join(helps)}, a GPU with more memory, or no other "
        "program on this one"
    )
