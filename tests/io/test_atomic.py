"""Nothing half-written stays behind."""

import fcntl
import json
import subprocess
import sys

import pytest

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.atomic import atomic_dir, atomic_path, sweep, write_json, write_text
from ambiguous_wild.io.lock import folder_lock


def test_a_failing_write_leaves_the_old_file(tmp_path):
    target = tmp_path / "a.txt"
    write_text(target, "old")
    with pytest.raises(RuntimeError), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("late", [False, True])
def test_an_error_names_the_file_that_was_asked_for(tmp_path, monkeypatch, late):
    target = tmp_path / "x.csv"

    def full(*names, **_):
        raise PermissionError(13, "Permission denied", str(names[0]) if late else str(tmp_path / ".x.tmp"))

    monkeypatch.setattr(*("os.replace", full) if late else ("tempfile.mkstemp", full))
    with pytest.raises(PermissionError) as found:
        write_text(target, "new")
    assert (found.value.filename, found.value.strerror) == (str(target), "Permission denied")
    assert not list(tmp_path.iterdir())


def test_a_failing_folder_leaves_the_old_folder(tmp_path):
    target = tmp_path / "d"
    with atomic_dir(target) as temporary:
        (temporary / "x").write_text("1")
    with pytest.raises(RuntimeError), atomic_dir(target) as temporary:
        (temporary / "y").write_text("2")
        raise RuntimeError
    assert [p.name for p in target.iterdir()] == ["x"]
    assert [p.name for p in tmp_path.iterdir()] == ["d"]


def test_a_folder_is_replaced_whole(tmp_path):
    target = tmp_path / "d"
    for name in ("x", "y"):
        with atomic_dir(target) as temporary:
            (temporary / name).write_text(name)
    assert [p.name for p in target.iterdir()] == ["y"]
    assert [p.name for p in tmp_path.iterdir()] == ["d"]


def test_json_refuses_nan_and_keeps_the_old(tmp_path):
    target = tmp_path / "a.json"
    write_json(target, {"x": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(target, {"x": float("nan")})
    assert json.loads(target.read_text()) == {"x": 1}


def test_a_locked_folder_names_its_holder_and_is_freed_afterwards(tmp_path):
    folder = tmp_path / "run"
    script = (
        "import sys; from ambiguous_wild.io.lock import folder_lock\n"
        "with folder_lock(sys.argv[1], 'second'): print('got it')"
    )
    with folder_lock(folder, "aw bench"):
        blocked = subprocess.run([sys.executable, "-c", script, folder], capture_output=True, text=True)
        assert "being worked on by aw bench" in blocked.stderr
    free = subprocess.run([sys.executable, "-c", script, folder], capture_output=True, text=True)
    assert free.stdout.strip() == "got it"
    assert list(tmp_path.iterdir()) == []


def test_a_lock_is_freed_after_an_error(tmp_path):
    with pytest.raises(AwError), folder_lock(tmp_path / "run", "first"):
        raise AwError("x")
    assert list(tmp_path.iterdir()) == []
    with folder_lock(tmp_path / "run", "second"):
        assert (tmp_path / ".run.lock").exists()


def test_a_lock_file_unlinked_under_ones_hands_is_not_held(tmp_path, monkeypatch):
    """B opens the file, A unlinks it and leaves, B locks what is no longer there: B must look again."""
    path, real = tmp_path / ".run.lock", fcntl.flock
    taken = []

    def flock(handle, operation):
        if not taken:
            path.unlink()
        taken.append(handle)
        real(handle, operation)

    monkeypatch.setattr("filelock._unix.fcntl.flock", flock)
    with folder_lock(tmp_path / "run", "B"):
        assert len(taken) == 2
        assert path.exists()


def test_what_a_killed_process_left_is_swept_and_nothing_else(tmp_path):
    script = (
        "import os, sys\nfrom ambiguous_wild.io.atomic import atomic_dir, atomic_path\n"
        "with atomic_path(sys.argv[1] + '/a.txt') as a, atomic_dir(sys.argv[1] + '/d') as d:\n"
        "    a.write_text('half'); (d / 'x').write_text('half'); os._exit(9)"
    )
    (tmp_path / "mine.txt").write_text("keep")
    (tmp_path / ".hidden").write_text("keep")
    subprocess.run([sys.executable, "-c", script, tmp_path])
    assert len(list(tmp_path.iterdir())) == 4
    sweep(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".hidden", "mine.txt"]


def test_a_file_where_a_folder_is_to_be_made_stays(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(AwError, match="a file lies there"), atomic_dir(tmp_path / "thesis.txt") as folder:
        (folder / "a").write_text("b")
    assert (tmp_path / "thesis.txt").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]
