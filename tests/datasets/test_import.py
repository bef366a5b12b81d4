"""Every layout gives the scene that it was made from."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder.resample import downsample_photo
from ambiguous_wild.builder.sfm import SfmCrash
from ambiguous_wild.cli import bench
from ambiguous_wild.cli import datasets as import_dataset
from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.readers import READERS, recognise
from ambiguous_wild.datasets.suites import suites
from ambiguous_wild.datasets.write import ImportSettings, import_scene
from ambiguous_wild.harness.grid import plan_cells
from ambiguous_wild.io.colmap_records import ModelCamera
from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.safe_pycolmap import pycolmap
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.train_config import TrainConfig
from tests.command_line import aw
from tests.datasets import layouts

KINDS = [k for k in layouts.LAYOUTS if k not in ("instant-ngp", "blender")]


@pytest.fixture(scope="module")
def native(tmp_path_factory):
    return load_scene(layouts.native(tmp_path_factory.mktemp("native") / "scene"))


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """kind -> (the dataset's folder, the result of its import), each made once."""
    base, made = tmp_path_factory.mktemp("layouts"), {}

    def of(kind):
        if kind not in made:
            root = layouts.LAYOUTS[kind](base / "raw" / kind)
            made[kind] = root, import_scene(root, base / "scenes" / kind, ImportSettings(factor=1))
        return made[kind]

    return of


def same_cameras(views, others):
    for a, b in zip(views, others, strict=True):
        assert np.allclose(a.camera.cam_from_world, b.camera.cam_from_world, atol=1e-6)
        assert np.allclose(a.camera.intrinsics, b.camera.intrinsics, atol=1e-6)
        assert (a.camera.width, a.camera.height) == (b.camera.width, b.camera.height)


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_pixels_and_split_are_those_of_the_native_scene(kind, native, imported):
    root, done = imported(kind)
    scene = load_scene(done.scene)
    assert done.info["imported"]["layout"] == kind
    assert [(v.name, v.split) for v in scene.views] == [(v.name, v.split) for v in native.views]
    same_cameras(scene.views, native.views)
    for a, b in zip(scene.views, native.views):
        assert np.array_equal(read_png_rgb(a.image_path), read_png_rgb(b.image_path))
    assert np.allclose(scene.points.xyz, native.points.xyz, atol=1e-5)
    # a photo that is used as it is lies on the disk once
    source = root / done.info["photos"][scene.views[0].name]["source"]
    assert scene.views[0].image_path.samefile(source)


@pytest.mark.parametrize("kind", [k for k in KINDS if k not in ("nerfstudio", "on-the-go")])
def test_tracks_still_meet_their_points(kind, imported):
    scene = load_scene(imported(kind)[1].scene)
    owner = np.repeat(np.arange(len(scene.points)), np.diff(scene.points.track_offsets))
    for index, view in enumerate(scene.views):
        rows = scene.points.track_views == index
        world = np.column_stack([scene.points.xyz[owner[rows]], np.ones(rows.sum())])
        cam = (world @ view.camera.cam_from_world.T)[:, :3] @ view.camera.intrinsics.T
        assert rows.sum() > 20
        assert np.allclose(cam[:, :2] / cam[:, 2:], scene.points.track_xy[rows], atol=1e-3)


def test_a_downsampled_scene_has_our_pixels_and_scaled_cameras(native, tmp_path):
    done = import_scene(layouts.robustnerf(tmp_path / "raw"), tmp_path / "scene", ImportSettings(factor=2))
    scene = load_scene(done.scene)
    for a, b in zip(scene.views, native.views):
        assert np.array_equal(
            read_png_rgb(a.image_path), downsample_photo(read_png_rgb(b.image_path), 32, 18)
        )
        assert np.isclose(a.camera.fx, b.camera.fx / 2)


def test_on_the_go_is_read_at_its_published_factor(tmp_path):
    done = import_scene(layouts.on_the_go(tmp_path / "fountain"), tmp_path / "scene")
    assert done.info["factor"] == 8
    assert load_scene(done.scene).views[0].camera.width == 8
    assert done.info["dataset"] == "NeRF On-the-go"


def test_shipped_downsampled_photos_are_linked(tmp_path):
    root = layouts.on_the_go_undistorted(tmp_path / "patio-high")
    assert recognise(root)[0] == "on-the-go"
    done = import_scene(root, tmp_path / "scene")
    view = load_scene(done.scene).views[0]
    assert view.image_path.samefile(root / "images_8" / view.name)


def test_downsampled_photos_alone_are_enough(tmp_path):
    root = layouts.on_the_go_undistorted(tmp_path / "corner")
    for path in (root / "images").iterdir():
        path.unlink()
    (root / "images").rmdir()
    scene = load_scene(import_scene(root, tmp_path / "scene").scene)
    assert (scene.views[0].camera.width, scene.views[0].camera.height) == (8, 4)


def test_of_several_downsampled_sizes_the_one_of_the_factor_is_read(tmp_path):
    root, native = layouts.native(tmp_path / "raw"), load_scene(layouts.native(tmp_path / "native"))
    for factor in (2, 4):
        (root / f"images_{factor}").mkdir()
        for path in (root / "images").iterdir():
            write_png(root / f"images_{factor}" / path.name, read_png_rgb(path)[::factor, ::factor].copy())
    shutil.rmtree(root / "images")
    for factor in (2, 4):
        done = import_scene(root, tmp_path / "scene", ImportSettings(factor=factor), overwrite=True)
        scene = load_scene(done.scene)
        assert scene.views[0].camera.width == layouts.WIDTH // factor
        assert np.allclose(scene.points.track_xy, native.points.track_xy / factor, atol=1e-3)


def test_blender_has_white_behind_and_the_field_of_view(native, imported):
    scene = load_scene(imported("blender")[1].scene)
    assert [v.split for v in scene.views] == ["test"] * 2 + ["train"] * 5  # test/... sorts before train/...
    by_base = {Path(v.name).name: v for v in scene.views}
    for view in native.views:
        other = by_base[view.name]
        assert np.allclose(other.camera.cam_from_world, view.camera.cam_from_world, atol=1e-6)
        pixels, wanted = read_png_rgb(other.image_path), read_png_rgb(view.image_path).copy()
        wanted[:4, :4] = 255
        assert np.array_equal(pixels, wanted)
        assert np.isclose(other.camera.fx, layouts.FX) and other.camera.cx == layouts.WIDTH / 2
    assert len(scene.points) == 100_000 and np.abs(scene.points.xyz).max() <= 1.3


def test_blender_photos_of_16_bits_keep_their_alpha(native, tmp_path):
    root = layouts.blender(tmp_path / "raw")
    for path in root.rglob("*.png"):
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.uint16) * 257
        path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    for view in load_scene(import_scene(root, tmp_path / "scene").scene).views:
        wanted = read_png_rgb(native.root / "images" / Path(view.name).name).copy()
        wanted[:4, :4] = 255
        assert np.array_equal(read_png_rgb(view.image_path), wanted)


