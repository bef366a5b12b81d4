"""Masks of a run in the pixels of the photos that its scene was built from; photos without distractors."""

import json
import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.export import export_scene
from ambiguous_wild.harness.grid import plan_cells, run_cells
from ambiguous_wild.io.images import orientation, read_gray, read_mask, read_png_rgb, upright, write_png
from ambiguous_wild.io.mask_files import MASK_STYLES, OWN_STYLE
from ambiguous_wild.io.original_photos import OriginalPhoto
from ambiguous_wild.report import full_size_masks, inpainting
from ambiguous_wild.report.full_size_masks import full_size, masks_of_run, write_full_size_masks
from ambiguous_wild.report.inpainting import Inpainting
from ambiguous_wild.splat.train_config import TrainConfig
from tests.builder.capture_maker import HEIGHT, WIDTH, render
from tests.command_line import aw
from tests.faults.compare import state
from tests.shared import made_once

TRAIN, TEST = ("p00", "p02", "p03", "p05"), ("p01", "p04")


@pytest.fixture(scope="module")
def made(built, tmp_path_factory):
    """The capture of `built`, its scene, and a run whose masks are the exact ones; nobody changes it."""

    def make(root):
        shutil.copytree(built / "raw", root / "raw")
        shutil.copytree(built / "scene", root / "scene")
        cells = plan_cells(["3dgs+truth"], [root / "scene"], [0], TrainConfig(iterations=150, probes=0))
        (report,) = run_cells(cells, root / "runs")
        assert report.outcome == "trained", report.error

    return made_once(tmp_path_factory, "full-size-masks", make)


@pytest.fixture
def case(made, tmp_path):
    """A copy of `made` that may be changed; its run says where its scene was."""
    for name in ("raw", "scene", "runs"):
        shutil.copytree(made / name, tmp_path / name)
    (config,) = tmp_path.rglob("config.yaml")
    config.write_text(config.read_text().replace(str(made), str(tmp_path)))
    return tmp_path


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


def test_each_photo_gets_the_mask_of_its_pixels(made, tmp_path):
    """Oracle: the exact masks, as they were drawn on the photos before these were undistorted and halved."""
    done = write_full_size_masks(made / "runs", tmp_path / "masks")
    assert done.masks == 6 and sorted(done.white) == ["test/p01.jpg", "test/p04.jpg"]
    assert done.lines() == ["nothing is masked in test/p01.jpg, test/p04.jpg: not among the train photos"]
    for name in TRAIN[1:]:
        truth = read_gray(made / "raw/truth/distractor" / f"{name}.png") > 0
        mask = read_gray(tmp_path / "masks/train" / f"{name}.png")
        assert mask.shape == (HEIGHT, WIDTH) and set(np.unique(mask)) == {0, 255}
        assert iou(mask == 0, truth) > 0.9
    assert all(read_gray(tmp_path / "masks/test" / f"{name}.png").all() for name in TEST)


@pytest.mark.parametrize("tool", ["colmap", "postshot"])
def test_names_and_colours_are_those_of_the_tool(made, tmp_path, tool):
    write_full_size_masks(made / "runs", tmp_path / "own")
    write_full_size_masks(made / "runs", tmp_path / "masks", tool=tool)
    name = {"colmap": "train/p05.jpg.png", "postshot": "train/p05.png"}[tool]
    own, theirs = read_gray(tmp_path / "own/train/p05.png"), read_gray(tmp_path / "masks" / name)
    assert np.array_equal(theirs, 255 - own if MASK_STYLES[tool].left_out else own)


def test_a_mask_follows_the_edge_of_the_photo(monkeypatch):
    photo = np.random.default_rng(0).integers(60, 80, (240, 320, 3)).astype(np.uint8)
    true = np.zeros((240, 320), np.uint8)
    cv2.circle(true, (160, 120), 61, 1, -1)
    photo[true > 0] += np.array([120, 60, 20], np.uint8)
    small = cv2.resize(true.astype(np.float32), (40, 30), interpolation=cv2.INTER_AREA) >= 0.5
    keep = (~small).astype(np.float32)
    enlarged, along = cv2.resize(keep, (320, 240)) < 0.5, ~full_size(keep, photo, None)
    assert iou(along, true > 0) > 0.999 and iou(enlarged, true > 0) < 0.95
    monkeypatch.setattr(full_size_masks, "_STRIP", 320 * 50)
    assert np.array_equal(~full_size(keep, photo, None), along)  # the strips leave no seams


