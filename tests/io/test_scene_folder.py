import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.io.colmap_model import write_model
from ambiguous_wild.io.images import write_png
from ambiguous_wild.io.scene_folder import load_scene, verify_files
from tests.io.model_maker import HEIGHT, WIDTH, make_model, write_scene
from tests.tiny_scene import write_tiny_scene

NAMES = [f"p{i}.png" for i in range(10)]


def mark_as_ours(root, factor=2):
    """A scene.json with the true hashes of what lies there."""
    from ambiguous_wild.builder.scene_package import list_files

    info = {"schema_version": 1, "factor": factor, "name": "tiny", "files": list_files(root, 1)}
    (root / "scene.json").write_text(json.dumps(info))


def test_plain_colmap_scene_splits_every_eighth_as_gsplat(tmp_path):
    write_scene(tmp_path, NAMES)
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.test] == ["p0.png", "p8.png"]
    assert [v.name for v in scene.views] == sorted(NAMES)
    assert scene.train[0].camera.width == WIDTH


@pytest.mark.parametrize("factor", [1, 2])
def test_points_project_onto_their_tracks_at_the_loaded_size(tmp_path, factor):
    write_scene(tmp_path, NAMES, factor=2)
    scene = load_scene(tmp_path, factor=factor)
    points = scene.points
    owner = np.repeat(np.arange(len(points)), np.diff(points.track_offsets))
    for k, i in enumerate(owner):
        camera = scene.views[points.track_views[k]].camera
        assert camera.width == WIDTH // factor
        seen = camera.intrinsics @ (camera.cam_from_world[:3] @ np.append(points.xyz[i], 1.0))
        assert np.allclose(seen[:2] / seen[2], points.track_xy[k], atol=1e-4)


def test_intrinsics_follow_the_actual_size_per_axis(tmp_path):
    write_scene(tmp_path, NAMES)
    for shade, name in enumerate(NAMES):  # rounding differs between tools
        write_png(tmp_path / "images_2" / name, np.full((25, 32, 3), shade, np.uint8))
    camera = load_scene(tmp_path, factor=2).views[0].camera
    assert (camera.fx, camera.fy) == pytest.approx((60.0 * 32 / WIDTH, 62.0 * 25 / HEIGHT))
    assert (camera.cx, camera.cy) == pytest.approx((33.0 * 32 / WIDTH, 23.0 * 25 / HEIGHT))


def test_lists_decide_the_split_and_name_what_is_missing(tmp_path):
    write_scene(tmp_path, NAMES)
    (tmp_path / "train_list.txt").write_text("p3.png\np4\nlost.png\n")  # one without extension
    (tmp_path / "test_list.txt").write_text("p1.png\n\n")
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.train] == ["p3.png", "p4.png"]
    assert [v.name for v in scene.test] == ["p1.png"]
    assert "lost.png" in scene.info["warnings"][0]
    # Observations in photos outside the split point nowhere.
    assert set(np.unique(scene.points.track_views)) == {-1, 0, 1, 2}


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        ("p1.png", None, "the other list"),
        ("p1.png", "p1.png", "keep it in one"),
        ("x.png", "p1.png", "no training"),
    ],
)
def test_lists_that_cannot_be(tmp_path, train, test, message):
    write_scene(tmp_path, NAMES)
    (tmp_path / "train_list.txt").write_text(train)
    if test is not None:
        (tmp_path / "test_list.txt").write_text(test)
    with pytest.raises(AwError, match=message):
        load_scene(tmp_path)


def test_keep_masks_reach_training_views_only(tmp_path):
    write_scene(tmp_path, NAMES)
    for name in ("p0.png", "p1.png"):  # p0 is a test view
        write_png(tmp_path / "masks" / "train" / name, np.zeros((HEIGHT, WIDTH), np.uint8))
    scene = load_scene(tmp_path)
    assert {v.name for v in scene.views if v.keep_path} == {"p1.png"}


def test_default_factor_comes_from_scene_json(tmp_path):
    write_scene(tmp_path, NAMES)
    mark_as_ours(tmp_path)
    scene = load_scene(tmp_path)
    assert scene.name == "tiny"
    assert scene.views[0].camera.width == WIDTH // 2
    assert scene.views[0].image_path == tmp_path / "images_2" / "p0.png"


def test_a_changed_file_is_named(tmp_path):
    write_scene(tmp_path, NAMES)
    mark_as_ours(tmp_path)
    path = tmp_path / "images_2" / "p3.png"
    data = bytearray(path.read_bytes())
    data[-20] ^= 1  # same size, another content
    path.write_bytes(data)
    with pytest.raises(AwError, match=r"1 of \d+ files .*images_2/p3\.png \(changed\).*aw build-scene"):
        load_scene(tmp_path)
    load_scene(tmp_path, verify="quick")  # sizes agree
    (tmp_path / "images_2" / "p4.png").unlink()
    with pytest.raises(AwError, match=r"p4\.png \(missing\)"):
        load_scene(tmp_path, verify="quick")


