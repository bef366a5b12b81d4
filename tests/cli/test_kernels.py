"""Kernels that are compiled while photos are placed."""

from __future__ import annotations

import subprocess
from pathlib import Path
from unittest.mock import Mock

import pytest

from ambiguous_wild.cli import build_scene as kernels


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
    (cache / "adam_1").mkdir()
    (cache / "adam_1" / "adam.catch_up_all-128.py311.nbi").touch()
    with kernels.kernels_meanwhile():
        subprocess.Popen.assert_not_called()


@pytest.mark.parametrize("code", [kernels._CODE, Path("scripts/test").read_text(encoding="utf-8")])
def test_what_compiles_beside_a_command_can_be_imported(code):
    lines = [line for line in code.splitlines() if line.startswith("from ambiguous_wild")]
    assert lines
    for line in lines:
        exec(line, {})
