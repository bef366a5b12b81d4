"""Specs as YAML: what is printed reads back the same; what is wrong is said in one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.simulate import command
from ambiguous_wild.core import AwError
from ambiguous_wild.simulate.check import PICTURES, SHEET_NAMES
from ambiguous_wild.simulate.presets import PRESETS
from ambiguous_wild.simulate.spec_file import dump_spec, parse_spec, read_spec
from ambiguous_wild.simulate.world import POSTERS, SHEETS

RED = "{name: a, kind: visitor, texture: cloth, ambiguity: none}"


def test_every_preset_survives_the_trip_through_yaml() -> None:
    for spec in PRESETS.values():
        text = dump_spec(spec)
        assert parse_spec(text) == spec
        assert dump_spec(parse_spec(text)) == text


def test_there_are_at_least_twelve_presets_beside_the_courtyards() -> None:
    assert sum(not name.startswith("courtyard") and name != "tiny" for name in PRESETS) >= 12


def test_a_printed_spec_makes_the_same_capture(tmp_path: Path) -> None:
    words = ["walkers", "--views", "3", "--width", "64"]
    run = CliRunner()
    text = run.invoke(command, [*words, "--print-spec"], catch_exceptions=False).stdout
    (tmp_path / "own.yaml").write_text(text)
    run.invoke(command, [*words, "-o", str(tmp_path / "raw")], catch_exceptions=False)
    again = run.invoke(
        command, [str(tmp_path / "own.yaml"), "-o", str(tmp_path / "raw")], catch_exceptions=False
    )
    assert "already there, unchanged" in again.stdout and (tmp_path / "raw/truth/sheet.jpg").is_file()


def test_what_is_left_out_is_as_in_the_courtyard() -> None:
    spec = parse_spec("name: mine\neffects: {jpeg: {}}\n")
    assert spec.radius_m == PRESETS["courtyard"].radius_m and spec.distractors == ()
    assert spec.effects.jpeg is not None and spec.effects.jpeg.quality == (30, 55)
    assert spec.effects.defocus is None and spec.designed.ambiguity == "unstated"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("effects: {iso_niose: {}}", "unknown effect 'iso_niose': did you mean 'iso_noise'"),
        ("effects: {jpeg: }", "effects.jpeg: {} for its defaults"),
        ("effects: {jpeg: {qualtiy: [1, 2]}}", "did you mean 'quality'"),
        ("effects: {jpeg: {quality: [0, 2]}}", "effects.jpeg.quality: between 1 and 95, got 0"),
        ("effects: {iso_noise: {iso: [900, 100]}}", "the smaller number first"),
        ("effects: {specular: {textures: [stnoe]}}", "did you mean 'stone'"),
        ("effects: [jpeg]", "one 'effect: {}' a line"),
        ("widht: 100", "did you mean 'width'"),
        ("width: -5", "width: between 64 and 4096, got -5"),
        ("width: [1, 2]", "width: expected int"),
        ("width: .nan", "width"),
        ("width: 100\nwidth: 200", "line 2: the key 'width' is there twice"),
        ("samples: 5", "a square number"),
        ("name: ../up", "letters, digits"),
        ("zoom: [2, 1]", "the smaller number first"),
        ("distractors: {kind: ball}", "distractors: a list"),
        ("distractors: [{kind: bal, name: a, texture: cloth, ambiguity: none}]", "did you mean 'ball'"),
        (
            "distractors: [{kind: ball, texture: cloth, ambiguity: none}]",
            "a distractor of the spec lacks 'name'",
        ),
        (f"distractors: [{RED.replace('cloth', 'clohT')}]", "did you mean 'cloth'"),
        (f"distractors: [{RED[:-1]}, size: -1}}]", "distractors[0].size: between 0.02 and 10, got -1"),
        (f"distractors: [{RED[:-1]}, path: walk}}]", "a walk needs two corners"),
        (f"distractors: [{RED[:-1]}, path: wlak}}]", "did you mean 'walk'"),
        ("world: {things: [{kind: box, texture: stone, at_m: [0, 0, 0], size_m: [1, -1, 1]}]}", "size_m"),
        ("world: {things: [{kind: box, texture: marble, at_m: [0, 0, 0]}]}", "unknown texture"),
        ("world: {furnitur: false}", "did you mean 'furniture'"),
        ("designed: {effects: [maks]}", "did you mean 'masks'"),
        ("a: &x [1]\nb: *x", "line 2: aliases"),
        ("!!python/object/apply:os.system [ls]", "not YAML"),
        ("width: [1, 2", "not YAML in line"),
        ("- 1", "'key: value' lines"),
        ("", "'key: value' lines"),
        ("? [1, 2]\n: 3", "not YAML"),
    ],
)
def test_a_bad_spec_is_said_in_one_line_and_writes_nothing(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    done = CliRunner().invoke(command, [str(path), "-o", str(tmp_path / "raw")])
    assert isinstance(done.exception, AwError) and done.exception.exit_code == 2
    message = str(done.exception)
    assert expected in message and "\n" not in message and str(path) in message
    assert list(tmp_path.iterdir()) == [path]


def test_files_that_are_no_text_are_refused(tmp_path: Path) -> None:
    with pytest.raises(AwError, match="No such file"):
        read_spec(tmp_path / "none.yaml")
    (tmp_path / "x.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(AwError, match="not UTF-8"):
        read_spec(tmp_path / "x.yaml")
    with pytest.raises(AwError, match="Is a directory"):
        read_spec(tmp_path)


def test_the_names_that_a_spec_may_use_are_those_that_the_world_bakes() -> None:
    assert tuple(SHEETS) == SHEET_NAMES and tuple(f"poster_{p}" for p in POSTERS) == PICTURES
