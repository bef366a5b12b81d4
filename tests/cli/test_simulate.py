"""`aw simulate`: what it prints, refuses and leaves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.simulate import command
from ambiguous_wild.core import AwError
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
