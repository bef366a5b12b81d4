"""A study in a file: what a command writes makes the same cells again; a bad file is one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml

from ambiguous_wild.harness import grid
from ambiguous_wild.harness.cell import CellReport
from ambiguous_wild.splat import calibration
from tests.command_line import aw

RECIPE = """
from dataclasses import dataclass
from ambiguous_wild.splat.method_hooks import MethodHooks
@dataclass(frozen=True)
class Config:
    sh_degree: int = 2
def build(config: Config) -> MethodHooks:
    return MethodHooks(sh_degree=config.sh_degree)
"""
PLUGIN = f"""{RECIPE}
from ambiguous_wild.methods import MethodEntry, register
register(MethodEntry('mine', 'of my own', build, config=Config))
"""


@pytest.fixture
def project(scene: Path, tmp_path: Path) -> Path:
    """A folder of a user: a scene, and methods in files."""
    (tmp_path / "scene").symlink_to(scene)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "recipe.py").write_text(RECIPE)
    (tmp_path / "own" / "plugin.py").write_text(PLUGIN)
    shutil.copytree(scene / "images", tmp_path / "sam")  # any pictures under the photos' names, as masks
    return tmp_path


@pytest.fixture
def planned(monkeypatch: pytest.MonkeyPatch):
    """The cells of a command, which trains nothing."""
    cells = []

    def run_cells(asked, output, options, callbacks):
        cells[:] = asked
        plan.config = dict(asked[0].config)  # here, as its paths are those of this folder
        reports = []
        for cell in asked:
            callbacks.started(cell, grid.cell_folder(output, cell))
            reports.append(CellReport(grid.cell_folder(output, cell), "skipped"))
        return reports

    monkeypatch.setattr(grid, "run_cells", run_cells)
    monkeypatch.setattr(calibration, "prepare_cpu", lambda *_: None)

    def plan(*words: object, cwd: Path) -> list[tuple[str, str]]:
        cells.clear()
        done = aw("bench", *words, cwd=cwd)
        assert done.returncode == 0, done.stderr
        return [(grid.cell_folder(Path(), cell).as_posix(), cell.identity) for cell in cells]

    return plan


STUDIES = [
    "--method 3dgs,refinesplat --seed 0 --seed 2 --iterations 9 --set refinesplat.lambda_cr=0.125",
    "--method 3dgs --budget 1m --budget 3m --effects none --effects exposure,antialias --protocol half",
    "--method own/recipe.py:build,3dgs@mask=refinesplat --max-gaussians 900 --set build.sh_degree=1",
    "--method mine --plugin own/plugin.py --mask truth --resolution full --set train.on_nonfinite=rollback",
    "--method 3dgs@mask=own/recipe.py:build --set build.sh_degree=1 --set train.probes=3 --device cpu",
    "--method 3dgs --mask sam",
]


@pytest.mark.parametrize("words", STUDIES)
def test_the_file_of_a_command_makes_the_same_cells(words: str, project: Path, planned) -> None:
    effects = () if "--effects" in words else ("--effects", "none")
    first = planned("--scene", "scene", *words.split(), *effects, "-o", "out/runs", cwd=project)
    file = project / "out" / "runs" / "study.yaml"
    text = file.read_text()
    assert first and str(project) not in text  # it holds no path of this machine
    (project / "elsewhere").mkdir()
    assert planned(file, "-o", "new", cwd=project / "elsewhere") == first
    assert planned(file, cwd=project / "elsewhere") == first
    assert file.read_text() == text and not file.with_name("study-2.yaml").exists()


def test_the_command_line_beats_the_file_which_beats_the_default(project: Path, planned) -> None:
    (project / "mine.yaml").write_text(
        "method: refinesplat\nscene: scene\nseed: [1, 2]\niterations: 30\neffects: none\n"
        "set: {refinesplat.lambda_cr: 0.5, train.probes: 4}\n"
    )
    folders = [folder for folder, _ in planned("mine.yaml", "--seed", 7, cwd=project)]
    assert folders == ["scene/refinesplat/seed7"]
    typed = ["--method", "refinesplat", "--scene", "scene", "--effects", "none", "--seed", 1]
    typed += ["--set", "refinesplat.lambda_cr=0.5"]
    # a length of the other kind replaces the file's, and settings are added to it
    for added in (["--iterations", 40], ["--budget", "1m", "--set", "refinesplat.mask_every=8"]):
        same = planned("mine.yaml", "--seed", 1, *added, cwd=project)
        assert same == planned(*typed, *added, cwd=project)


def test_commands_into_one_folder_share_a_file_where_they_are_one_grid(project: Path, planned) -> None:
    def run(*words: object) -> dict[str, dict]:
        common = ("--scene", "scene", "--iterations", 5, "--effects", "none", "-o", "runs")
        planned(*words, *common, cwd=project)
        return {p.name: yaml.safe_load(p.read_text()) for p in sorted((project / "runs").glob("*.yaml"))}

    run("--method", "3dgs")
    run("--method", "refinesplat")
    both = run("--method", "3dgs,refinesplat", "--seed", 1)
    assert list(both) == ["study.yaml"]
    assert both["study.yaml"]["method"] == ["3dgs", "refinesplat"] and both["study.yaml"]["seed"] == [0, 1]
    assert run("--method", "3dgs", "--seed", 1) == both  # a part of it
    other = run("--method", "absgs", "--seed", 5)  # would add runs that nobody made
    assert list(other) == ["study-2.yaml", "study.yaml"] and other["study.yaml"] == both["study.yaml"]
    assert other["study-2.yaml"]["method"] == ["absgs"]


def test_files_of_others_stay_as_they_are(project: Path, planned) -> None:
    runs = project / "runs"
    runs.mkdir()
    (runs / "study.yaml").write_text("notes: mine\n")
    words = ("--method", "3dgs", "--scene", "scene", "--iterations", 5, "--effects", "none")
    planned(*words, cwd=project)
    (runs / "study-2.yaml").write_text((runs / "study-2.yaml").read_text() + "# as in the paper\n")
    before = (runs / "study-2.yaml").read_text()
    planned(*words, "--seed", 3, cwd=project)
    assert (runs / "study.yaml").read_text() == "notes: mine\n"
    assert (runs / "study-2.yaml").read_text() == before
    assert yaml.safe_load((runs / "study-3.yaml").read_text())["seed"] == [3]


def test_a_changed_study_trains_what_is_missing_and_names_what_it_left(scene: Path, tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(
        f"method: 3dgs\nscene: {scene}\nseed: [0, 1]\niterations: 5\neffects: none\noutput: runs\n"
        "pictures: false\nset: {train.probes: 0}\n"
    )
    assert "2 trained" in aw("bench", file).stderr
    file.write_text(file.read_text().replace("[0, 1]", "[1, 2]"))
    again = aw("bench", file).stderr
    assert "2 runs: 1 kept, 1 trained" in again or "2 runs: 1 trained, 1 kept" in again
    assert "1 run in" in again and f"not of {file}" in again and "scene/3dgs/seed0" in again


@pytest.mark.parametrize(
    "words",
    [
        "--method 3dgs --iterations 7 --set train.checkpoint_every_s=3",
        "--method refinesplat --iterations 7 --seed 3 --resolution full --max-gaussians 700",
        "--method robustsplat@mask=refinesplat --budget 90.5s --set refinesplat.lambda_cr=0.5",
        "--method refinesplat+2passes --iterations 9 --effects exposure,antialias --protocol half",
    ],
)
def test_the_config_of_a_run_makes_the_same_run(words: str, scene: Path, tmp_path: Path, planned) -> None:
    effects = () if "--effects" in words else ("--effects", "none")
    first = planned("--scene", scene, *words.split(), *effects, cwd=tmp_path)
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(planned.config | {"config_hash": first[0][1]}))
    assert planned(config, "-o", "again", cwd=tmp_path) == first


BAD = {
    "methd: [3dgs]": "unknown key in bad.yaml 'methd': did you mean 'method'?",
    "- 3dgs\n- refinesplat": "bad.yaml is damaged (no 'key: value' lines)",
    "method: {a: b}": "bad.yaml: method: a text or a number is expected",
    "seed: [1, two]": "bad.yaml: seed: 'two' is not a valid integer range",
    "seed: true": "bad.yaml: seed: 'true' is not a valid",
    "iterations: [1, 2]": "bad.yaml: iterations: one value is expected, not a list",
    "iterations: 3.5": "bad.yaml: iterations",
    "pictures: perhaps": "bad.yaml: pictures: write true or false, not 'perhaps'",
    "device: tpu": "bad.yaml: device: 'tpu' is not one of",
    "overwrite: always": "'overwrite' is for the command line alone",
    "json: true": "'json' is for the command line alone",
    'scene: ""': "bad.yaml: scene: the name is empty",
    'scene: "a\\0b"': "bad.yaml: scene: 'a\\x00b' holds an invisible character",
    "scene: [[a]]": "bad.yaml: scene",
    "set: [3dgs.k]": "write METHOD.KEY=VALUE",
    "set: {3dgs.k: {a: 1}}": "bad.yaml: set: 3dgs.k: a text",
    "scene: nowhere": "there is no scene folder",
    "method: 3dgs\nmethod: 3dgs": "the key 'method' occurs twice",
    "a: &a [x, x]\nb: &b [*a, *a]\nmethod: [*b, *b]": "aliases (*name) are not supported",
    "method: " + "[" * 200: "nested deeper than 50",
    "method: !!python/object/apply:os.system ['true']": "not YAML",
    "budget: 1m\niterations: 5": "exclude each other",
    "config_hash: x": "bad.yaml is a damaged config.yaml of a run",
    "config_hash: x\nmethod: 3dgs\ntrain: 3": "bad.yaml is a damaged config.yaml of a run",
}


@pytest.mark.parametrize("text", BAD)
def test_a_bad_file_is_one_line(text: str, scene: Path, tmp_path: Path) -> None:
    whole = "".join(
        f"{key}: {value}\n"
        for key, value in {"method": "3dgs", "scene": scene, "iterations": 5}.items()
        if f"{key}:" not in text and not text.startswith(("-", "config"))
    )
    (tmp_path / "bad.yaml").write_text(whole + text)
    before = sorted(tmp_path.rglob("*"))
    done = aw("bench", "bad.yaml", cwd=tmp_path)
    assert done.returncode == 2 and BAD[text] in done.stderr, done.stderr
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_what_is_no_study_is_named(tmp_path: Path) -> None:
    assert "no study absent.yaml" in aw("bench", "absent.yaml", cwd=tmp_path).stderr
    assert "did you mean --method 3dgs?" in aw("bench", "3dgs", "--scene", "x", cwd=tmp_path).stderr


def test_the_method_of_a_run_in_a_file_must_be_given(project: Path, planned) -> None:
    words = ("--scene", "scene", "--iterations", 5, "--effects", "none", "--set", "build.sh_degree=1")
    first = planned("--method", "own/recipe.py:build", *words, cwd=project)
    config = project / "config.yaml"
    config.write_text(yaml.safe_dump(planned.config | {"config_hash": first[0][1]}))
    done = aw("bench", config, "-o", "again", cwd=project)
    assert (
        done.returncode == 2
        and "add --plugin FILE.py, --method FILE.py:RECIPE or --mask FOLDER" in done.stderr
    )
    assert planned(config, "--method", "own/recipe.py:build", "-o", "again", cwd=project) == first
    words = ("--scene", "scene", "--iterations", 5, "--effects", "none")
    masked = planned("--method", "refinesplat", "--mask", "sam", *words, cwd=project)
    other = project / "masked.yaml"
    other.write_text(yaml.safe_dump(planned.config | {"config_hash": masked[0][1]}))
    assert planned(other, "--mask", "sam", "-o", "masked", cwd=project) == masked
    changed = project / "changed" / "recipe.py"
    changed.parent.mkdir()
    shutil.copy(project / "own" / "recipe.py", changed)
    changed.write_text(changed.read_text() + "# edited\n")
    done = aw("bench", config, "--method", f"{changed}:build", "-o", "other", cwd=project)
    assert "not the same run as" in done.stderr and "recipe.py has changed since" in done.stderr
