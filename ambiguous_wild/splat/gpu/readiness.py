"""Whether torch and gsplat can use the GPU of this machine; if not, what is missing and its command.

`look` collects the facts once; functions without side effects judge them. Only `torch_facts` imports torch,
so that `aw doctor` can run it in a process of its own.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.extras import install_command, torch_command
from ambiguous_wild.splat.gpu import gsplat_cut
from ambiguous_wild.splat.gpu.gsplat_build import (
    compile_kernels,
    is_compiled,
    is_prebuilt,
    kernels_folder,
    search_path,
    toolkit,
)

TOOLKIT = "https://developer.nvidia.com/cuda-toolkit-archive"


@dataclass(frozen=True)
class Lack:
    """A missing dependency of the GPU."""

    what: str
    fix: str  # the command that mends it, or what to do

    def __str__(self) -> str:
        return f"{self.what}: {self.fix}"


@dataclass(frozen=True)
class Found:
    """Facts about this machine."""

    torch: Mapping[str, Any]  # see `torch_facts`
    driver: str | None  # what nvidia-smi says of the first GPU; None = it is absent or sees none
    gsplat: str | None  # where its package lies
    folder: Path  # that its kernels are compiled into
    prebuilt: bool  # its kernels came compiled, with a wheel of one's own
    compiled: bool  # they lie in the folder
    nvcc: str | None  # the CUDA version of the compiler that torch will take; "" = unknown
    compiler: str | None  # of C++
    ninja: str | None
    hidden: str | None  # $CUDA_VISIBLE_DEVICES
    cut: bool = False  # we compile what is called of its sources, see `gsplat_cut`

    @property
    def has_gpu(self) -> bool:
        """Whether there is one, usable or not."""
        return self.driver is not None or bool(self.torch["cuda"])


def torch_facts() -> dict[str, Any]:
    """torch's version and the GPUs that it sees, as plain values."""
    import torch

    cuda, error = torch.cuda.is_available(), ""
    if not cuda and torch.version.cuda is not None:
        try:
            torch.cuda.init()  # says why: no driver, or one that is too old
        except (RuntimeError, AssertionError) as reason:
            error = " ".join(str(reason).split())
    gpus = range(torch.cuda.device_count() if cuda else 0)
    return {
        "version": torch.__version__,
        "built": torch.version.cuda,
        "cuda": cuda,
        "names": [torch.cuda.get_device_name(i) for i in gpus],
        "capabilities": [list(torch.cuda.get_device_capability(i)) for i in gpus],
        "archs": torch.cuda.get_arch_list() if cuda else [],
        "error": error,
    }


def look(torch: Mapping[str, Any] | None = None) -> Found:
    """Collect the facts about this machine.

    Args:
        torch: result of `torch_facts`, if another process called it; None calls it here.
    """
    facts = torch_facts() if torch is None else torch
    spec = importlib.util.find_spec("gsplat")
    package = None if spec is None or spec.origin is None else Path(spec.origin).parent
    kernels = kernels_folder(facts["built"])
    cut = None if package is None else gsplat_cut.folder_of(package, kernels)
    return Found(
        torch=facts,
        driver=first_line("nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"),
        gsplat=None if package is None else str(package),
        folder=cut or kernels,
        prebuilt=package is not None and is_prebuilt(package),
        compiled=is_compiled(cut or kernels),
        nvcc=_nvcc(),
        compiler=shutil.which(os.environ.get("CXX", "c++")),
        ninja=shutil.which("ninja", path=search_path()),
        hidden=os.environ.get("CUDA_VISIBLE_DEVICES"),
        cut=cut is not None,
    )


def why_not(found: Found) -> Lack | None:
    """The first missing dependency of training on the GPU; None if there is none."""
    return no_cuda(found) or no_gsplat(found) or no_kernels(found)


def make_ready(found: Found, say: Callable[[str], None]) -> None:
    """Compile gsplat's kernels unless they are compiled, on a machine where nothing is missing.

    Raises:
        AwError: the compiler failed.
    """
    if not found.prebuilt:
        package = Path(found.gsplat) if found.cut and found.gsplat else None
        compile_kernels(
            found.folder, lambda: found.compiled or is_compiled(found.folder), say, package=package
        )


def choose(device: str, say: Callable[[str], None], *, looking: Callable[[], Found] | None = None) -> str:
    """ "cpu" or "cuda" for "auto", "cpu" or "cuda"; says so if a GPU stays unused.

    Raises:
        AwError: cuda was asked for and is not usable; says what is missing.
    """
    if device == "cpu":
        return "cpu"
    found = (looking or look)()
    problem = str(why_not(found) or "")
    if not problem:
        try:
            make_ready(found, say)
            return "cuda"
        except AwError as error:
            problem = str(error)
    if device == "cuda":
        raise AwError(f"--device cuda: {problem}; 'aw doctor' tells more, --device cpu runs without")
    if found.has_gpu:
        say(f"warning: the GPU is not used, the CPU is: {problem}")
    return "cpu"


