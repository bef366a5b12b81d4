"""What is fixed to the camera is found, and nothing else that stands still in photos is taken for it.

Matches are projections of random points, so that the truth is known and no photo is needed.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder import scene_record
from ambiguous_wild.builder.checks import fixed_to_camera
from ambiguous_wild.builder.fixed_to_camera import FixedArea, find_fixed
from ambiguous_wild.builder.photo_comparison import compare_photos, photo_features
from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.safe_pycolmap import pycolmap
from tests.builder.capture_maker import COUNT, SETTINGS, write_capture, write_split_capture

WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
NOISE_PX = 0.2
Matches = dict[tuple[int, int], np.ndarray]


def _matched(photos: list[np.ndarray], rng: np.random.Generator) -> tuple[list[np.ndarray], Matches]:
    """Return features with noise, and the matches of points that both photos of a pair show.

    Args:
        photos: [P, 2] px a photo; a row is a point, NaN where the photo does not show it.
        rng: source of the noise.
    """
    inside = [((xy >= 0) & (xy < [WIDTH, HEIGHT])).all(axis=1) for xy in photos]
    matches = {}
    for a, b in combinations(range(len(photos)), 2):
        rows = np.flatnonzero(inside[a] & inside[b])
        if len(rows) >= 15:
            matches[a, b] = np.column_stack([rows, rows])
    noisy = [np.nan_to_num(xy + rng.normal(0, NOISE_PX, xy.shape), nan=-1.0) for xy in photos]
    return noisy, matches


def _project(points: np.ndarray, eye: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Project points [P, 3] into a camera that looks along z after the rotation vector `turn`."""
    local = (points - eye) @ cv2.Rodrigues(np.asarray(turn, float))[0].T
    with np.errstate(all="ignore"):
        xy = FOCAL * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2]
    xy[local[:, 2] <= 0.1] = np.nan
    return xy


def _walk(points: np.ndarray, count: int, turn_deg: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Walk sideways past the points with an unsteady hand."""
    turns = np.radians(rng.normal(0, turn_deg, (count, 3)))
    eyes = [np.array([0.25 * k, 0.05 * rng.normal(), 0.0]) for k in range(count)]
    return [_project(points, eye, turn) for eye, turn in zip(eyes, turns)]


def _band(top: float, bottom: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw points [count, 2] px between two heights, over the whole width."""
    return np.column_stack([rng.uniform(0, WIDTH, count), rng.uniform(top * HEIGHT, bottom * HEIGHT, count)])


def _find(
    photos: list[np.ndarray], rng: np.random.Generator, cameras: list[int] | None = None
) -> list[FixedArea]:
    features, matches = _matched(photos, rng)
    sizes = [(WIDTH, HEIGHT)] * len(photos)
    return find_fixed(features, sizes, cameras or [0] * len(photos), matches)


def _scene(rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.uniform(-4, 7, 900), rng.uniform(-3, 3, 900), rng.uniform(3, 8, 900)])


def _with(photos: list[np.ndarray], fixed: np.ndarray, top: float) -> list[np.ndarray]:
    """Add points fixed to the camera, in front of the scene below a height."""
    hidden = [np.where(xy[:, 1:] > top * HEIGHT, np.nan, xy) for xy in photos]
    return [np.vstack([xy, fixed]) for xy in hidden]


def test_a_bonnet_is_found_and_filled_down_to_the_border():
    rng = np.random.default_rng(0)
    photos = _with(_walk(_scene(rng), 8, 1.0, rng), _band(0.8, 0.97, 300, rng), 0.8)
    [area] = _find(photos, rng)
    assert area.photos == list(range(8))
    assert area.share == pytest.approx(0.2, abs=0.03)
    mask = area.keep_mask()
    assert mask.shape == (HEIGHT, WIDTH) and set(np.unique(mask)) == {0, 255}
    assert not mask[round(0.83 * HEIGHT) :].any() and mask[: round(0.76 * HEIGHT)].all()
    assert area.covers(np.array([[320.0, 470.0], [320.0, 100.0], [639.9, 479.9]])).tolist() == [
        True,
        False,
        True,
    ]


