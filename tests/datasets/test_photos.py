"""Photos, masks and models as people have them: sizes, alpha, names, several models."""

import dataclasses
import json
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from ambiguous_wild.core import AwError
from ambiguous_wild.core.names import is_text
from ambiguous_wild.datasets.readers import recognise
from ambiguous_wild.datasets.write import ImportSettings, import_scene
from ambiguous_wild.harness.grid import plan_cells
from ambiguous_wild.io.colmap_records import points_without_tracks
from ambiguous_wild.io.images import read_mask, read_png_rgb, write_png
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.data import load_keep
from ambiguous_wild.splat.train_config import TrainConfig
from tests.command_line import aw
from tests.datasets import layouts


@pytest.mark.parametrize(
    ("names", "masks"),
    [
        ({}, ["{stem}.png", "{stem}.JPG.png", "{name}.PNG"]),
        ({"images/": "front/"}, ["front/{stem}.jpg", "{stem}.png", "front/{name}.png"]),
    ],
    ids=["flat", "folders"],
)
def test_masks_beside_the_photos_are_found_and_said(names, masks, tmp_path):
    prefix = names.get("images/", "")
    all_names = [f"{prefix}{n[:-4]}.JPG" for n in layouts.NAMES]
    root = tmp_path / "raw"
    layouts.write_photos(root / "images", all_names)
    layouts.write_model(root / "sparse" / "0", layouts.make_model(all_names))
    layouts.write_lists(root, all_names[:5], all_names[5:])
    keep = np.zeros((layouts.HEIGHT, layouts.WIDTH), np.uint8)
    keep[:, 20:] = 1
    for spelling, name in zip(masks, all_names):
        base = Path(name).name
        path = root / "masks" / spelling.format(stem=base[:-4], name=base)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".png", keep)[1].tobytes())
    done = aw("import", root, "-o", tmp_path / "scene")
    assert "keep masks of 3 of 5 training photos in" in done.stdout and "--no-masks" in done.stdout
    for scene in (load_scene(tmp_path / "scene"), load_scene(root)):
        assert [bool(v.keep_path) for v in scene.train] == [True] * 3 + [False] * 2
        for view in scene.train[:3]:
            assert np.array_equal(load_keep(view), keep)
    assert "keep masks of 3 of 5 training photos" in load_scene(root).info["warnings"][0]
    aw("import", root, "-o", tmp_path / "without", "--no-masks")
    assert not any(v.keep_path for v in load_scene(tmp_path / "without").train)


@pytest.mark.parametrize("factor", [1, 2])
def test_alpha_of_photos_is_a_keep_mask(factor, tmp_path):
    root = layouts.native(tmp_path / "raw")
    alpha = np.full((layouts.HEIGHT, layouts.WIDTH), 255, np.uint8)
    for name, left in ((layouts.TRAIN[0], 0), (layouts.TRAIN[1], 20), (layouts.TEST[0], 20)):
        alpha[:, :left] = 0
        path = root / "images" / name
        pixels = np.dstack([cv2.imread(str(path)), alpha])
        path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    (root / "masks").mkdir()
    rows = np.full_like(alpha, 255)
    rows[:6] = 0
    cv2.imwrite(str(root / "masks" / layouts.TRAIN[1]), rows)
    done = import_scene(root, tmp_path / "scene", ImportSettings(factor=factor))
    assert any("alpha of 2 photos hides pixels" in note for note in done.info["imported"]["notes"])
    scene = load_scene(done.scene)
    assert [bool(v.keep_path) for v in scene.train] == [False, True, False, False, False]
    kept = np.minimum(rows, alpha)[::factor, ::factor] > 0
    assert np.array_equal(load_keep(scene.train[1]) > 0, kept)
    tested = read_mask(done.scene / "masks" / "test" / layouts.TEST[0]) > 0
    assert np.array_equal(tested, alpha[::factor, ::factor] > 0)
    assert not (done.scene / "masks" / "test" / layouts.TEST[1]).exists()
    assert np.array_equal(load_keep(load_scene(root, check=False).train[1]) > 0, np.minimum(rows, alpha) > 0)


def _larger_cameras(root, times):
    """The native scene whose model was made of photos that are `times` larger."""
    layouts.native(root)
    model = layouts.make_model()
    for camera in model.cameras.values():
        values = {"width": camera.width * times, "height": camera.height * times}
        values["params"] = tuple(times * v for v in camera.params)
        for name, value in values.items():
            object.__setattr__(camera, name, value)
    for image in model.images.values():
        image.xys[:] *= times
    layouts.write_model(root / "sparse" / "0", model)
    return root


