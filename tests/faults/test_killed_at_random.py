"""kill -9 at random moments of a command; run again, it ends with the files of an undisturbed run.

A command is killed, with its whole process group, at a random time after its imports, up to KILLS_A_FOLDER
times in one folder; then it runs to its end. After every kill all files with final names must be complete.
After the last run the folder must equal that of an undisturbed run byte by byte, except for times (see
`compare`), with no extra files. AW_KILLS sets how often each command is killed.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.builder.capture_maker import write_capture
from tests.faults.compare import half_written, state
from tests.tiny_scene import write_tiny_scene

pytestmark = pytest.mark.slow
KILLS = int(os.environ.get("AW_KILLS", "4"))
KILLS_A_FOLDER = 4
IMPORTS = 0.3  # share of a short command's time before it works


@dataclass(frozen=True)
class Victim:
    """A command to kill.

    prepare: makes the inputs in a folder, once.
    argv: the command's words from the folder of the inputs and the folder to write into.
    """

    prepare: Callable[[Path], None]
    argv: Callable[[Path, Path], list[str]]


def _tiny_scene(inputs: Path) -> None:
    write_tiny_scene(inputs / "scene")


def _bench(inputs: Path, out: Path) -> list[str]:
    words = ["bench", "--method", "3dgs", "--scene", str(inputs / "scene"), "--iterations", "150"]
    words += ["--threads", "1", "--set", "train.checkpoint_every_s=0.1", "--cache", str(inputs / "cache")]
    return [*words, "-o", str(out / "runs")]


def _grid(inputs: Path, out: Path) -> list[str]:
    """Several methods, two processes."""
    words = ["bench", "--scene", str(inputs / "scene"), "--iterations", "60", "--jobs", "2"]
    for method in ("3dgs", "robustsplat", "refinesplat"):
        words += ["--method", method]
    words += ["--set", "train.checkpoint_every_s=0.1", "--cache", str(inputs / "cache")]
    return [*words, "-o", str(out / "runs")]


def _build(inputs: Path, out: Path) -> list[str]:
    words = ["build-scene", str(inputs / "raw"), "-o", str(out / "scene"), "--factor", "2"]
    return [*words, "--max-features", "500", "--threads", "1", "--name", "walls"]


def _simulate(inputs: Path, out: Path) -> list[str]:
    return ["simulate", "tiny", "-o", str(out / "raw"), "--views", "6", "--width", "96"]


def _runs(inputs: Path) -> None:
    """Two finished runs."""
    _tiny_scene(inputs)
    for seed in ("0", "1"):
        words = ["bench", "--method", "3dgs", "--scene", str(inputs / "scene"), "--iterations", "20"]
        words += ["--threads", "1", "--seed", seed, "--cache", str(inputs / "cache")]
        finish([*words, "-o", str(inputs / "runs")], inputs / "runs.log")


def _board(inputs: Path) -> None:
    _runs(inputs)
    finish(_add(inputs, inputs), inputs / "add.log")


def _add(inputs: Path, out: Path) -> list[str]:
    return ["leaderboard", "add", str(inputs / "runs"), "--board", str(out / "board"), "--dataset", "tiny"]


def _publish(inputs: Path, out: Path) -> list[str]:
    return ["leaderboard", "publish", "--board", str(inputs / "board"), "-o", str(out / "site")]


# To add a command, add a line here.
VICTIMS = {
    "bench": Victim(_tiny_scene, _bench),
    "bench of three methods": Victim(_tiny_scene, _grid),
    "build-scene": Victim(lambda inputs: write_capture(inputs / "raw", 4), _build),
    "simulate": Victim(lambda inputs: None, _simulate),
    "leaderboard add": Victim(_runs, _add),
    "leaderboard publish": Victim(_board, _publish),
}


def start(argv: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """`aw ARGV` in a process group of its own."""
    words = [sys.executable, "-m", "ambiguous_wild.cli.main", *argv]
    with open(log, "ab") as sink:
        return subprocess.Popen(words, stdout=sink, stderr=sink, start_new_session=True)


def finish(argv: Sequence[str], log: Path) -> float:
    """Run to the end; returns seconds."""
    begun = time.monotonic()
    code = start(argv, log).wait()
    assert code == 0, log.read_text(errors="replace")[-400:]
    return time.monotonic() - begun


def kill_after(argv: Sequence[str], log: Path, seconds: float) -> bool:
    """Kill the process and its group after `seconds`; False if it had already ended."""
    process = start(argv, log)
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return process.wait() == -signal.SIGKILL
    return False


@pytest.mark.parametrize("name", VICTIMS)
def test_a_command_killed_at_random_moments_and_run_again_ends_with_the_same_files(name, tmp_path):
    victim, inputs = VICTIMS[name], tmp_path / "inputs"
    inputs.mkdir()
    victim.prepare(inputs)
    for once in ("undisturbed", "twin"):
        (tmp_path / once).mkdir()
        # the first fills caches, so the second says how long it takes
        usual_s = finish(victim.argv(inputs, tmp_path / once), tmp_path / f"{once}.log")
    expected = state(tmp_path / "undisturbed")
    assert state(tmp_path / "twin") == expected
    killed = rounds = 0
    while killed < KILLS:
        dice = random.Random(f"{name} {rounds}")
        out, log = tmp_path / f"round{rounds}", tmp_path / f"round{rounds}.log"
        out.mkdir()
        argv = victim.argv(inputs, out)
        for _ in range(min(KILLS_A_FOLDER, KILLS - killed)):
            if not kill_after(argv, log, dice.uniform(IMPORTS, 1.0) * usual_s):
                break  # it ended before: nothing is left to kill
            killed += 1
            assert half_written(out) == []
        finish(argv, log)
        assert state(out) == expected
        rounds += 1
        assert rounds < 10 * KILLS, "the command ends before it can be killed"