def test_only_the_photos_of_its_camera_have_it():
    rng = np.random.default_rng(1)
    views = _walk(_scene(rng), 12, 1.0, rng)
    fixed = _band(0.8, 1.0, 200, rng)
    photos = [*_with(views[:6], fixed, 0.8), *_with(views[6:], np.full_like(fixed, np.nan), 1.0)]
    areas = _find(photos, rng, [1] * 6 + [2] * 6)
    assert [area.photos for area in areas] == [[0, 1, 2, 3, 4, 5]]
    assert [area.photos for area in _find(photos[:6], rng, list(range(6)))] == [[0, 1, 2, 3, 4, 5]]


def test_a_plain_capture_has_none():
    rng = np.random.default_rng(2)
    assert _find(_walk(_scene(rng), 10, 1.0, rng), rng) == []


def test_the_point_that_a_camera_circles_is_not_fixed():
    rng = np.random.default_rng(3)
    points = rng.normal([0, 0, 5], 1.2, (1500, 3))
    photos = []
    for angle in np.linspace(-0.6, 0.6, 10):
        eye = np.array([5 * np.sin(angle), 0, 5 - 5 * np.cos(angle)])
        photos.append(_project(points, eye, np.array([0, angle, 0])))
    features, _ = _matched(photos, rng)
    centre = np.linalg.norm(features[0] - [WIDTH / 2, HEIGHT / 2], axis=1) < 4
    assert centre.any()  # there are points that stand still
    assert _find(photos, rng) == []


@pytest.mark.parametrize("skyline", [False, True])
def test_distant_scenery_is_not_fixed(skyline: bool):
    """A drone flies straight ahead and never turns: what is far stands still, exactly."""
    rng = np.random.default_rng(4)
    depth = 3 * 1.15 ** rng.uniform(0, 40, 1500)
    ground = np.column_stack([depth * rng.uniform(-0.6, 0.6, 1500), np.full(1500, 1.5), depth])
    far = np.column_stack([rng.uniform(-6e4, 6e4, 500), rng.uniform(-4e4, 0, 500), np.full(500, 1e5)])
    points = np.vstack([ground, far]) if skyline else ground
    photos = [_project(points, np.array([0, 0, 0.4 * k]), np.zeros(3)) for k in range(10)]
    assert _find(photos, rng) == []


def test_photos_that_stand_still_have_none():
    """A tripod: all stands still but a passer-by."""
    rng = np.random.default_rng(5)
    still, passer = _band(0, 1, 600, rng), _band(0.4, 0.8, 60, rng) * [0.2, 1.0]
    assert _find([np.vstack([still, passer + np.array([60 * k, 0])]) for k in range(8)], rng) == []


def test_a_camera_that_turns_on_a_tripod_shows_a_bonnet_but_no_scenery():
    rng = np.random.default_rng(6)
    far = np.column_stack([rng.uniform(-90, 90, 900), rng.uniform(-40, 40, 900), np.full(900, 60.0)])
    photos = [_project(far, np.zeros(3), np.array([0, 0.06 * k, 0])) for k in range(8)]
    assert _find(photos, rng) == []
    [area] = _find(_with(photos, _band(0.85, 1.0, 200, rng), 0.85), rng)
    assert area.share == pytest.approx(0.15, abs=0.03)


def test_pixels_complete_an_area_with_few_features_and_tell_who_shows_it():
    """A bonnet with features on its upper edge alone, in front of noise that changes."""
    rng = np.random.default_rng(7)
    edge = _band(0.8, 0.82, 60, rng)
    features, matches = _matched(_with(_walk(_scene(rng), 8, 1.0, rng), edge, 0.8), rng)
    bonnet = np.linspace(90, 160, HEIGHT - round(0.8 * HEIGHT))[:, None] * np.ones(WIDTH)

    def photo(number: int, shown: bool = True) -> np.ndarray:
        noise = np.random.default_rng(100 + number).integers(0, 256, (48, 64), np.uint8)
        grey = cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
        if shown:
            grey[round(0.8 * HEIGHT) :] = bonnet
        return grey

    sizes = [(WIDTH, HEIGHT)] * 8
    [area] = find_fixed(features, sizes, [0] * 8, matches, photo)
    assert area.share == pytest.approx(0.2, abs=0.02)
    assert [area.shown_by(photo(k)) for k in range(8)] == [True] * 8
    assert not any(area.shown_by(photo(k, shown=False)) for k in range(8))