def test_lens_distortion_is_taken_out(tmp_path):
    """Oracle: where a point of the world falls in the undistorted photo, by its own camera."""
    root = layouts.robustnerf(tmp_path / "raw")
    model = layouts.make_model([*layouts.NAMES, "clean000.png"])
    params = (70.0, 71.0, 31.5, 18.5, -0.3, 0.05, 0.001, 0.0)
    lens = pycolmap.Camera(model="OPENCV", width=64, height=36, params=list(params))
    model.cameras[1] = ModelCamera(1, "OPENCV", 64, 36, params)
    layouts.write_model(root / "sparse" / "0", model)
    scene = load_scene(import_scene(root, tmp_path / "scene", ImportSettings(factor=1)).scene)
    view = scene.views[0]
    # A bright square is put where the lens sees one direction, and must come out where the pinhole sees it.
    ray = np.array([0.25, 0.1])
    spot = np.asarray(lens.img_from_cam(np.array([[*ray, 1.0]])))[0]
    photo = np.zeros((36, 64, 3), np.uint8)
    row, column = int(spot[1]), int(spot[0])
    photo[row - 1 : row + 2, column - 1 : column + 2] = 255
    write_png(root / "images" / view.name, photo)
    other = load_scene(import_scene(root, tmp_path / "again", ImportSettings(factor=1)).scene).views[0]
    flat = read_png_rgb(other.image_path)[..., 0].astype(float)
    rows, columns = np.mgrid[: flat.shape[0], : flat.shape[1]] + 0.5
    found = np.array([(flat * columns).sum(), (flat * rows).sum()]) / flat.sum()
    centre = np.asarray(lens.cam_from_img(np.array([[column + 0.5, row + 0.5]])))[0]
    expected = centre * [other.camera.fx, other.camera.fy] + [other.camera.cx, other.camera.cy]
    assert np.abs(found - expected).max() < 0.3


