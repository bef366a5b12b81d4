"""Numbers of distractors and static objects in the truth, against cameras.json and the spec's places."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from ambiguous_wild.io.images import read_gray
from ambiguous_wild.simulate import capture_writer
from ambiguous_wild.simulate.photo_render import FIXED
from ambiguous_wild.simulate.presets import preset, resized
from ambiguous_wild.simulate.spec import Distractor, Effects, LensDistortion, Thing, WorldSpec
from ambiguous_wild.simulate.world import World

RADIUS_M = 0.4
PLACES = ((-1.3, -0.9), (1.2, -1.5))  # of two static balls
WAITING = ((-0.4, -1.6), (0.4, -0.9))  # of two balls that are distractors and keep their places
BALL = Distractor(
    "ball", "ball", "vivid", "none", presence=1.0, distance_m=(0.3, 9.0), path="walk", waypoints=WAITING[:1]
)
SPEC = replace(
    resized(preset("tiny"), views=4, width=160),
    detail_px_per_m=5.0,
    occlusion=(0.0, 0.3),
    distractors=(BALL, replace(BALL, name="second", waypoints=WAITING[1:])),
    world=WorldSpec(
        furniture=False,
        things=tuple(Thing("ball", "clay", (*at, 0.0), (2 * RADIUS_M,) * 3) for at in PLACES),
    ),
)
LENS = replace(SPEC, effects=Effects(lens_distortion=LensDistortion(-0.12)))


@pytest.fixture(scope="module", params=[SPEC, LENS], ids=["pinhole", "lens"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, World]:
    out = tmp_path_factory.mktemp("numbers") / "raw"
    capture_writer.simulate(request.param, out, seed=2)
    return out, capture_writer.plan_capture(request.param, 2)[0]


def cameras(raw: Path) -> dict[str, dict]:
    """Cameras of the train photos by stem."""
    known = json.loads((raw / "truth" / "cameras.json").read_text())
    return {path.stem: known[path.name] for path in sorted((raw / "train").iterdir())}


def pixels_of(camera: dict, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that points [N, 3] of the world project into, if inside the photo."""
    local = np.column_stack([points, np.ones(len(points))]) @ np.array(camera["cam_from_world"]).T
    flat = local[:, :2] / local[:, 2:3]
    k1, square = camera.get("distortion", {}).get("k1", 0.0), (flat**2).sum(1, keepdims=True)
    seen = (local[:, 2] > 0) & (1 + 3 * k1 * square[:, 0] > 0)  # farther out the formula folds back
    flat = flat * (1 + k1 * square)
    pixels = np.floor(flat * (camera["fx"], camera["fy"]) + (camera["cx"], camera["cy"])).astype(int)
    inside = seen & ((pixels >= 0) & (pixels < (camera["width"], camera["height"]))).all(1)
    return pixels[inside, 1], pixels[inside, 0]


