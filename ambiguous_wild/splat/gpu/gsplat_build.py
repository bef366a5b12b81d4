"""gsplat's kernels: where they are, and how they are compiled.

gsplat 1.5.3 comes as sources, which are compiled with nvcc, a C++17 compiler and ninja into a folder that is
kept. Of this release we compile what is called (`gsplat_cut`), and an interrupted compile goes on where it
was. Other versions compile themselves when they are first used. Processes that compile at the same time
break each other's result, so one process compiles here, before the first render.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.lock import patient_lock
from ambiguous_wild.splat.gpu import gsplat_cut

NAME = "gsplat_cuda"  # of the extension, as gsplat/cuda/_backend.py calls it
COMPILE_S = 3600.0  # longest wait for the compiler, or for another process that runs it
# in a process of its own, which finds the packages where this one does, also under `python -I`
_FIND = "import sys; sys.path[:] = {path!r}; "
_WHOLE = "from gsplat.cuda._backend import _C; sys.exit(3 if _C is None else 0)"
_CUT = (
    "from pathlib import Path; from ambiguous_wild.splat.gpu.gsplat_cut import compile_here; "
    "compile_here(Path({package!r}), Path({folder!r}))"
)


def is_prebuilt(package: Path) -> bool:
    """Whether gsplat's folder holds its kernels, from a wheel that was compiled beforehand."""
    return any(path.is_file() for kind in ("so", "pyd") for path in package.glob(f"csrc*.{kind}"))


def is_compiled(folder: Path) -> bool:
    """Whether they are compiled into that folder; gsplat looks for these two names too."""
    if folder.name.startswith(gsplat_cut.NAME):
        return gsplat_cut.is_complete(folder)
    return any((folder / f"{NAME}.{kind}").is_file() for kind in ("so", "lib"))


def announce_compile(folder: Path, say: Callable[[str], None]) -> None:
    """One line before the first compile."""
    say(f"gsplat compiles its kernels once, several minutes, kept in {folder}")


def compile_kernels(
    folder: Path,
    compiled: Callable[[], bool],
    say: Callable[[str], None],
    *,
    package: Path | None = None,
    run: Callable[..., Any] = subprocess.run,
) -> None:
    """Compile the kernels, in a process of its own, unless they are there.

    Args:
        folder: of the cut sources, or `kernels_folder`.
        package: gsplat's folder where its sources are cut; None = gsplat compiles itself.
        compiled: whether they are there; called again after other processes have finished.
        say: gets a line before the compiler starts.
        run: `subprocess.run`.

    Raises:
        AwError: the compiler failed, with its first error and where the rest is.
    """
    os.environ["PATH"] = search_path()  # torch calls ninja by its name
    if home := toolkit():
        # torch guesses it from the place of nvcc, which may be a link; another guess later compiles again
        os.environ["CUDA_HOME"] = str(home)
    if compiled():
        return
    with patient_lock(folder.with_name(f"{NAME}-compile"), "a compile of gsplat", COMPILE_S):
        if compiled():
            return
        announce_compile(folder, say)
        code = _WHOLE if package is None else _CUT.format(package=str(package), folder=str(folder))
        code = _FIND.format(path=[str(Path(p).resolve()) for p in sys.path]) + code
        try:
            done = run(
                [sys.executable, "-c", code], capture_output=True, text=True, timeout=COMPILE_S, check=False
            )
        except subprocess.TimeoutExpired:
            raise AwError(f"gsplat did not compile within {COMPILE_S / 60:.0f} minutes") from None
        if done.returncode:
            raise AwError(_failure(folder, f"{done.stdout}\n{done.stderr}", done.returncode))


def _failure(folder: Path, text: str, code: int) -> str:
    log = folder.with_name(f"{NAME}.log")
    log.write_text(text, encoding="utf-8", errors="replace")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if "error" in line.lower()] or lines[-1:] or [f"exit code {code}"]
    return (
        f"gsplat did not compile: {errors[0][:300]}; everything it said is in {log}. "
        "docs/gpu.md says which compilers it takes"
    )


def kernels_folder(built: str | None) -> Path:
    """Where torch puts what it compiles for gsplat; the rule of torch.utils.cpp_extension.

    Args:
        built: the CUDA version torch is built for.
    """
    chosen = os.environ.get("TORCH_EXTENSIONS_DIR")
    if chosen is not None:
        return Path(chosen) / NAME
    cache = Path(os.path.realpath(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"))
    kind = "cpu" if built is None else f"cu{built.replace('.', '')}"
    python = f"py{sys.version_info.major}{sys.version_info.minor}{getattr(sys, 'abiflags', '')}"
    return cache / "torch_extensions" / f"{python}_{kind}" / NAME


def toolkit(places: Sequence[Path] | None = None) -> Path | None:
    """The CUDA toolkit for torch where $CUDA_HOME names none; None = none is whole, or one is named.

    Args:
        places: where to look; None = around nvcc, and the usual folders.
    """
    if os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH"):
        return None
    if places is None:
        nvcc = shutil.which("nvcc")
        around = [] if nvcc is None else [Path(nvcc).parents[1], Path(nvcc).resolve().parents[1]]
        places = [*around, Path("/usr/local/cuda"), *sorted(Path("/usr/local").glob("cuda-*"), reverse=True)]
    whole = (p for p in places if (p / "include/cuda_runtime.h").is_file() and (p / "bin/nvcc").is_file())
    return next(whole, None)


def search_path() -> str:
    """$PATH, and the folder of this interpreter where pip puts ninja even if it is not activated."""
    path, own = os.environ.get("PATH", ""), str(Path(sys.executable).parent)
    return path if own in path.split(os.pathsep) else os.pathsep.join(filter(None, (path, own)))