def test_extra_files_of_other_tools_do_not_matter(tmp_path):
    write_scene(tmp_path, NAMES)
    mark_as_ours(tmp_path)
    (tmp_path / "images_2_png").mkdir()
    (tmp_path / "notes.txt").write_text("mine")
    scene = load_scene(tmp_path)
    assert scene.info["loaded_factor"] == 2 and len(scene.views) == len(NAMES)


def test_of_several_models_that_of_scene_json_is_read(tmp_path):
    write_scene(tmp_path, NAMES[:-1])
    mark_as_ours(tmp_path, 1)
    write_png(tmp_path / "images" / NAMES[-1], np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    write_model(tmp_path / "sparse" / "1", make_model(NAMES))
    assert len(load_scene(tmp_path).views) == len(NAMES) - 1


def test_masks_put_beside_a_scene_json_that_no_view_uses_are_named(tmp_path):
    write_scene(tmp_path, NAMES)
    mark_as_ours(tmp_path, 1)
    for name in ("p1.png", "train/p1.png", "test/p0.png", "train/p0.png"):  # p0 is a test photo
        write_png(tmp_path / "masks" / name, np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.warns(UserWarning, match=r"belong to no photo: p1\.png, train/p0\.png \(the mask of"):
        load_scene(tmp_path)


def test_a_path_that_leaves_the_scene_is_refused(tmp_path):
    write_scene(tmp_path, NAMES)
    with pytest.raises(AwError, match="outside itself"):
        verify_files(tmp_path, {"files": {"../secret": {"sha256": "", "bytes": 0}}})
    write_model(tmp_path / "sparse" / "0", make_model(["../../evil.png"]))
    with pytest.raises(AwError, match="outside itself"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"schema_version": 99}', '{"schema_version": 1, "schema_version": 1}']
)
def test_scene_json_that_cannot_be_read(tmp_path, text):
    write_scene(tmp_path, NAMES)
    (tmp_path / "scene.json").write_text(text)
    with pytest.raises(AwError, match=r"scene\.json"):
        load_scene(tmp_path)


OURS = {"schema_version": 1, "name": "tiny", "factor": 1, "files": {}}
ENTRY = {"sha256": "0" * 64, "bytes": 3}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        *(({"factor": factor}, "factor must be") for factor in ("abc", None, 0, -1, 1.5, True)),
        ({"name": 3}, "name must be"),
        ({"name": None}, "name must be"),
        ({"files": None}, "lists no files"),
        ({"files": {"a.png": "abc", "b.png": ENTRY}}, r"sha256 or bytes.*: 'a.png'\)"),
        ({"files": {"a.png": {"bytes": 3}}}, "sha256 or bytes"),
        ({"files": {"a.png": {"sha256": "0" * 64}}}, "sha256 or bytes"),
        ({"files": {"a.png": ENTRY | {"bytes": "3"}}}, "sha256 or bytes"),
        ({"schema_version": True}, "schema_version"),
    ],
)
@pytest.mark.parametrize("verify", [True, "quick", False])
def test_a_scene_json_edited_by_hand_is_one_line_that_says_what_is_wrong(tmp_path, change, words, verify):
    write_scene(tmp_path, NAMES[:2])
    (tmp_path / "scene.json").write_text(json.dumps(OURS | change))
    with pytest.raises(AwError, match=rf"scene\.json.*{words}") as caught:
        load_scene(tmp_path, verify=verify)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name", ["../../evil", "/evil", "..", ".cache", "", " ", "a\\b", "a\0b", "a\x1b[1m", "x" * 101]
)
def test_the_name_of_a_scene_cannot_choose_where_runs_lie(tmp_path, name):
    write_scene(tmp_path, NAMES[:2])
    (tmp_path / "scene.json").write_text(json.dumps(OURS | {"name": name}))
    with pytest.raises(AwError, match=r'(?s)scene name.*; change "name" in scene\.json'):
        load_scene(tmp_path)


def test_a_plain_folder_gives_its_own_name_which_is_checked_too(tmp_path):
    write_scene(tmp_path / "yard", NAMES[:2])
    assert load_scene(tmp_path / "yard").name == "yard"
    (tmp_path / "yard").rename(tmp_path / "a\nb")
    with pytest.raises(AwError, match=r"(?s)scene name.*; rename the folder"):
        load_scene(tmp_path / "a\nb")


