"""Versions and hardware of a run, for env.json."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys

from ambiguous_wild import __version__
from ambiguous_wild.harness.running.records import Environment

PACKAGES = ("numpy", "numba", "torch", "opencv-contrib-python-headless", "scipy", "gsplat", "transformers")


def environment(device: str) -> Environment:
    """Versions, platform and device as plain values."""
    import torch

    facts: Environment = {
        "ambiguous_wild": __version__,
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "cpu": _cpu_name(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "device": device,
        "packages": {name: installed(name) for name in PACKAGES},
    }
    if device.startswith("cuda"):
        from ambiguous_wild.splat.gpu.gsplat_seam import max_alpha

        facts["gpu"] = torch.cuda.get_device_name(device)
        facts["gsplat_max_alpha"] = max_alpha(device)  # differs between its sources
    return facts


def installed(package: str) -> str | None:
    """The version of an installed distribution, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cpu_name() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as f:
            for line in f:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
