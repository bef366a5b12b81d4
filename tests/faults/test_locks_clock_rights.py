"""Two commands on one folder, a clock that jumps, a folder nobody may write in."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest

from ambiguous_wild.cli import main
from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import folder_lock
from tests.faults.small_disks import read_only, small_disk, writable

_HOLD = """
import sys
from pathlib import Path
from ambiguous_wild.io.files import folder_lock
with folder_lock(Path(sys.argv[1]), "aw bench --method 3dgs"):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def holder(folder):
    """A process that holds the folder until it is killed."""
    words = [sys.executable, "-c", _HOLD, str(folder)]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def test_the_second_command_is_told_who_works_and_takes_over_from_the_dead(tmp_path):
    folder = tmp_path / "there"
    with holder(folder) as process:
        with (
            pytest.raises(AwError, match=rf"process {process.pid}.*(wait|another)"),
            folder_lock(folder, "aw bench"),
        ):
            pass
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert (tmp_path / ".there.lock").exists()  # what the dead one leaves holds nobody up
        with folder_lock(folder, "aw bench"):
            pass
    assert list(tmp_path.iterdir()) == []


def aw(capsys, *words):
    """(exit code, lines of the error) of a command in this process."""
    before = sys.argv
    sys.argv = ["aw", *map(str, words)]
    try:
        main.main()
        code = 0
    except SystemExit as end:
        code = end.code
    finally:
        sys.argv = before
    return code, [line for line in capsys.readouterr().err.splitlines() if "error:" in line]


def bench_words(scene, out):
    return ["bench", "--method", "3dgs", "--scene", scene, "--iterations", 5, "--threads", 1, "-o", out]


def test_a_bench_that_meets_another_ends_with_one_line_and_touches_nothing(scene, tmp_path, capsys):
    run = tmp_path / "runs" / "scene" / "3dgs" / "seed0"
    run.parent.mkdir(parents=True)
    with holder(run) as process:
        code, lines = aw(capsys, *bench_words(scene, tmp_path / "runs"))
        assert code == 2
        assert len(lines) == 1 and f"process {process.pid}" in lines[0]
        assert not run.exists()


def test_read_only_folders_end_with_one_line(scene, tmp_path, capsys):
    with small_disk(tmp_path / "disk", 5000) as disk:
        (disk / "raw").mkdir()
        for i in range(3):
            (disk / "raw" / f"{i}.jpg").write_bytes(b"no photo %d" % i)
        read_only(disk)
        commands = {
            "bench": bench_words(scene, disk / "runs"),
            "build-scene": ["build-scene", disk / "raw", "-o", disk / "scene", "--threads", 1],
            "simulate": ["simulate", "tiny", "-o", disk / "capture", "--views", 6, "--width", 96],
        }
        for name, words in commands.items():
            code, lines = aw(capsys, *words)
            assert (code, len(lines)) == (2, 1), name
            assert "Read-only file system" in lines[0], lines
        assert [p.name for p in disk.iterdir()] == ["raw"]
        writable(disk)


def test_a_clock_that_jumps_changes_no_result(scene, tmp_path, capsys, monkeypatch):
    from tests.faults.compare import state

    assert aw(capsys, *bench_words(scene, tmp_path / "steady" / "runs"))[0] == 0
    dice = random.Random(0)
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: dice.uniform(0, 4e9))
        patch.setattr(time, "time_ns", lambda: int(dice.uniform(0, 4e18)))
        code, lines = aw(capsys, *bench_words(scene, tmp_path / "jumping" / "runs"))
    assert (code, lines) == (0, [])
    assert state(tmp_path / "jumping") == state(tmp_path / "steady")