def _cropped(root):
    write_png(root / "images" / "p2.png", np.zeros((HEIGHT, HEIGHT, 3), np.uint8))


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (None, {}, "no scene folder"),
        (lambda root: shutil.rmtree(root / "sparse"), {}, r"COLMAP model.*aw build-scene"),
        (lambda root: shutil.rmtree(root / "sparse"), {"factor": 4}, r"COLMAP model.*aw build-scene"),
        (lambda root: None, {"factor": 8}, r"factor 8; it has factor 1 \(images\), 2"),
        (lambda root: (root / "images" / "p2.png").unlink(), {}, r"lacks p2\.png"),
        (_cropped, {}, r"p2\.png is 48x48"),
        (
            lambda root: write_model(root / "sparse/0", make_model(NAMES, camera="SIMPLE_RADIAL")),
            {},
            "aw import FOLDER",
        ),
    ],
)
def test_what_is_no_whole_scene_is_refused(tmp_path, spoil, options, message):
    if spoil is not None:
        write_scene(tmp_path / "s", NAMES)
        spoil(tmp_path / "s")
    with pytest.raises(AwError, match=message):
        load_scene(tmp_path / "s", **options)


def test_a_file_is_answered_with_its_folder(tmp_path):
    (tmp_path / "scene.json").write_text(json.dumps(OURS))
    with pytest.raises(AwError, match=f"is a file.*give the folder: {re.escape(str(tmp_path))}$"):
        load_scene(tmp_path / "scene.json")


def test_photos_stripped_of_their_2d_points_lose_their_observations_only(tmp_path):
    model = write_scene(tmp_path, NAMES)
    whole = load_scene(tmp_path).points
    bare = {"xys": np.empty((0, 2)), "point_ids": np.empty(0, dtype=np.int64)}
    images = {i: replace(m, **bare) if m.name == "p3.png" else m for i, m in model.images.items()}
    write_model(tmp_path / "sparse" / "0", replace(model, images=images))
    points = load_scene(tmp_path).points
    lost = whole.track_views == 3
    assert lost.any() and (points.track_views[lost] == -1).all()
    assert np.array_equal(points.track_views[~lost], whole.track_views[~lost])
    assert np.array_equal(points.track_xy[~lost], whole.track_xy[~lost])
    # One point too few is no stripped model but a damaged one.
    short = {i: replace(m, xys=m.xys[:1], point_ids=m.point_ids[:1]) for i, m in model.images.items()}
    write_model(tmp_path / "sparse" / "0", replace(model, images=short))
    with pytest.raises(AwError, match="contradict each other"):
        load_scene(tmp_path)


def test_copies_under_another_extension_are_found(tmp_path):
    write_scene(tmp_path, [f"p{i}.jpg.png" for i in range(3)])
    names = [f"p{i}.JPG" for i in range(3)]
    write_model(tmp_path / "sparse" / "0", make_model(names))
    for i in range(3):
        (tmp_path / "images" / f"p{i}.jpg.png").rename(tmp_path / "images" / f"p{i}.png")
    assert [v.image_path.name for v in load_scene(tmp_path).views] == ["p0.png", "p1.png", "p2.png"]


def test_training_side_needs_neither_pycolmap_nor_openimageio(tmp_path):
    write_scene(tmp_path, NAMES)
    code = (
        "import sys; sys.modules['pycolmap'] = sys.modules['OpenImageIO'] = None\n"
        "from ambiguous_wild.io.scene_folder import load_scene\n"
        "from ambiguous_wild.io.images import load_image_float\n"
        "s = load_scene(sys.argv[1]); print(len(s.views), load_image_float(s.views[0].image_path).shape)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["10", "(48,", "64,", "3)"], done.stderr


def test_a_list_that_begins_with_a_byte_order_mark_loses_no_photo(tmp_path):
    root = write_tiny_scene(tmp_path / "scene")
    for name in ("train_list.txt", "test_list.txt"):
        (root / name).write_bytes(b"\xef\xbb\xbf" + (root / name).read_bytes())
    scene = load_scene(root)
    assert (len(scene.train), len(scene.test)) == (6, 2)
    assert not scene.info["warnings"]


def test_photos_whose_renders_would_be_one_file_are_refused(tmp_path):
    root = write_tiny_scene(tmp_path / "scene")
    (root / "images" / "test_1.png").rename(root / "images" / "test_0.jpg")
    for name in ("sparse/0/images.txt", "test_list.txt"):
        (root / name).write_text((root / name).read_text().replace("test_1.png", "test_0.jpg"))
    with pytest.raises(AwError, match=r"'test_0\.jpg' and 'test_0\.png' differ in their extension only"):
        load_scene(root)
