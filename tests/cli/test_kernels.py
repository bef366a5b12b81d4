"""Kernels that are compiled while photos are registered."""

from __future__ import annotations

import re
import subprocess
import sys
from unittest.mock import Mock

import pytest

from ambiguous_wild.cli import build_scene as kernels
from ambiguous_wild.io.numba_cache import kernel_cache
from ambiguous_wild.splat import calibration
from tests.command_line import Terminal


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """An empty folder of compiled kernels; processes are not started."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(subprocess, "Popen", Mock())
    return tmp_path


def test_nothing_is_left_behind_even_after_an_error(cache):
    with pytest.raises(KeyError), kernels.kernels_meanwhile():
        raise KeyError
    subprocess.Popen.assert_called_once()
    assert [name for name, *_ in subprocess.Popen.return_value.method_calls] == ["kill", "wait"]


def test_what_is_compiled_already_is_left_alone(cache):
    kernel_cache().mkdir()
    (kernel_cache() / "adam.catch_up-128.py311.nbi").touch()
    with kernels.kernels_meanwhile():
        subprocess.Popen.assert_not_called()


def test_what_compiles_beside_a_command_can_be_imported():
    (line,) = [line for line in kernels._CODE.splitlines() if line.startswith("from ambiguous_wild")]
    exec(line, {})


def test_the_time_of_compiling_is_measured_here_and_a_clock_runs(monkeypatch):
    monkeypatch.setattr(calibration, "_cached", lambda: False)
    monkeypatch.setattr(calibration, "COLD_IN_SAMPLES", 1000.0)
    monkeypatch.setattr(sys, "stderr", shown := Terminal())
    said = []
    calibration.warm_up(said.append)
    (seconds,) = re.findall(r"^compiling CPU kernels \(about (\d+) s, once per machine", said[0])
    assert len(said) == 1 and 20 < int(seconds) < 60_000  # a sample takes from 20 ms to a minute
    assert "compiling [00:0" in shown.getvalue() and shown.left().strip() == ""
    calibration.warm_up()  # nobody is told
    assert shown.getvalue().count("compiling [00:00 of") == 1
