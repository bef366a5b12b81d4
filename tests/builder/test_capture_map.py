"""What the map shows, on cameras and links that are made up, and that its file is always the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from scipy.spatial.transform import Rotation

from ambiguous_wild.builder.capture_map import (
    CaptureMap,
    MapPhoto,
    component_gaps,
    map_of_model,
    map_of_photos,
    printable,
    short_labels,
    top_view,
)
from ambiguous_wild.builder.map_drawing import NAME_PX, frame, place_labels, with_labels, write_map
from ambiguous_wild.builder.overlap_graph import GrowthForecast
from ambiguous_wild.builder.records import no_model
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera, ModelImage, points_without_tracks
from ambiguous_wild.io.images import read_png_rgb


def looking(centre: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Rotation [3, 3], camera from world, of a camera at `centre` that looks at `target`."""
    ahead = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def ring(count: int, world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and centres of a ring, counterclockwise seen from above, in a rotated world [3, 3]."""
    angles = 2 * np.pi * np.arange(count) / count
    centres = np.column_stack([3 * np.cos(angles), 2 * np.sin(angles), np.full(count, 0.5)]) @ world.T
    middle, up = world @ np.array([0.0, 0.0, 0.2]), world @ np.array([0.0, 0.0, 1.0])
    return np.array([looking(c, middle, up) for c in centres]), centres


@pytest.fixture(params=range(4))
def world(request: pytest.FixtureRequest) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(request.param).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def area(xy: np.ndarray) -> float:
    """Signed area of a polygon [N, 2]: positive counterclockwise."""
    x, y = xy.T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def test_a_ring_is_seen_from_above_and_not_mirrored(world: np.ndarray) -> None:
    rotations, centres = ring(16, world)
    plane = top_view(rotations, centres)
    xy = centres @ plane.T
    assert area(xy) == pytest.approx(16 / 2 * 6 * np.sin(2 * np.pi / 16), rel=1e-6)
    assert np.ptp(xy[:, 0]) == pytest.approx(6, rel=1e-6)  # the long axis is horizontal
    inwards = -(xy - xy.mean(axis=0))
    assert ((rotations[:, 2] @ plane.T) * inwards).sum(axis=1).min() > 0


def test_photos_that_look_one_way_look_up_the_map(world: np.ndarray) -> None:
    centres = np.array([(k, 0.3 * k, 0.0) for k in range(5)], float) @ world.T
    ahead, up = world @ np.array([0.6, 0.8, -0.1]), world @ np.array([0.0, 0.0, 1.0])
    rotations = np.array([looking(c, c + ahead, up) for c in centres])
    x, y = top_view(rotations, centres) @ ahead
    assert x == pytest.approx(0, abs=1e-9) and y > 0
    assert np.cross(*top_view(rotations, centres)) @ up > 0.9


def test_nadir_photos_are_seen_as_from_the_aircraft(world: np.ndarray) -> None:
    grid = np.array([(x, y, 0.05 * ((x + y) % 2)) for x in range(5) for y in range(3)], float) @ world.T
    down = world @ np.array([0.0, 0.0, -1.0])
    # Every second row is flown the other way, so the photos have no common up.
    ups = [world @ np.array([0.0, 1.0 if k % 3 % 2 else -1.0, 0.0]) for k in range(len(grid))]
    rotations = np.array([looking(c, c + down, u) for c, u in zip(grid, ups)])
    plane = top_view(rotations, grid)
    assert np.abs(plane @ down).max() < 0.05
    assert np.cross(plane[0], plane[1]) @ down == pytest.approx(-1, abs=1e-2)


def ground(world: np.ndarray) -> np.ndarray:
    """Points [P, 3] near a plane 4 below the cameras of the nadir tests."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-4, 9, (300, 2)), rng.normal(-4, 0.2, 300)])
    return np.concatenate([points, rng.normal(size=(20, 3)) * 30]) @ world.T


def nadir_photos(places: np.ndarray, ups: np.ndarray, world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and centres of cameras at places [N, 3] that look down, their up towards ups [N, 3]."""
    centres, down = places @ world.T, world @ np.array([0.03, 0.02, -1.0])
    return np.array([looking(c, c + down, world @ u) for c, u in zip(centres, ups)]), centres


STRIP = np.array([(0.1 * (k % 2), k, 0.2 * (k % 3)) for k in range(6)], float)


BACK = np.concatenate([STRIP, STRIP[::-1] + np.array([0.5, 0.0, 0.0])])
GRID = np.array([(x, y, 0.9 * ((x + 2 * y) % 3)) for x in range(4) for y in range(3)], float)


@pytest.mark.parametrize(
    ("places", "ups", "with_points"),
    [
        (STRIP, [1.0] * 6, True),
        (BACK, [1.0] * 6 + [-1.0] * 6, True),
        (STRIP, [1.0, -1.0] * 3, False),  # flown back and forth: cameras are enough
        (GRID, [1.0] * 3 + [-1.0] * 3 + [1.0] * 3 + [-1.0] * 3, True),  # at mixed heights
    ],
)
def test_nadir_photos_on_a_path_are_seen_as_from_the_aircraft(
    world: np.ndarray, places: np.ndarray, ups: list[float], with_points: bool
) -> None:
    rotations, centres = nadir_photos(places, np.array([(0.0, up, 0.0) for up in ups]), world)
    plane = top_view(rotations, centres, ground(world) if with_points else None)
    assert np.cross(*plane) @ world @ np.array([0.0, 0.0, 1.0]) > 0.95
    if places is not GRID:
        assert np.ptp(centres @ plane.T, axis=0).max() == pytest.approx(5, rel=0.05)


def test_a_walk_along_a_facade_is_seen_from_above(world: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    places = np.column_stack([np.arange(9.0), rng.normal(0, 0.1, 9), rng.normal(1.6, 0.05, 9)])
    wall = np.column_stack([rng.uniform(-2, 10, 400), rng.normal(5, 0.1, 400), rng.uniform(0, 6, 400)])
    up, ahead = world @ np.array([0.0, 0.0, 1.0]), world @ np.array([0.0, 1.0, 0.1])
    rotations = np.array([looking(c, c + ahead, up) for c in places @ world.T])
    plane = top_view(rotations, places @ world.T, wall @ world.T)
    assert np.cross(*plane) @ up > 0.95 and plane[1] @ ahead > 0.9


NAMES = [f"IMG_{k}.jpg" for k in range(8)]


def model_of(names: list[str]) -> ColmapModel:
    rotations, centres = ring(8, np.eye(3))
    camera = ModelCamera(1, "PINHOLE", 40, 30, (30.0, 30.0, 20.0, 15.0))
    images = {}
    for k, name in enumerate(NAMES):
        if name in names:
            images[k + 1] = image_of(k + 1, name, rotations[k], centres[k])
    return ColmapModel(
        {1: camera}, images, points_without_tracks(np.random.default_rng(0).normal(size=(50, 3)))
    )


def image_of(number: int, name: str, rotation: np.ndarray, centre: np.ndarray) -> ModelImage:
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    no_points = np.zeros((0, 2)), np.zeros(0, np.int64)
    return ModelImage(number, np.array([w, x, y, z]), -rotation @ centre, 1, name, *no_points)


def all_links(names: list[str]) -> list[tuple[str, str, int]]:
    return [(a, b, 50) for k, a in enumerate(names) for b in names[k + 1 :]]


SOURCES = {name: f"walk/{name}" for name in NAMES}


def drawn_with(registered: list[str], **mapping: Any) -> CaptureMap:
    left_out = {name: "no partner" for name in NAMES if name not in registered}
    return map_of_model(
        model_of(registered), {**no_model(), "left_out": left_out, **mapping}, SOURCES, {NAMES[1]}
    )


def test_test_photos_and_provisional_ones_are_marked() -> None:
    drawn = drawn_with(NAMES, links=all_links(NAMES), provisional=[NAMES[5]])
    assert [p.kind for p in drawn.photos].count("test") == 1 and drawn.photos[1].kind == "test"
    assert [k for k, p in enumerate(drawn.photos) if p.provisional] == [5]
    assert drawn.stars == [] and drawn.advice == [] and not any(p.weak for p in drawn.photos)
    assert drawn.photos[3].name == "walk/IMG_3.jpg"


def test_a_bridge_has_a_star_midway_and_a_sentence() -> None:
    first, second = NAMES[:4], NAMES[4:]
    drawn = drawn_with(NAMES, links=[*all_links(first), *all_links(second), (NAMES[4], NAMES[3], 18)])
    assert [link.ends for link in drawn.links if link.kind == "weak"] == [(3, 4)]
    assert drawn.stars == [tuple(np.mean([drawn.photos[3].xy, drawn.photos[4].xy], axis=0))]
    assert drawn.advice == ["take 2 or 3 photos between walk/IMG_3.jpg and walk/IMG_4.jpg"]


def test_without_links_nothing_is_weak() -> None:
    drawn = drawn_with(NAMES)
    assert drawn.links == [] and drawn.advice == [] and not any(p.weak for p in drawn.photos)


def test_photos_left_out_are_drawn_where_they_would_be() -> None:
    registered = NAMES[:5]
    centre = ring(8, np.eye(3))[1][5]
    drawn = drawn_with(
        registered,
        links=all_links(registered),
        hypotheses={NAMES[5]: centre.tolist()},
        unregistered_links=[(NAMES[0], NAMES[6], 20), (NAMES[4], NAMES[6], 30), (NAMES[6], NAMES[7], 90)],
    )
    by_name = {p.name: p for p in drawn.photos}
    plane = top_view(*(part[:5] for part in ring(8, np.eye(3))))
    assert by_name["walk/IMG_5.jpg"].xy == pytest.approx(tuple(plane @ centre))
    assert by_name["walk/IMG_5.jpg"].kind == "left out" and not by_name["walk/IMG_5.jpg"].unsure
    guess = by_name["walk/IMG_6.jpg"]
    apart = np.linalg.norm(np.subtract(guess.xy, [p.xy for p in drawn.photos[:5]]), axis=1)
    assert guess.unsure and np.argmin(apart) == 4
    assert [link.ends for link in drawn.links if link.kind == "left out"] == [(4, 6)]
    assert "walk/IMG_7.jpg" not in by_name
    assert drawn.listed == ["walk/IMG_5.jpg, walk/IMG_6.jpg, walk/IMG_7.jpg: no partner"]
    assert drawn.advice == ["take 2 or 3 photos between walk/IMG_4.jpg and walk/IMG_6.jpg"]


def test_other_components_are_listed_and_not_drawn() -> None:
    registered = NAMES[:5]
    drawn = drawn_with(registered, links=all_links(registered), components=[registered, NAMES[5:]])
    assert len(drawn.photos) == 5 and drawn.title.startswith("5 of 8 photos registered")
    assert drawn.listed == ["another part, 3 photos: walk/IMG_5.jpg, walk/IMG_6.jpg, walk/IMG_7.jpg"]
    assert drawn.advice == [
        "take a photo that shows both walk/IMG_4.jpg and walk/IMG_5.jpg, to join the parts"
    ]


def test_photos_without_poses_show_the_prediction() -> None:
    links = [(a, b, 40) for a in range(4) for b in range(a + 1, 4)] + [
        (4, 5, 30),
        (4, 6, 30),
        (5, 6, 30),
        (3, 4, 14),
    ]
    growth = GrowthForecast([[0, 1, 2, 3], [4, 5, 6]], [7])
    drawn = map_of_photos([f"{k}.jpg" for k in range(8)], links, growth, component_gaps(growth, links))
    assert [p.kind for p in drawn.photos] == ["train"] * 4 + ["component"] * 3 + ["left out"]
    assert drawn.advice == [
        "take 2 or 3 photos between 3.jpg and 4.jpg",
        "take 2 or 3 photos between 6.jpg and 7.jpg",
    ]
    assert [(link.ends, link.kind) for link in drawn.links if link.kind != "strong"] == [
        ((3, 4), "weak"),
        ((6, 7), "left out"),
    ]
    assert all(p.heading is None for p in drawn.photos) and not drawn.posed


def test_names_cover_no_camera_and_no_other_name() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(50, 350, (60, 2))
    names = [f"IMG_{k:04d}" for k in range(60)]
    registered = place_labels(xy, names, range(60), (400, 400))
    assert 5 < len(registered) < 60 and 0 in registered
    high = NAME_PX
    for k, (x, y) in registered.items():
        wide = 0.6 * NAME_PX * len(names[k])
        assert not ((xy[:, 0] > x) & (xy[:, 0] < x + wide) & (xy[:, 1] > y) & (xy[:, 1] < y + high)).any()
        for other, (u, v) in registered.items():
            assert other == k or abs(u - x) >= wide or abs(v - y) >= high


def test_far_points_do_not_shrink_the_cameras() -> None:
    photos = [MapPhoto(str(k), (float(k), 0.0)) for k in range(11)]
    drawn = CaptureMap("", photos, [], [], [])
    far = replace(drawn, points=np.random.default_rng(0).normal(size=(500, 2)) * 1000)
    assert frame(far)[1] < 2 * frame(drawn)[1]


def test_a_hypothesis_far_away_neither_shrinks_the_map_nor_leaves_it() -> None:
    registered = NAMES[:5]
    links = {"links": all_links(registered), "unregistered_links": [(NAMES[4], NAMES[6], 30)]}
    far = {NAMES[6]: [5000.0, 0.0, 0.0], NAMES[7]: [0.0, 5000.0, 0.0]}
    drawn = drawn_with(registered, hypotheses=far, **links)
    assert frame(drawn)[1] < 1.5 * frame(drawn_with(registered, links=links["links"]))[1]
    (guess,) = (photo for photo in drawn.photos if photo.kind == "left out")
    assert guess.name == "walk/IMG_6.jpg" and guess.unsure  # without a partner, IMG_7 is only listed
    wrong = replace(drawn.photos[0], xy=(5000.0, 0.0), kind="left out")
    assert frame(replace(drawn, photos=[*drawn.photos, wrong]))[1] < 1.5 * frame(drawn)[1]


def test_labels_are_short_and_each_of_one_photo() -> None:
    def labels(*names: str) -> list[str]:
        made = short_labels(names)
        return [made[name] for name in names]

    assert labels("front/000.jpg", "b.jpg", "b.png") == ["front/000", "b.jpg", "b.png"]
    assert labels("x" * 300 + "1234567890.jpg", "y.jpg") == ["…xxx1234567890", "y"]
    same = ["left/2024-05-03_120002.jpg", "right/2024-05-03_120002.jpg"]
    assert labels(*same) == ["left/2024-05-03_120002", "right/2024-05-03_120002"]
    deep = labels(*(f"a/very/long/path/{name}" for name in same))
    assert deep == labels(*same)
    deep = labels(*(f"{day}/very/long/path/{name}" for day in "ab" for name in same[:1]), "c/" + same[1])
    assert len(set(deep)) == 3 and all(label.endswith("/2024-05-03_120002") for label in deep)
    assert labels("images/IMG_0001.jpg", "images/IMG_0002.jpg") == ["IMG_0001", "IMG_0002"]
    ends = labels("2024-05-03_120002.jpg", "left/2024-05-03_120002.jpg")
    assert len(set(ends)) == 2


def test_advice_holds_whole_names_and_each_gap() -> None:
    names = [f"{side}/2024-05-03_12000{k}.jpg" for side in ("left", "right") for k in range(4)]
    growth = GrowthForecast([[0, 1, 2]], [3, 4, 5, 6, 7])
    links = [(0, 1, 40), (0, 2, 40), (1, 2, 40)]
    drawn = map_of_photos(names, links, growth, component_gaps(growth, links))
    assert len(drawn.advice) == 5 and all(".jpg and " in text for text in drawn.advice)
    assert len({with_labels(drawn, text) for text in drawn.advice}) == 5
    assert with_labels(drawn, drawn.advice[0]).endswith("left/2024-05-03_120003")


def test_control_characters_are_replaced() -> None:
    assert printable("a\x1bb.jpg") == "a?b.jpg"


@pytest.mark.parametrize("stars", [[], [(0.0, 0.0)]])
def test_the_heading_names_a_star_only_where_one_is_drawn(
    stars: list[tuple[float, float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts: list[str] = []
    draw = Axes.text

    def text(axes: Axes, x: float, y: float, shown: str, **style: Any) -> Any:
        texts.append(shown)
        return draw(axes, x, y, shown, **style)

    monkeypatch.setattr(Axes, "text", text)
    drawn = CaptureMap("", [MapPhoto("a", (1.0, 1.0))], [], stars, ["take a photo"])
    write_map(drawn, tmp_path / "map.png")
    assert ("Take more photos (star)" in texts) == bool(stars)
    assert ("Take more photos" in texts) == (not stars)


def test_equal_maps_have_equal_bytes_whatever_the_names(tmp_path: Path) -> None:
    drawn = drawn_with(NAMES[:6], links=all_links(NAMES[:6]), unregistered_links=[(NAMES[0], NAMES[6], 20)])
    drawn.photos[0] = replace(drawn.photos[0], name="$\\frac{")  # no formula
    for name in ("a.png", "b.png"):
        write_map(drawn, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    picture = read_png_rgb(tmp_path / "a.png")
    assert picture.shape == (860, 1300, 3) and picture.min() < 50
    assert (tmp_path / "a.png").stat().st_size < 200_000


def test_one_photo_or_cameras_at_one_place_can_be_drawn(tmp_path: Path) -> None:
    write_map(CaptureMap("", [MapPhoto("a", (1.0, 1.0))] * 2, [], [], []), tmp_path / "map.png")
    assert np.isfinite(top_view(np.stack([np.eye(3)] * 3), np.zeros((3, 3)))).all()
