"""No training starts from points in space that photos show to be free."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.core.scene import SparsePoints
from ambiguous_wild.splat.free_space import free_space_violations
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks

RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.9, 0.1)
PLACE = (1.5, 0.3, 7.0)
Colour = tuple[float, float, float]


def a_wall(xs: Iterable[float] = np.linspace(-1, 4, 8), slope: float = 0.0) -> np.ndarray:
    """Points in five rows from y = -2 to 2, at depth 10 + slope * x."""
    return np.array([(x, y, 10.0 + slope * x) for y in np.linspace(-2, 2, 5) for x in xs])


def capture(
    place: tuple[float, float, float],
    observed: Sequence[int],
    *,
    at: Sequence[float] = (0, 1, 2, 3),
    wall: np.ndarray | None = None,
    wall_observed: Sequence[int] | None = None,
) -> SimpleNamespace:
    """Train data: cameras that look along z at a wall, whose points all observe, and one more point, row 0.

    Args:
        place: position of that point.
        observed: photos that observe it; the first after the train photos is a test photo.
        at: x of the train cameras.
        wall, wall_observed: points of the wall, and photos that observe them, if not `a_wall` and all.
    """
    wall = a_wall() if wall is None else wall
    cameras = []
    for x in [*at, 0.0]:
        pose = np.eye(4)
        pose[0, 3] = -float(x)
        cameras.append(Camera(100, 80, 100.0, 100.0, 50.0, 40.0, pose))
    views = [
        SimpleNamespace(name=f"{k}", camera=camera, split="train" if k < len(at) else "test")
        for k, camera in enumerate(cameras)
    ]
    seen = list(range(len(at))) if wall_observed is None else wall_observed
    tracks = [np.array(observed, np.int32), *[np.array(seen, np.int32)] * len(wall)]
    offsets = np.cumsum([0, *map(len, tracks)])
    xyz, total = np.concatenate([[place], wall]), int(offsets[-1])
    points = SparsePoints(
        xyz, np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz)), offsets, np.concatenate(tracks),
        np.zeros((total, 2), np.float32),
    )  # fmt: skip
    count = len(at)
    return SimpleNamespace(
        scene=SimpleNamespace(points=points, views=views, train=views[:count]), cameras=cameras[:count],
        photos=[torch.full((80, 100, 3), 0.5)] * count, user_keep=[None] * count, device="cpu",
    )  # fmt: skip


def left_out(data: SimpleNamespace) -> bool:
    """Whether the first point is; points of the wall never are."""
    found = free_space_violations(data)
    assert not found[1:].any()
    return bool(found[0])


@pytest.mark.parametrize(
    ("place", "observed", "gone"),
    [
        ((1.0, 0.0, 5.9), (0, 1), True),  # photos 2 and 3 do not observe it
        ((1.0, 0.0, 5.9), (0, 1, 4), True),  # a test photo confirms nothing
        ((1.0, 0.0, 5.9), (0, 0, 0), True),  # one photo, however often
        ((1.0, 0.0, 6.1), (0, 1), False),  # six tenths of 10
        ((0.65, 0.0, 5.9), (0, 1), True),  # photo 3 has it at 10.2 px, and the wall from 10 px on
        ((0.63, 0.0, 5.9), (0, 1), False),  # only photo 2 has it before the wall
        ((1.0, 1.1, 5.9), (0, 1), True),
        ((1.0, 1.2, 5.9), (0, 1), False),  # below the wall, where nothing speaks against ground
        ((1.0, 0.0, -1.0), (0, 1), False),  # behind the cameras
    ],
)
def test_points_close_to_photos_that_do_not_observe_them(place, observed, gone):
    data = capture(place, observed)
    assert left_out(data) == gone
    start = MethodHooks().first_gaussians(data)
    np.testing.assert_array_equal(start.means, data.scene.points.xyz[gone:].astype(np.float32))


def test_three_photos_may_confirm_something_near():
    at = [0, 0.5, 1, 1.5, 2]
    assert left_out(capture((1.0, 0.0, 5.9), (0, 1), at=at))
    assert not left_out(capture((1.0, 0.0, 5.9), (0, 1, 2), at=at))


def test_a_point_beside_a_near_one_may_be_right():
    wall = a_wall()
    place = tuple((wall[19] - [2.5, 0.0, 0.0]) * 0.5 + [2.5, 0.0, 0.0])
    assert left_out(capture(place, (0, 1)))
    wall[19, 2] = 8.0  # 0.6 of it is nearer than the point, which stands beside it in both photos
    assert not left_out(capture(place, (0, 1), wall=wall))


def test_a_point_no_nearer_than_others_elsewhere_may_be_right():
    wall = a_wall()
    wall[wall[:, 0] > 3, 2] = 7.0
    assert not left_out(capture((1.0, 0.0, 5.9), (0, 1), wall=wall))


def test_points_in_a_line_or_none_enclose_nothing():
    wall = a_wall()
    wall[:, 1] = 0.0
    assert not left_out(capture((1.0, 0.0, 5.9), (0, 1), wall=wall))
    assert left_out(capture((1.0, 0.0, 5.9), (0, 1), at=[0, 1, 2, 3, 4], wall_observed=[0, 1, 2, 3]))


def test_photos_without_long_tracks_have_no_free_space():
    assert not left_out(capture((1.0, 0.0, 5.9), (0, 1), wall_observed=(0, 1)))
    scene = SimpleNamespace(points=SparsePoints.without_tracks(np.ones((5, 3))), views=[], train=[])
    scan = SimpleNamespace(scene=scene, cameras=[], photos=[], user_keep=[])
    assert not free_space_violations(scan).any()


def test_points_of_the_user_are_all_started_from():
    data = capture((1.0, 0.0, 5.9), (0, 1))
    hooks = MethodHooks(user_start=(data.scene.points.xyz, data.scene.points.rgb))
    start = hooks.first_gaussians(data)
    assert isinstance(start, Gaussians) and len(start) == 41


def draw(
    data: SimpleNamespace,
    shown: Mapping[int, Colour],
    *,
    slope: float = 0.0,
    half: float = 4.5,
    gains: Sequence[float] = (),
) -> SimpleNamespace:
    """Give photos of a wall with waves of colour, at depth 10 + slope * x; a square hides the first point.

    Args:
        data: of `capture`; changed, and returned.
        shown: photo -> colour of the square in it.
        slope: of the wall along x.
        half: half the side of the square, px.
        gains: of the photos' exposure.
    """
    columns, rows = np.meshgrid(np.arange(100) + 0.5, np.arange(80) + 0.5)
    photos = []
    for k, camera in enumerate(data.cameras):
        x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
        # on the ray centre + z (x, y, 1): z = 10 + slope (centre + z x)
        z = (10.0 + slope * camera.center[0]) / (1.0 - slope * x)
        across, down = camera.center[0] + z * x, z * y
        waves = [np.sin(4 * across), np.cos(4 * down), np.sin(2 * (across + down))]
        photo = 0.5 + 0.3 * np.stack(waves, axis=-1)
        if k in shown:
            (column, row), _ = (found[0] for found in camera.project(data.scene.points.xyz[:1]))
            photo[(abs(columns - column) < half) & (abs(rows - row) < half)] = shown[k]
        photos.append(torch.from_numpy((photo * (gains[k] if gains else 1.0)).astype(np.float32)))
    data.photos = photos
    return data


@pytest.mark.parametrize("slope", [0.0, 1.0])
@pytest.mark.parametrize(
    ("shown", "gone"),
    [
        ({0: RED, 1: RED}, True),  # gone in photos 2 and 3
        ({0: RED, 1: RED, 2: RED}, False),  # photo 3 alone sees the wall
        ({0: RED, 1: RED, 2: RED, 3: RED}, False),  # there, though two photos have no match
        # hidden by something else, of which no other photo shows the colour on the wall
        ({0: RED, 1: RED, 2: GREEN, 3: (0.1, 0.1, 0.9)}, False),
    ],
)
def test_photos_that_show_the_surface_see_through_a_point(slope, shown, gone):
    data = capture(PLACE, (0, 1), wall=a_wall(np.linspace(-1, 6, 11), slope))
    assert left_out(draw(data, shown, slope=slope)) == gone
    data.photos = [photo.repeat_interleave(4, 0).repeat_interleave(4, 1) for photo in data.photos]
    assert left_out(data) == gone  # larger photos are reduced


def test_a_photo_that_observes_a_point_does_not_see_through_it():
    assert not left_out(draw(capture(PLACE, (0, 1, 2)), {0: RED, 1: RED}))


@pytest.mark.parametrize(("depth", "gone"), [(8.8, True), (9.2, False)])
def test_points_nearly_on_the_surface_are_of_it(depth, gone):
    data = capture((2.5, 0.3, depth), (0, 1, 2), at=[0, 1, 2, 3, 4, 5])
    assert left_out(draw(data, dict.fromkeys((0, 1, 2), RED), half=1.5)) == gone


@pytest.mark.parametrize(("difference", "gone"), [(0.1, True), (0.04, False)])
def test_what_is_another_colour(difference, gone):
    data = draw(capture(PLACE, (0, 1)), {})
    data.photos = [torch.full((80, 100, 3), 0.5) for _ in range(4)]
    for k in (0, 1):
        column, row = data.cameras[k].project(np.array([PLACE]))[0][0].astype(int)
        data.photos[k][row - 4 : row + 5, column - 4 : column + 5] += difference
    assert left_out(data) == gone


@pytest.mark.parametrize(("photos", "gone"), [(9, True), (10, False)])
def test_four_times_as_many_photos_that_show_the_point_outweigh_the_others(photos, gone):
    at = [0.3 * k for k in range(photos)]  # photos 0 and 1 observe it, 2 and 3 see through it
    there = {k: RED for k in range(photos) if k not in (2, 3)}
    assert left_out(draw(capture(PLACE, (0, 1), at=at), there)) == gone


def test_a_wide_triangle_says_nothing_of_colours():
    corners = [(x, y) for x in (-1, 4) for y in (-2, 2)]
    near = np.linspace(-0.05, 0.05, 3)
    wall = np.array([(x + a, y + b, 10.0) for x, y in corners for a in near for b in near])
    assert not left_out(draw(capture(PLACE, (0, 1), wall=wall), {0: RED, 1: RED}))


def test_photos_that_have_point_and_place_closer_together_are_not_asked():
    # the last three stand at one place, and something hides the point from them
    data = capture(PLACE, (0, 1), at=[0, 1, 2, 2, 2])
    assert not left_out(draw(data, {0: RED, 1: RED, 2: GREEN, 3: GREEN, 4: GREEN}))


@pytest.mark.parametrize("gain", [1.0, 1.3])
@pytest.mark.parametrize(("there", "gone"), [(range(8), False), ((0, 1), True)])
def test_exposure_does_not_count_as_another_colour(gain, there, gone):
    data = capture(PLACE, (0, 1), at=[0.4 * k for k in range(8)])
    gains = [1.0] * 3 + [gain] * 5
    assert (
        left_out(draw(data, dict.fromkeys(there, (0.7, 0.2, 0.2)), gains=[0.75 * g for g in gains])) == gone
    )


def test_masked_pixels_say_nothing():
    data = capture((1.0, 0.0, 5.9), (0, 1))
    keep = torch.ones(80, 100)
    keep[:, :50] = 0.0  # photos 2 and 3 have the point left of their middle
    data.user_keep = [None, None, 1.0 - keep, None]
    assert left_out(data)
    data.user_keep = [None, None, keep, None]
    assert not left_out(data)
    data = draw(capture(PLACE, (0, 1)), {0: RED, 1: RED})
    data.user_keep = [torch.zeros(40, 50), torch.zeros(40, 50), None, None]  # nobody confirms but 2 and 3
    assert not left_out(data)


def test_photos_smaller_than_the_scene():
    """As a plan of effects has them."""
    data = draw(capture(PLACE, (0, 1)), {0: RED, 1: RED})
    data.cameras = [camera.resized(50, 40) for camera in data.cameras]
    data.photos = [photo.reshape(40, 2, 50, 2, 3).mean((1, 3)) for photo in data.photos]
    data.user_keep = [torch.ones(40, 50)] * 4
    assert left_out(data)
