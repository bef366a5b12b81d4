"""A scene written for other tools, and read back by our readers, COLMAP and NerfBaselines."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.export import WRITERS, export_scene
from ambiguous_wild.datasets.write import ImportSettings, import_scene
from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.safe_pycolmap import pycolmap
from ambiguous_wild.io.scene_folder import load_scene
from tests.command_line import aw
from tests.datasets import layouts
from tests.datasets.test_import import same_cameras
from tests.io.model_maker import HEIGHT, WIDTH, write_scene

NERFBASELINES = "AW_NERFBASELINES"  # the program, as in tests/harness/test_nerfbaselines.py


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene at factor 2 with a keep mask."""
    base = tmp_path_factory.mktemp("export")
    return import_scene(layouts.nerfstudio(base / "raw"), base / "toy", ImportSettings(factor=2)).scene


@pytest.mark.parametrize("form", [f for f in WRITERS if f != "on-the-go"])
def test_read_back_it_is_the_same_scene(form, scene, tmp_path):
    done = export_scene(scene, form, tmp_path / "out")
    assert (done.train, done.test) == (5, 2)
    back = load_scene(import_scene(tmp_path / "out", tmp_path / "back").scene)
    native = load_scene(scene)
    assert [(v.name, v.split) for v in back.views] == [(v.name, v.split) for v in native.views]
    same_cameras(back.views, native.views)
    assert (back.views[0].camera.width, back.views[0].camera.height) == (32, 18)
    for a, b in zip(back.views, native.views):
        assert np.array_equal(read_png_rgb(a.image_path), read_png_rgb(b.image_path))
    assert np.allclose(back.points.xyz, native.points.xyz, atol=1e-5)
    assert np.array_equal(read_gray(back.train[0].keep_path), read_gray(native.train[0].keep_path))
    if form == "colmap":
        assert [p.name for p in (tmp_path / "out" / "masks").iterdir()] == [f"{native.train[0].name}.png"]


def test_on_the_go_keeps_full_size_and_split(scene, tmp_path):
    done = export_scene(scene, "on-the-go", tmp_path / "out")
    assert "keep masks" in done.left_out and "points" in done.left_out
    # the layout holds no points; a model beside it is what people add
    shutil.copytree(scene / "sparse", tmp_path / "out" / "sparse")
    back = load_scene(import_scene(tmp_path / "out", tmp_path / "back").scene)
    native = load_scene(scene)
    assert [(v.name, v.split) for v in back.views] == [(v.name, v.split) for v in native.views]
    same_cameras(back.views, native.views)
    assert all(a.image_path.samefile(b.image_path) for a, b in zip(back.views, native.views))
    (tmp_path / "poses").mkdir()
    data = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert data["fl_x"] == pytest.approx(layouts.FX) and data["w"] == layouts.WIDTH