def nearest_ball(camera: dict, places: Sequence[tuple[float, float]]) -> np.ndarray:
    """Which ball a pixel's middle shows, [H, W] int from 1; 0: none; -1: within two pixels of an edge."""
    rows, columns = np.mgrid[: camera["height"], : camera["width"]] + 0.5
    x, y = (columns - camera["cx"]) / camera["fx"], (rows - camera["cy"]) / camera["fy"]
    radius = np.linspace(0, 2, 4001)
    bent = radius * (1 + camera.get("distortion", {}).get("k1", 0.0) * radius**2)
    rising = slice(int(np.argmax(bent)) + 1)
    away = np.hypot(x, y)
    scale = np.interp(away, bent[rising], radius[rising]) / away
    rays = np.stack([x * scale, y * scale, np.ones_like(x)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    nearest, which = np.full(x.shape, np.inf), np.zeros(x.shape, int)
    for number, at in enumerate(places, 1):
        to = np.array(camera["cam_from_world"]) @ (*at, RADIUS_M, 1.0)
        along = rays @ to[:3]
        inside = RADIUS_M**2 - (to[:3] @ to[:3] - along**2)
        depth = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.inf)
        which = np.where(depth < nearest, number, which)
        nearest = np.minimum(depth, nearest)
    square = np.ones((5, 5), bool)
    edge = ndimage.grey_dilation(which, footprint=square) != ndimage.grey_erosion(which, footprint=square)
    return np.where(edge, -1, which)


def test_each_distractor_has_its_number_of_the_spec(made: tuple[Path, World]) -> None:
    raw, _ = made
    shown = set()
    for stem, camera in cameras(raw).items():
        image = read_gray(raw / "truth" / "instances" / f"{stem}.png")
        which = nearest_ball(camera, (*WAITING, *PLACES))
        expected = np.where(which <= len(WAITING), which, 0)
        np.testing.assert_array_equal(image[which >= 0], expected[which >= 0])
        shown |= set(expected[which > 0].tolist())
    assert shown == {0, 1, 2}


def test_a_static_object_has_one_number_where_it_is_seen_without_distractors(
    made: tuple[Path, World],
) -> None:
    raw, _ = made
    found: dict[int, set[int]] = {1: set(), 2: set()}
    hidden = 0
    for stem, camera in cameras(raw).items():
        image = read_gray(raw / "truth" / "objects" / f"{stem}.png")
        which = nearest_ball(camera, PLACES)
        for ball, numbers in found.items():
            numbers |= set(image[which == ball].tolist())
            assert not np.isin(image[which == 0], list(numbers)).any()
        mask = read_gray(raw / "truth" / "distractor" / f"{stem}.png") > 0
        hidden += int((mask & (which > 0)).sum())
    (first,), (second,) = found.values()
    assert first != second and 0 not in (first, second) and hidden > 50


def test_statue_and_posters_have_numbers_of_their_own_and_the_place_has_none(
    made: tuple[Path, World],
) -> None:
    raw, world = made
    places: dict[str, list] = {}
    for shape in world.shapes:
        if shape.thing == "statue" or shape.thing.startswith("poster "):
            places.setdefault(shape.thing, []).append(shape.center)
    walls = [(x, 4.19, 3.2) for x in (-3.2, -2.6, 0.0, 1.0, 2.9)] + [(-5.59, 0.5, 3.2), (5.59, 0.5, 3.2)]
    ground = [(x, y, 0.0) for x in (-2.2, -0.8, 0.1, 2.4) for y in (-1.2, -0.2, 3.0)]
    found: dict[str, list[int]] = {name: [] for name in places}
    of_place, of_balls = [], set()
    for stem, camera in cameras(raw).items():
        image = read_gray(raw / "truth" / "objects" / f"{stem}.png")
        ball = nearest_ball(camera, PLACES)
        of_balls |= set(image[ball > 0].tolist())
        for name, centres in places.items():
            found[name] += image[pixels_of(camera, np.mean(centres, axis=0)[None])].tolist()
        rows, columns = pixels_of(camera, np.array([*walls, *ground]))
        of_place += image[rows, columns][ball[rows, columns] == 0].tolist()
    assert len(of_place) > 20 and set(of_place) == {0}
    (statue,) = set(found.pop("statue"))
    posters = [{n for n in numbers if n != statue} for numbers in found.values()]  # it hides some of them
    posters = [numbers for numbers in posters if numbers]
    assert all(len(numbers) == 1 for numbers in posters) and len(posters) > 3
    assert len(set.union(*posters, of_balls, {statue, 0})) == len(posters) + 4


def test_masks_shares_and_what_is_fixed_to_the_camera_agree_with_the_numbers(tmp_path: Path) -> None:
    spec = replace(preset("tiny"), train_views=3, test_views=1, width=160, height=90, detail_px_per_m=5.0)
    facts = capture_writer.simulate(replace(spec, fixed="stamp"), tmp_path / "raw", seed=4)
    seen = set()
    for name, photo in facts["photos"].items():
        numbers, mask = (
            read_gray(tmp_path / "raw" / "truth" / part / f"{Path(name).stem}.png")
            for part in ("instances", "distractor")
        )
        np.testing.assert_array_equal(mask, np.where(numbers > 0, 255, 0))
        shares = {n: float((numbers == n).mean()) for n in set(numbers.ravel().tolist()) - {0}}
        assert shares.pop(FIXED) > 0
        placed = {d["which"] + 1: d for d in photo["distractors"]}
        assert shares.keys() == {n for n, d in placed.items() if d["occlusion"] > 0}
        for number, share in shares.items():
            assert placed[number]["occlusion"] == pytest.approx(share, abs=1e-6)
            assert placed[number]["distractor"] == spec.distractors[number - 1].name
        assert photo["occlusion"] == pytest.approx((mask > 0).mean(), abs=1e-6)
        seen |= shares.keys()
    assert seen == {1, 2, 3}