@pytest.mark.parametrize("turn", range(1, 9))
def test_masks_and_photos_are_written_as_the_file_is_turned(turn, tmp_path):
    shown = np.zeros((60, 80, 3), np.uint8)
    shown[:20, :30] = 255
    exif = Image.Exif()
    exif[0x0112] = turn
    stored = upright(shown, {6: 8, 8: 6}.get(turn, turn))
    Image.fromarray(np.ascontiguousarray(stored)).save(tmp_path / "a.jpg", quality=95, exif=exif)
    photo = OriginalPhoto("a.jpg", "")
    opened = full_size_masks._CapturePhotos(tmp_path, ()).open(photo)
    assert opened.pixels.shape == shown.shape
    full_size_masks._write_mask(tmp_path / "a.png", opened, opened.pixels[..., 0] < 128, OWN_STYLE)
    mask = read_mask(tmp_path / "a.png")
    assert mask.shape == stored.shape[:2] and orientation(tmp_path / "a.png") == turn
    wrong = (upright(mask, turn) == 0) != (shown[..., 0] == 255)
    assert wrong.mean() < 0.01
    full_size_masks._write_photo(tmp_path / "clean/a.jpg", tmp_path / "a.jpg", opened, opened.pixels)
    assert orientation(tmp_path / "clean/a.jpg") == turn
    assert np.abs(read_png_rgb(tmp_path / "clean/a.jpg").astype(int) - stored).mean() < 2


def test_the_render_takes_the_place_of_what_is_masked(made, tmp_path, monkeypatch):
    monkeypatch.setattr(inpainting, "UNSEEN", 1.0)  # the run is short, and its depths are rough
    done = write_full_size_masks(made / "runs", tmp_path / "masks", inpaint=tmp_path / "clean")
    assert (done.inpainted, done.copied) == (3, 1)
    assert sorted(done.left_out) == ["test/p01.jpg", "test/p04.jpg"]
    assert (tmp_path / "clean/train/p00.jpg").read_bytes() == (made / "raw/train/p00.jpg").read_bytes()
    for name in TRAIN[1:]:
        path = tmp_path / "clean/train" / f"{name}.jpg"
        before, after = read_png_rgb(made / "raw/train" / f"{name}.jpg"), read_png_rgb(path)
        masked = read_gray(tmp_path / "masks/train" / f"{name}.png") == 0
        difference = np.abs(before.astype(int) - after).mean(axis=-1)
        far = cv2.dilate(masked.astype(np.uint8), np.ones((25, 25))) == 0
        assert difference[far].mean() < 2 < difference[masked].mean()


def test_inpainted_photos_never_share_a_file():
    names = full_size_masks.inpainted_names(
        ["b/a.tif", "b/A.png", "a.heic", "c.JPG", "c.tif", "a.webp", "a.webp.png"]
    )
    assert names == {
        "b/a.tif": "b/a.tif.png", "b/A.png": "b/A.png", "a.heic": "a.png", "c.JPG": "c.JPG", "c.tif": "c.png",
        "a.webp": "a.webp.png.png", "a.webp.png": "a.webp.png",
    }  # fmt: skip


def test_the_photo_of_a_view_is_found_by_its_whole_name(tmp_path):
    names = ["IMG[1].png", "a.png", "a.1.png", "b/a.png"]
    for name in names:
        write_png(tmp_path / "images" / name, np.zeros((4, 6, 3), np.uint8))
    (tmp_path / "images/a.JSON").touch()
    views = [SimpleNamespace(name=name) for name in ["IMG[1].png", "a.jpg", "a.1.png", "b/a.png"]]
    photos = full_size_masks._photos_of(SimpleNamespace(root=tmp_path, info={}, views=views)).photos
    assert [photo.source for photo in photos] == names


