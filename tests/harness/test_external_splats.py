"""Programs that leave splats, and what a description shows them: train photos alone, or NeRF-W's folders."""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.grid import plan_cells, run_cells
from ambiguous_wild.harness.result_file import read_result
from ambiguous_wild.io.colmap_model import read_model, write_views
from ambiguous_wild.io.images import read_png_rgb, to_uint8, write_png
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import registry
from ambiguous_wild.methods.external import PACKAGED, load_description, packaged
from ambiguous_wild.methods.external_process import stage_scene
from ambiguous_wild.splat.train_config import TrainConfig
from tests.methods.baselines import parts_of, trained
from tests.tiny_scene import TEST, TRAIN

TRAINER = """
import json, pathlib, shutil, sys
scene, output, splats = (pathlib.Path(a) for a in sys.argv[1:])
seen = sorted(str(p.relative_to(scene)) for p in scene.rglob("*") if p.is_file())
(output / "seen.json").write_text(json.dumps(seen))
shutil.copyfile(splats, output / "splats.ply")
"""


@pytest.fixture(scope="module")
def model(scene, tmp_path_factory):
    """A trained model of ours, and its file of splats."""
    from ambiguous_wild.io.ply import write_splat_ply

    folder = tmp_path_factory.mktemp("model")
    trainer = trained(scene, folder / "run", parts_of("3dgs"), iterations=60)
    write_splat_ply(folder / "ours.ply", {k: v.numpy() for k, v in trainer.neutral_model().items()})
    return trainer, folder / "ours.ply"


def described(folder, splats, **changes):
    (folder / "trainer.py").write_text(TRAINER)
    keys = {
        "name": "foreign", "prefix": [sys.executable, str(folder / "trainer.py")], "photos": "train",
        "train": ["{scene}", "{output}", str(splats)], "drawn_by": "us", "ply": "{output}/splats.ply",
    }  # fmt: skip
    (folder / "foreign.yaml").write_text(yaml.safe_dump(keys | changes))
    return f"external:{folder / 'foreign.yaml'}"


def test_splats_are_drawn_by_our_renderer_and_test_photos_stay_unseen(scene, model, tmp_path):
    trainer, splats = model
    (cell,) = plan_cells([described(tmp_path, splats)], [scene], [0], TrainConfig(iterations=5))
    (report,) = run_cells([cell], tmp_path / "runs")
    assert report.outcome == "trained", report.error
    result = read_result(report.folder / "metrics.json")
    assert result["facts"]["drawn_by"] == "ambiguous_wild" and result["cost"]["gaussians"] == len(
        trainer.gaussians
    )
    for view in load_scene(scene).test:
        want = to_uint8(trainer.render(view.camera).image.numpy())
        found = read_png_rgb(report.folder / "renders/test" / view.name)
        assert np.abs(found.astype(int) - want).max() <= 1
    seen = (report.folder / "external/output/seen.json").read_text()
    assert all(name in seen for name in TRAIN) and not any(name in seen for name in TEST)
    assert "truth" not in seen and "test_list" not in seen


def test_no_splats_no_result(scene, model, tmp_path):
    reference = described(tmp_path, model[1], ply="{output}/absent.ply")
    (cell,) = plan_cells([reference], [scene], [0], TrainConfig(iterations=5))
    (report,) = run_cells([cell], tmp_path / "runs")
    assert report.outcome == "failed" and "left no splats" in report.error
    with pytest.raises(AwError, match="does not say ply"):
        load_description(Path(described(tmp_path, model[1], ply="").removeprefix("external:")))


def test_a_written_model_is_read_again(scene, tmp_path):
    loaded = load_scene(scene)
    write_views(tmp_path / "sparse", loaded.train, loaded.points)
    found = read_model(tmp_path / "sparse")
    names = {image.name: image for image in found.images.values()}
    assert set(names) == set(TRAIN)
    for view in loaded.train:
        image = names[view.name]
        assert image.cam_from_world() == pytest.approx(view.camera.cam_from_world, abs=1e-12)
        lens = found.cameras[image.camera_id]
        assert (lens.width, lens.height) == (view.camera.width, view.camera.height)
    assert np.asarray(found.points.xyz) == pytest.approx(loaded.points.xyz)
    assert np.array_equal(found.points.rgb, loaded.points.rgb)


