"""Compiled kernels belong to exactly one state of their source."""

import os
import stat
from pathlib import Path

import pytest

from ambiguous_wild.splat import calibration
from ambiguous_wild.splat.cpu import compile as cache


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


def test_a_change_in_any_kernel_file_gives_another_folder(home, monkeypatch):
    source = home / "cpu"
    source.mkdir()
    (source / "cache.py").write_text("x = 1\n")
    (source / "simd.py").write_text("y = 1\n")
    monkeypatch.setattr(cache, "__file__", str(source / "cache.py"))
    before = cache.kernel_cache()
    assert cache.kernel_cache() == before
    assert before.is_relative_to(home / "cache")
    (source / "simd.py").write_text("y = 2\n")
    assert cache.kernel_cache() != before


def test_the_users_own_folder_comes_first(home, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/elsewhere")
    assert str(cache.kernel_cache()) == "/elsewhere"


def test_without_a_writable_home_a_private_temporary_folder_is_used(home, monkeypatch):
    (home / "cache").write_text("a file where the folder should be")
    monkeypatch.setattr(cache.tempfile, "tempdir", str(home))
    folder = cache.kernel_cache().parent
    assert folder == home / f"ambiguous_wild-{os.getuid()}"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(0o777)  # somebody else could plant code there now
    assert cache.kernel_cache().parent != folder


def announced(monkeypatch):
    """Return the line of a command that finds nothing compiled; where kernels lie is decided anew."""
    lines = []
    monkeypatch.setattr(cache._config, "CACHE_DIR", str(cache.kernel_cache()))
    monkeypatch.setattr(calibration, "_cached", lambda: False)
    calibration.warm_up(lines.append)
    return " ".join(lines)


def test_the_line_says_how_often_kernels_are_compiled_and_what_to_set(home, monkeypatch):
    assert "once per machine" in announced(monkeypatch)
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    monkeypatch.setattr(cache.tempfile, "tempdir", str(home))
    line = announced(monkeypatch)
    assert f"again when {home / 'ambiguous_wild-'}" in line and "set NUMBA_CACHE_DIR" in line
    cache.kernel_cache().parent.chmod(0o777)
    line = announced(monkeypatch)
    assert "at every command" in line and "set NUMBA_CACHE_DIR" in line and "once per machine" not in line
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(home / "mine"))
    assert "once per machine" in announced(monkeypatch)
