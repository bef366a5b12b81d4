"""Every way in which a GPU cannot be used is one line that says what brings it; asked of made-up machines."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.gpu import gsplat_build, readiness
from ambiguous_wild.splat.gpu.readiness import Found, choose, why_not

ARCHS = ["sm_75", "sm_80", "sm_86", "sm_90", "sm_100", "sm_120"]
TORCH = {
    "version": "2.13.0",
    "built": "13.0",
    "cuda": True,
    "names": ["Fine GPU"],
    "capabilities": [[8, 6]],
    "archs": ARCHS,
    "error": "",
}
CPU_BUILD = {
    "version": "2.13.0+cpu",
    "built": None,
    "cuda": False,
    "names": [],
    "capabilities": [],
    "archs": [],
}


def found(torch=None, **other):
    """A machine that lacks nothing but what is said."""
    values = {
        "driver": "Fine GPU, 600.0", "gsplat": "/site/gsplat", "folder": Path("/cache/gsplat_cuda"),
        "prebuilt": False, "compiled": True, "nvcc": "13.0", "compiler": "/usr/bin/c++",
        "ninja": "/usr/bin/ninja", "hidden": None,
    }  # fmt: skip
    return Found(torch=TORCH | (torch or {}), **(values | other))


def blind(**other):
    return found(
        {"cuda": False, "names": [], "capabilities": [], "archs": [], **other.pop("torch", {})}, **other
    )


def test_a_machine_that_lacks_nothing_is_ready():
    assert why_not(found()) is None
    assert why_not(found(compiled=False)) is None  # it can be compiled
    assert why_not(found(nvcc=None, compiler=None, ninja=None, prebuilt=True)) is None  # and need not be


CASES = {
    "cpu build": (
        found(CPU_BUILD | {"error": ""}),
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
    "old gpu": (
        found({"names": ["Old GPU"], "capabilities": [[6, 1]]}),
        f"Old GPU has compute capability 6.1, torch 2.13.0 is built for {', '.join(ARCHS)}",
        "install a build of torch for 6.1",
    ),
    "old gpu first": (
        found({"names": ["Old GPU", "Fine GPU"], "capabilities": [[6, 1], [8, 6]]}),
        "Old GPU has compute capability 6.1",
        "export CUDA_VISIBLE_DEVICES=1",
    ),
    "no gsplat": (found(gsplat=None, compiled=False), "gsplat is not installed", "[cuda]"),
    "no nvcc": (
        found(compiled=False, nvcc=None),
        "gsplat needs nvcc to compile its kernels, and there is none",
        "the CUDA toolkit 13.0",
    ),
    "no c++": (
        found(compiled=False, compiler=None), "needs a C++17 compiler to compile", "apt-get install g++"
    ),
    "no ninja": (
        found(compiled=False, ninja=None), "needs ninja to compile", f"{sys.executable} -m pip install ninja"
    ),
    "compiled, no nvcc": (
        found(nvcc=None), "needs nvcc to load the kernels it has compiled", "the CUDA toolkit 13.0"
    ),
    "other nvcc": (
        found(compiled=False, nvcc="12.4"),
        "gsplat needs nvcc of CUDA 13.0 as torch to compile its kernels, and it is of CUDA 12.4",
        "the CUDA toolkit 13.0",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_each_lack_is_one_line_with_what_brings_it(case):
    machine, what, fix = CASES[case]
    lack = why_not(machine)
    assert lack is not None and what in lack.what and fix in lack.fix
    assert "\n" not in str(lack) and str(lack) == f"{lack.what}: {lack.fix}"


def test_all_that_the_compiler_lacks_is_said_at_once():
    lack = why_not(found(compiled=False, nvcc=None, ninja=None))
    assert "needs nvcc and ninja to compile" in lack.what
    assert "toolkit" in lack.fix and "pip install ninja" in lack.fix


def test_the_command_replaces_a_cpu_build_by_the_same_release():
    fix = why_not(found(CPU_BUILD)).fix
    assert fix.endswith("'torch==2.13.0'") and "+cpu" not in fix


@pytest.mark.parametrize(
    ("capability", "archs", "fits"),
    [
        ((8, 6), ["sm_86"], True),
        ((8, 9), ["sm_86"], True),  # code of 8.6 runs on 8.9
        ((8, 0), ["sm_86"], False),
        ((9, 0), ["sm_86"], False),  # not on another major version
        ((9, 0), ["sm_86", "compute_86"], True),  # PTX does
        ((7, 5), ["compute_80"], False),
        ((9, 0), ["sm_90a"], True),
        ((12, 0), ["sm_100", "sm_120"], True),
        ((12, 1), ["sm_100a"], False),
        ((8, 6), ["gfx90"], False),
    ],
)
def test_code_runs_where_nvidia_says_it_does(capability, archs, fits):
    lack = why_not(found({"capabilities": [list(capability)], "archs": archs}))
    assert (lack is None) is fits


# -- the choice -----------------------------------------------------------------------------------


def test_auto_takes_the_gpu_or_says_why_it_lies_idle(monkeypatch):
    monkeypatch.setenv("PATH", "/bin")  # what is added to it is taken back
    said = []
    assert choose("auto", said.append, looking=found) == "cuda" and said == []
    machine = found(gsplat=None, compiled=False)
    assert choose("auto", said.append, looking=lambda: machine) == "cpu"
    (line,) = said
    assert line.startswith("warning: the GPU is not used, the CPU is: gsplat is not installed: ")
    assert "[cuda]" in line and "\n" not in line


def test_auto_says_nothing_where_there_is_no_gpu():
    said = []
    machine = found(CPU_BUILD | {"error": ""}, driver=None, gsplat=None)
    assert choose("auto", said.append, looking=lambda: machine) == "cpu" and said == []


@pytest.mark.parametrize("case", CASES)
def test_asking_for_the_gpu_is_an_error_with_the_same_words(case):
    machine, what, fix = CASES[case]
    with pytest.raises(AwError) as error:
        choose("cuda", print, looking=lambda: machine)
    assert str(error.value).startswith("--device cuda: ") and error.value.exit_code == 2
    assert what in str(error.value) and fix in str(error.value)


def test_the_cpu_is_taken_without_a_look():
    assert choose("cpu", print, looking=lambda: pytest.fail("looked")) == "cpu"


# -- compiling ------------------------------------------------------------------------------------


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """gsplat as its wheel leaves it, a compiler that can be told what to do, and what was said."""
    monkeypatch.setenv("PATH", "/bin")
    (tmp_path / "gsplat").mkdir()
    place = tmp_path / "torch_extensions" / "gsplat_cuda"
    state = SimpleNamespace(said=[], runs=[], place=place, package=tmp_path / "gsplat")

    def fake_run(words, **options):
        state.runs.append(words)
        if state.fails:
            return subprocess.CompletedProcess(words, 1, "building", "note\nx.cu(3): error: no such\nmore")
        place.mkdir(parents=True)
        (place / "gsplat_cuda.so").touch()
        return subprocess.CompletedProcess(words, 0, "", "")

    state.fails = False
    state.compile = lambda compiled=None: gsplat_build.compile_kernels(
        place,
        compiled or (lambda: gsplat_build.is_compiled(place)),
        state.said.append,
        run=fake_run,
    )
    return state


def test_kernels_are_compiled_once_and_that_is_announced(machine):
    machine.compile()
    machine.compile()
    assert len(machine.runs) == 1 and machine.runs[0][0] == sys.executable
    assert "gsplat.cuda._backend" in machine.runs[0][2]
    assert machine.said == [f"gsplat compiles its kernels once, several minutes, kept in {machine.place}"]
    assert list(machine.place.parent.glob(".*lock")) == []


def test_kernels_of_a_wheel_that_was_compiled_beforehand_are_found(machine, monkeypatch):
    assert not gsplat_build.is_prebuilt(machine.package)
    (machine.package / "csrc.cpython-312-x86_64-linux-gnu.so").touch()
    assert gsplat_build.is_prebuilt(machine.package)
    monkeypatch.setattr(readiness, "compile_kernels", lambda *_: pytest.fail("compiles"))
    readiness.make_ready(found(prebuilt=True, compiled=False), machine.said.append)


def test_what_another_process_compiled_meanwhile_is_not_compiled_again(machine):
    answers = iter([False, True])  # before the lock, and with it
    machine.compile(lambda: next(answers))
    assert machine.runs == [] and machine.said == []


def test_a_failing_compiler_is_one_line_and_a_log(machine):
    machine.fails = True
    with pytest.raises(
        AwError, match=r"gsplat did not compile: x\.cu\(3\): error: no such; .*gsplat_cuda\.log"
    ):
        machine.compile()
    assert "more" in (machine.place.parent / "gsplat_cuda.log").read_text()


def test_auto_goes_on_with_the_cpu_where_the_compiler_fails(monkeypatch):
    def fails(found, say):
        raise AwError("gsplat did not compile: error")

    monkeypatch.setattr(readiness, "make_ready", fails)
    said = []
    assert choose("auto", said.append, looking=lambda: found(compiled=False)) == "cpu"
    assert said == ["warning: the GPU is not used, the CPU is: gsplat did not compile: error"]
    with pytest.raises(AwError, match="did not compile"):
        choose("cuda", said.append, looking=lambda: found(compiled=False))


@pytest.mark.parametrize("own", [True, False])
def test_the_folder_is_the_one_that_torch_takes(own, tmp_path, monkeypatch):
    from torch.utils import cpp_extension

    monkeypatch.delenv("TORCH_EXTENSIONS_DIR", raising=False)
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR" if own else "XDG_CACHE_HOME", str(tmp_path))
    theirs = cpp_extension._get_build_directory("gsplat_cuda", False)
    import torch

    assert str(gsplat_build.kernels_folder(torch.version.cuda)) == theirs


def test_ninja_of_this_environment_is_found_though_nobody_activated_it(monkeypatch):
    monkeypatch.setenv("PATH", "/bin")
    assert gsplat_build.search_path().split(":") == ["/bin", str(Path(sys.executable).parent)]
    monkeypatch.setenv("PATH", gsplat_build.search_path())
    assert gsplat_build.search_path().count(str(Path(sys.executable).parent)) == 1


def test_a_toolkit_is_one_with_compiler_and_headers_and_what_is_named_is_left_alone(tmp_path, monkeypatch):
    for name in ("CUDA_HOME", "CUDA_PATH"):
        monkeypatch.setenv(name, "put back afterwards")
        monkeypatch.delenv(name)
    links, whole = tmp_path / "links", tmp_path / "cuda-13.0"
    for folder in (links, whole):
        (folder / "bin").mkdir(parents=True)
        (folder / "bin/nvcc").touch()
    (whole / "include").mkdir()
    (whole / "include/cuda_runtime.h").touch()
    assert gsplat_build.toolkit([links, whole]) == whole  # a link to nvcc has no headers around it
    assert gsplat_build.toolkit([links]) is None
    monkeypatch.setattr(gsplat_build, "toolkit", lambda: whole)
    gsplat_build.compile_kernels(tmp_path / "kept", lambda: True, print)
    assert os.environ["CUDA_HOME"] == str(whole)
    monkeypatch.undo()
    monkeypatch.setenv("CUDA_HOME", str(links))
    assert gsplat_build.toolkit([whole]) is None
    gsplat_build.compile_kernels(tmp_path / "kept", lambda: True, print)
    assert os.environ["CUDA_HOME"] == str(links)


# -- looking --------------------------------------------------------------------------------------


def program(folder, name, text):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\necho '{text}'\n")
    path.chmod(0o755)


def test_what_is_looked_at_is_what_torch_and_gsplat_will_take(tmp_path, monkeypatch):
    for name in ("CUDA_PATH", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)
    program(tmp_path / "bin", "nvidia-smi", "Fine GPU, 600.0")
    program(tmp_path / "bin", "nvcc", "Cuda compilation tools, release 11.8, V11.8.89")
    program(tmp_path / "toolkit/bin", "nvcc", "Cuda compilation tools, release 13.0, V13.0.1")
    program(tmp_path / "bin", "my-c++", "")
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/bin")
    monkeypatch.setenv("CXX", "my-c++")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "toolkit"))
    (tmp_path / "gsplat").mkdir()
    (tmp_path / "gsplat/__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "kept"))
    seen = readiness.look(TORCH)
    assert (seen.driver, seen.nvcc, seen.hidden) == ("Fine GPU, 600.0", "13.0", None)
    assert seen.compiler == str(tmp_path / "bin/my-c++") and seen.gsplat == str(tmp_path / "gsplat")
    assert not seen.compiled and seen.folder == tmp_path / "kept/gsplat_cuda"
    (tmp_path / "kept/gsplat_cuda").mkdir(parents=True)
    (tmp_path / "kept/gsplat_cuda/gsplat_cuda.so").touch()
    assert readiness.look(TORCH).compiled
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "absent"))
    assert readiness.look(TORCH).nvcc == "11.8"  # gsplat takes the one on $PATH then


def test_torch_is_asked_for_plain_values():
    facts = readiness.torch_facts()
    assert facts.keys() == TORCH.keys()
