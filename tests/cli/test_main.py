"""The front door: help, exit codes, one red line for what a user can mend."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ambiguous_wild import __version__
from ambiguous_wild.cli.main import COMMANDS, SECTIONS
from tests.command_line import aw


def typed(*words: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own, as a shell starts it."""
    command = [sys.executable, "-m", "ambiguous_wild.cli.main", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_help_lists_every_command_and_version_prints() -> None:
    done = typed("--help")
    assert done.returncode == 0
    for name, (_, text) in COMMANDS.items():
        assert name in done.stdout and text.split()[0] in done.stdout
    assert __version__ in typed("--version").stdout
    wrong = typed("tabel")
    assert wrong.returncode == 2 and wrong.stderr.startswith("error: ") and wrong.stdout == ""


def test_every_command_is_in_one_section() -> None:
    assert sorted(name for names in SECTIONS.values() for name in names) == sorted(COMMANDS)


@pytest.mark.parametrize("words", [(), ("study",), ("leaderboard",), ("weights",)])
def test_a_group_alone_prints_its_help(words: tuple[str, ...]) -> None:
    done = typed(*words)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == typed(*words, "--help").stdout == typed("help", *words).stdout
    assert done.stdout.count("\n") > 5


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help(name: str) -> None:
    done = aw(name, "--help")
    assert done.returncode == 0, done.stderr
    assert f"{name} [OPTIONS]" in done.stdout
    assert "--help" in done.stdout


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["tabel"], "did you mean 'table'?"),
        (["table"], "Missing argument 'RUNS...'"),
        (["table", "nowhere"], "no folder of runs nowhere"),
        (["table", ".", "--format", "pdf"], "pdf"),
        (["methods", "--plugin", "mine.py"], "no plugin file mine.py"),
    ],
)
def test_a_users_mistake_is_one_line_and_exit_code_2(words: list[str], expected: str, tmp_path: Path) -> None:
    done = aw(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert expected in done.stderr and done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


def test_a_reader_that_leaves_is_no_error() -> None:
    code = f"{sys.executable} -m ambiguous_wild.cli.main methods --json | head -n 1; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == ["[", "0"] and done.stderr == ""
