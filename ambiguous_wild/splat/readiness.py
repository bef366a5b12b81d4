"""Whether torch and gsplat can use this machine's GPU; if not, what is missing and the command that helps.

`gpu_facts` collects the facts, functions without side effects judge them, and `load_kernels` draws one
Gaussian. Only `torch_facts` imports torch, so that `aw doctor` can call it in another process.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

from ambiguous_wild.core.errors import AwError, install_command, installed, torch_command
from ambiguous_wild.io.files import patient_lock

GSPLAT = "1.5.3"  # the release that gsplat_calls.py is written for
INSTALL_GSPLAT = f"{sys.executable} -m pip install 'gsplat=={GSPLAT}'"
TOOLKIT = "https://developer.nvidia.com/cuda-toolkit-archive"
COMPILE_S = 3600.0  # longest wait for another process that compiles gsplat's kernels, seconds


@dataclass(frozen=True)
class MissingDependency:
    """A missing dependency of training on the GPU."""

    what: str
    fix: str  # the command that installs it, or what to do

    def __str__(self) -> str:
        return f"{self.what}: {self.fix}"


class TorchFacts(TypedDict):
    """Facts about the installed torch."""

    version: str
    built: str | None  # version of CUDA that it is built for; None = a CPU build
    cuda: bool  # whether it can use a GPU
    names: list[str]  # names of the GPUs that it sees
    toolkit: str | None  # folder of the CUDA toolkit that it compiles with
    error: str  # why a CUDA build sees no GPU


@dataclass(frozen=True)
class GpuFacts:
    """Facts about this machine."""

    torch: TorchFacts
    driver: str | None  # name and driver of the first GPU, from nvidia-smi; None = it is absent or fails
    gsplat: str | None  # installed version
    prebuilt: bool  # whether the installed gsplat contains compiled kernels
    compiler: str | None  # path of the C++ compiler
    hidden: str | None  # $CUDA_VISIBLE_DEVICES

    @property
    def has_gpu(self) -> bool:
        """Whether there is a GPU, usable or not."""
        return self.driver is not None or bool(self.torch["cuda"])


def torch_facts() -> TorchFacts:
    """Return facts about the installed torch, as plain values."""
    import torch

    cuda, error, toolkit = torch.cuda.is_available(), "", None
    if cuda:
        from torch.utils import cpp_extension

        toolkit = cpp_extension.CUDA_HOME
    elif torch.version.cuda is not None:
        try:
            torch.cuda.init()  # says why: no driver, or one that is too old
        except (RuntimeError, AssertionError) as reason:
            error = " ".join(str(reason).split())
    return {
        "version": torch.__version__,
        "built": torch.version.cuda,
        "cuda": cuda,
        "names": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count() if cuda else 0)],
        "toolkit": toolkit,
        "error": error,
    }


def gpu_facts(torch: TorchFacts | None = None) -> GpuFacts:
    """Collect the facts about this machine.

    Args:
        torch: result of `torch_facts` in another process; None calls it in this one.
    """
    spec = importlib.util.find_spec("gsplat")
    package = None if spec is None or spec.origin is None else Path(spec.origin).parent
    return GpuFacts(
        torch=torch_facts() if torch is None else torch,
        driver=first_output_line("nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"),
        gsplat=installed("gsplat"),
        prebuilt=package is not None and any(package.glob("csrc*.so")),
        compiler=shutil.which(os.environ.get("CXX", "c++")),
        hidden=os.environ.get("CUDA_VISIBLE_DEVICES"),
    )


def missing_dependency(facts: GpuFacts) -> MissingDependency | None:
    """Return the first missing dependency of training on the GPU; None if nothing is missing."""
    return cuda_problem(facts) or gsplat_problem(facts) or compiler_problem(facts)


def cuda_problem(facts: GpuFacts) -> MissingDependency | None:
    """Return why torch cannot compute on the GPU; None if it can."""
    torch = facts.torch
    if torch["cuda"]:
        return None
    if torch["built"] is None:
        what = f"torch {torch['version']} is a CPU build"
        return MissingDependency(
            what, torch_command(torch["version"]) if facts.driver else "nothing to do without a GPU"
        )
    what = f"torch {torch['version']} is built for CUDA {torch['built']}, but sees no GPU"
    if facts.driver is None:
        return MissingDependency(
            f"{what}, and no NVIDIA driver answers", "install the driver, see that nvidia-smi works"
        )
    if facts.hidden is not None and facts.hidden.strip() in ("", "-1"):
        return MissingDependency(
            f"{what}: CUDA_VISIBLE_DEVICES={facts.hidden!r} hides it", "unset CUDA_VISIBLE_DEVICES"
        )
    why = f" ({torch['error']})" if torch["error"] else ""
    return MissingDependency(
        f"{what}; the driver has {facts.driver}{why}", "install a newer driver, then restart"
    )


def gsplat_problem(facts: GpuFacts) -> MissingDependency | None:
    """Return why gsplat cannot be called; None if it can."""
    if facts.gsplat is None:
        return MissingDependency("gsplat is not installed", install_command("cuda"))
    if facts.gsplat.partition("+")[0] != GSPLAT:
        return MissingDependency(
            f"gsplat {facts.gsplat} is installed, and {GSPLAT} is needed", INSTALL_GSPLAT
        )
    return None


def compiler_problem(facts: GpuFacts) -> MissingDependency | None:
    """Return what gsplat lacks to compile or load its kernels (to load them it needs nvcc too)."""
    if facts.prebuilt:
        return None
    built, toolkit = facts.torch["built"], facts.torch["toolkit"]
    tools = {
        f"nvcc (the CUDA toolkit {built}: {TOOLKIT}, then export CUDA_HOME=ITS_FOLDER)": toolkit,
        "a C++17 compiler (sudo apt-get install g++, or export CXX=ITS_PATH)": facts.compiler,
    }
    wanted = [text for text, path in tools.items() if not path]
    if not wanted:
        return None
    names = " and ".join(text.partition(" (")[0] for text in wanted)
    return MissingDependency(
        f"gsplat needs {names} to compile its kernels, and there is none", "install " + "; ".join(wanted)
    )


def load_kernels() -> None:
    """Draw one Gaussian on the GPU. Before its first picture gsplat compiles its kernels, for minutes.

    Only one process compiles at a time, because parallel compilations of gsplat break each other.

    Raises:
        AwError: the kernels cannot be compiled or loaded, or the installed gsplat takes other arguments.
    """
    from torch.utils.cpp_extension import get_default_build_root

    from ambiguous_wild.splat.gsplat_calls import max_alpha

    own = str(Path(sys.executable).parent)  # pip installs ninja here, activated or not
    if own not in (path := os.environ.get("PATH", "")).split(os.pathsep):
        os.environ["PATH"] = os.pathsep.join(filter(None, (path, own)))
    with patient_lock(Path(get_default_build_root()) / "gsplat", "a compile of gsplat", COMPILE_S):
        try:
            max_alpha("cuda")
        except Exception as error:  # compilers, loaders and CUDA raise many kinds
            lines = str(error).strip().splitlines() or [type(error).__name__]
            reason = next((line for line in lines if "error:" in line), lines[0]).strip()[:300]
            raise AwError(
                f"gsplat cannot draw on this GPU: {reason}; docs/gpu.md says what it needs, and "
                f"{INSTALL_GSPLAT} --force-reinstall --no-deps installs it anew"
            ) from error


def require_gpu(facts: GpuFacts) -> None:
    """Make sure that gsplat can draw on this machine's GPU.

    Raises:
        AwError: something is missing; the message holds the command that installs it.
    """
    lack = missing_dependency(facts)
    if lack is not None:
        raise AwError(str(lack))
    load_kernels()


def choose_device(
    device: str, say: Callable[[str], None], *, collect_facts: Callable[[], GpuFacts] | None = None
) -> str:
    """Return "cpu" or "cuda" for "auto", "cpu" or "cuda"; warns through `say` if a GPU stays unused.

    Raises:
        AwError: cuda was requested and cannot be used; the message says what is missing.
    """
    if device == "cpu":
        return "cpu"
    facts = (collect_facts or gpu_facts)()
    try:
        require_gpu(facts)
        return "cuda"
    except AwError as error:
        problem = str(error)
    if device == "cuda":
        raise AwError(f"--device cuda: {problem}; 'aw doctor' tells more, --device cpu runs without")
    if facts.has_gpu:
        say(f"warning: the GPU is not used, the CPU is: {problem}")
    return "cpu"


def first_output_line(*words: str) -> str | None:
    """Return the first line that a program prints; None if the program is missing or fails."""
    if shutil.which(words[0]) is None:
        return None
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    lines = done.stdout.strip().splitlines()
    return lines[0] if done.returncode == 0 and lines else None
