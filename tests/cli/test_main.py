"""The front door: help, exit codes, one red line for what a user can mend."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import click
import cv2
import numpy as np
import pytest

from ambiguous_wild import __version__
from ambiguous_wild.cli.main import COMMANDS
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.weight_files import read_tensors
from ambiguous_wild.io.terminal import say
from tests.command_line import aw
from tests.harness.fake_runs import fake_result, save


def test_help_lists_every_command_and_version_prints() -> None:
    done = aw("--help")
    assert done.returncode == 0
    for name, (_, text) in COMMANDS.items():
        assert name in done.stdout and text.split()[0] in done.stdout
        assert f"{name} [OPTIONS]" in aw(name, "--help").stdout
    assert __version__ in aw("--version").stdout


@pytest.mark.parametrize("words", [(), ("study",), ("leaderboard",), ("weights",)])
def test_a_group_alone_prints_its_help(words: tuple[str, ...]) -> None:
    done = aw(*words)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == aw(*words, "--help").stdout == aw("help", *words).stdout
    assert done.stdout.count("\n") > 5


def test_a_reader_that_leaves_is_no_error() -> None:
    code = f"{sys.executable} -m ambiguous_wild.cli.main methods --json | head -n 1; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == ["[", "0"] and done.stderr == ""


@pytest.mark.parametrize(
    ("line", "code", "expected"),
    [
        ("table . >&-", 2, "error: "),
        ("methods >&-", 0, ""),
        ("methods >&- 2>&-", 0, ""),
        ("table . > /dev/full", 2, "error: "),
        ("methods > /dev/full", 2, "No space left on device; free space"),
    ],
)
def test_a_closed_or_full_output_is_no_traceback(line: str, code: int, expected: str, tmp_path: Path) -> None:
    command = f"{sys.executable} -m ambiguous_wild.cli.main {line}"
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, cwd=tmp_path, env=env)
    assert done.returncode == code and expected in done.stderr and done.stderr.count("\n") <= 1, done.stderr


def test_a_file_that_may_not_be_written_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    runs = save(tmp_path / "runs", fake_result("3dgs"))
    monkeypatch.setattr("tempfile.mkstemp", refuse)
    done = aw("table", runs, "-o", tmp_path / "t.tex")
    assert done.returncode == 2
    assert "t.tex: Permission denied; change its permissions, or choose another folder" in done.stderr


@pytest.mark.parametrize(
    "line",
    [
        "methods", "methods refinesplat", "weights list", "fetch", "simulate", "plan none", "screen none",
        "leaderboard --help", "bench --help", "table {runs}", "table {runs} --metric all",
        "cost {runs} -o {out}",
        "export {runs}",
    ],
)  # fmt: skip
def test_no_word_is_broken_at_80_columns(line: str, tmp_path: Path) -> None:
    runs = save(tmp_path / "runs", *(fake_result(m, seed=s) for m in ("3dgs", "refinesplat") for s in (0, 1)))
    words = line.format(runs=runs, out=tmp_path / "cost").split()
    whole, narrow = aw(*words), aw(*words, columns=80)
    out, err = click.unstyle(narrow.stdout), click.unstyle(narrow.stderr)
    for text in (out, err):
        for shown in text.splitlines():
            # paths and commands are never broken, and every column of a table was asked for
            long = "aw " in shown or "/" in shown or "--metric" in line
            assert (len(shown) <= 80 or long) and "\\n" not in shown, shown
    if words[0] not in ("table", "cost", "methods") and "--help" not in words:  # these choose other columns
        assert (out.split(), err.split()) == (whole.stdout.split(), whole.stderr.split())


@pytest.mark.parametrize("value", ["abc", "0", "-1", "1.5"])
def test_a_number_of_threads_that_is_none_is_named(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    done = aw("methods")
    assert done.returncode == 2 and f"OMP_NUM_THREADS is '{value}'" in done.stderr
    monkeypatch.setenv("OMP_NUM_THREADS", "4,2")
    assert aw("methods").returncode == 0


FULL = OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))


@pytest.mark.parametrize("error", [MemoryError(), FULL, ImportError("failed to map segment")])
def test_too_little_memory_is_said_so(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("safetensors.torch.load_file", fails)
    if not isinstance(error, ImportError):
        (tmp_path / "a.safetensors").touch()
        with pytest.raises(AwError, match="cannot be read as weights"):  # it asks for more than it holds
            read_tensors(tmp_path / "a.safetensors")
        monkeypatch.setattr("ambiguous_wild.core.weight_files._fits", lambda path: False)
        with pytest.raises(MemoryError):  # the file of weights is whole
            read_tensors(Path("a.safetensors"))
    monkeypatch.setattr("ambiguous_wild.cli.main.cli.main", fails)
    done = aw("methods")
    assert done.returncode == 2 and "too little memory" in done.stderr and done.stderr.count("\n") == 1


def test_names_cannot_control_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    done = aw("view", "runs\x1b[2J")
    assert done.returncode == 2 and "runs\\x1b[2J" in done.stderr and "\x1b[2J" not in done.stderr
    say("drawing 9 frames of 3dgs\n\x1b[2J")
    assert capsys.readouterr().err == "drawing 9 frames of 3dgs\\n\\x1b[2J\n"


@pytest.mark.parametrize("command", ["screen", "build-scene", "capture"])
def test_photos_whose_names_are_no_text_are_named(command: str, tmp_path: Path) -> None:
    for i in range(4):
        name = os.fsencode(tmp_path) + b"/raw/\xff%d.png" % i
        (tmp_path / "raw").mkdir(exist_ok=True)
        photo = cv2.imencode(".png", np.full((40, 40, 3), i, np.uint8))[1]
        Path(os.fsdecode(name)).write_bytes(photo.tobytes())
    done = aw(command, tmp_path / "raw", *([] if command == "screen" else ["-o", tmp_path / "out"]))
    assert done.returncode == 2 and "not UTF-8: '\\udcff0.png'" in done.stderr and "rename" in done.stderr
