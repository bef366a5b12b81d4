"""Scenes in coordinates of maps, in tiny and huge units, with a camera or points far away."""

from __future__ import annotations

import gzip
import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.core import Camera, SceneTransform
from ambiguous_wild.datasets.export import export_scene
from ambiguous_wild.datasets.points import random_points
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.ply import read_point_ply, read_splat_ply, read_transform, write_splat_ply
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.io.splat_files import FORMATS
from ambiguous_wild.viewing.model import Renderer, ViewedModel, space_of
from ambiguous_wild.viewing.model_export import export
from ambiguous_wild.viewing.page_file import page_text
from ambiguous_wild.viewing.video import from_file, orbit, through_views
from tests.tiny_scene import write_tiny_scene
from tests.viewing.wall_runs import wall_model

UTM = np.array([448123.25, 4100456.5, 312.0])
MOVES = [(np.zeros(3), 1e-3), (np.zeros(3), 1e4), (UTM, 1.0), (UTM, 1e-3), (-UTM, 3e3)]


def moved(root: Path, shift: np.ndarray, scale: float) -> Path:
    """The tiny scene in other coordinates."""
    write_tiny_scene(root)
    model = root / "sparse" / "0"
    poses = [line.split() for line in (model / "images.txt").read_text().splitlines() if line]
    for row in poses:  # they do not turn
        row[5:8] = [repr(float(float(t) * scale - s)) for t, s in zip(row[5:8], shift)]
    (model / "images.txt").write_text("".join(" ".join(row) + "\n\n" for row in poses))
    points = [line.split() for line in (model / "points3D.txt").read_text().splitlines()]
    for row in points:
        row[1:4] = [repr(float(float(x) * scale + s)) for x, s in zip(row[1:4], shift)]
    (model / "points3D.txt").write_text("".join(" ".join(row) + "\n" for row in points))
    return root


def world(gaussians: dict[str, np.ndarray], place: SceneTransform) -> np.ndarray:
    return gaussians["means"].astype(np.float64) / place.scale + place.centre


def test_an_ordinary_scene_is_not_touched(tmp_path: Path) -> None:
    scene = load_scene(write_tiny_scene(tmp_path / "s"))
    assert scene.transform == SceneTransform() and np.array_equal(scene.train[1].camera.center, [0.25, 0, 0])
    write_splat_ply(tmp_path / "m.ply", wall_model(3), scene.transform)
    assert b"comment" not in (tmp_path / "m.ply").read_bytes()


@pytest.mark.parametrize(("shift", "scale"), MOVES)
def test_a_scene_shows_and_exports_the_same_wherever_it_lies(
    tmp_path: Path, shift: np.ndarray, scale: float
) -> None:
    plain = load_scene(write_tiny_scene(tmp_path / "plain"))
    scene = load_scene(moved(tmp_path / "moved", shift, scale))
    times = scene.transform.scale * scale
    assert 0.5 < times * np.median(np.abs(plain.points.xyz[:, 2])) / 4 < 2
    offset = (shift - scene.transform.centre) * scene.transform.scale
    assert np.abs(offset).max() < 10  # near the origin
    np.testing.assert_allclose(scene.points.xyz, plain.points.xyz * times + offset, atol=1e-6)
    assert scene.extent == pytest.approx(plain.extent * times, rel=1e-6)

    # the wall as a model of each scene: the same pictures
    wall = wall_model(2500)
    inner = {k: v.copy() for k, v in wall.items()}
    inner["means"] = (wall["means"] * times + offset).astype(np.float32)
    inner["log_scales"] = (wall["log_scales"] + np.log(times)).astype(np.float32)
    ply = tmp_path / "m.ply"
    write_splat_ply(ply, inner, scene.transform)
    assert read_transform(ply) == scene.transform
    model = ViewedModel("m", ply)
    before = Renderer(wall, model.render_settings)(plain.test[0].camera).astype(int)
    after = Renderer(model.read(), model.render_settings)(scene.test[0].camera).astype(int)
    assert before.std() > 10 and np.abs(before - after).mean() < 0.5

    # files and their metadata give the positions of the user's coordinates back
    true = wall["means"].astype(np.float64) * scale + shift
    for made in export(model, tmp_path / "out", list(FORMATS), scene.test)[0]:
        assert made.psnr_to_model is not None and made.psnr_to_model > 35, made
        place = made.transform
        if made.format == "gltf":
            data = made.path.read_bytes()
            node = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])["nodes"][0]
            x, y, z = node.get("translation", [0, 0, 0])
            place = SceneTransform((-x, -y, z))
        elif made.format == "spz":
            data = made.path.read_bytes()
            told = json.loads(data[10 : data.index(b"\0", 10)])
            place = SceneTransform(tuple(told["offset"]), told["scale"])
            assert len(gzip.decompress(data)) > 1000
        elif made.format == "sog":
            told = json.loads(zipfile.ZipFile(made.path).read("meta.json"))["asset"]
            place = SceneTransform(tuple(told.get("offset", (0, 0, 0))), told.get("scale", 1.0))
        elif any(scene.transform.centre):
            x, y, z = scene.transform.centre
            assert f"comment offset {x!r} {y!r} {z!r}\n".encode() in made.path.read_bytes()
        found = world(FORMATS[made.format].decode(made.path.read_bytes(), made.path).gaussians, place)
        for axis in range(3):
            np.testing.assert_allclose(np.sort(found[:, axis]), np.sort(true[:, axis]), atol=4e-3 * scale)

    # paths of cameras come in the user's coordinates; what the page saves is turned back by centre and scale
    camera = scene.test[0].camera
    row = {"position": (shift + scale * np.array([0.3, 0, 0])).tolist(), "rotation": np.eye(3).tolist()}
    row |= {"fx": 60.0, "fy": 60.0, "width": 64, "height": 48}
    (tmp_path / "path.json").write_text(json.dumps([row, row]))
    film = from_file(tmp_path / "path.json", scene, 2, (64, 48))
    np.testing.assert_allclose(film[0].center, camera.center, atol=1e-5)
    page = page_text(scene, [model], title="t")[0]
    assert f'"scale": {scene.transform.scale}' in page or f'"scale":{scene.transform.scale}' in page

    # another layout is written in the files' own coordinates, to the last millimetre
    export_scene(tmp_path / "moved", "nerfstudio", tmp_path / "ns")
    xyz, _ = read_point_ply(tmp_path / "ns" / "sparse_pc.ply")
    want = plain.points.xyz * scale + shift
    np.testing.assert_allclose(xyz, want, atol=1e-5 * scale)