def test_the_test_protocol_comes_with_the_scene(imported, tmp_path):
    """A newcomer gets half photos and fitted appearance on Photo Tourism, and whole photos elsewhere."""
    train = TrainConfig(iterations=5)
    tourism = plan_cells(
        ["refinesplat", "3dgs"], [imported("photo-tourism")[1].scene], [0], train, effects="auto"
    )
    assert [cell.protocol for cell in tourism] == ["half", "half"]
    assert "appearance" in tourism[0].chosen.effects and tourism[1].chosen == tourism[0].chosen
    plain = plan_cells(["refinesplat"], [imported("robustnerf")[1].scene], [0], train, effects="auto")
    assert plain[0].protocol == "full" and "appearance" not in plain[0].chosen.effects
    asked = plan_cells(["3dgs"], [imported("photo-tourism")[1].scene], [0], train, protocol="full")
    assert asked[0].protocol == "full"
    made = layouts.nerfbaselines(tmp_path / "nb", "nerfw")
    assert import_scene(made, tmp_path / "scene").info["evaluation"]["protocol"] == "half"


def test_keep_masks_of_nerfstudio_keep_their_meaning(imported):
    view = load_scene(imported("nerfstudio")[1].scene).train[0]
    assert view.keep_path is not None
    mask = read_gray(view.keep_path)
    assert (mask[:, :20] == 0).all() and (mask[:, 20:] == 255).all()


def test_points_of_test_photos_are_dropped_on_demand(imported, tmp_path):
    root = imported("colmap")[0]
    done = import_scene(root, tmp_path / "scene", ImportSettings(drop_test_only_points=True))
    assert imported("colmap")[1].info["counts"]["points_seen_in_test_only"] == 10
    assert done.info["counts"]["points"] == 50
    assert done.info["counts"]["points_seen_in_test_only"] == 0
    assert len(load_scene(done.scene).points) == 50


def test_names_that_the_model_lacks_are_counted_and_said(tmp_path):
    root = layouts.native(tmp_path / "raw")
    layouts.write_lists(root, test=[*layouts.TEST, "lost.png"])
    done = aw("import", root, "-o", tmp_path / "scene")
    assert done.returncode == 0
    assert "warning: 1 listed test photo not in the model: lost.png" in done.stdout


def test_the_same_import_again_does_nothing_and_another_is_refused(tmp_path):
    root = layouts.native(tmp_path / "raw")
    first = import_scene(root, tmp_path / "scene")
    state = (first.scene / "scene.json").stat().st_mtime_ns
    assert import_scene(root, tmp_path / "scene").up_to_date
    assert (first.scene / "scene.json").stat().st_mtime_ns == state
    with pytest.raises(AwError, match="--overwrite"):
        import_scene(root, tmp_path / "scene", ImportSettings(factor=2))
    again = import_scene(root, tmp_path / "scene", ImportSettings(factor=2), overwrite=True)
    assert again.info["factor"] == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["raw", "scene"]


def test_another_protocol_is_another_import(tmp_path):
    root = layouts.nerfbaselines(tmp_path / "raw")
    import_scene(root, tmp_path / "scene")
    info = json.loads((root / "nb-info.json").read_text())
    (root / "nb-info.json").write_text(json.dumps({**info, "evaluation_protocol": "nerfw"}))
    again = import_scene(root, tmp_path / "scene", overwrite=True)
    assert not again.up_to_date and again.info["evaluation"]["protocol"] == "half"


def test_a_damaged_import_is_repaired_on_request(tmp_path):
    root = layouts.native(tmp_path / "raw")
    photo = import_scene(root, tmp_path / "scene").scene / "images" / layouts.TRAIN[0]
    photo.unlink()
    with pytest.raises(AwError, match="'aw import DATASET -o SCENE --overwrite'"):
        import_scene(root, tmp_path / "scene")
    assert not import_scene(root, tmp_path / "scene", overwrite=True).up_to_date and photo.is_file()


