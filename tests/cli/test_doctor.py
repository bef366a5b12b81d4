"""`aw doctor`: what it reports is true, and missing parts come with a command to paste."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.cli import doctor
from ambiguous_wild.cli.doctor import PROBES, Probe, SystemCheck, all_checks, other_versions, probe, unmet
from ambiguous_wild.io import numba_cache
from tests.command_line import aw


@pytest.fixture(scope="module")
def report() -> list[SystemCheck]:
    return all_checks()


def test_the_core_works_where_the_tests_run(report: list[SystemCheck]) -> None:
    core = {c.name: c for c in report if c.group == "core"}
    assert [c.name for c in core.values() if not c.ok] == []
    assert core["python"].detail == ".".join(map(str, sys.version_info[:3]))
    assert core["torch"].detail.startswith(__import__("torch").__version__)
    assert {"cpu", "packages", "OpenImageIO", "pycolmap", "numba", "kernel cache", "disk"} <= core.keys()


def test_whatever_lacks_comes_with_a_way_to_get_it(report: list[SystemCheck]) -> None:
    for c in report:
        assert c.detail and bool(c.fix) is not c.ok, c
        if c.fix:
            assert subprocess.run(["bash", "-n", "-c", c.fix]).returncode == 0, c.fix
            assert c.fix.startswith((*doctor.COMMANDS, "export ", "unset ", "df ")), c.fix


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("nothing to do without a GPU", "# nothing to do without a GPU"),
        ("install a newer driver, then restart", "# install a newer driver, then restart"),
        ("unset CUDA_VISIBLE_DEVICES", "unset CUDA_VISIBLE_DEVICES"),
        ("export A=1, which is built for", "export A=1  # which is built for"),
        (f"{sys.executable} -m pip install x", f"{sys.executable} -m pip install x"),
    ],
)
def test_words_that_are_no_command_are_a_comment(words: str, line: str) -> None:
    assert doctor.pastable(words) == line


@pytest.mark.parametrize("tool", ["apt-get", "brew", ""])
def test_a_system_package_comes_with_the_command_of_the_machine(
    tool: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor.shutil, "which", lambda name: f"/bin/{name}" if name == tool else None)
    monkeypatch.setattr(doctor.readiness, "first_output_line", lambda *words: None)
    fix = doctor._git().fix
    assert fix.startswith("# install git from https://") if not tool else f"{tool} install" in fix


def test_what_one_command_needs_comes_with_its_extra(
    monkeypatch: pytest.MonkeyPatch, report: list[SystemCheck]
) -> None:
    assert {"ray", "choix", "nltk", "nerfbaselines"} <= {c.name for c in report if c.group == "optional"}
    monkeypatch.setattr(doctor, "installed", lambda name: None)
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("AW_NERFBASELINES", raising=False)
    fixes = {c.name: c.fix for c in doctor._extras()}
    assert "[ray]" in fixes["ray"]
    assert "[study]" in fixes["choix"] and "[study]" in fixes["nltk"]
    assert fixes["nerfbaselines"].startswith("python3 -m venv")


def test_weights_come_with_the_command_that_downloads_them(report: list[SystemCheck]) -> None:
    optional = {c.name: c for c in report if c.group == "optional"}
    assert optional["transformers"].ok
    for name in ("dinov2-small", "dino-vits16", "efficientnet-lite0"):
        assert optional[name].ok or optional[name].fix == f"aw weights get {name}"


def test_lpips_comes_with_the_command_for_the_files_it_lacks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("TORCH_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("AW_WEIGHTS", str(tmp_path / "my weights"))
    assert doctor._metrics()[0].fix == "aw weights get alexnet lpips-alex"
    (tmp_path / "my weights").mkdir()
    (tmp_path / "my weights" / "alexnet.safetensors").touch()
    assert doctor._metrics()[0].fix == "aw weights get lpips-alex"
    (tmp_path / "my weights" / "lpips_alex.pth").touch()
    assert doctor._metrics()[0].ok


def test_the_report_prints_every_check(monkeypatch: pytest.MonkeyPatch, report: list[SystemCheck]) -> None:
    monkeypatch.setattr(doctor, "all_checks", lambda: report)
    out = aw("doctor").stdout
    for c in report:
        assert f"{'✓' if c.ok else '✗'} {c.name}" in out and c.detail in out and c.fix in out
    facts = json.loads(aw("doctor", "--json").stdout)
    assert facts["ok"] is True
    assert [SystemCheck(**c) for c in facts["checks"]] == report


@pytest.mark.parametrize("words", [[], ["--json"]])
def test_a_broken_core_is_an_error_with_what_to_run(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = [
        SystemCheck("core", "numba", False, "no threads", "pip install numba"),
        SystemCheck("optional", "git", True, "2"),
    ]
    monkeypatch.setattr(doctor, "all_checks", lambda: found)
    done = aw("doctor", *words)
    assert done.returncode == 2 and "no threads" in done.stdout
    assert "numba" in done.stderr and "pip install numba" in done.stderr


def test_requirements_that_are_not_met_are_found() -> None:
    assert unmet([f"numpy>={np.__version__}", "click"]) == []
    wrong = [f"numpy>{np.__version__}", "no-such-package-of-ours>=1"]
    assert unmet(wrong) == wrong


def test_versions_other_than_the_tested_are_named(tmp_path: Path) -> None:
    file = tmp_path / "constraints.txt"
    file.write_text(f"# tested\nclick=={version('click')}  # here\nnumpy==0.0.1\nno-such-package==3\n")
    assert other_versions(file) == [f"numpy {np.__version__} (tested: 0.0.1)"]
    assert other_versions(tmp_path / "absent.txt") is None


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("raise OSError('nms does not exist')", "nms does not exist"),
        ("import os; os.kill(os.getpid(), 9)", "crashed (signal 9)"),
        ("print('hello')", "unexpected output"),
    ],
)
def test_a_probe_that_fails_says_how(code: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PROBES, "broken", code)
    found = probe("broken")
    assert found.facts is None and words in found.error


def test_a_broken_torchvision_is_named_and_an_absent_one_is_fine() -> None:
    assert doctor._torchvision(None).ok
    broken = doctor._torchvision(Probe(None, "operator torchvision::nms does not exist"))
    assert not broken.ok and broken.group == "optional"
    assert broken.fix.endswith("-m pip uninstall -y torchvision")


def test_a_cache_that_cannot_be_written_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    probe_ok = Probe({"threads": 2, "layer": "omp"})
    folder = tmp_path / "new" / "cache"
    monkeypatch.setattr(numba_cache, "cache_in_use", lambda: folder)
    (tmp_path / "new").write_text("a file where the folder should be")
    assert not doctor._numba(probe_ok)[1].ok
    (tmp_path / "new").unlink()
    fresh = doctor._numba(probe_ok)[1]
    assert fresh.ok and "not compiled yet" in fresh.detail
    folder.mkdir(parents=True)
    (folder / "a.nbi").touch()
    monkeypatch.setattr(numba_cache.os, "access", lambda path, mode: False)
    complete = doctor._numba(probe_ok)[1]
    assert complete.ok and "1 kernels compiled" in complete.detail
    (folder / "a.nbi").unlink()
    refused = doctor._numba(probe_ok)[1]
    assert not refused.ok and "NUMBA_CACHE_DIR" in refused.fix