def test_the_page_says_what_sizes_cost_that_its_format_does_not_hold(tmp_path: Path) -> None:
    scene = load_scene(write_tiny_scene(tmp_path / "s"))
    wall = wall_model(500)
    write_splat_ply(tmp_path / "held.ply", wall)
    assert "dB to the model" not in page_text(scene, [ViewedModel("m", tmp_path / "held.ply")], title="t")[0]
    wall["means"] = np.float32(1e4) * wall["means"]
    wall["log_scales"] = wall["log_scales"] + np.float32(np.log(1e4))
    write_splat_ply(tmp_path / "large.ply", wall)
    (note,) = re.findall(
        r'"notes": ?\["([^"]*)"\]', page_text(scene, [ViewedModel("m", tmp_path / "large.ply")], title="t")[0]
    )
    assert "dB to the model" in note and "gltf" in note


@pytest.mark.parametrize("side", ["train", "test"])
def test_one_camera_far_away_is_named_and_changes_no_size(tmp_path: Path, side: str) -> None:
    usual = load_scene(write_tiny_scene(tmp_path / "usual"))
    model = write_tiny_scene(tmp_path / "far") / "sparse" / "0"
    name = f"{side}_1.png"
    images = (model / "images.txt").read_text().splitlines()
    at = next(i for i, line in enumerate(images) if line.endswith(name))
    row = images[at].split()
    images[at] = " ".join([*row[:5], "5000", *row[6:]])
    (model / "images.txt").write_text("\n".join(images) + "\n")
    rng = np.random.default_rng(0)
    with open(model / "points3D.txt", "a") as f:  # and points
        f.writelines(
            f"{900 + i} {x} {y} {z} 9 9 9 1\n" for i, (x, y, z) in enumerate(5e4 * rng.normal(size=(50, 3)))
        )
    scene = load_scene(tmp_path / "far")
    named = [w for w in scene.info["warnings"] if "far from all others" in w]
    assert len(named) == (side == "train") and all(name in w for w in named)
    assert scene.transform == SceneTransform() and scene.extent == pytest.approx(usual.extent, rel=0.3)
    assert space_of(scene).distance == pytest.approx(space_of(usual).distance, rel=0.2)
    model_there = read_model(tmp_path / "far" / "sparse" / "0")
    random = random_points(model_there, {v.name: v.split for v in scene.views}, blender=False)
    assert np.abs(random.xyz).max() < 30
    for film in (orbit, through_views):
        if (film, side) != (through_views, "test"):  # one of two test cameras: no telling which is wrong
            centers = np.array([c.center for c in film(scene, 8, (64, 48))])
            assert np.abs(centers).max() < 10


def test_damaged_places_are_refused(tmp_path: Path) -> None:
    write_splat_ply(tmp_path / "m.ply", wall_model(3), SceneTransform((1.0, 2.0, 3.0), 2.0))
    data = (tmp_path / "m.ply").read_bytes()
    for bad in (b"training_scale nan", b"training_scale 0.0", b"training_scale x"):
        (tmp_path / "b.ply").write_bytes(data.replace(b"training_scale 2.0", bad))
        with pytest.raises(Exception, match="comments offset and training_scale are damaged"):
            read_splat_ply(tmp_path / "b.ply")


def test_a_camera_moves_with_its_scene() -> None:
    pose = np.eye(4)
    pose[:3, 3] = [-10.0, 0, 0]
    camera = Camera(10, 10, 5, 5, 5, 5, pose)
    np.testing.assert_allclose(SceneTransform((8.0, 0, 0), 4.0).inside(camera).center, [8.0, 0, 0])