def no_cuda(found: Found) -> Lack | None:
    """Why torch cannot compute on the GPU."""
    torch = found.torch
    if torch["built"] is None:
        what = f"torch {torch['version']} is a CPU build"
        return Lack(what, torch_command(torch["version"]) if found.driver else "nothing to do without a GPU")
    if torch["cuda"]:
        return _other_capability(torch)
    what = f"torch {torch['version']} is built for CUDA {torch['built']}, but sees no GPU"
    if found.driver is None:
        return Lack(f"{what}, and no NVIDIA driver answers", "install the driver, see that nvidia-smi works")
    if found.hidden is not None and found.hidden.strip() in ("", "-1"):
        return Lack(f"{what}: CUDA_VISIBLE_DEVICES={found.hidden!r} hides it", "unset CUDA_VISIBLE_DEVICES")
    why = f" ({torch['error']})" if torch["error"] else ""
    return Lack(f"{what}; the driver has {found.driver}{why}", "install a newer driver, then restart")


def no_gsplat(found: Found) -> Lack | None:
    """Why there is no gsplat."""
    return None if found.gsplat else Lack("gsplat is not installed", install_command("cuda"))


def no_kernels(found: Found) -> Lack | None:
    """Why gsplat's kernels can neither be compiled nor, once they are, be loaded.

    Where gsplat compiles itself, loading has the same requirements: gsplat looks for nvcc and torch for
    ninja at every start.
    """
    if found.prebuilt or (found.cut and found.compiled):
        return None
    to_do = "to load the kernels it has compiled" if found.compiled else "to compile its kernels"
    built = found.torch["built"]
    absent = [
        (found.nvcc is None, f"nvcc (the CUDA toolkit {built}: {TOOLKIT}, then export CUDA_HOME=ITS_FOLDER)"),
        (found.compiler is None, "a C++17 compiler (sudo apt-get install g++, or export CXX=ITS_PATH)"),
        (found.ninja is None, f"ninja ({sys.executable} -m pip install ninja)"),
    ]
    wanted = [text for lacks, text in absent if lacks]
    if wanted:
        names = " and ".join(text.partition(" (")[0] for text in wanted)
        return Lack(f"gsplat needs {names} {to_do}, and there is none", "install " + "; ".join(wanted))
    if found.nvcc and built and found.nvcc.partition(".")[0] != built.partition(".")[0]:
        return Lack(
            f"gsplat needs nvcc of CUDA {built} as torch {to_do}, and it is of CUDA {found.nvcc}",
            f"install the CUDA toolkit {built}: {TOOLKIT}, then export CUDA_HOME=ITS_FOLDER",
        )
    return None


def _other_capability(torch: Mapping[str, Any]) -> Lack | None:
    """Why this torch was not built for the first GPU's compute capability."""
    usable = [_runs_on(tuple(c), torch["archs"]) for c in torch["capabilities"]]
    if not torch["archs"] or not usable or usable[0]:
        return None
    have = "{}.{}".format(*torch["capabilities"][0])
    what = (
        f"{torch['names'][0]} has compute capability {have}, "
        f"torch {torch['version']} is built for {', '.join(torch['archs'])}"
    )
    if any(usable):
        return Lack(what, f"export CUDA_VISIBLE_DEVICES={usable.index(True)}, which is built for")
    return Lack(what, f"install a build of torch for {have}, see https://pytorch.org/get-started")


def _runs_on(capability: tuple[int, ...], archs: list[str]) -> bool:
    """Whether code for one of the architectures runs on that capability.

    Machine code (sm_86) runs within its major version from its minor one on, PTX (compute_90) from its
    version on; a letter at the end (sm_90a) ties it to that very version. Source: CUDA C++ Programming
    Guide, "Application Compatibility".
    """
    for arch in archs:
        match = re.fullmatch(r"(sm|compute)_(\d+)(\d)([a-z]?)", arch)
        if match is None:
            continue
        version = (int(match[2]), int(match[3]))
        if match[4] == "a":
            fits = capability == version
        elif match[1] == "compute":
            fits = capability >= version
        else:
            fits = capability[0] == version[0] and capability >= version
        if fits:
            return True
    return False


def _nvcc() -> str | None:
    """The CUDA version of the nvcc that torch and gsplat take, "" where it does not say."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH") or toolkit()
    found = shutil.which("nvcc")
    if home:
        inside = Path(home) / "bin" / "nvcc"
        found = str(inside) if inside.is_file() else found
    if found is None:
        return None
    try:
        said = subprocess.run([found, "--version"], capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    match = re.search(r"release (\d+\.\d+)", said.stdout)
    return match[1] if match else ""


def first_line(*words: str) -> str | None:
    """The first line that a program prints; None if it is missing or fails."""
    if shutil.which(words[0]) is None:
        return None
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    lines = done.stdout.strip().splitlines()
    return lines[0] if done.returncode == 0 and lines else None
