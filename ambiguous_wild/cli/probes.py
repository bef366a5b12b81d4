"""Test imports that may crash or hang (torch, torchvision, pycolmap), each in its own process."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

TIMEOUT_S = 60

# Each prints one line of JSON.
PROBES = {
    "torch": """
from ambiguous_wild.splat.readiness import torch_facts
print(json.dumps(torch_facts()))
""",
    "torchvision": "import torchvision; print(json.dumps({'version': torchvision.__version__}))",
    "numba": """
import numba
threads = numba.get_num_threads()  # starts the threading layer
print(json.dumps({"threads": threads, "layer": numba.threading_layer()}))
""",
    "OpenImageIO": "import OpenImageIO; print(json.dumps({'version': OpenImageIO.VERSION_STRING}))",
    "pycolmap": """
import tempfile, pathlib
from ambiguous_wild.io.safe_pycolmap import pycolmap
import numpy as np
from ambiguous_wild.io.images import read_png_rgb, write_png
image = np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3)
with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / "probe.png"
    write_png(path, image)
    assert (read_png_rgb(path) == image).all(), "the PNG read back differs from the one written"
print(json.dumps({"version": pycolmap.__version__}))
""",
}


@dataclass(frozen=True)
class Probe:
    """The facts a process printed, or the error."""

    facts: dict[str, Any] | None
    error: str = ""


def probe(name: str) -> Probe:
    """Run one of `PROBES` in its own process."""
    code = "import json\n" + PROBES[name]
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Probe(None, f"no answer within {TIMEOUT_S} s")
    if done.returncode < 0:
        return Probe(None, f"the process crashed (signal {-done.returncode})")
    lines = done.stderr.strip().splitlines()
    if done.returncode:
        return Probe(None, lines[-1] if lines else f"exit code {done.returncode}")
    try:
        return Probe(json.loads(done.stdout.strip().splitlines()[-1]))
    except (IndexError, ValueError):
        return Probe(None, f"unexpected output {done.stdout[-200:]!r}")
