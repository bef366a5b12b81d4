"""Without viser, `aw view --live` says what to install."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.command_line import aw


def test_the_command_that_installs_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    done = aw("view", "--live", tmp_path / "scene")
    assert done.returncode == 2 and "needs viser" in done.stderr
    assert "-m pip install" in done.stderr and "[view]'" in done.stderr and done.stderr.count("\n") == 1
