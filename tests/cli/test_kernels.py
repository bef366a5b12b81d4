"""Kernels that are compiled while photos are placed."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import ClassVar

import pytest

from ambiguous_wild.cli import build_scene as kernels


class Process:
    """Counts what is done to it."""

    started: ClassVar[list[Process]] = []

    def __init__(self, words: list[str], **how: object) -> None:
        self.words, self.ended = words, False
        self.started.append(self)

    def kill(self) -> None:
        self.ended = True

    def wait(self) -> None:
        assert self.ended


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """An empty folder of compiled kernels; processes are counted, not started."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(Process, "started", [])
    monkeypatch.setattr(subprocess, "Popen", Process)
    return tmp_path


def test_nothing_is_left_behind_even_after_an_error(cache):
    with pytest.raises(KeyError), kernels.kernels_meanwhile():
        raise KeyError
    assert [p.ended for p in Process.started] == [True]


def test_what_is_compiled_already_is_left_alone(cache):
    (cache / "adam_1").mkdir()
    (cache / "adam_1" / "adam.catch_up_all-128.py311.nbi").touch()
    with kernels.kernels_meanwhile():
        assert Process.started == []


@pytest.mark.parametrize("code", [kernels._CODE, Path("scripts/test").read_text(encoding="utf-8")])
def test_what_compiles_beside_a_command_can_be_imported(code):
    lines = [line for line in code.splitlines() if line.startswith("from ambiguous_wild")]
    assert lines
    for line in lines:
        exec(line, {})
