"""Which pixels the region metrics are about, on a wall where it can be worked out by hand."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.harness import regions
from ambiguous_wild.harness.measures import measure_images, metrics
from ambiguous_wild.harness.regions import find_regions
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.metrics.mask_scores import psnr_valid
from ambiguous_wild.vision.sparse_surface import inverse_depth
from tests.tiny_scene import HEIGHT, TEST, TRAIN, WALL_Z, WIDTH, write_tiny_scene

X, Y = (-0.2, 0.8), (-0.5, 0.5)  # a part of the wall, in metres


def part_of_wall(camera: Camera) -> np.ndarray:
    """Pixels that show the part, [H, W] bool."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x = camera.center[0] + (columns - camera.cx) / camera.fx * WALL_Z
    y = (rows - camera.cy) / camera.fy * WALL_Z
    return (x >= X[0]) & (x <= X[1]) & (y >= Y[0]) & (y <= Y[1])


def scene_with_part_hidden(root: Path, photos: int) -> Path:
    """The tiny scene, the part of its wall hidden by distractors in that many of its six train photos."""
    write_tiny_scene(root)
    for view in load_scene(root).train:
        hidden = part_of_wall(view.camera) & (TRAIN.index(view.name) < photos)
        cv2.imwrite(str(root / "truth" / "distractor" / view.name), hidden.astype(np.uint8) * 255)
    return root


def test_covered_is_what_was_hidden_in_at_least_half_of_the_views(tmp_path: Path) -> None:
    scene = load_scene(scene_with_part_hidden(tmp_path / "scene", 4))
    regions = find_regions(scene)
    for view in scene.test:
        expected, got = part_of_wall(view.camera), regions.pixels["psnr_covered"][view.name]
        assert (expected & got).sum() / (expected | got).sum() > 0.85
        assert np.array_equal(regions.pixels["psnr_uncovered"][view.name], ~got)
    assert list(regions.missing) == ["psnr_valid", "psnr_consistent"]  # its test photos are clean


@pytest.mark.parametrize(("hidden", "has_sparse_points"), [(3, True), (4, False)])
def test_supported_is_what_three_train_views_show(
    tmp_path: Path, hidden: int, has_sparse_points: bool
) -> None:
    """Of six train views that all look at a part of the wall."""
    scene = load_scene(scene_with_part_hidden(tmp_path / "scene", hidden))
    regions = find_regions(scene)
    for view in scene.test:
        part, got = part_of_wall(view.camera), regions.pixels["psnr_supported"][view.name]
        inner = cv2.erode(part.astype(np.uint8), np.ones((7, 7))).astype(bool)
        assert got[inner].mean() == pytest.approx(float(has_sparse_points), abs=0.1)
        assert got[~part].any()


def test_without_masks_every_view_shows_what_it_looks_at(tmp_path: Path) -> None:
    clean = write_tiny_scene(tmp_path / "clean", distractors=False)
    with_masks = find_regions(load_scene(clean)).pixels["psnr_supported"]
    for path in (clean / "truth/distractor").iterdir():
        path.unlink()
    without = find_regions(load_scene(clean)).pixels["psnr_supported"]
    assert all(np.array_equal(with_masks[name], without[name]) for name in with_masks)


def test_what_cannot_be_told_is_missing_with_its_reason(tmp_path: Path) -> None:
    rarely = find_regions(load_scene(scene_with_part_hidden(tmp_path / "rarely", 2)))
    assert list(rarely.pixels) == ["psnr_supported"]
    assert "half of the train views" in rarely.missing["psnr_covered"]
    clean = load_scene(write_tiny_scene(tmp_path / "clean", distractors=False))
    assert find_regions(clean).missing["psnr_uncovered"] == "no train photo shows a distractor"
    for path in (tmp_path / "clean/truth/distractor").iterdir():
        path.unlink()
    assert "no exact masks" in find_regions(load_scene(tmp_path / "clean")).missing["psnr_covered"]
    few = scene_with_part_hidden(tmp_path / "few", 4)
    lines = (few / "sparse/0/points3D.txt").read_text().splitlines(keepends=True)
    (few / "sparse/0/points3D.txt").write_text("".join(lines[:5]))
    assert "too few sparse points" in find_regions(load_scene(few)).missing["psnr_covered"]


