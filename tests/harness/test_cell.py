"""A cell: what its scene is known by, what it ran on, and that its command makes the same cell again."""

from __future__ import annotations

import dataclasses
import math
import shlex
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.builder.scene_package import list_files
from ambiguous_wild.cli.bench import command, parse_budget
from ambiguous_wild.harness.callbacks import outcome_line
from ambiguous_wild.harness.cell import (
    Cell,
    CellReport,
    code_hash,
    environment,
    installed,
    provenance,
    reproduce_command,
    scene_identity,
)
from ambiguous_wild.harness.grid import plan_cells
from ambiguous_wild.harness.regions import find_regions
from ambiguous_wild.harness.run_cost import peak_rss_mb, reset_peak
from ambiguous_wild.io.files import write_json
from ambiguous_wild.io.images import read_gray, write_png
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import registry
from ambiguous_wild.methods.registry import load_plugin
from ambiguous_wild.splat.train_config import TrainConfig
from tests.io.model_maker import write_scene
from tests.tiny_scene import write_tiny_scene


def test_a_scene_is_known_by_what_is_trained_and_scored_on(tmp_path):
    scene = load_scene(write_tiny_scene(tmp_path / "scene"))
    files = {name: {"sha256": f"{k}"} for k, name in enumerate(("images/a.png", "truth/capture.json"))}

    def identity(**changed):
        return scene_identity(replace(scene, info={**scene.info, "files": files | changed}))

    assert identity() == identity(**{"truth/capture.json": {"sha256": "another version's"}})
    assert identity() != identity(**{"images/a.png": {"sha256": "another photo"}})


def test_a_result_says_where_test_photos_may_hold_distractors(tmp_path):
    (cell,) = plan_cells(["3dgs"], [write_tiny_scene(tmp_path / "scene")], [0], TrainConfig(iterations=1))
    assert "test_photos" not in cell.result()["facts"]
    mixed = replace(cell, scene=replace(cell.scene, info={**cell.scene.info, "split": "every-8"}))
    assert "every 8th photo is a test photo" in mixed.result()["facts"]["test_photos"]
    chosen = replace(cell, scene=replace(cell.scene, info={**cell.scene.info, "split": "list"}))
    assert "test_photos" not in chosen.result()["facts"]


def test_a_result_says_why_there_are_no_masks_to_compare(tmp_path):
    scene, length = write_tiny_scene(tmp_path / "scene"), TrainConfig(iterations=200)
    plain, masking, graft = plan_cells(["3dgs", "robustsplat", "3dgs@mask=robustsplat"], [scene], [0], length)
    reasons = [cell.result().get("facts").get("no_masks") for cell in (plain, masking, graft)]
    late = "masks had not begun at 200 iterations"
    assert reasons == ["the method makes no masks", late, late]
    assert "at 60 iterations" in masking.result(cost={"iterations": 60})["facts"]["no_masks"]  # of a budget
    assert "no_masks" not in masking.result(masks={"iou": 0.5})["facts"]
    assert "no_masks" not in masking.result(error="lost")["facts"]
    report = CellReport(tmp_path, "trained", result=masking.result())
    assert f"{late}, a run too short" in outcome_line(report)
    same = {"image": "a.png", "psnr": math.inf}, {"image": "b.png", "psnr": 20.0}
    line = outcome_line(replace(report, result=masking.result() | {"per_image": same}))
    assert line.startswith("PSNR 20.00 dB over 2 test views")  # as in tables: the mean of finite values
    for path in (scene / "truth/distractor").iterdir():
        write_png(path, read_gray(path)[::2, ::2])
    assert "not of the photos' size" in masking.result()["facts"]["no_masks"]
    missing = find_regions(load_scene(scene)).missing
    assert all("not of the photos' size" in missing[f"psnr_{key}"] for key in ("supported", "covered"))
    for path in (scene / "truth/distractor").iterdir():
        path.rename(path.with_name(f"test_{path.name}"))  # truth of other photos alone
    assert "no_masks" not in masking.result()["facts"]


