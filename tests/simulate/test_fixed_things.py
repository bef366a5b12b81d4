"""What is fixed to the camera: the same pixels in every photo, exact masks, clean pixels elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ambiguous_wild.core import AwError
from ambiguous_wild.io.images import read_gray, read_png_rgb
from ambiguous_wild.io.photos import Exif
from ambiguous_wild.simulate.capture_writer import simulate
from ambiguous_wild.simulate.composite_photos import _write_jpeg, composite_photos
from ambiguous_wild.simulate.composite_scene import composite
from ambiguous_wild.simulate.fixed_things import alpha_over, overlay_layer
from ambiguous_wild.simulate.placement import CompositeConfig
from ambiguous_wild.simulate.presets import PRESETS, resized
from ambiguous_wild.simulate.spec import FixedThing

HEIGHT, WIDTH = 90, 120


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    for i in range(7):
        pixels = np.dstack([rows + 10 * i, columns, 200 - rows]).astype(np.uint8)
        _write_jpeg(folder / f"p{i:02d}.jpg", pixels, Exif())
    return folder


def test_a_bonnet_covers_the_bottom_and_mirrors_the_scene() -> None:
    dark, light = (np.full((HEIGHT, WIDTH, 3), v, np.float32) for v in (0.0, 0.5))
    first, second = (overlay_layer("bonnet", photo, 0, 3) for photo in (dark, light))
    assert np.array_equal(first[..., 3], second[..., 3])
    assert first[-1, :, 3].min() == 1.0 and first[: HEIGHT // 2, :, 3].max() == 0.0
    assert 0.17 < first[..., 3].mean() < 0.23
    inside = first[..., 3] == 1.0
    np.testing.assert_allclose((second - first)[inside, :3], 0.1, atol=1e-5)  # a fifth of the scene's light
    assert not np.array_equal(first, overlay_layer("bonnet", dark, 0, 4))


def test_the_digits_of_a_stamp_change_and_its_place_does_not() -> None:
    photo = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    first, later = (overlay_layer("stamp", photo, number, 0)[..., 3] for number in (0, 7))
    assert not np.array_equal(first, later)
    assert first[: round(0.85 * HEIGHT)].max() == 0.0 and first[:, -2:].max() == 0.0
    assert 0.002 < first.mean() < 0.05
    columns = np.flatnonzero(first.any(axis=0))
    date = columns[: len(columns) // 2]
    assert np.array_equal(first[:, : date[-1]], later[:, : date[-1]])


def test_layers_add_up_as_light_does() -> None:
    upper = np.array([[[0.2, 0.1, 0.0, 0.5]]], np.float32)
    lower = np.array([[[0.4, 0.4, 0.4, 0.8]]], np.float32)
    np.testing.assert_allclose(alpha_over(upper, lower)[0, 0], [0.4, 0.3, 0.2, 0.9])
    photo = np.array([[[1.0, 0.5, 0.25]]], np.float32)
    twice = alpha_over(upper, alpha_over(lower, photo))
    np.testing.assert_allclose(alpha_over(alpha_over(upper, lower), photo), twice, rtol=1e-6)


@pytest.mark.parametrize("thing", ["bonnet", "stamp"])
@pytest.mark.parametrize("patches", [False, True])
def test_every_photo_of_a_capture_has_it(
    photos: Path, tmp_path: Path, thing: FixedThing, patches: bool
) -> None:
    config = CompositeConfig(fixed=thing, patches=patches, seed=2)
    facts = composite_photos(photos, tmp_path / "raw", config)
    assert facts["config"]["fixed"] == thing
    assert any(photo["distractors"] for photo in facts["photos"].values()) == patches
    for i in range(7):
        name = f"p{i:02d}"
        mask = read_gray(tmp_path / f"raw/truth/distractor/{name}.png") > 0
        clean = read_png_rgb(tmp_path / f"raw/truth/clean/{name}.png")
        photo = np.asarray(Image.open(tmp_path / f"raw/{'test' if i == 3 else 'train'}/{name}.jpg"))
        light = overlay_layer(thing, np.zeros(clean.shape, np.float32), i, 2)[..., 3]
        assert mask[light >= 0.25].all()
        if not patches:
            assert np.array_equal(mask, light >= 0.25)
        far = np.abs(photo.astype(int) - clean).max(axis=2)
        assert far[light > 0.6].mean() > 20 and np.median(far[~mask]) < 4
    assert (facts["occlusion"]["min"] > 0.15) == (thing == "bonnet")


def test_a_scene_has_poses_already(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    with pytest.raises(AwError, match="--fixed is for plain photos"):
        composite(tmp_path / "scene", tmp_path / "out", CompositeConfig(fixed="bonnet"))
    with pytest.raises(AwError, match="--path is for plain photos"):
        composite(tmp_path / "scene", tmp_path / "out", CompositeConfig(path=True, patches=True))


def test_the_preset_has_it_in_train_photos_with_exact_masks(tmp_path: Path) -> None:
    spec = resized(PRESETS["bonnet"], views=3, width=96)
    spec = replace(spec, detail_px_per_m=5.0, samples=1, distractors=(), occlusion=(0.0, 0.0))
    facts = simulate(spec, tmp_path / "raw")
    masks = [read_gray(p) for p in sorted((tmp_path / "raw/truth/distractor").iterdir())]
    assert len(masks) == 3 and all(np.array_equal(mask, masks[0]) for mask in masks)
    assert (masks[0] > 0).mean() == pytest.approx(facts["occlusion"]["mean"], abs=1e-6)
    assert masks[0][-1].all() and not masks[0][: len(masks[0]) // 2].any()
    clean = simulate(replace(spec, fixed=None), tmp_path / "clean")
    assert clean["occlusion"]["max"] == 0.0
    for part in ("test", "truth/clean"):
        for path in sorted((tmp_path / "raw" / part).iterdir()):
            assert path.read_bytes() == (tmp_path / "clean" / part / path.name).read_bytes()