def test_a_users_mask_of_a_test_photo_is_what_psnr_valid_measures(tmp_path: Path) -> None:
    root = write_tiny_scene(tmp_path / "scene")
    (root / "masks" / "test").mkdir(parents=True)
    keep = np.zeros((HEIGHT, WIDTH), np.uint8)
    keep[:10, 40:] = 255
    cv2.imwrite(str(root / "masks" / "test" / TEST[0]), keep)
    scene = load_scene(root)
    a, b = np.random.default_rng(0).integers(0, 256, (2, HEIGHT, WIDTH, 3), dtype=np.uint8)
    pictures, metric = [(name, a, b) for name in TEST], [metrics()["psnr_valid"]]
    rows, _ = measure_images(pictures, metric, scene)
    assert rows[0]["psnr_valid"] == psnr_valid(a, b, keep)
    assert "psnr_valid" not in rows[1]  # it has no mask, and no value to invent
    right = slice(WIDTH // 2, None)
    (half, *_), _ = measure_images(pictures, metric, scene, half=True)
    assert half["psnr_valid"] == psnr_valid(a[:, right], b[:, right], keep[:, right])
    cv2.imwrite(str(root / "masks" / "test" / TEST[0]), keep[:-1])
    with pytest.raises(AwError, match="its photo is 64x48"):
        find_regions(load_scene(root))


def test_metrics_are_the_same_on_several_threads_and_regions_are_found_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = scene_with_part_hidden(tmp_path / "scene", 3)
    find, scenes = regions._find_regions, []
    monkeypatch.setattr(regions, "_find_regions", lambda scene: scenes.append(scene) or find(scene))
    images = np.random.default_rng(0).integers(0, 256, (len(TEST), 2, HEIGHT, WIDTH, 3), dtype=np.uint8)
    asked = [metric for metric in metrics().values() if "lpips" not in metric.key]
    one, several = (
        measure_images(
            [(name, *pair) for name, pair in zip(TEST, images)],
            asked, load_scene(root), around=partial(nullcontext, threads),
        )
        for threads in (1, 3)
    )  # fmt: skip
    assert one == several and list(one[0][0]) == list(several[0][0]) and "psnr_covered" in one[0][0]
    assert len(scenes) == 2


def test_depth_between_points_is_exact_on_a_plane_and_ignores_what_lies_behind() -> None:
    camera = Camera(60, 40, 50.0, 50.0, 30.0, 20.0, np.eye(4))
    rng = np.random.default_rng(1)
    u, v = rng.uniform(-10, 70, 3000), rng.uniform(-10, 50, 3000)
    x, y = (u - 30) / 50, (v - 20) / 50
    z = 4.0 / (1.0 + 0.5 * x)  # a slanted wall: x + 2 z / ... linear in 1/z
    wall = np.stack([x * z, y * z, z], axis=1)
    inverse = inverse_depth(camera, np.concatenate([wall, 3.0 * wall[::3]]))  # and another behind it
    assert inverse is not None and inverse.shape == (40, 60)
    expected = (1.0 + 0.5 * ((np.arange(60) + 0.5 - 30) / 50)) / 4.0
    assert np.abs(inverse - expected[None, :]).max() < 1e-5
    assert inverse_depth(camera, wall[:4]) is None


def test_consistent_is_what_other_photos_show_too(tmp_path: Path) -> None:
    """A part of the wall is hidden by a distractor in one test photo alone; the photo is darker, too."""
    root = write_tiny_scene(tmp_path / "scene", distractors=False)
    view, other = load_scene(root).test
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    hidden[12:36, 20:44] = True
    photo = cv2.imread(str(view.image_path))
    clean = (photo * 0.8).astype(np.uint8)
    photo = np.where(hidden[..., None], (30, 240, 30), clean).astype(np.uint8)
    cv2.imwrite(str(view.image_path), photo)
    scene = load_scene(root)
    assert find_regions(scene).missing["psnr_consistent"] == "test photos hold no distractors"
    mixed = replace(scene, info={**scene.info, "split": "every-8"})
    pixels = find_regions(mixed).pixels["psnr_consistent"]
    assert pixels[view.name][hidden].mean() < 0.1  # without the distractor's own rim
    inside = np.s_[4:-4, 8:-8]  # near the rim fewer than three photos look
    assert pixels[view.name][inside][~hidden[inside]].mean() > 0.8 and pixels[other.name][inside].mean() > 0.9
    # a model that draws the distractor, and the wall a little worse, has more PSNR than the wall itself
    ghost, wall = np.where(hidden[..., None], photo, clean * 0.9).astype(np.uint8), clean
    rows, missing = measure_images(
        [(view.name, picture[..., ::-1].copy(), photo[..., ::-1].copy()) for picture in (ghost, wall)],
        [metrics()[key] for key in ("psnr", "psnr_consistent")],
        mixed,
    )
    (of_ghost, of_wall) = rows
    assert not missing and of_ghost["psnr"] > of_wall["psnr"] + 5
    assert of_wall["psnr_consistent"] > of_ghost["psnr_consistent"] + 5