def test_a_plain_scene_is_known_by_its_photos_masks_and_model(tmp_path):
    root = write_tiny_scene(tmp_path / "scene")
    seen = {scene_identity(load_scene(root))}

    def another():
        found = scene_identity(load_scene(root))
        new = found not in seen
        seen.add(found)
        return new

    assert not another()
    shutil.copy(root / "images/train_1.png", root / "images/train_0.png")
    assert another()
    (root / "masks/train").mkdir(parents=True)
    shutil.copy(root / "truth/distractor/train_0.png", root / "masks/train/train_0.png")
    assert another()
    shutil.copy(root / "truth/distractor/train_1.png", root / "masks/train/train_0.png")
    assert another()
    shutil.copytree(root / "masks/train", root / "masks/test")
    assert another()
    shutil.copy(root / "truth/distractor/train_1.png", root / "truth/distractor/train_0.png")
    assert another()
    for file, old, new in (
        ("cameras.txt", "60.0 60.0", "61.0 61.0"),
        ("points3D.txt", " 0.5\n", " 0.5\n9999 0.1 0.1 4 1 2 3 0.5\n"),
    ):
        text = (root / "sparse/0" / file).read_text()
        (root / "sparse/0" / file).write_text(text.replace(old, new, 1))
        assert another(), file


def test_a_plain_scene_is_known_by_its_tracks(tmp_path):
    write_scene(tmp_path, [f"p{i}.png" for i in range(9)])
    scene = load_scene(tmp_path)
    points = scene.points
    other = replace(points, track_xy=points.track_xy + np.float32(1.0))
    assert scene_identity(replace(scene, points=other)) != scene_identity(scene)


def test_pictures_that_scene_json_does_not_list_are_part_of_what_a_scene_is(tmp_path):
    root = write_tiny_scene(tmp_path / "scene")
    write_json(root / "scene.json", {"schema_version": 1, "factor": 1, "files": list_files(root, 1)})
    listed = scene_identity(load_scene(root))
    shutil.copytree(root / "images", root / "images_2")
    assert scene_identity(load_scene(root)) == listed
    half = scene_identity(load_scene(root, factor=2))
    shutil.copy(root / "images/train_1.png", root / "images_2/train_0.png")
    assert scene_identity(load_scene(root, factor=2)) != half


def test_the_environment_names_what_is_there_and_what_is_not():
    facts = environment("cpu")
    assert facts["packages"]["numpy"] == np.__version__
    assert facts["python"] == ".".join(map(str, sys.version_info[:3]))
    assert facts["cores"] >= 1
    assert installed("no-such-distribution") is None


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can forget a peak")
def test_the_peak_is_that_of_the_run_not_of_the_process():
    block = np.ones(40_000_000)  # 320 MB
    high = peak_rss_mb()
    del block
    reset_peak()
    assert peak_rss_mb() < high - 200


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_scene(tmp_path_factory.mktemp("data") / "my scene")


def typed(text: str) -> Cell:
    """The cell that the command line asks for."""
    words = shlex.split(text)
    assert words[:2] == ["aw", "bench"]
    given = command.make_context("bench", words[2:]).params
    train = TrainConfig(
        iterations=given["iterations"],
        resolution=given["resolution"],
        max_gaussians=given["max_gaussians"],
    )
    more = {name: given[name] for name in ("settings", "device", "factor", "protocol")}
    (effects,) = given["effects"]
    (cell,) = plan_cells(given["methods"], given["scenes"], given["seeds"], train, effects=effects, **more)
    return cell


@pytest.mark.parametrize(
    ("method", "settings", "more"),
    [
        ("3dgs", [], {}),
        ("refinesplat", ["refinesplat.lambda_cr=0.125", "refinesplat.density.merge_every=0"], {}),
        ("refinesplat", [], {"effects": "exposure,antialias", "protocol": "half"}),
        ("3dgs@mask=refinesplat", ["refinesplat.lambda_cr=0.5"], {}),
        ("dronesplat+2passes", ["dronesplat.min_mask_start=10"], {}),
        ("3dgs@mask=dronesplat+2passes", [], {}),
    ],
)
def test_the_command_of_a_result_makes_the_same_cell(
    scene: Path, method: str, settings: list[str], more: dict
) -> None:
    train = TrainConfig(iterations=70, seed=3, max_gaussians=900, resolution="full")
    (cell,) = plan_cells([method], [scene], [3], train, settings=settings, **more)
    assert typed(reproduce_command(cell)).identity == cell.identity


