"""Every way in which a GPU cannot be used is one line that says what brings it; asked of made-up machines."""

import os
import sys
from pathlib import Path

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.splat import gsplat_calls, readiness
from ambiguous_wild.splat.readiness import GpuFacts, choose_device, missing_dependency

TORCH = {
    "version": "2.13.0",
    "built": "13.0",
    "cuda": True,
    "names": ["Fine GPU"],
    "toolkit": "/usr/local/cuda",
    "error": "",
}
CPU_BUILD = {"version": "2.13.0+cpu", "built": None, "cuda": False, "names": [], "toolkit": None}


def found(torch=None, **other):
    """A machine that lacks nothing but what is said."""
    values = {
        "driver": "Fine GPU, 600.0", "gsplat": "1.5.3", "prebuilt": False, "compiler": "/usr/bin/c++",
        "hidden": None,
    }  # fmt: skip
    return GpuFacts(torch=TORCH | (torch or {}), **(values | other))


def blind(**other):
    return found({"cuda": False, "names": [], "toolkit": None, **other.pop("torch", {})}, **other)


@pytest.fixture
def kernels(monkeypatch):
    """Stands in for the first picture; `fails` is what it raises."""

    class Kernels:
        fails = None
        drawn = 0

        def __call__(self, device):
            self.drawn += 1
            if self.fails is not None:
                raise self.fails
            return 0.999

    monkeypatch.setenv("PATH", "/bin")  # what is added to it is taken back
    monkeypatch.setattr(gsplat_calls, "max_alpha", state := Kernels())
    return state


def test_a_machine_that_lacks_nothing_is_ready():
    assert missing_dependency(found()) is None
    assert (
        missing_dependency(found({"toolkit": None}, compiler=None, prebuilt=True)) is None
    )  # nothing to compile
    assert missing_dependency(found(gsplat="1.5.3+pt29cu130")) is None


CASES = {
    "cpu build": (
        found(CPU_BUILD),
        "torch 2.13.0+cpu is a CPU build",
        f"{sys.executable} -m pip uninstall -y torch && {sys.executable} -m pip install",
    ),
    "no driver": (blind(driver=None), "sees no GPU, and no NVIDIA driver answers", "nvidia-smi"),
    "hidden": (blind(hidden=""), "CUDA_VISIBLE_DEVICES='' hides it", "unset CUDA_VISIBLE_DEVICES"),
    "old driver": (
        blind(torch={"error": "The NVIDIA driver on your system is too old"}),
        "the driver has Fine GPU, 600.0 (The NVIDIA driver on your system is too old)",
        "install a newer driver",
    ),
    "no gsplat": (found(gsplat=None), "gsplat is not installed", "[cuda]"),
    "other gsplat": (
        found(gsplat="1.6.0"),
        "gsplat 1.6.0 is installed, and 1.5.3 is needed",
        f"{sys.executable} -m pip install 'gsplat==1.5.3'",
    ),
    "no nvcc": (
        found({"toolkit": None}),
        "gsplat needs nvcc to compile its kernels, and there is none",
        "the CUDA toolkit 13.0",
    ),
    "no c++": (found(compiler=None), "needs a C++17 compiler to compile", "apt-get install g++"),
}


@pytest.mark.parametrize("case", CASES)
def test_each_lack_is_one_line_with_what_brings_it(case):
    machine, what, fix = CASES[case]
    lack = missing_dependency(machine)
    assert lack is not None and what in lack.what and fix in lack.fix
    assert "\n" not in str(lack) and str(lack) == f"{lack.what}: {lack.fix}"
    with pytest.raises(AwError) as error:
        choose_device("cuda", print, collect_facts=lambda: machine)
    assert str(error.value).startswith(f"--device cuda: {lack}") and error.value.exit_code == 2


def test_all_that_the_compiler_lacks_is_said_at_once():
    lack = missing_dependency(found({"toolkit": None}, compiler=None))
    assert "needs nvcc and a C++17 compiler to compile" in lack.what
    assert "toolkit" in lack.fix and "apt-get install g++" in lack.fix


def test_the_command_replaces_a_cpu_build_by_the_same_release():
    fix = missing_dependency(found(CPU_BUILD)).fix
    assert fix.endswith("'torch==2.13.0'") and "+cpu" not in fix


# -- the choice -----------------------------------------------------------------------------------


def test_auto_takes_the_gpu_or_says_why_it_lies_idle(kernels):
    said = []
    assert choose_device("auto", said.append, collect_facts=found) == "cuda" and said == []
    assert kernels.drawn == 1
    machine = found(gsplat=None)
    assert choose_device("auto", said.append, collect_facts=lambda: machine) == "cpu"
    (line,) = said
    assert line.startswith("warning: the GPU is not used, the CPU is: gsplat is not installed: ")
    assert "[cuda]" in line and "\n" not in line and kernels.drawn == 1


def test_auto_says_nothing_where_there_is_no_gpu():
    said = []
    machine = found(CPU_BUILD, driver=None, gsplat=None)
    assert choose_device("auto", said.append, collect_facts=lambda: machine) == "cpu" and said == []


def test_the_cpu_is_taken_without_a_look():
    assert choose_device("cpu", print, collect_facts=lambda: pytest.fail("looked")) == "cpu"


@pytest.mark.parametrize(
    ("fails", "reason"),
    [
        (
            RuntimeError("Error building 'gsplat_cuda'\n x.cu(3): error: no such\nmore"),
            "x.cu(3): error: no such;",
        ),
        (AttributeError("'NoneType' object has no attribute 'intersect_tile'"), "'NoneType' object has no"),
        (AssertionError(), "AssertionError;"),
    ],
)
def test_kernels_that_cannot_be_made_are_one_line_with_the_command(kernels, fails, reason):
    kernels.fails = fails
    said = []
    assert choose_device("auto", said.append, collect_facts=found) == "cpu"
    (line,) = said
    assert f"gsplat cannot draw on this GPU: {reason}" in line and "\n" not in line
    assert f"{readiness.INSTALL_GSPLAT} --force-reinstall --no-deps" in line
    with pytest.raises(AwError, match="cannot draw on this GPU"):
        choose_device("cuda", said.append, collect_facts=found)


def test_ninja_of_this_environment_is_found_though_nobody_activated_it(kernels):
    for _ in range(2):
        readiness.load_kernels()
        assert os.environ["PATH"].split(":") == ["/bin", str(Path(sys.executable).parent)]


# -- collect_facts --------------------------------------------------------------------------------------


def program(folder, name, text):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\necho '{text}'\n")
    path.chmod(0o755)


def test_what_is_looked_at_is_what_torch_and_gsplat_will_take(tmp_path, monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    program(tmp_path / "bin", "nvidia-smi", "Fine GPU, 600.0")
    program(tmp_path / "bin", "my-c++", "")
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/bin")
    monkeypatch.setenv("CXX", "my-c++")
    for folder in ("gsplat", "gsplat-1.5.3.dist-info"):
        (tmp_path / folder).mkdir()
    (tmp_path / "gsplat/__init__.py").touch()
    (tmp_path / "gsplat-1.5.3.dist-info/METADATA").write_text("Name: gsplat\nVersion: 1.5.3\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    seen = readiness.gpu_facts(TORCH)
    assert (seen.driver, seen.gsplat, seen.hidden) == ("Fine GPU, 600.0", "1.5.3", None)
    assert seen.compiler == str(tmp_path / "bin/my-c++") and not seen.prebuilt
    (tmp_path / "gsplat/csrc.cpython-312-x86_64-linux-gnu.so").touch()
    assert readiness.gpu_facts(TORCH).prebuilt