@pytest.mark.parametrize("form", WRITERS)
def test_equal_names_stay_apart_and_masks_of_test_photos_go_along(form, tmp_path):
    names = [f"{side}/{i}.png" for side in ("back", "front") for i in range(4)]
    write_scene(tmp_path / "rig", names, points=60)
    half = np.zeros((HEIGHT, WIDTH), np.uint8)
    half[:, : WIDTH // 2] = 255
    write_png(tmp_path / "rig" / "masks" / "test" / names[0], half)
    native = load_scene(tmp_path / "rig")
    done = export_scene(native.root, form, tmp_path / "out")
    back = load_scene(import_scene(tmp_path / "out", tmp_path / "back", ImportSettings(factor=1)).scene)
    assert [v.split for v in back.views] == [v.split for v in native.views]
    for a, b in zip(back.views, native.views, strict=True):
        assert a.name == (b.name.replace("/", "_") if form == "on-the-go" else b.name)
        assert np.array_equal(read_png_rgb(a.image_path), read_png_rgb(b.image_path))
    same_cameras(back.views, native.views)
    if form == "on-the-go":
        assert "keep masks" in done.left_out
        return
    assert np.array_equal(read_gray(back.test[0].keep_path), half)
    # nerfstudio and NerfBaselines read a mask of every photo, or none
    shares = {None if v.keep_path is None else read_gray(v.keep_path).mean() for v in back.train}
    assert shares == ({None} if form == "colmap" else {255})


def test_colmap_itself_reads_it(scene, tmp_path):
    export_scene(scene, "colmap", tmp_path / "out")
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    assert model.num_reg_images() == 7 and model.num_points3D() == 60
    view = load_scene(scene).views[0]
    image = next(i for i in model.images.values() if i.name == view.name)
    pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
    assert np.allclose(pose, view.camera.cam_from_world, atol=1e-9)
    assert next(iter(model.cameras.values())).width == view.camera.width


def test_tracks_stay_at_the_exported_size(tmp_path):
    root = layouts.native(tmp_path / "raw")
    scene = import_scene(root, tmp_path / "toy", ImportSettings(factor=2)).scene
    export_scene(scene, "colmap", tmp_path / "out")
    back, native = load_scene(tmp_path / "out"), load_scene(scene)
    assert np.allclose(back.points.track_xy, native.points.track_xy, atol=1e-3)


def test_the_half_protocol_goes_along_where_it_can(tmp_path):
    scene = import_scene(layouts.phototourism(tmp_path / "raw"), tmp_path / "toy").scene
    export_scene(scene, "nerfbaselines", tmp_path / "out")
    info = json.loads((tmp_path / "out" / "nb-info.json").read_text())
    assert info["evaluation_protocol"] == "nerfw"
    assert "the half-photo protocol" in export_scene(scene, "nerfstudio", tmp_path / "ns").left_out


def test_nothing_is_overwritten(scene, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(AwError, match="nothing is overwritten"):
        export_scene(scene, "colmap", tmp_path / "out")
    with pytest.raises(AwError, match="inside the scene"):
        export_scene(scene, "colmap", scene / "out")
    done = aw("export-scene", scene, "--as", "nerfstudio", "-o", tmp_path / "ns", "--copy")
    assert done.returncode == 0 and "5 training and 2 test photos as nerfstudio" in done.stdout
    assert not any(
        p.samefile(q) for p in (tmp_path / "ns/images").iterdir() for q in (scene / "images_2").iterdir()
    )


@pytest.mark.skipif(NERFBASELINES not in os.environ, reason="NerfBaselines is not installed")
def test_nerfbaselines_reads_it(scene, tmp_path):
    """The foreign reader's cameras and pixels, in its own environment."""
    export_scene(scene, "nerfbaselines", tmp_path / "out")
    code = (
        "import sys, json\n"
        "from nerfbaselines.datasets import load_dataset\n"
        "out = {}\n"
        "for side in ('train', 'test'):\n"
        "    d = load_dataset(sys.argv[1], side, features=frozenset(('points3D_xyz',)), load_features=True)\n"
        "    out[side] = {'names': [str(p) for p in d['image_paths']], 'root': str(d['image_paths_root']),\n"
        "        'poses': d['cameras'].poses.tolist(), 'intrinsics': d['cameras'].intrinsics.tolist(),\n"
        "        'sums': [int(i.astype('int64').sum()) for i in d['images']]}\n"
        "print('RESULT' + json.dumps(out))\n"
    )
    python = Path(os.environ[NERFBASELINES]).with_name("python")
    done = subprocess.run([python, "-c", code, str(tmp_path / "out")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    read = json.loads(next(x for x in done.stdout.splitlines() if x.startswith("RESULT"))[6:])
    native = load_scene(scene)
    for side, views in (("train", native.train), ("test", native.test)):
        names = [Path(n).name for n in read[side]["names"]]
        for view in views:
            k = names.index(view.name)
            pose = np.linalg.inv(view.camera.cam_from_world)[:3]
            assert np.allclose(read[side]["poses"][k], pose, atol=1e-5)
            c = view.camera
            assert np.allclose(read[side]["intrinsics"][k], [c.fx, c.fy, c.cx, c.cy], atol=1e-4)
            assert read[side]["sums"][k] == int(read_png_rgb(view.image_path).astype(np.int64).sum())
