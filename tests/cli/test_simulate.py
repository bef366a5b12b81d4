"""`aw simulate`: what it prints, refuses and leaves."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.simulate import simulate_command as command
from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import folder_lock
from ambiguous_wild.simulate.presets import PRESETS


def aw_simulate(*words: object) -> str:
    return CliRunner().invoke(command, [str(w) for w in words], catch_exceptions=False).stdout


def test_list_names_every_preset() -> None:
    lines = aw_simulate("--list").splitlines()
    assert [line.split()[0] for line in lines] == list(PRESETS)
    assert [row["name"] for row in json.loads(aw_simulate("--list", "--json"))] == list(PRESETS)


def test_counts_and_the_next_command(tmp_path: Path) -> None:
    words = ("tiny", "-o", tmp_path / "raw", "--views", 4, "--width", 64)
    first = aw_simulate(*words)
    assert "wrote" in first and "4 train and 2 test photos of 64x36" in first
    assert f"next: aw build-scene {tmp_path / 'raw'}" in first
    assert len(list((tmp_path / "raw/train").iterdir())) == 4
    assert "already there, unchanged" in aw_simulate(*words)
    said = json.loads(aw_simulate(*words, "--json"))
    assert said["reused"] and said["preset"] == "tiny" and 0 < said["occlusion"]["mean"] < 1


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["courtyrad", "-o", "x"], "did you mean 'courtyard'"),
        (["tiny"], "-o raw"),
        ([], "name a capture"),
        (["tiny", "-o", "x", "--views", "1"], "3 to 2000"),
    ],
)
def test_errors_say_what_to_do(words: list[str], expected: str) -> None:
    error = CliRunner().invoke(command, words).exception
    assert isinstance(error, AwError) and expected in str(error)


def test_the_next_command_can_be_pasted_where_the_path_has_spaces(tmp_path: Path) -> None:
    out = tmp_path / "my raw"
    said = aw_simulate("tiny", "-o", out, "--views", 4, "--width", 64)
    words = shlex.split(said.splitlines()[-1])
    assert words[3] == str(out) and words[5] == f"{out}-scene"


def test_what_a_killed_run_left_is_swept_but_nothing_else(tmp_path: Path) -> None:
    for name in (".raw.tmp-a1", ".raw.old-b2", ".raw2.tmp-c3", ".raw.tmpl"):
        (tmp_path / name / "train").mkdir(parents=True)
    aw_simulate("tiny", "-o", tmp_path / "raw", "--views", 4, "--width", 64)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".raw.tmpl", ".raw2.tmp-c3", "raw"]


def test_two_runs_do_not_write_one_folder(tmp_path: Path) -> None:
    (tmp_path / ".raw.tmp-a1").mkdir()
    with folder_lock(tmp_path / "raw", "aw simulate tiny"):
        done = CliRunner().invoke(command, ["tiny", "-o", str(tmp_path / "raw")])
        assert isinstance(done.exception, AwError) and "being worked on" in str(done.exception)
    assert (tmp_path / ".raw.tmp-a1").is_dir()


@pytest.mark.parametrize("out", ["/dev/null/x", "{}/file/x", "/proc/x"])
def test_an_output_that_cannot_be_is_found_before_the_work(
    out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("x")
    monkeypatch.setattr(
        "ambiguous_wild.simulate.capture_writer.simulate", lambda *_: pytest.fail("worked first")
    )
    error = CliRunner().invoke(command, ["tiny", "-o", out.format(tmp_path)]).exception
    assert isinstance(error, AwError) and "cannot write" in str(error)
