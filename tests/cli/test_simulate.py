"""`aw simulate` and `aw composite`: what they print and leave; their mistakes are in test_mistakes.py."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from ambiguous_wild.io.files import folder_lock
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.simulate.presets import PRESETS
from tests.command_line import aw
from tests.io.model_maker import write_scene

TINY = ("simulate", "tiny", "--views", 4, "--width", 64)
NAMES = [f"p{i}.png" for i in range(10)]


@pytest.fixture
def commands(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[object, ...]]:
    base = tmp_path_factory.mktemp("base")
    write_scene(base, NAMES, points=100)
    return {"simulate": TINY, "composite": ("composite", base, "--patches")}


def printed(*words: object) -> str:
    done = aw(*words)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_without_a_name_every_preset_is_listed() -> None:
    assert [line.split()[0] for line in printed("simulate").splitlines()] == list(PRESETS)
    assert [row["name"] for row in json.loads(printed("simulate", "--json"))] == list(PRESETS)


def test_a_capture_is_counted_and_the_next_command_can_be_pasted(tmp_path: Path) -> None:
    out = tmp_path / "my raw"
    first = printed(*TINY, "-o", out)
    assert "wrote" in first and "4 train and 2 test photos of 64x36" in first
    words = shlex.split(first.splitlines()[-1])
    assert words[:4] == ["next:", "aw", "build-scene", str(out)] and words[5] == f"{out}-scene"
    assert len(list((out / "train").iterdir())) == 4 and (out / "truth/sheet.jpg").is_file()
    assert "already there, unchanged" in printed(*TINY, "-o", out)
    facts = json.loads(printed(*TINY, "-o", out, "--json"))
    assert facts["reused"] and facts["preset"] == "tiny" and 0 < facts["occlusion"]["mean"] < 1
    assert "wrote" in printed(*TINY, "-o", out, "--seed", 1, "--overwrite")  # its sheet is its own


def test_a_composite_is_counted_and_its_facts_lie_in_the_scene(commands, tmp_path: Path) -> None:
    out = tmp_path / "my out"
    text = printed(*commands["composite"], "-o", out, "--coverage", 0.1, "--pose", "lying")
    assert "8 train photos, 3 distractors cover" in text
    assert f"--scene '{out}'" in text.splitlines()[-1]
    assert len(load_scene(out).train) == 8
    facts = json.loads(printed(*commands["composite"], "-o", tmp_path / "out", "--seed", 5, "--json"))
    saved = json.loads((tmp_path / "out/truth/composite.json").read_text())
    assert facts == {k: v for k, v in saved.items() if k != "photos"} and facts["config"]["seed"] == 5


@pytest.mark.parametrize("name", ["simulate", "composite"])
def test_what_a_killed_run_left_is_swept_but_nothing_else(name: str, commands, tmp_path: Path) -> None:
    for folder in (".out.tmp-a1", ".out.old-b2", ".out2.tmp-c3", ".out.tmpl"):
        (tmp_path / folder / "train").mkdir(parents=True)
    with folder_lock(tmp_path / "out", f"aw {name}"):  # two runs do not write one folder
        done = aw(*commands[name], "-o", tmp_path / "out")
        assert done.returncode == 2 and "being worked on" in done.stderr
    assert (tmp_path / ".out.tmp-a1").is_dir()
    printed(*commands[name], "-o", tmp_path / "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == [".out.tmpl", ".out2.tmp-c3", "out"]
