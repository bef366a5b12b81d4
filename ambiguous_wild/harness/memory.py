"""Peak memory of one run, not of the process's whole life."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

_PROC = Path("/proc/self")


def reset_peak() -> None:
    """Forget the peak so far, where the system can (Linux)."""
    try:
        (_PROC / "clear_refs").write_text("5")
    except OSError:
        return


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
