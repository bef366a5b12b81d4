"""Compile the CPU kernels in a process of their own while something else runs."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_CODE = (
    "import os\n"
    "if hasattr(os, 'nice'): os.nice(19)\n"
    "from ambiguous_wild.splat.calibration import warm_up\n"
    "warm_up()\n"
)


@contextmanager
def kernels_meanwhile() -> Iterator[None]:
    """Compile at the lowest priority meanwhile; what is not finished at the end is left for later.

    Each kernel is kept as soon as it is compiled. Nothing is said and nothing fails: the command that needs
    the kernels compiles what is missing, and reports what went wrong.
    """
    if _compiled():
        yield
        return
    quiet = subprocess.DEVNULL
    one = {**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", _CODE], stdin=quiet, stdout=quiet, stderr=quiet, env=one
        )
    except OSError:
        yield
        return
    try:
        yield
    finally:
        process.kill()
        process.wait()


def _compiled() -> bool:
    """Whether the kernel that is compiled last is on disk for this state of the source."""
    from ambiguous_wild.splat.cpu.compile import kernel_cache

    return any(kernel_cache().rglob("*catch_up_all*.nbi"))