def test_an_import_leaves_the_unfinished_ones_of_other_names(tmp_path):
    other = tmp_path / ".scene1.import-0123456789abcdef"
    other.mkdir()
    import_scene(layouts.native(tmp_path / "raw"), tmp_path / "scene[12]", ImportSettings(name="scene"))
    assert other.is_dir()


def test_a_crash_of_colmap_keeps_its_log(monkeypatch, tmp_path):
    def crash(folder, images, scratch, *args, **kwargs):
        scratch.mkdir()
        (scratch / "colmap.log").write_text("the reason")
        raise SfmCrash(f"log: {scratch / 'colmap.log'}")

    monkeypatch.setattr("ambiguous_wild.datasets.write.find_motion", crash)
    with pytest.raises(SfmCrash) as error:
        import_scene(layouts.native(tmp_path / "raw"), tmp_path / "scene", ImportSettings(motion=True))
    assert Path(str(error.value).removeprefix("log: ")).read_text() == "the reason"


def test_what_is_trained_on_has_the_bits_of_the_native_scene(native, imported):
    other = load_scene(imported("robustnerf")[1].scene)
    for a, b in zip(other.views, native.views, strict=True):
        assert np.array_equal(a.camera.cam_from_world, b.camera.cam_from_world)
        assert np.array_equal(a.camera.intrinsics, b.camera.intrinsics)
        assert np.array_equal(read_png_rgb(a.image_path), read_png_rgb(b.image_path))
    for field in dataclasses.fields(native.points):
        assert np.array_equal(getattr(other.points, field.name), getattr(native.points, field.name))


def spoilt(layout, spoil):
    """A function that writes the layout and changes its folder."""
    return lambda root: spoil(layout(root))


def ngp(change):
    return layouts.edited(layouts.instant_ngp, "transforms.json", change)


def _transforms(**changes):
    return ngp(lambda data: {**data, **changes})


def _other_table(root):
    rows = [f"other{i}.jpg\t{i}\ttrain\tx" for i in range(9)]
    (root / "toy.tsv").write_text("\n".join(["filename\tid\tsplit\tdataset", *rows]) + "\n")


def _matrix(data):
    data["frames"][0]["transform_matrix"] = [[1, 2], [3, 4]]


def _texts(data):
    rows = data["frames"][0]["transform_matrix"]
    data["frames"][0]["transform_matrix"] = [[str(value) for value in row] for row in rows]


def _far(data):
    data["frames"][1]["transform_matrix"][0][3] = 1e300


def _transposed(data):
    for frame in data["frames"]:
        frame["transform_matrix"] = [list(column) for column in zip(*frame["transform_matrix"])]


def _outside(data):
    return json.loads(json.dumps(data).replace("./images/extra000.png", "../../secret.png"))


def _stems(root):
    layouts.write_photos(root / "images", ["clutter000.jpg"])
    _other_model([*layouts.NAMES, "clutter000.jpg"])(root)
    layouts.write_lists(root, [*layouts.TRAIN, "clutter000.jpg"])


def _other_model(names):
    return lambda root: layouts.write_model(root / "sparse" / "0", layouts.make_model(names))


def _one_photo_twice(root):
    shutil.copy(root / "images" / "clutter000.png", root / "images" / "extra000.png")