RECIPE = """
from dataclasses import dataclass
from ambiguous_wild.methods import MethodEntry, register
from ambiguous_wild.splat.method_hooks import MethodHooks
@dataclass(frozen=True)
class Config:
    sh_degree: int = 2
def build(config: Config):
    return MethodHooks(sh_degree=config.sh_degree)
"""
PROGRAM = """
name: copycat
train: train {scene} {strength}
renders: "{output}/{stem}.png"
options: {strength: 1}
"""


@pytest.mark.parametrize(
    ("method", "setting"),
    [
        ("my@work/trimmed.py:build", "build.sh_degree=1"),
        ("my@work/trimmed.py:build@mask=refinesplat", "refinesplat.lambda_cr=0.5"),
        ("external:my@work/ext.yaml", "copycat.strength=3"),
        ("nerfbaselines:splatfacto", "nerfbaselines-splatfacto.seed_key=seed"),
    ],
)
def test_a_method_given_by_reference_is_found_again_from_anywhere(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, setting: str
) -> None:
    monkeypatch.setenv("AW_NERFBASELINES", "true")
    folder = tmp_path / "my@work"
    folder.mkdir()
    (folder / "trimmed.py").write_text(RECIPE)
    (folder / "ext.yaml").write_text(PROGRAM)
    monkeypatch.chdir(tmp_path)
    (cell,) = plan_cells([method], [scene], [0], TrainConfig(iterations=9), settings=[setting])
    text = reproduce_command(cell)
    monkeypatch.setattr(registry, "registered", {})  # another process
    monkeypatch.chdir("/")
    assert typed(text).identity == cell.identity
    assert "--plugin" not in text


def test_a_graft_names_the_plugin_of_its_host(scene: Path, tmp_path: Path) -> None:
    plugin = tmp_path / "mine.py"
    plugin.write_text(f"{RECIPE}\nregister(MethodEntry('mine', 'of my own', build, config=Config))\n")
    load_plugin(plugin)
    (cell,) = plan_cells(["mine@mask=truth"], [scene], [0], TrainConfig(iterations=9))
    words = shlex.split(reproduce_command(cell))
    assert words[words.index("--plugin") + 1 :] == [str(plugin)]
    assert typed(shlex.join(words)).identity == cell.identity


def test_a_variant_of_an_ablation_is_its_method_with_other_settings(scene: Path) -> None:
    (cell,) = plan_cells(["refinesplat"], [scene], [0], TrainConfig(iterations=9))
    options = dataclasses.replace(cell.options, lambda_cr=0.25)
    variant = dataclasses.replace(
        cell, method=dataclasses.replace(cell.method, name="refinesplat@x-y"), options=options
    )
    assert typed(reproduce_command(variant)).identity == dataclasses.replace(cell, options=options).identity


def test_budgets_and_plugins_are_part_of_the_command(scene: Path, tmp_path: Path) -> None:
    plugin = tmp_path / "mine.py"
    plugin.write_text(
        "from ambiguous_wild.methods import MethodEntry, register\n"
        "def build(options):\n    raise RuntimeError\n"
        "register(MethodEntry('mine', 'of my own', build))\n"
    )
    load_plugin(plugin)
    (cell,) = plan_cells(["mine"], [scene], [0], TrainConfig(budget_s=90.5))
    words = shlex.split(reproduce_command(cell))
    assert words[words.index("--plugin") + 1] == str(plugin)
    assert parse_budget(words[words.index("--budget") + 1]) == 90.5 and "--iterations" not in words


def test_a_result_names_machine_and_code(scene: Path) -> None:
    (cell,) = plan_cells(["3dgs"], [scene], [0], TrainConfig(iterations=5))
    facts = provenance(cell)
    assert facts["environment"]["packages"]["numpy"] and facts["environment"]["device"] == "cpu"
    assert len(facts["code_hash"]) == len(cell.identity) and facts["code_hash"] == code_hash()
