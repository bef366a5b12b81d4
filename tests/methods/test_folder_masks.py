"""Masks from files: named after photos of the scene or of the capture, at any size, for any method."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.benchmark import bench, find_methods
from ambiguous_wild.io.colmap_records import ModelCamera
from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.keep_resize import smaller_keep
from ambiguous_wild.io.lens import make_lens
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.folder_masks import folder_keeps
from ambiguous_wild.methods.registry import get_method
from tests.tiny_scene import HEIGHT, WIDTH


def truth(scene, view):
    return read_gray(scene.root / "truth/distractor" / view.name) >= 128


def write_keeps(scene, folder, scale=1.0, pattern="{}.png"):
    """The exact masks of a scene as keep masks, enlarged."""
    for view in scene.train:
        keep = (~truth(scene, view)).astype(np.uint8) * 255
        mask = cv2.resize(keep, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
        write_png(folder / pattern.format(view.name.removesuffix(".png")), mask)
    return folder


@pytest.mark.parametrize(
    ("scale", "pattern"), [(1, "{}.png"), (4, "{}.png.png"), (0.5, "mask_{}.png"), (2, "{}.mask.png")]
)
def test_any_size_and_spelling_gives_the_same_masks(scene, tmp_path, scale, pattern):
    loaded = load_scene(scene)
    keeps = folder_keeps(write_keeps(loaded, tmp_path / "sam", scale, pattern), loaded)
    for view, keep in zip(loaded.train, keeps, strict=True):
        assert keep.shape == (HEIGHT, WIDTH) and keep.dtype == np.float32
        assert np.array_equal(keep == 0, truth(loaded, view))


def test_masks_of_photos_as_they_were_taken_bend_with_them(built):
    """Oracle: the builder took the same exact masks through the lens and reduced them."""
    loaded = load_scene(built / "scene")
    masks = built / "raw/truth/distractor"  # white = distractor, called after the capture's photos
    keeps = folder_keeps(masks, loaded)
    for view, keep in zip(loaded.train, keeps, strict=True):
        assert keep.shape == (view.camera.height, view.camera.width)
        assert (keep.astype(bool) == truth(loaded, view)).mean() > 0.995


def as_built(scene, lens):
    """The scene, as if its photos had been undistorted from those of a camera."""
    size = {"width": lens.width, "height": lens.height}
    names = [view.name for view in scene.train]
    camera = size | {"model": lens.model, "params": lens.params, "photos": names}
    photos = {name: size | {"source": name, "sha256": name, "exif": {}} for name in names}
    inputs = {"photos": [[name, 0, 0, name] for name in names]}
    built = {"chosen": {}, "cameras": [camera], "lost": [], "skipped": [], "photos": photos, "inputs": inputs}
    return replace(scene, info=scene.info | built)


def test_only_masks_of_photos_as_they_were_taken_are_undistorted(scene, tmp_path):
    """A circle in a corner, where the lens moves it by more than a pixel of the training size."""
    camera = ModelCamera(1, "SIMPLE_RADIAL", 512, 384, (480.0, 256.0, 192.0, 0.3))
    lens, loaded = make_lens(camera), as_built(load_scene(scene), camera)
    flat = lens.pinhole.width, lens.pinhole.height
    assert flat != (512, 384) and abs(flat[0] * 3 / (flat[1] * 4) - 1) < 0.01  # hardly another shape

    def at(size, centre):
        mask = np.full((384, 512), 255, np.uint8)
        cv2.circle(mask, centre, 20, 0, -1)
        mask = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
        for view in loaded.train:
            write_png(tmp_path / view.name, mask)
        return mask, folder_keeps(tmp_path, loaded)[0]

    for size in (flat, (2 * flat[0], 2 * flat[1])):
        mask, keep = at(size, (60, 60))
        assert np.array_equal(keep, smaller_keep((mask > 0).astype(np.float32), (HEIGHT, WIDTH), "majority"))
    for size in ((512, 384), (1024, 768)):
        mask, keep = at(size, (60, 60))
        centre = np.argwhere(keep == 0).mean(0)[::-1] + 0.5
        expected = lens.undistort_points(np.array([[60.0, 60.0]]))[0] * [WIDTH / flat[0], HEIGHT / flat[1]]
        assert np.abs(centre - expected).max() < 0.4 < 1 < np.abs(expected - np.array([7.5, 7.5])).max()


def test_a_lens_of_no_photo_is_refused_before_its_map_is_made(scene, tmp_path):
    camera = ModelCamera(1, "SIMPLE_RADIAL", 100_000, 100_000, (480.0, 256.0, 192.0, 0.3))
    loaded = as_built(load_scene(scene), camera)
    with pytest.raises(AwError, match=r"damaged.*100000x100000 px is the size of no photo"):
        folder_keeps(write_keeps(loaded, tmp_path / "sam", 2), loaded)


def test_a_method_is_trained_with_the_masks_of_a_folder(scene, tmp_path):
    folder = write_keeps(load_scene(scene), tmp_path / "sam", 2)

    def train():
        parts = {"mask": str(folder)}
        report = bench(
            "3dgs",
            scene,
            output=tmp_path / "runs",
            iterations=20,
            parts=parts,
            effects="none",
            pictures=False,
        )
        return report.runs[0]

    run = train()
    assert run.method == "3dgs@mask=sam" and run.outcome == "trained", run.error
    for view in load_scene(scene).train:
        assert np.array_equal(
            read_gray(run.folder / "masks" / view.name) == 0, truth(load_scene(scene), view)
        )
    assert train().outcome == "kept"
    write_png(folder / "train_0.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    with pytest.raises(AwError, match="3dgs@mask=sam has changed since this run"):
        train()


def test_a_folder_takes_no_method_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("truth", "refinesplat", "mine"):
        Path(name).mkdir()
    for mask, donor in (("truth", "3dgs@mask=truth"), ("refinesplat", "3dgs@mask=refinesplat")):
        assert list(find_methods(["3dgs"], (), {"mask": mask}, 1)) == [donor]
    with pytest.raises(AwError, match="mine holds no masks"):
        find_methods(["3dgs"], (), {"mask": "mine"}, 1)


def test_what_is_wrong_with_a_folder_is_said(scene, tmp_path):
    loaded = load_scene(scene)
    folder = write_keeps(loaded, tmp_path / "sam")
    (folder / "train_1.png").unlink()
    (folder / "train_4.png").unlink()
    with pytest.raises(AwError, match=r"2 of 6 train photos have no mask in .*: train_1\.png, train_4\.png"):
        folder_keeps(folder, loaded)
    write_keeps(loaded, folder)
    write_png(folder / "train_2.png", np.full((HEIGHT, HEIGHT), 255, np.uint8))
    with pytest.raises(AwError, match=r"train_2\.png is 48x48 px, of another shape than its photo"):
        folder_keeps(folder, loaded)
    write_png(folder / "train_2.png", read_png_rgb(scene / "images/train_2.png"))
    with pytest.raises(AwError, match="is no mask of black and white"):
        folder_keeps(folder, loaded)
    (tmp_path / "empty").mkdir()
    (tmp_path / "a,b").mkdir()
    for wrong, words in (
        ("empty", "holds no masks"),
        ("a,b", "rename that folder"),
        ("none", "no folder of masks"),
    ):
        with pytest.raises(AwError, match=words):
            get_method(f"masks:{tmp_path / wrong}")