@pytest.mark.parametrize(
    ("folder", "info", "times", "factor"),
    [
        ("toy", {"loader": "colmap", "downscale_factor": 8}, 8, 1),
        ("toy", {"loader": "colmap", "downscale_factor": 8}, 4, 2),
        ("corner", None, 8, 1),
        ("toy", None, 3, 1),
        ("toy", {"loader": "colmap", "downscale_loaded_factor": 2}, 1, 2),
        ("toy", {"loader": "colmap", "downscale_loaded_factor": 2}, 8, 2),
    ],
)
def test_photos_smaller_than_their_cameras_are_trained_on_as_they_are(folder, info, times, factor, tmp_path):
    root = _larger_cameras(tmp_path / folder, times)
    if info:
        (root / "nb-info.json").write_text(json.dumps(info))
    done = import_scene(root, tmp_path / "scene")
    assert done.info["factor"] == factor
    assert any("smaller than the model's cameras" in note for note in done.info["imported"]["notes"]) == (
        times > 1
    )
    scene, native = load_scene(done.scene), load_scene(layouts.native(tmp_path / "native"))
    assert scene.views[0].camera.width == layouts.WIDTH // factor
    for a, b in zip(scene.views, native.views, strict=True):
        assert np.allclose(a.camera.intrinsics[:2], b.camera.intrinsics[:2] / factor, rtol=1e-6)
    assert np.allclose(scene.points.track_xy, native.points.track_xy / factor, atol=1e-3)
    assert any("trains on photos of" in warning for warning in done.info["warnings"])


def test_a_label_map_is_no_mask(tmp_path):
    root = layouts.nerfstudio(tmp_path / "raw")
    labels = np.arange(layouts.WIDTH, dtype=np.uint8)[None].repeat(layouts.HEIGHT, 0) // 20
    cv2.imwrite(str(root / "masks" / "m.png"), labels)
    with pytest.raises(AwError, match=r"m.png is no mask .* 4 values, 0 \(31 %\), 1 \(31 %\)"):
        import_scene(root, tmp_path / "scene")
    assert [p.name for p in tmp_path.iterdir()] == ["raw"]
    done = import_scene(root, tmp_path / "scene", ImportSettings(masks=False))
    assert load_scene(done.scene).train[0].keep_path is None


def test_masks_that_keep_little_are_suspected_to_be_inverted_in_an_import_too(tmp_path):
    root = layouts.nerfstudio(tmp_path / "raw")
    cv2.imwrite(str(root / "masks" / "m.png"), np.eye(layouts.HEIGHT, layouts.WIDTH, dtype=np.uint8) * 255)
    (note,) = (n for n in import_scene(root, tmp_path / "scene").info["imported"]["notes"] if "median" in n)
    assert "keep only" in note and "are they inverted?" in note


def _one_photo(root):
    layouts.write_photos(root / "images", layouts.NAMES[:1])
    layouts.write_model(root / "sparse" / "0", layouts.make_model(layouts.NAMES[:1]))


_no_test = layouts.edited(layouts.nerfstudio, "transforms.json", lambda data: {**data, "test_filenames": []})


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (_one_photo, (), "has no train photo: 1 photo in the split"),
        (_no_test, (), "lists no test photos"),
        (layouts.native, ("--factor", 5), "--factor 5 leaves less than 16 px a side, too small to train on"),
    ],
)
def test_a_scene_that_cannot_be_trained_or_measured_is_refused(make, options, message, tmp_path):
    make(tmp_path / "raw")
    done = aw("import", tmp_path / "raw", "-o", tmp_path / "scene", *options)
    assert done.returncode == 2 and message in done.stderr and not (tmp_path / "scene").exists()


def test_a_bench_that_tests_nothing_is_refused(tmp_path):
    root = layouts.native(tmp_path / "scene")
    (root / "test_list.txt").write_text("\ufeffextra000.png\n", encoding="utf-16-le")  # as PowerShell writes
    assert [view.name for view in load_scene(root).test] == ["extra000.png"]
    (root / "test_list.txt").write_text("")
    with warnings.catch_warnings(record=True) as said, pytest.raises(AwError, match="tests nothing"):
        plan_cells(["3dgs"], [root], [0], TrainConfig(iterations=20))
    assert all(is_text(str(warning.message)) for warning in said)


def test_colours_of_start_points_are_read_under_other_names(tmp_path):
    root = layouts.nerfstudio(tmp_path / "raw")
    data = (root / "sparse_pc.ply").read_bytes()
    for colour in (b"red", b"green", b"blue"):
        data = data.replace(b"uchar " + colour, b"uchar diffuse_" + colour)
    (root / "sparse_pc.ply").write_bytes(data)
    points = load_scene(import_scene(root, tmp_path / "scene").scene).points
    assert np.array_equal(points.rgb, layouts.make_model().points.rgb)


