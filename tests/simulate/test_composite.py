"""Composites: exact masks, untouched test photos, right size and place, and nothing where it may not be."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.scene_folder import load_scene, read_scene_json
from ambiguous_wild.simulate.composite_scene import composite
from ambiguous_wild.simulate.cutouts import read_cutouts
from ambiguous_wild.simulate.placement import (
    CompositeConfig,
    local_colours,
    place_cutouts,
    scene_spread,
    visible_points,
)
from tests.io.model_maker import HEIGHT, WIDTH, write_scene

# every eighth is a test photo: back/p00, back/p08, front/p07
NAMES = [f"{side}/p{i:02d}.png" for side in ("back", "front") for i in range(9)]
CONFIG = CompositeConfig(coverage=0.12, seed=3)


def write_rgba(path: Path, rgba: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))


def disc(colour: tuple[int, int, int], side: int = 24) -> np.ndarray:
    """[side, side, 4] uint8: a disc of one colour on nothing."""
    rows, columns = np.mgrid[:side, :side] - (side - 1) / 2
    alpha = np.where(np.hypot(rows, columns) < side / 2 - 1, 255, 0).astype(np.uint8)
    return np.dstack([np.full((side, side, 3), colour, np.uint8), alpha])


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("scenes") / "base"
    write_scene(root, NAMES, points=120)
    return root


@pytest.fixture(scope="module")
def cutouts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cutouts")
    for name, colour in (("one", (250, 20, 20)), ("two", (20, 250, 20)), ("wide", (20, 20, 250))):
        rgba = disc(colour)
        write_rgba(folder / f"{name}.png", np.repeat(rgba, 2, 1) if name == "wide" else rgba)
    return folder


@pytest.fixture(scope="module")
def made(base: Path, cutouts: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "made"
    composite(base, out, CONFIG, cutouts)
    return out


def plain_scene(root: Path, colour: tuple[int, int, int], factor: int = 2) -> Path:
    """A scene of which every photo is of one colour."""
    write_scene(root, NAMES, factor=factor, points=120)
    for name in NAMES:
        for part, n in (("images", 1), (f"images_{factor}", factor)):
            photo = np.full((HEIGHT // n, WIDTH // n, 3), colour, np.uint8)
            write_png(root / part / name, photo)
    return root


def linear(photo: np.ndarray) -> np.ndarray:
    x = photo / 255.0
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def test_test_photos_model_and_lists_are_those_of_the_source(base: Path, made: Path) -> None:
    before, after = load_scene(base), load_scene(made)
    assert [(v.name, v.split) for v in after.views] == [(v.name, v.split) for v in before.views]
    assert after.name == "made" and len(after.points) == len(before.points)
    for folder in ("images", "images_2"):
        for view in after.test:
            assert sha256_file(made / folder / view.name) == sha256_file(base / folder / view.name)
        for view in after.train:
            assert sha256_file(made / folder / view.name) != sha256_file(base / folder / view.name)
    for path in (base / "sparse/0").iterdir():
        assert sha256_file(path) == sha256_file(made / "sparse/0" / path.name)


def test_truth_lies_beside_every_train_photo_and_tells_the_truth(base: Path, made: Path) -> None:
    scene = load_scene(made)
    for part in ("distractor", "clean"):
        folder = made / "truth" / part
        assert sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*.png")) == [
            v.name for v in scene.train
        ]
    facts = json.loads((made / "truth/composite.json").read_text())
    assert list(facts) == [
        "schema", "version", "source", "config", "mask", "poses", "cutouts", "occlusion", "photos",
    ]  # fmt: skip
    for view in scene.train:
        photo = read_png_rgb(view.image_path)
        clean = read_png_rgb(made / "truth/clean" / view.name)
        mask = read_gray(made / "truth/distractor" / view.name) > 0
        assert np.array_equal(clean, read_png_rgb(base / "images" / view.name))
        assert mask.shape == photo.shape[:2] and mask.any()
        gap = np.abs(linear(photo) - linear(clean)).max(2)
        # Less than a quarter of a pixel may lie outside the mask; three pixels away nothing changed.
        around = cv2.dilate(mask.astype(np.uint8), np.ones((7, 7))) > 0
        assert not gap[~around].any() and gap[~mask].max() <= 0.25 + 0.01
        assert facts["photos"][view.name]["occlusion"] == pytest.approx(mask.mean(), abs=1e-6)
        assert (gap[mask] > 0.02).mean() > 0.9


def test_mean_coverage_is_what_was_asked_for(base: Path, cutouts: Path, tmp_path: Path) -> None:
    facts = composite(base, tmp_path / "out", replace(CONFIG, coverage=0.25), cutouts)
    assert facts["occlusion"]["mean"] == pytest.approx(0.25, rel=0.2)


def test_same_seed_same_bytes_another_seed_other_places(
    base: Path, cutouts: Path, made: Path, tmp_path: Path
) -> None:
    composite(base, tmp_path / "made", CONFIG, cutouts)
    again = read_scene_json(tmp_path / "made")
    assert again == read_scene_json(made)
    other = composite(base, tmp_path / "other", replace(CONFIG, seed=4), cutouts)
    here = json.loads((made / "truth/composite.json").read_text())
    assert all(other["photos"][n]["distractors"] != p["distractors"] for n, p in here["photos"].items())


def test_scene_json_says_how_it_was_made_and_is_not_a_builds(
    base: Path, cutouts: Path, tmp_path: Path
) -> None:
    write_scene(tmp_path / "base", NAMES, points=120)
    source: dict[str, object] = {"schema_version": 1, "factor": 2, "name": "b", "files": {}}
    source |= {"build_key": "k", "license": "CC0-1.0"}
    (tmp_path / "base/scene.json").write_text(json.dumps(source))
    composite(tmp_path / "base", tmp_path / "out", CONFIG, cutouts)
    info = read_scene_json(tmp_path / "out")
    assert (
        info is not None and "build_key" not in info and info["factor"] == 2 and info["images"] == "images_2"
    )
    assert list(info["composite"]) == ["source", "config", "cutouts", "occlusion", "poses"]
    assert info["composite"]["source"]["scene_json"] == sha256_file(tmp_path / "base/scene.json")
    assert {c["sha256"] for c in info["composite"]["cutouts"]} == {sha256_file(p) for p in cutouts.iterdir()}
    assert info["composite"]["config"]["seed"] == 3 and info["license"].startswith("CC0-1.0; cut-outs")
    present = {
        p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*") if p.is_file()
    }
    assert info["files"].keys() == present - {"scene.json"}
    assert load_scene(tmp_path / "out").train[0].camera.width == WIDTH // 2
    assert read_gray(tmp_path / "out/truth/distractor/back/p01.png").shape == (HEIGHT // 2, WIDTH // 2)


def test_every_size_shows_the_same_thing(cutouts: Path, tmp_path: Path) -> None:
    """The small photo is the large one averaged over areas in linear light, up to rounding to 8 bits."""
    root = plain_scene(tmp_path / "plain", (90, 120, 60))
    composite(root, tmp_path / "out", replace(CONFIG, shadow=0.4), cutouts)
    for view in load_scene(tmp_path / "out").train:
        large = linear(read_png_rgb(tmp_path / "out/images" / view.name))
        small = linear(read_png_rgb(tmp_path / "out/images_2" / view.name))
        mean = large.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3))
        np.testing.assert_allclose(small, mean, atol=0.012)


def test_nothing_stays_where_it_was(tmp_path: Path) -> None:
    names = [f"p{i:02d}.png" for i in range(40)]
    write_scene(tmp_path / "base", names, points=400)
    scene = load_scene(tmp_path / "base")
    config = replace(CONFIG, presence=1.0)
    stands = place_cutouts(visible_points(scene), scene_spread(scene), config, np.random.default_rng(0), 2)
    for which in range(2):
        spots = np.array([s.position for photo in stands for s in photo if s.which == which])
        assert len(spots) > 0.8 * len(stands)
        close = np.linalg.norm(spots[:, None] - spots[None], axis=2) < 0.04 * scene_spread(scene)
        assert close.sum(1).max() <= 0.2 * len(stands)
    for view, photo in zip(scene.train, stands):
        for s in photo:
            ahead = view.camera.cam_from_world[:3] @ np.append(s.position, 1.0)
            assert 0 < ahead[2] < 6.0  # nearer than the farthest point


def test_presence_is_the_share_of_photos(base: Path) -> None:
    scene = load_scene(base)
    places = visible_points(scene) * 12
    stands = place_cutouts(places, 1e-3, replace(CONFIG, presence=0.4), np.random.default_rng(1), 3)
    share = np.mean([len(s) for s in stands]) / 3
    assert share == pytest.approx(0.4, abs=4 * math.sqrt(0.24 / (3 * len(places))))


def test_patches_of_a_scene_of_one_colour_cannot_be_seen(tmp_path: Path) -> None:
    """Same colour by construction: the photo stays as it was, though the mask says where they are."""
    root = plain_scene(tmp_path / "plain", (90, 120, 60))
    facts = composite(root, tmp_path / "out", replace(CONFIG, patches=True, pose="lying"))
    assert facts["occlusion"]["mean"] > 0.08
    for view in load_scene(tmp_path / "out").train:
        gap = np.abs(read_png_rgb(view.image_path).astype(int) - (90, 120, 60))
        assert gap.max() <= 1
        assert read_gray(tmp_path / "out/truth/distractor" / view.name).max() in (0, 255)


def test_patches_go_where_the_photo_is_like_them(base: Path) -> None:
    """Of photos dark on the left and bright on the right, a dark patch goes left, a bright one right."""
    places, rng = visible_points(load_scene(base)), np.random.default_rng(0)
    middles = [float(np.median(site.uv[:, 0])) for site in places]  # as many points on either side
    around = [np.zeros((HEIGHT, WIDTH, 3)) for _ in places]
    for background, middle in zip(around, middles, strict=True):
        background[..., 0] = np.where(np.arange(WIDTH) < int(middle), 16.0, 88.0)
    away = {0: np.full(3, 1e6)}
    for lightness, right in ((16.0, False), (88.0, True)):
        stands = place_cutouts(places, 1e-3, CONFIG, rng, 1, {0: np.array([lightness, 0, 0])}, around, away)
        sides = [
            site.view.camera.project(np.array([s.position]))[0][0, 0] > middle
            for site, group, middle in zip(places, stands, middles, strict=True)
            for s in group
        ]
        assert len(sides) > 8 and np.mean(np.array(sides) == right) > 0.9


def test_a_patch_is_never_put_back_where_it_is_from(base: Path) -> None:
    scene = load_scene(base)
    places, spread = visible_points(scene), scene_spread(scene)
    photo = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    origin, around = places[0].xyz[0], [local_colours(photo)] * len(places)
    colours = {0: around[0][0, 0]}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        stands = place_cutouts(places, spread, CONFIG, rng, 1, colours, around, {0: origin})
        for site, group in zip(places, stands, strict=True):
            for s in group:  # it stands before a point, on the ray to it
                ray = np.asarray(s.position) - site.view.camera.center
                off = site.xyz - site.view.camera.center
                along = off @ ray / np.linalg.norm(off, axis=1) / np.linalg.norm(ray)
                assert np.linalg.norm(site.xyz[along.argmax()] - origin) >= 0.08 * spread


def test_a_plain_scene_of_jpeg_photos_gets_png_train_photos(cutouts: Path, tmp_path: Path) -> None:
    root = tmp_path / "base"
    write_scene(root, [n.replace(".png", ".jpg") for n in NAMES], points=120)
    for path in root.glob("images*/*/*.jpg"):  # write_scene wrote PNG bytes under these names
        cv2.imwrite(str(path), read_png_rgb(path)[..., ::-1])
    composite(root, tmp_path / "out", CONFIG, cutouts)
    scene = load_scene(tmp_path / "out")
    assert {v.image_path.suffix for v in scene.train} == {".png"}
    assert {v.image_path.suffix for v in scene.test} == {".jpg"}
    photo = read_png_rgb(root / "images" / scene.train[0].name)
    assert np.array_equal(photo, read_png_rgb(tmp_path / "out/truth/clean/back/p01.png"))


def test_cutouts_of_16_bits_are_read_and_cropped_to_what_is_visible(tmp_path: Path) -> None:
    rgba = np.pad(disc((255, 128, 0)), ((10, 3), (5, 7), (0, 0)))
    write_rgba(tmp_path / "deep.png", rgba.astype(np.uint16) * 257)
    (deep,) = read_cutouts(tmp_path)
    write_rgba(tmp_path / "deep.png", rgba)
    (plain,) = read_cutouts(tmp_path)
    assert plain.light.shape == (24, 24, 4)  # 22 px seen and the rim
    np.testing.assert_allclose(deep.light, plain.light, atol=1e-6)


def test_bad_cutouts_are_named(base: Path, tmp_path: Path) -> None:
    with pytest.raises(AwError, match="no folder of cut-outs"):
        composite(base, tmp_path / "out", CONFIG, tmp_path / "none")
    (tmp_path / "c").mkdir()
    with pytest.raises(AwError, match="holds no PNG"):
        composite(base, tmp_path / "out", CONFIG, tmp_path / "c")
    good = disc((1, 2, 3))
    write_rgba(tmp_path / "c/good.png", good)
    write_rgba(tmp_path / "c/opaque.png", np.full((20, 20, 4), 255, np.uint8))
    write_rgba(tmp_path / "c/empty.png", np.zeros((20, 20, 4), np.uint8))
    write_png(tmp_path / "c/rgb.png", good[..., :3])
    with pytest.raises(AwError, match=r"3 of 4 cut-outs .* empty.png, opaque.png, rgb.png"):
        composite(base, tmp_path / "out", CONFIG, tmp_path / "c")
    (tmp_path / "c/cut.png").write_bytes(b"\x89PNG")
    with pytest.raises(AwError, match=r"cannot read image .*cut.png"):
        composite(base, tmp_path / "out", CONFIG, tmp_path / "c")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"coverage": 0.0}, "--coverage 0: it lies between"),
        ({"coverage": 0.9}, "--coverage 0.9"),
        ({"presence": 0.0}, "--presence 0"),
        ({"shadow": 2.0}, "--shadow 2"),
        ({"coverage": 0.6, "presence": 0.1}, "more than 3 cut-outs can cover"),
        ({"coverage": math.nan}, "--coverage nan"),
    ],
)
def test_a_config_that_cannot_be_is_refused(
    base: Path, cutouts: Path, tmp_path: Path, change: dict, expected: str
) -> None:
    with pytest.raises(AwError, match=expected):
        composite(base, tmp_path / "out", replace(CONFIG, **change), cutouts)
    assert list(tmp_path.iterdir()) == []


def test_a_taken_output_and_a_scene_that_will_not_do_are_refused(
    base: Path, cutouts: Path, made: Path, tmp_path: Path
) -> None:
    write_scene(tmp_path / "bare", NAMES, points=0)
    out = tmp_path / "out"
    for words, message in (
        ((base, made, CONFIG, cutouts), "exists"),
        ((base, base / "inside", CONFIG, cutouts), "inside each other"),
        ((made, out, CONFIG, cutouts), "has distractors already"),
        ((base, out, CONFIG), "--cutouts FOLDER"),
        ((tmp_path / "bare", out, CONFIG, cutouts), "has no points"),
        ((tmp_path / "none", out, CONFIG, cutouts), "there is no scene folder"),
    ):
        with pytest.raises(AwError, match=message):
            composite(*words)


def test_a_run_that_breaks_leaves_nothing(base: Path, cutouts: Path, tmp_path: Path) -> None:
    def breaks(views):
        yield views[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        composite(base, tmp_path / "out", CONFIG, cutouts, progress=breaks)
    assert list(tmp_path.iterdir()) == []