def _over(path: Path, bonnet: np.ndarray) -> None:
    """Paste a bonnet over the lower rows of a photo."""
    photo = cv2.imread(str(path))
    photo[-len(bonnet) :] = bonnet
    cv2.imwrite(str(path), photo, [cv2.IMWRITE_JPEG_QUALITY, 95])


def test_a_scene_is_built_past_a_bonnet(tmp_path: Path):
    """The user's masks are kept, and a test photo without a bonnet gets no mask of it."""
    raw = write_split_capture(tmp_path / "raw")
    bonnet = cv2.resize(
        np.random.default_rng(0).integers(0, 256, (8, 40, 3), np.uint8),
        (320, 60),
        interpolation=cv2.INTER_CUBIC,
    )
    for path in [*sorted((raw / "train").glob("*.jpg")), raw / "test" / "p01.jpg"]:
        _over(path, bonnet)
    for i in range(COUNT):
        mask = np.full((240, 320), 255, np.uint8)
        mask[:, :30] = 0
        write_png(tmp_path / "masks" / f"p{i:02d}.png", mask)
    result = build_scene(raw, tmp_path / "scene", SETTINGS, masks=tmp_path / "masks")
    [fact] = result.info["fixed_to_camera"]
    assert sorted(fact["photos"]) == ["test/p01.jpg", *(f"train/p{i:02d}.jpg" for i in (0, 2, 3, 5))]
    assert (fact["width"], fact["height"], fact["where"]) == (320, 240, "lower")
    assert fact["share"] == pytest.approx(0.25, abs=0.03)
    [line] = scene_record.fixed_lines([fact])
    assert line.startswith(f"the lower {100 * fact['share']:.0f} % of every photo") and "5 photos" in line
    assert result.info["counts"]["registered"] == COUNT
    for name, hidden in {"train/p00": True, "test/p01": True, "test/p04": False}.items():
        keep = read_gray(result.scene / "masks" / f"{name}.png")  # at half of the size
        assert not keep[:, :10].any() and keep[:80, 25:].all()
        assert keep[95:, 25:].any() != hidden
    assert result.info["masks"] is not None
    shares = result.info["masks"]["kept_share"]
    assert shares["p00"] < 0.75 and shares["p04"] == pytest.approx(1 - 30 / 320, abs=1e-3)
    for image in pycolmap.Reconstruction(str(result.scene / "sparse" / "0")).images.values():
        if image.name != "p04.png":
            assert max(p.xy[1] for p in image.points2D if p.has_point3D()) < 0.79 * 240


class CountingBar(Bar):
    """Keeps name, total and steps of each stage."""

    def __init__(self) -> None:
        super().__init__(False)
        self.stages: list[tuple[str, int | None, int]] = []

    def start(self, what: str, total: int | None) -> None:
        self.stages.append((what, total, 0))

    def step(self, count: int = 1) -> None:
        what, total, steps = self.stages[-1]
        self.stages[-1] = (what, total, steps + count)


def test_the_capture_check_names_it_and_compares_the_rest(tmp_path: Path):
    bonnet = cv2.resize(
        np.random.default_rng(0).integers(0, 256, (8, 40, 3), np.uint8),
        (320, 60),
        interpolation=cv2.INTER_CUBIC,
    )
    paths = write_capture(tmp_path / "raw")
    plain = compare_photos([photo_features(read_png_rgb(path)) for path in paths])
    for path in paths:
        _over(path, bonnet)
    bar = CountingBar()
    compared = compare_photos([photo_features(read_png_rgb(path)) for path in paths], bar)
    pairs = len(paths) * (len(paths) - 1) // 2
    assert bar.stages == [("comparing photos", pairs, pairs), (bar.stages[1][0], pairs, pairs)]
    check = fixed_to_camera(compared)
    assert check.state == "warning" and check.finding.startswith("the lower 2") and check.advice
    assert fixed_to_camera(plain).state == "ok" and plain.fixed == []
    assert compared.covisible.tolist() == plain.covisible.tolist()
