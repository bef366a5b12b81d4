"""Compiled kernels belong to exactly one state of their source."""

import ast
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

import ambiguous_wild
from ambiguous_wild.io import numba_cache as cache
from ambiguous_wild.splat import calibration


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


def test_a_change_in_a_kernel_file_gives_another_folder_and_in_another_file_none(home, monkeypatch):
    source = home / "splat" / "cpu"
    source.mkdir(parents=True)
    (source / "adam.py").write_text("@parallel_kernel\ndef dense(): ...\n")
    for path in ("splat/cpu/buffers.py", *cache._OPTIONS):
        (home / path).parent.mkdir(exist_ok=True)
        (home / path).write_text("y = 1\n")
    monkeypatch.setattr(cache, "_PACKAGE", home)
    before = cache.kernel_cache()
    assert before.is_relative_to(home / "cache")
    (source / "buffers.py").write_text("y = 2\n")
    assert cache.kernel_cache() == before
    (source / "adam.py").write_text("@parallel_kernel\ndef dense(n): ...\n")
    changed = cache.kernel_cache()
    assert changed != before
    (source / "compile.py").write_text("fastmath = True\n")  # Numba's index does not know options
    assert cache.kernel_cache() not in (before, changed)


def test_kernels_use_constants_of_kernel_files_alone():
    """Numba compiles constants in, so that a file that gives one must be part of the hash."""
    files = {path.stem for path in cache.kernel_files()}
    splat = {"adam", "bins", "blend", "photometric", "project", "reverse", "simd"}
    assert files == splat | {"kernels", "tracer"}
    for path in cache.kernel_files():
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.ImportFrom) and node.module.rpartition(".")[2] not in files:
                assert not [alias.name for alias in node.names if alias.name.isupper()], path


def test_the_users_own_folder_comes_first(home, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/elsewhere")
    assert str(cache.kernel_cache().parent) == "/elsewhere"


CODE = """
import sys
sys.path.insert(0, {root!r})
from pathlib import Path
from ambiguous_wild.io import numba_cache
assert Path(numba_cache.__file__).is_relative_to({root!r})
from ambiguous_wild.simulate.kernels import _fold
assert _fold(0.5, 4.0) == 1.5
print(sum(_fold.stats.cache_hits.values()), sum(_fold.stats.cache_misses.values()))
"""


def test_a_copy_of_the_package_uses_the_same_kernels_even_where_it_cannot_write(home, monkeypatch):
    folder = home / "shipped"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    package = Path(ambiguous_wild.__file__).parent

    def run(root):
        root.mkdir()
        shutil.copytree(package, root / "ambiguous_wild", ignore=shutil.ignore_patterns("__pycache__"))
        code = CODE.format(root=str(root))
        return subprocess.run(
            [sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True
        ).stdout

    assert run(home / "one").split() == ["0", "1"]
    (index,) = folder.rglob("*_fold*.nbi")
    index.parent.chmod(0o500)
    assert run(home / "two").split() == ["1", "0"]


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
    monkeypatch.setattr(calibration, "cache_in_use", cache.kernel_cache)
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
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(home / "ambiguous_wild-mine"))
    assert "once per machine" in announced(monkeypatch)
    monkeypatch.setattr(cache.os, "access", lambda path, mode: False)
    assert "at every command, as" in announced(monkeypatch)