def _picture(name, *size):
    return lambda root: write_png(root / name, np.zeros(size, np.uint8))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (spoilt(layouts.native, _stems), "'clutter000.jpg' and 'clutter000.png' differ in their extension"),
        (spoilt(layouts.native, _other_model([*layouts.NAMES[:-1], "a\nb.png"])), "which no list can hold"),
        (spoilt(layouts.native, lambda root: (root / "test_list.txt").unlink()), "test_list.txt"),
        (
            spoilt(layouts.native, _picture("images/clutter001.png", 64, 36, 3)),
            "clutter001.png (36x64, its camera 64x36, turned",
        ),
        (
            spoilt(layouts.nerfstudio, _picture("masks/m.png", 50, 40)),
            "m.png is 40x50 but its photo clutter000.png 64x36",
        ),
        (
            spoilt(layouts.robustnerf, lambda root: (root / "images" / "extra001.png").unlink()),
            "1 of 7 photos that the model registers are not in",
        ),
        (spoilt(layouts.robustnerf, _other_model([*layouts.NAMES, "other.png"])), "other.png (none)"),
        (spoilt(layouts.phototourism, _other_table), "table of another scene"),
        (spoilt(layouts.on_the_go, _other_table), "choose one with --as"),
        (
            layouts.edited(layouts.on_the_go, "split.json", lambda _: {"clutter": [0, 1], "extra": [99]}),
            "they belong to two scenes",
        ),
        (
            layouts.edited(
                layouts.nerfbaselines,
                "nb-info.json",
                lambda _: {"loader": ["colmap"], "evaluation_protocol": {}},
            ),
            "unknown loader",
        ),
        (_transforms(w=64e9, h=36e9, k1=0.1), "the model is damaged"),
        (_transforms(fl_x=0), "the model is damaged"),
        (_transforms(fl_x="wide"), "fl_x is 'wide', not a number"),
        (_transforms(camera_model=["x"]), "camera_model"),
        (_transforms(frames=[{"file_path": 3}]), "frame 0 has no file_path"),
        (_transforms(ply_file_path="../p.ply"), "leads out of"),
        (ngp(_far), "too far away"),
        (ngp(_transposed), "transposed"),
        (ngp(_outside), "leads out of"),
        (ngp(_matrix), "clutter000.png"),
        (ngp(_texts), "transform_matrix is not [4, 4] numbers"),
        (lambda root: root.mkdir(), "no known layout"),
        (spoilt(layouts.native, _one_photo_twice), "raw: test photos are training photos"),
    ],
)
def test_a_wrong_dataset_is_one_line_and_nothing_is_left(spoil, message, tmp_path):
    spoil(tmp_path / "raw")
    done = aw("import", tmp_path / "raw", "-o", tmp_path / "scene")
    assert done.returncode == 2
    *stages, error = done.stderr.splitlines()
    assert message in error and len(stages) <= 1 and "Traceback" not in done.stderr
    assert ".scene.import-" not in error
    assert [p.name for p in tmp_path.iterdir()] == ["raw"]


def test_points_are_triangulated_where_the_dataset_has_poses_alone(tmp_path):
    """Oracle: photos of two walls with exact cameras; the points must lie on the walls."""
    from tests.builder import capture_maker as maker

    paths = maker.write_capture(tmp_path / "raw" / "images", 6)
    frames = []
    for path, eye in zip(paths, maker.eyes(6)):
        z = np.array([0.0, 0.0, 5.2]) - eye
        z /= np.linalg.norm(z)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        c2w = np.eye(4)
        c2w[:3, :3], c2w[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
        matrix = (c2w @ layouts.OPENGL).tolist()
        frames.append({"file_path": f"images/{path.name}", "transform_matrix": matrix})
    shared = {"w": maker.WIDTH, "h": maker.HEIGHT, "fl_x": maker.FOCAL, "fl_y": maker.FOCAL}
    (tmp_path / "raw" / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    done = import_scene(tmp_path / "raw", tmp_path / "scene", jobs=2)
    assert done.info["imported"]["layout"] == "instant-ngp"
    scene = load_scene(done.scene)
    for view, eye in zip(scene.views, maker.eyes(6)):
        assert np.allclose(view.camera.center, eye, atol=1e-6)
    assert len(scene.points) > 100
    distances = []
    for corner, u, v, _ in maker.walls():
        normal = np.cross(u, v)
        distances.append(np.abs((scene.points.xyz - corner) @ normal / np.linalg.norm(normal)))
    assert np.median(np.min(distances, axis=0)) < 0.02
    assert (scene.points.track_views >= 0).all()


def test_what_moves_is_found_in_reduced_photos_too(built, tmp_path):
    for part in ("images_2", "sparse"):
        shutil.copytree(built / "scene" / part, tmp_path / "raw" / part)
    for name in ("train_list.txt", "test_list.txt"):
        shutil.copyfile(built / "scene" / name, tmp_path / "raw" / name)
    done = import_scene(tmp_path / "raw", tmp_path / "scene", ImportSettings(motion=True))
    assert any("features of train photos are static" in note for note in done.info["imported"]["notes"])


def test_too_few_matches_give_random_points_and_say_so(imported):
    done = imported("instant-ngp")[1]
    assert "too few points could be triangulated: initial points are random" in done.info["imported"]["notes"]
    assert done.info["counts"]["points"] == 100_000


def test_the_command_offers_what_there_is():
    """The command line lists names without importing the readers."""
    assert set(import_dataset.KINDS) == set(READERS)
    assert set(bench.SUITES) == set(suites())
