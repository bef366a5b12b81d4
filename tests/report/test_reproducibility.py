"""The statement of a paper: what runs have in common, in what they differ, and their fewest commands."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import pytest
import yaml

from ambiguous_wild.harness.grid import plan_cells
from ambiguous_wild.harness.result_file import config_identity, write_result
from ambiguous_wild.report.reproducibility import statement, to_latex, to_markdown, to_text
from ambiguous_wild.splat.train_config import TrainConfig
from tests.command_line import aw
from tests.harness.fake_runs import fake_result

MACHINE = {
    "ambiguous_wild": "0.1.0", "python": "3.12.1", "platform": "Linux", "cpu": "Xeon", "commit": "ab" * 20,
    "packages": {"numpy": "2.1.0", "gsplat": None},
}  # fmt: skip


@pytest.fixture
def runs(scene: Path, tmp_path: Path):
    """Makes finished runs of the tiny scene, with fake results: of each method, with two seeds."""

    def make(*methods: str, train: TrainConfig = TrainConfig(iterations=70), **changes: object) -> Path:  # noqa: B008
        for cell in plan_cells(list(methods), [scene], [0, 1], train):
            folder = tmp_path / "runs" / cell.scene.name / cell.method.name / f"seed{cell.train.seed}"
            folder.mkdir(parents=True)
            config = dict(cell.config) | {"config_hash": cell.identity}
            (folder / "config.yaml").write_text(yaml.safe_dump(config))
            facts = {"facts": {"length": "70 iterations"}} if train.budget_s is None else {}
            own = {
                "options": cell.result()["options"],
                "config_hash": cell.identity,
                "scene_hash": cell.scene_id,
            }
            known = {"version": config["version"], "environment": MACHINE, "code_hash": "c" * 64}
            result = fake_result(cell.method.name, cell.scene.name, cell.train.seed) | own | known | facts
            result["cost"]["iterations"] = 70
            write_result(folder / "metrics.json", result | changes)
        return tmp_path / "runs"

    return make


def test_runs_of_one_grid_are_one_paragraph_and_one_command(runs, scene: Path) -> None:
    said = statement([runs("3dgs", "absgs")])
    text = " ".join(said.sentences)
    assert "4 runs of 2 methods (3dgs and absgs), with seeds 0 and 1" in text
    assert "trained for 70 iterations" in text and f"(commit {'ab' * 20}, code {'c' * 12})" in text
    assert "Python 3.12.1 and numpy 2.1.0" in text and "gsplat" not in text
    assert "All ran on Xeon (2 threads, Linux)" in text and "repeat bit for bit" in text
    (line,) = said.commands
    words = shlex.split(line)
    assert [words[k + 1] for k, word in enumerate(words) if word == "--method"] == ["3dgs", "absgs"]
    assert [words[k + 1] for k, word in enumerate(words) if word == "--seed"] == ["0", "1"]
    for form in (to_text, to_markdown, to_latex):
        assert str(scene.parent) not in form(said) and "/tmp" not in form(said)


def test_the_command_makes_the_same_cells(runs, scene: Path) -> None:
    from ambiguous_wild.cli.bench import command

    (line,) = statement([runs("refinesplat@mask=truth")]).commands
    given = command.make_context("bench", shlex.split(line)[2:]).params
    train = TrainConfig(iterations=given["iterations"])
    again = plan_cells(given["methods"], [scene], given["seeds"], train, settings=given["settings"])
    said = [yaml.safe_load(p.read_text())["config_hash"] for p in sorted(runs().rglob("config.yaml"))]
    assert [cell.identity for cell in again] == said


def test_masks_of_a_folder_are_given_as_they_were_typed(runs, scene: Path, tmp_path: Path) -> None:
    (tmp_path / "sam").mkdir()
    for photo in (scene / "images").iterdir():
        (tmp_path / "sam" / photo.name).write_bytes(photo.read_bytes())
    names = [f"{host}@mask=masks:{tmp_path / 'sam'}" for host in ("3dgs", "absgs")]
    said = statement([runs(*names, reproduce=f"aw bench --method {names[0]}")])
    (line,) = said.commands
    assert (
        "--method 3dgs --mask sam --method absgs" in line or "--method 3dgs --method absgs --mask sam" in line
    )
    assert "Masks given as files, with the SHA-256 of all in a folder: sam " in " ".join(said.sentences)
    assert "Methods in files" not in " ".join(said.sentences)


def test_where_runs_differ_it_says_which_have_what(runs) -> None:
    runs("3dgs")
    runs("absgs", environment=MACHINE | {"cpu": "EPYC", "commit": "cd" * 20})
    said = statement([runs("gs-w", train=TrainConfig(budget_s=60.0), facts={"length": "60 s"})])
    text = " ".join(said.sentences)
    assert (
        "different machines: Xeon (2 threads, Linux) for 3dgs and gs-w; EPYC (2 threads, Linux) for absgs"
        in text
    )
    assert f"commit {'cd' * 20}" in text and "The code differs between runs" in text
    assert "70 iterations for 3dgs and absgs; 60 s for gs-w" in text
    assert "3dgs and absgs repeat bit for bit; gs-w do not, as they end by the clock" in text
    assert len(said.commands) == 2 and "--budget 60s" in said.commands[1]
    other = statement([runs("mip-splatting", facts={"no_effects": "an external program"})])
    assert "as they end by the clock or are of another program" in " ".join(other.sentences)


def test_runs_that_went_on_with_corrections_do_not_repeat(runs) -> None:
    for path in (folder := runs("3dgs")).rglob("config.yaml"):
        more = {"continued": [{"iteration": 9, "config_hash": "a"}], "corrections": {"sha256": "a" * 64}}
        config = yaml.safe_load(path.read_text()) | more
        config["config_hash"] = config_identity(config)
        path.write_text(yaml.safe_dump(config))
        result = json.loads((path.parent / "metrics.json").read_text())
        write_result(path.parent / "metrics.json", result | {"config_hash": config["config_hash"]})
    runs("absgs")
    said = statement([folder])
    text = " ".join(said.sentences)
    assert "Masks of 3dgs were corrected by hand." in text
    assert "absgs repeat bit for bit; 3dgs do not, as they went on from shorter ones" in text
    assert ["--corrections CORRECTIONS.json" in line for line in said.commands] == [True, False]


def test_failures_and_runs_without_settings_are_named(runs, tmp_path: Path) -> None:
    folder = runs("3dgs", "absgs")
    for name in ("3dgs/seed1/config.yaml", "absgs/seed0/metrics.json"):
        (folder / "scene" / name).unlink()
    text = " ".join(statement([folder]).sentences)
    assert "1 run failed, did not end or changed since (absgs on scene)" in text
    assert "The command of 1 of 3 runs is not known" in text
    (tmp_path / "none").mkdir()
    assert "no run in" in aw("statement", tmp_path / "none").stderr


def test_a_copy_of_a_run_is_not_counted(runs, tmp_path: Path) -> None:
    shutil.copytree(runs("3dgs") / "scene" / "3dgs", tmp_path / "runs" / "copy")
    done = aw("statement", tmp_path / "runs")
    assert done.returncode == 2 and "is a copy of" in done.stderr


def test_the_suffix_names_the_format(runs, tmp_path: Path) -> None:
    folder = runs("3dgs@mask=truth", environment=MACHINE | {"cpu": "50 % \\evil{} <b>"})
    for suffix, begins, safe in ((".tex", "", r"50 \% \textbackslash{}evil"), (".md", "", "&lt;b&gt;")):
        done = aw("statement", folder, "-o", tmp_path / f"s{suffix}")
        assert done.returncode == 0, done.stderr
        text = (tmp_path / f"s{suffix}").read_text()
        assert safe in text and text.startswith(begins)
    assert r"-{}-method 3dgs@mask=truth" in (tmp_path / "s.tex").read_text()
    assert "\n    aw bench --method" in aw("statement", folder).stdout
    wrong = aw("statement", folder, "-o", tmp_path / "s.pdf")
    assert wrong.returncode == 2 and "no format is known for .pdf" in wrong.stderr
    assert not (tmp_path / "s.pdf").exists()
