"""`aw composite`: what it prints, refuses and leaves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.simulate import composite_command as command
from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import folder_lock
from ambiguous_wild.io.scene_folder import load_scene
from tests.io.model_maker import write_scene

NAMES = [f"p{i}.png" for i in range(10)]


@pytest.fixture
def base(tmp_path: Path) -> Path:
    write_scene(tmp_path / "base", NAMES, points=100)
    return tmp_path / "base"


def aw_composite(*words: object) -> str:
    return CliRunner().invoke(command, [str(w) for w in words], catch_exceptions=False).stdout


def test_counts_and_the_next_command(base: Path, tmp_path: Path) -> None:
    said = aw_composite(base, "-o", tmp_path / "my out", "--patches", "--coverage", 0.1, "--pose", "lying")
    assert "8 train photos, 3 distractors cover" in said
    assert f"--scene '{tmp_path / 'my out'}'" in said.splitlines()[-1]
    assert len(load_scene(tmp_path / "my out").train) == 8


def test_json_gives_the_facts_that_lie_in_the_scene(base: Path, tmp_path: Path) -> None:
    said = json.loads(aw_composite(base, "-o", tmp_path / "out", "--patches", "--seed", 5, "--json"))
    facts = json.loads((tmp_path / "out/truth/composite.json").read_text())
    assert said == {k: v for k, v in facts.items() if k != "photos"} and said["config"]["seed"] == 5


def test_what_a_killed_run_left_is_swept_but_nothing_else(base: Path, tmp_path: Path) -> None:
    for name in (".out.tmp-a1", ".out2.tmp-c3"):
        (tmp_path / name).mkdir()
    aw_composite(base, "-o", tmp_path / "out", "--patches")
    assert sorted(p.name for p in tmp_path.iterdir()) == [".out2.tmp-c3", "base", "out"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], "--cutouts FOLDER"),
        (["--cutouts", "nowhere"], "no folder"),
        (["--patches", "--coverage", "2"], "2"),
    ],
)
def test_errors_say_what_to_do(base: Path, tmp_path: Path, words: list[str], expected: str) -> None:
    error = CliRunner().invoke(command, [str(base), "-o", str(tmp_path / "out"), *words]).exception
    assert isinstance(error, AwError) and expected in str(error)


def test_two_runs_do_not_write_one_folder(base: Path, tmp_path: Path) -> None:
    with folder_lock(tmp_path / "out", "aw composite"):
        done = CliRunner().invoke(command, [str(base), "-o", str(tmp_path / "out"), "--patches"])
        assert isinstance(done.exception, AwError) and "being worked on" in str(done.exception)