def test_nerfws_folders_hold_the_split_and_full_size(scene, tmp_path):
    small = tmp_path / "scene"
    import shutil

    shutil.copytree(scene, small)
    (small / "images_2").mkdir()
    for path in (small / "images").iterdir():
        write_png(small / "images_2" / path.name, np.ascontiguousarray(read_png_rgb(path)[::2, ::2]))
    loaded = load_scene(small, factor=2)
    folder = stage_scene(loaded, tmp_path / "staged", {}, photos="nerf-w")
    rows = [row.split("\t") for row in (folder / f"{loaded.name}.tsv").read_text().splitlines()]
    assert rows[0] == ["filename", "id", "split", "dataset"]
    assert {row[0]: row[2] for row in rows[1:]} == dict.fromkeys(TRAIN, "train") | dict.fromkeys(TEST, "test")
    found = read_model(folder / "dense/sparse")
    assert {(c.width, c.height) for c in found.cameras.values()} == {(64, 48)}
    assert all(
        image.camera_id == number for number, image in found.images.items()
    )  # which its loader expects
    assert sorted(p.name for p in (folder / "dense/images").iterdir()) == sorted([*TRAIN, *TEST])
    with pytest.raises(AwError, match="--factor 2"):
        stage_scene(load_scene(small, factor=1), tmp_path / "full", {}, photos="nerf-w")


@pytest.mark.parametrize("name", sorted(p.stem for p in PACKAGED.glob("*.yaml")))
def test_descriptions_of_the_package_are_sound(name, tmp_path, monkeypatch):
    for variable in ("AW_HA_NERF", "AW_CR_NERF"):
        monkeypatch.setenv(variable, str(tmp_path))
    entry = load_description(packaged(name))
    assert entry.name == name and entry.summary and entry.paper and entry.needs
    monkeypatch.delenv("AW_HA_NERF")
    if name == "ha-nerf":
        with pytest.raises(AwError, match="export AW_HA_NERF=FOLDER"):
            load_description(packaged(name))


def test_an_unknown_description_names_those_that_there_are():
    with pytest.raises(AwError, match=r"did you mean 'opensplat'.*external:PATH\.yaml"):
        registry.get_method("external:opensplatt")


# The command line of OpenSplat 1.2, and what it reads and writes.
OPENSPLAT = """#!{python}
import argparse, json, pathlib, shutil, sys
if sys.argv[1:] == ["--version"]:
    print("9.9 (git commit abc)")
    sys.exit()
parser = argparse.ArgumentParser(allow_abbrev=False)
parser.add_argument("scene", type=pathlib.Path)
parser.add_argument("-o", "--output", type=pathlib.Path)
for option in ["-n", "--densify-from", "--refine-every", "--sh-degree-interval", {newer}]:
    parser.add_argument(option, type=int)
given = parser.parse_args()
model = {{path.name for path in (given.scene / "sparse/0").iterdir()}}
assert model >= {{"cameras.bin", "images.bin", "points3D.bin"}}
assert sorted(path.name for path in (given.scene / "images").iterdir()) == {photos}
shutil.copyfile({splats!r}, given.output)
given.output.with_name("given.json").write_text(json.dumps(vars(given), default=str))
"""


@pytest.fixture
def opensplat(model, tmp_path, monkeypatch):
    """A function that puts a stand-in on PATH."""

    def install(newer='"--densify-until"'):
        program = tmp_path / "bin" / "opensplat"
        program.parent.mkdir()
        program.write_text(
            OPENSPLAT.format(python=sys.executable, newer=newer, photos=sorted(TRAIN), splats=str(model[1]))
        )
        program.chmod(0o755)
        monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")

    return install


def test_opensplat_gets_the_train_photos_and_its_version_is_recorded(scene, opensplat, tmp_path):
    opensplat()
    settings = ["opensplat.densify_until=70"]
    (cell,) = plan_cells(["external:opensplat"], [scene], [0], TrainConfig(iterations=90), settings=settings)
    (report,) = run_cells([cell], tmp_path / "runs")
    assert report.outcome == "trained", report.error
    result = read_result(report.folder / "metrics.json")
    assert result["facts"]["revision"] == "9.9 (git commit abc)" and result["facts"]["not_told"] == ["seed"]
    given = json.loads((report.folder / "external/output/given.json").read_text())
    assert (given["n"], given["densify_until"], given["refine_every"]) == (90, 70, 500)


def test_an_opensplat_whose_splats_would_lie_elsewhere_is_refused(scene, opensplat, tmp_path):
    opensplat(newer="")
    (cell,) = plan_cells(["external:opensplat"], [scene], [0], TrainConfig(iterations=5))
    (report,) = run_cells([cell], tmp_path / "runs")
    assert report.outcome == "failed" and "unrecognized arguments: --densify-until=-1" in report.error