def test_what_no_other_photo_shows_is_not_invented(made, monkeypatch):
    monkeypatch.setattr(inpainting, "UNSEEN", 0.5)  # the run is short, and its depths are rough
    run, scene, paths = masks_of_run(made / "runs")
    camera = scene.train[0].camera
    keep = np.ones((camera.height, camera.width))
    masked = keep.copy()
    masked[:, : camera.width // 2] = 0  # the left wall

    def unseen(others):
        keeps = dict.fromkeys(paths, others) | {"p03.png": masked}
        return Inpainting(run, scene, keeps)

    assert not unseen(keep).why_not("p03.png") and not unseen(keep).why_not("p00.png")
    why = unseen(masked).why_not("p03.png")
    assert "more than 50% of the masked area is visible in no other photo" in why
    assert "add photos that show it" in why


def _forget_masks(case):
    shutil.rmtree(next(case.glob("runs/*/*/seed0/masks")))


def _lose_photo(case):
    (case / "raw/train/p03.jpg").unlink()


def _lose_capture(case):
    (case / "raw").rename(case / "elsewhere")


def _change_photo(case):
    cv2.imwrite(str(case / "raw/train/p03.jpg"), render(np.zeros(3), np.array([0.0, 0.0, 5.0])))


def _fill_output(case):
    (case / "masks").mkdir()
    (case / "masks/mine.txt").touch()


def _escape(case):
    path = case / "scene/scene.json"
    path.write_text(path.read_text().replace('"train/p03.jpg"', '"../../p03.jpg"'))


def _be_older(case):
    path = case / "scene/scene.json"
    record = json.loads(path.read_text())
    for camera in record["cameras"]:
        del camera["params"]
    path.write_text(json.dumps(record))


def _be_packed(case):
    path = case / "scene/scene.json"
    record = json.loads(path.read_text())
    del record["capture"]
    path.write_text(json.dumps(record))


def _two_runs(case):
    run = next(case.glob("runs/*/*/seed0"))
    shutil.copytree(run, run.with_name("seed1"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_forget_masks, "has no masks: 3dgs+truth makes none"),
        (_lose_photo, "1 of 6 photos of the scene are gone"),
        (_lose_capture, "was built from are not at"),
        (_change_photo, "have changed since the scene was built: train/p03.jpg"),
        (_fill_output, "masks exists; nothing is overwritten"),
        (_escape, "is no path in a folder"),
        (_be_older, "does not say by which lenses it was undistorted"),
        (_be_packed, "does not say where its photos are"),
        (_two_runs, "holds 2 runs, give one of them"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(case, change, words):
    change(case)
    before = state(case)
    done = aw("masks", "runs", "-o", "masks", "--inpaint", "clean", cwd=case)
    assert done.returncode == 2 and words in done.stderr and done.stderr.count("error: ") == 1
    assert state(case) == before


def test_masks_go_with_an_exported_scene(made, tmp_path):
    done = aw(
        "export-scene", made / "scene", "--as", "nerfstudio", "--masks", made / "runs", "-o", tmp_path / "out"
    )
    assert done.returncode == 0, done.stderr
    _, scene, paths = masks_of_run(made / "runs", made / "scene")
    for view in scene.train:
        assert np.array_equal(read_gray(tmp_path / "out/masks" / view.name), read_gray(paths[view.name]))
    assert read_gray(tmp_path / "out/masks/p01.png").all()
    with pytest.raises(AwError, match="not of its photo's size"):
        export_scene(
            made / "scene", "colmap", tmp_path / "small", masks={"p05.png": made / "scene/images/p05.png"}
        )
    assert not (tmp_path / "small").exists()
    words = ("export-scene", made / "scene", "--masks", made / "runs", "-o", tmp_path / "small")
    refused = aw(*words, "--as", "on-the-go")
    assert refused.returncode == 2 and "on-the-go holds no masks" in refused.stderr
    assert not (tmp_path / "small").exists()


def test_scene_and_photos_are_found_where_scene_and_run_were_moved(case, tmp_path):
    """First everything moves, then all but the photos, as a folder of 'aw try' that is put away."""
    (case / "all").mkdir()
    for name in ("raw", "scene", "runs"):
        (case / name).rename(case / "all" / name)
    assert masks_of_run(case / "all/runs")[1].root == case / "all/scene"
    (case / "all/old").mkdir()
    for name in ("scene", "runs"):
        (case / "all" / name).rename(case / "all/old" / name)
    assert write_full_size_masks(case / "all/old/runs", tmp_path / "masks").masks == 6


def test_masks_of_an_imported_scene_fit_its_photos(scene, tmp_path):
    cells = plan_cells(["3dgs+truth"], [scene], [0], TrainConfig(iterations=20, probes=0))
    (report,) = run_cells(cells, tmp_path / "runs")
    assert report.outcome == "trained", report.error
    done = write_full_size_masks(tmp_path / "runs", tmp_path / "masks")
    assert "the masks fit those in its folder images" in done.lines()[0] and len(done.white) == 2
    truth = read_gray(scene / "truth/distractor/train_3.png") > 0
    assert iou(read_gray(tmp_path / "masks/train_3.png") == 0, truth) > 0.9
