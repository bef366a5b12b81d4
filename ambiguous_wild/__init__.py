"""Distractor-free 3D Gaussian Splatting in ambiguous scenes: builder, trainer, harness."""

import importlib
import os
from typing import TYPE_CHECKING, Any

from ambiguous_wild.core.machine import allowed_cores, usable_cores

# Two OpenMP pools share the cores, Numba's and torch's. By default their idle threads spin, each on the
# core the other needs: 63 ms an iteration where sleeping threads take 4 (2 cores, 64x48 px). OpenMP reads
# this when it is loaded, so it must stand before the first import of either.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# numpy's BLAS spins likewise, and is given small matrices here: with three runs on two cores, depth maps from
# sparse points took 39 s instead of 2.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Numba and torch start a thread for each core that they may run on, whatever a container's quota is.
if usable_cores() < len(allowed_cores()):
    for _name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(_name, str(usable_cores()))

__version__ = "0.1.0"

# imported when they are asked for: the package itself stays quick to import
_OFFERED = {
    "Metric": "harness.measures",
    "bench": "harness.benchmark",
    "build_scene": "builder.pipeline",
    "open_run": "harness.replay",
    "plan": "harness.mask_plan",
    "read_runs": "harness.store",
    "table": "report.comparison",
}

if TYPE_CHECKING:
    from ambiguous_wild.builder.pipeline import build_scene as build_scene
    from ambiguous_wild.harness.benchmark import bench as bench
    from ambiguous_wild.harness.mask_plan import plan as plan
    from ambiguous_wild.harness.measures import Metric as Metric
    from ambiguous_wild.harness.replay import open_run as open_run
    from ambiguous_wild.harness.store import read_runs as read_runs
    from ambiguous_wild.report.comparison import table as table


def __getattr__(name: str) -> Any:
    """A function or class of `_OFFERED`, see docs/python.md."""
    if name in _OFFERED:
        return getattr(importlib.import_module(f"ambiguous_wild.{_OFFERED[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *_OFFERED]