def test_a_model_without_points_starts_from_random_ones_and_says_so(tmp_path):
    root = layouts.native(tmp_path / "raw")
    model = dataclasses.replace(layouts.make_model(), points=points_without_tracks())
    images = {k: dataclasses.replace(i, point_ids=np.full(len(i.xys), -1)) for k, i in model.images.items()}
    layouts.write_model(root / "sparse" / "0", dataclasses.replace(model, images=images))
    done = aw("import", root, "-o", tmp_path / "scene")
    assert "note: the model has no points: training starts from random ones" in done.stdout
    assert len(load_scene(tmp_path / "scene").points) == 100_000


def test_of_several_models_the_largest_is_read_or_the_one_that_is_named(tmp_path):
    root = layouts.native(tmp_path / "raw")
    (root / "sparse" / "0").rename(root / "sparse" / "1")
    few = layouts.NAMES[2:]
    layouts.write_model(root / "sparse" / "0", layouts.make_model(few))
    done = aw("import", root, "-o", tmp_path / "scene")
    assert "sparse holds 2 COLMAP models: 1 with 7 photos is read, not 0 (5)" in done.stdout
    direct = load_scene(root)
    assert len(load_scene(tmp_path / "scene").views) == len(direct.views) == 7
    assert "2 COLMAP models" in direct.info["warnings"][0]
    named = import_scene(root, tmp_path / "named", ImportSettings(model="0"))
    assert [v.name for v in load_scene(named.scene).views] == sorted(few)
    with pytest.raises(AwError, match="unknown model '2'"):
        import_scene(root, tmp_path / "none", ImportSettings(model="2"))


@pytest.mark.parametrize(
    "loader", ["nerfbaselines.datasets.phototourism:load_phototourism_dataset", "phototourism"]
)
def test_photo_tourism_as_nerfbaselines_hands_it_out(loader, tmp_path):
    layouts.phototourism(tmp_path / "raw")
    root = tmp_path / "raw" / "dense"
    (tmp_path / "raw" / "toy.tsv").rename(root / "nerfw_split.csv")
    assert recognise(root)[0] == "photo-tourism"
    (root / "nb-info.json").write_text(json.dumps({"loader": loader, "id": "phototourism", "type": None}))
    done = import_scene(root, tmp_path / "scene")
    assert done.info["evaluation"]["protocol"] == "half" and done.info["dataset"] == "Photo Tourism"
    sides = {name: facts["split"] for name, facts in done.info["photos"].items()}
    assert sides == {n: "train" if n in layouts.TRAIN else "test" for n in layouts.NAMES}
    with pytest.raises(AwError, match=r"nerfw_split.csv is a table of splits"):
        import_scene(root, tmp_path / "wrong", ImportSettings(kind="colmap"))


def test_masks_outside_the_dataset_are_nobody_s(tmp_path):
    root = layouts.instant_ngp(tmp_path / "raw")
    for photo in (root / "images").iterdir():
        photo.rename(root / photo.name)
    text = (root / "transforms.json").read_text().replace("images/", "")
    (root / "transforms.json").write_text(text)
    (tmp_path / "masks").mkdir()
    write_png(tmp_path / "masks" / layouts.TRAIN[0], np.zeros((layouts.HEIGHT, layouts.WIDTH), np.uint8))
    assert not any(v.keep_path for v in load_scene(import_scene(root, tmp_path / "scene").scene).train)


@pytest.mark.parametrize(("tag", "as_shown"), [(3, True), (3, False), (6, True)])
def test_photos_are_turned_by_exif_where_the_model_saw_them_so(tag, as_shown, tmp_path):
    root = layouts.native(tmp_path / "raw")
    model = layouts.make_model()
    seen = {}  # photos in which every point has its colour
    for image in model.images.values():
        seen[image.name] = photo = np.full((layouts.HEIGHT, layouts.WIDTH, 3), 90, np.uint8)
        for (x, y), number in zip(image.xys.clip(0).astype(int), image.point_ids):
            photo[y : y + 2, x : x + 2] = model.points.rgb[number - 1]
        pixels = Image.fromarray(photo)
        if as_shown:
            pixels = pixels.transpose({3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90}[tag])
        exif = Image.Exif()
        exif[0x0112] = tag
        pixels.save(root / "images" / image.name, exif=exif)
    keep = np.full((layouts.HEIGHT, layouts.WIDTH), 255, np.uint8)
    keep[:9, :20] = 0
    write_png(root / "masks" / layouts.TRAIN[0], keep)
    done = import_scene(root, tmp_path / "scene")
    scene = load_scene(done.scene)
    for view in scene.views:
        assert np.array_equal(read_png_rgb(view.image_path), seen[view.name])
        notes = done.info["photos"][view.name]["notes"]
        assert (f"turned upright (EXIF orientation {tag})" in notes) == as_shown
    assert np.array_equal(load_keep(scene.train[0]) > 0, keep > 0)
