"""Nothing half-written stays behind."""

import contextlib
import fcntl
import os
import select
import socket
import stat
import subprocess
import sys
import threading

import pytest

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.files import (
    atomic_dir,
    atomic_path,
    check_output,
    folder_lock,
    replace_folder,
    sweep,
    sweep_killed,
    sweep_siblings,
    write_json,
    write_text,
)


def test_a_failing_write_leaves_the_old_file(tmp_path):
    target = tmp_path / "a.txt"
    write_text(target, "old")
    with pytest.raises(RuntimeError), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(target, {"x": float("nan")})
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


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path):
    target = tmp_path / "d"
    for name in ("x", "y"):
        with atomic_dir(target) as temporary:
            (temporary / name).write_text(name)
    with pytest.raises(RuntimeError), atomic_dir(target) as temporary:
        (temporary / "z").write_text("half")
        raise RuntimeError
    assert [p.name for p in target.iterdir()] == ["y"]
    assert [p.name for p in tmp_path.iterdir()] == ["d"]


def test_a_failed_folder_leaves_none_above_it_that_was_not_there(tmp_path):
    (tmp_path / "mine").mkdir()
    with pytest.raises(RuntimeError), atomic_dir(tmp_path / "mine" / "new" / "deep" / "out"):
        raise RuntimeError
    assert [path.name for path in tmp_path.iterdir()] == ["mine"] and not any((tmp_path / "mine").iterdir())
    with pytest.raises(RuntimeError), atomic_dir(tmp_path / "new" / "deep" / "out"):
        (tmp_path / "new" / "other").touch()  # of somebody else, meanwhile
        raise RuntimeError
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["other"]


def test_a_lock_is_freed_after_an_error(tmp_path):
    with pytest.raises(AwError), folder_lock(tmp_path / "run", "first"):
        raise AwError("x")
    assert list(tmp_path.iterdir()) == []
    with folder_lock(tmp_path / "run", "second"):
        assert (tmp_path / ".run.lock").exists()


@pytest.mark.parametrize(
    ("number", "advice"), [(28, "free space"), (27, "raise ulimit -f"), (30, "make it writable")]
)
def test_a_lock_that_cannot_be_written_says_what_to_do(tmp_path, monkeypatch, number, advice):
    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("filelock.FileLock.acquire", refuse)
    with (
        pytest.raises(AwError, match=f"{os.strerror(number)}; {advice}, or choose"),
        folder_lock(tmp_path / "run", "aw bench"),
    ):
        pass


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
        "import os, sys\nfrom ambiguous_wild.io.files import atomic_dir, atomic_path\n"
        "with atomic_path(sys.argv[1] + '/a.txt') as a, atomic_dir(sys.argv[1] + '/d') as d:\n"
        "    a.write_text('half'); (d / 'x').write_text('half'); os._exit(9)"
    )
    (tmp_path / "mine.txt").write_text("keep")
    (tmp_path / ".hidden").write_text("keep")
    subprocess.run([sys.executable, "-c", script, tmp_path])
    assert len(list(tmp_path.iterdir())) == 4
    sweep(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".hidden", "mine.txt"]


def test_a_folder_that_was_not_replaced_goes_back(tmp_path):
    with atomic_dir(tmp_path / "d") as temporary:
        (temporary / "x").touch()
    with pytest.raises(FileNotFoundError):
        replace_folder(tmp_path / "nothing", tmp_path / "d")
    assert [path.name for path in tmp_path.rglob("*")] == ["d", "x"]
    for clear in (lambda: sweep(tmp_path), lambda: sweep_siblings(tmp_path / "d")):
        (tmp_path / ".d.old-abcd1234").mkdir()
        (tmp_path / "d").rename(tmp_path / ".d.old-abcd1234" / "d")  # as a kill between the renames leaves it
        clear()
        assert [path.name for path in tmp_path.rglob("*")] == ["d", "x"]


def test_a_link_stays_and_its_target_is_written(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "there" / "real.txt")
    (tmp_path / "folder").symlink_to(tmp_path / "there")
    assert check_output(tmp_path / "link.txt") == tmp_path / "there" / "real.txt"
    write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "there" / "real.txt").read_text() == "new"
    with atomic_dir(tmp_path / "folder") as made:
        (made / "a").write_text("a")
    assert (tmp_path / "folder").is_symlink() and os.listdir(tmp_path / "there") == ["a"]


def test_a_pipe_gets_the_bytes_and_stays(tmp_path):
    pipe, got = tmp_path / "p", []
    os.mkfifo(pipe)
    for write in (lambda: write_text(pipe, "x"), lambda: write_text(pipe, "y" * 300_000)):
        with pytest.raises(AwError, match="nobody reads"):
            write()
        reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
        os.set_blocking(reading, True)
        writer = threading.Thread(target=write)
        writer.start()
        while not (ready := select.select([reading], [], [], 20)[0]) or (part := os.read(reading, 1 << 16)):
            assert ready, "nothing came"
            got.append(part)
        writer.join()
        os.close(reading)
    assert b"".join(got) == b"x" + b"y" * 300_000
    assert stat.S_ISFIFO(pipe.stat().st_mode) and os.listdir(tmp_path) == ["p"]


@pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() != 0, reason="only root makes device nodes")
def test_a_device_gets_the_bytes_and_stays(tmp_path):
    os.mknod(tmp_path / "n", stat.S_IFCHR | 0o666, os.makedev(1, 3))
    os.mknod(tmp_path / "full", stat.S_IFCHR | 0o666, os.makedev(1, 7))
    try:
        write_text(tmp_path / "n", "gone")
    except PermissionError:
        pytest.skip("device nodes do not open on this file system")
    with pytest.raises(OSError, match="No space left") as raised:
        write_text(tmp_path / "full", "too much")
    assert raised.value.filename == str(tmp_path / "full")
    assert all(stat.S_ISCHR(path.stat().st_mode) for path in tmp_path.iterdir())
    assert sorted(os.listdir(tmp_path)) == ["full", "n"]


def test_what_is_neither_file_nor_pipe_is_refused_and_stays(tmp_path):
    (tmp_path / "d").mkdir()
    (tmp_path / "gone").symlink_to(tmp_path / "nowhere")
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(AwError, match="a file lies there"), atomic_dir(tmp_path / "thesis.txt"):
        pass
    with socket.socket(socket.AF_UNIX) as s:
        s.bind(str(tmp_path / "s"))
    before = {p.name: p.lstat().st_mode for p in tmp_path.iterdir()}
    for name, why in (("d", "a folder lies there"), ("gone", "link to nowhere"), ("s", "socket")):
        with pytest.raises(AwError, match=why):
            write_text(tmp_path / name, "x")
        with pytest.raises(AwError) if name != "d" else contextlib.nullcontext():
            check_output(tmp_path / name)
        with pytest.raises(AwError) if name != "d" else contextlib.nullcontext(), atomic_dir(tmp_path / name):
            pass
    assert {p.name: p.lstat().st_mode for p in tmp_path.iterdir()} == before
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_a_check_before_the_work_makes_nothing(tmp_path):
    assert check_output(tmp_path / "a" / "b" / "c.txt") == tmp_path / "a" / "b" / "c.txt"
    (tmp_path / "file").touch()
    with pytest.raises(AwError, match="file is a file, not a folder"):
        check_output(tmp_path / "file" / "b" / "c.txt")
    assert os.listdir(tmp_path) == ["file"]


def test_a_full_disk_names_the_file_whoever_found_it_full(tmp_path):
    told = "Error while serializing: IoError(Os { code: 28, kind: StorageFull })"
    for error in (OSError(28, "No space left on device"), ValueError(told)):
        with pytest.raises(OSError, match="No space left") as raised, atomic_path(tmp_path / "a.bin"):
            raise error
        assert raised.value.filename == str(tmp_path / "a.bin") and not list(tmp_path.iterdir())


def test_what_killed_writers_of_a_file_left_goes_and_nothing_else(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True
    )
    names = {
        ".3dgs.{}-ab.tmp.sog": False,
        ".3dgs.{}-ab.tmp.spz": True,
        ".other.{}-ab.tmp.sog": True,
        "{}.sog": True,
    }
    for name in names:
        (tmp_path / name.format(done.stdout.strip())).write_text("x")
    (tmp_path / f".3dgs.{os.getpid()}-ab.tmp.sog").write_text("alive")
    sweep_killed(tmp_path / "3dgs.sog")
    assert {n: (tmp_path / n.format(done.stdout.strip())).exists() for n in names} == names
    assert (tmp_path / f".3dgs.{os.getpid()}-ab.tmp.sog").exists()
    with atomic_path(tmp_path / "3dgs.sog") as temporary:  # writers have names of this kind
        assert temporary.name.startswith(f".3dgs.{os.getpid()}-")


def test_of_two_who_make_one_folder_the_second_is_told(tmp_path):
    with (
        pytest.raises(AwError, match="another command made"),
        atomic_dir(tmp_path / "out", replace=False) as second,
    ):
        (second / "b").write_text("second")
        with atomic_dir(tmp_path / "out", replace=False) as first:
            (first / "a").write_text("first")
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "a"]


@pytest.mark.parametrize(
    ("work", "name"),
    [
        ("write_bytes(out / 'a.bin', [bytes(9999)])", "a.bin"),
        ("save(out / 'a.safetensors', {'x': np.zeros(9999)})", "a.safetensors"),
        ("with atomic_dir(out / 'd') as d: write_bytes(d / 'sub' / 'a.bin', [bytes(9999)])", "d/sub/a.bin"),
        ("with atomic_dir(out / 'd') as d: shutil.copyfile(sys.executable, d / 'copy')", "d/copy"),
        ("with atomic_dir(out / 'd') as d, open(d / 'a', 'wb') as f: f.write(bytes(9999)), f.flush()", "d"),
    ],
)
def test_a_file_over_the_limit_of_the_shell_is_named_as_it_was_asked_for(tmp_path, work, name):
    script = (
        "import resource, shutil, sys\nfrom pathlib import Path\nimport numpy as np\n"
        "from ambiguous_wild.core.errors import disk_line\n"
        "from ambiguous_wild.io.files import atomic_dir, write_bytes\n"
        "from ambiguous_wild.splat.checkpoint import save\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\nout = Path(sys.argv[1])\n"
        f"try:\n    {work}\nexcept OSError as error:\n    print(disk_line(error))"
    )
    done = subprocess.run([sys.executable, "-c", script, tmp_path], capture_output=True, text=True)
    advice = "raise ulimit -f, or choose another folder"
    assert done.stdout == f"{tmp_path / name}: File too large; {advice}\n", done.stderr
    assert not list(tmp_path.iterdir())
