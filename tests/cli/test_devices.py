"""`--device`: the same words on the command line and in `aw doctor`, and an exit code the shell can read."""

import sys

import pytest

from ambiguous_wild.cli import doctor
from ambiguous_wild.cli import options as devices
from ambiguous_wild.cli.doctor import Probe
from ambiguous_wild.core import AwError
from ambiguous_wild.splat import readiness
from tests.command_line import aw
from tests.splat.test_readiness import CASES, TORCH, found


@pytest.fixture
def here(monkeypatch):
    """Makes this machine the one that is given."""

    def be(machine):
        monkeypatch.setattr(readiness, "gpu_facts", lambda torch=None: machine)

    return be


def test_auto_warns_on_stderr_and_takes_the_cpu(here, capsys):
    here(CASES["no gsplat"][0])
    assert devices.choose_device("auto") == "cpu"
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert err.startswith("warning: the GPU is not used, the CPU is: gsplat is not installed: ")
    assert f"{sys.executable} -m pip install" in err and "[cuda]" in err


def test_cuda_is_refused_with_exit_code_2_before_anything_is_made(here, scene, tmp_path):
    here(CASES["no nvcc"][0])
    done = aw("bench", "--method", "3dgs", "--scene", scene, "-o", tmp_path / "runs", "--device", "cuda")
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: --device cuda: gsplat needs nvcc to compile its kernels")
    assert not (tmp_path / "runs").exists()


def test_a_grid_falls_back_and_runs(here, scene, tmp_path, monkeypatch):
    # it compiles all kernels
    monkeypatch.setattr("ambiguous_wild.splat.calibration.prepare_cpu", lambda *_: None)
    here(CASES["other gsplat"][0])
    words = ("--method", "3dgs", "--scene", scene, "--iterations", 3, "--no-pictures")
    done = aw("bench", *words, "-o", tmp_path / "runs")
    assert done.returncode == 0
    assert done.stderr.count("warning: the GPU is not used, the CPU is: gsplat 1.6.0 is installed") == 1
    assert "1 run: 1 trained" in done.stderr


@pytest.mark.parametrize("case", CASES)
def test_doctor_says_it_in_the_same_words(here, case):
    machine, what, fix = CASES[case]
    here(machine)
    said = {c.name: c for c in doctor._gpu(Probe(dict(machine.torch)))}
    (wrong,) = [c for c in said.values() if c.name != "nvidia driver" and not c.ok]
    assert what in wrong.detail and fix in wrong.fix
    with pytest.raises(AwError) as error:
        devices.choose_device("cuda")
    remedy = wrong.fix.removeprefix("# ").replace("  # ", ", ")  # there a line to paste, here a sentence
    assert f"{wrong.detail}: {remedy}" in str(error.value)


def test_doctor_says_where_the_kernels_are(here):
    for words, machine in {"compiled by the first run": {}, "in the wheel": {"prebuilt": True}}.items():
        here(found(**machine))
        (kernels,) = [c for c in doctor._gpu(Probe(TORCH)) if c.name == "gsplat kernels"]
        assert kernels.ok and kernels.detail.startswith(words) and kernels.fix == ""
    (broken,) = doctor._gpu(Probe(None, "no torch"))
    assert (broken.name, broken.ok, broken.detail) == ("torch cuda", False, "no torch")
