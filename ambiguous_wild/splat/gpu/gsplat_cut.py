"""gsplat's CUDA sources, cut to the calls that are made here, and compiled by ourselves.

Release 1.5.3 compiles 19 numbers of channels, 2DGS, packed and unscented projections: several minutes, and
from the start again after an interruption. Here only 1 and 3 channels of the 3DGS calls are compiled, in a
folder where ninja goes on with what it has. The clamp of alpha is the CPU's and that of gsplat's later
sources, 0.99 instead of 0.999. Nothing else is changed. Other versions compile themselves.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import re
import sys
from pathlib import Path
from typing import Any

NAME = "gsplat_cut"  # of the extension
CHANNELS = (1, 3)
_CLAMP = ("0.999f", "0.99f")
_DONE = "complete"  # written after the compiled module was imported once
_WHOLE = (  # files that are taken as they are
    "Intersect.cpp", "IntersectTile.cu", "ProjectionEWA3DGSFused.cu", "SphericalHarmonics.cpp",
    "SphericalHarmonicsCUDA.cu",
)  # fmt: skip
_CALLS = {  # of files of which some functions are taken
    "Projection.cpp": ("projection_ewa_3dgs_fused_fwd", "projection_ewa_3dgs_fused_bwd"),
    "Rasterization.cpp": ("rasterize_to_pixels_3dgs_fwd", "rasterize_to_pixels_3dgs_bwd"),
}
_CLAMPED = {"RasterizeToPixels3DGSFwd.cu": 1, "RasterizeToPixels3DGSBwd.cu": 2}  # times the constant occurs
_BOUND = (
    *_CALLS["Projection.cpp"], *_CALLS["Rasterization.cpp"], "intersect_tile", "intersect_offset",
    "spherical_harmonics_fwd", "spherical_harmonics_bwd",
)  # fmt: skip
_MODULE = """#include <torch/extension.h>

#include "Ops.h"

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {{
    py::enum_<gsplat::CameraModelType>(m, "CameraModelType")
        .value("PINHOLE", gsplat::CameraModelType::PINHOLE)
        .export_values();
{calls}
}}
"""


class CannotCut(Exception):
    """The sources are not those of the release that this module knows."""


def originals() -> tuple[str, ...]:
    """Names of the files in csrc that the cut sources are made of."""
    return (*_WHOLE, *_CALLS, *_CLAMPED)


@functools.cache
def sources(package: Path) -> dict[str, str]:
    """Name and text of the source files of the cut extension.

    Args:
        package: gsplat's folder.

    Raises:
        CannotCut: the sources are absent or of another release.
    """
    csrc = package / "cuda" / "csrc"
    try:
        texts = {name: (csrc / name).read_text(encoding="utf-8") for name in originals()}
    except OSError as error:
        raise CannotCut(str(error)) from None
    found = {name: texts[name] for name in _WHOLE}
    for name, wanted in _CALLS.items():
        found[name] = _channels(_only(texts[name], wanted))
    for name, times in _CLAMPED.items():
        if texts[name].count(_CLAMP[0]) != times:
            raise CannotCut(f"{name} has no constant {_CLAMP[0]} {times} times")
        found[name] = _channels(texts[name].replace(*_CLAMP))
    calls = "\n".join(f'    m.def("{call}", &gsplat::{call});' for call in _BOUND)
    return found | {"module.cpp": _MODULE.format(calls=calls)}


def _only(text: str, calls: tuple[str, ...]) -> str:
    """The file with only these functions; each ends with a brace at the start of a line."""
    head, opened, body = text.partition("namespace gsplat {\n")
    functions = re.split(r"(?<=\n\}\n)", body)
    kept = [f for f in functions if any(re.search(rf"\b{call}\($", f, re.MULTILINE) for call in calls)]
    if not opened or len(kept) != len(calls):
        raise CannotCut(f"of {', '.join(calls)} {len(kept)} were found")
    return head + opened + "".join(kept) + "\n} // namespace gsplat\n"


def _channels(text: str) -> str:
    """Without the instances for numbers of channels that no call here has."""

    def line(match: re.Match[str]) -> str:
        return match[0] if int(match[1]) in CHANNELS else ""

    return re.sub(r"^ *__(?:INS|LAUNCH_KERNEL)__\((\d+)\)\n", line, text, flags=re.MULTILINE)


def digest(package: Path) -> str:
    """Of the cut sources.

    Raises:
        CannotCut: see `sources`.
    """
    parts = [f"{name}\n{text}" for name, text in sorted(sources(package).items())]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:12]


def folder_of(package: Path, kernels: Path) -> Path | None:
    """Where the extension of these sources is compiled, or None where gsplat must compile itself.

    Args:
        package: gsplat's folder.
        kernels: where torch would put gsplat's own (`gsplat_build.kernels_folder`).
    """
    try:
        return kernels.with_name(f"{NAME}_{digest(package)}")
    except CannotCut:
        return None


def is_complete(folder: Path) -> bool:
    """Whether a compile in that folder came to its end."""
    return (folder / _DONE).is_file() and (folder / f"{NAME}.so").is_file()


def compile_here(package: Path, folder: Path) -> None:
    """Compile, or go on with a compile that was interrupted. Called in a process of its own.

    Raises:
        RuntimeError: the compiler's, with what it said.
    """
    from torch.utils.cpp_extension import load

    place = folder / "src"
    place.mkdir(parents=True, exist_ok=True)
    for name, text in sources(package).items():
        path = place / name
        # an untouched file keeps its time, so ninja compiles what is missing and nothing else
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    cuda = package / "cuda"
    (folder / "lock").unlink(missing_ok=True)  # of a process that was killed: torch would wait for it
    load(
        NAME,
        sources=[str(place / name) for name in sources(package)],
        extra_cflags=["-O3", "-Wno-attributes"],
        extra_cuda_cflags=["-O3", "-use_fast_math"],
        extra_include_paths=[
            str(p) for p in (cuda / "include", cuda / "csrc", cuda / "csrc/third_party/glm")
        ],
        build_directory=str(folder),
        verbose=True,
    )
    (folder / _DONE).touch()


def use(folder: Path) -> Any:
    """Load the compiled module in the place where gsplat looks first, `gsplat.csrc`; returns it."""
    import gsplat

    spec = importlib.util.spec_from_file_location(NAME, folder / f"{NAME}.so")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules["gsplat.csrc"] = module
    gsplat.csrc = module
    return module
