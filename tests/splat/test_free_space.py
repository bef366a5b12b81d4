"""No training starts from points in space that photos show to be free."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.core.scene import SparsePoints
from ambiguous_wild.splat.free_space import free_space_violations
from ambiguous_wild.splat.method_hooks import MethodHooks

GREY = [torch.full((80, 100, 3), 0.5)] * 4  # photos that tell nothing
RED = (0.9, 0.1, 0.1)


def a_wall() -> np.ndarray:
    """8 x 5 points from (-1, -2) to (4, 2), 10 away."""
    return np.array([(x, y, 10.0) for y in np.linspace(-2, 2, 5) for x in np.linspace(-1, 4, 8)])


def scene_with(place, photos, wall_photos=4, wall=None) -> SimpleNamespace:
    """Four train cameras 1 apart that look along z at a wall of 40 points; one more point, and a test photo.

    Args:
        place: position of that point.
        photos: indices of the photos that see it; 4 is the test photo.
        wall_photos: train photos that see each of the 40.
        wall: the 40 points; those of `a_wall` if None.
    """
    views = []
    for k in range(5):
        pose = np.eye(4)
        pose[0, 3] = -float(k)
        camera = Camera(100, 80, 100.0, 100.0, 50.0, 40.0, pose)
        views.append(SimpleNamespace(name=f"{k}", camera=camera, split="train" if k < 4 else "test"))
    xyz = np.concatenate([[place], a_wall() if wall is None else wall])
    tracks = [np.array(photos, np.int32), *[np.arange(wall_photos, dtype=np.int32)] * 40]
    offsets = np.cumsum([0, *map(len, tracks)])
    points = SparsePoints(
        xyz, np.zeros((41, 3), np.uint8), np.zeros(41), offsets, np.concatenate(tracks),
        np.zeros((int(offsets[-1]), 2), np.float32),
    )  # fmt: skip
    return SimpleNamespace(points=points, views=views, train=views[:4])


def start_data(scene) -> SimpleNamespace:
    return SimpleNamespace(scene=scene, device="cpu", photos=GREY, user_keep=[None] * 4)


@pytest.mark.parametrize(
    ("place", "photos", "left_out"),
    [
        ((1.0, 0.0, 5.9), (0, 1), True),  # photos 2 and 3 do not show it
        ((1.0, 0.0, 5.9), (0, 1, 2), False),  # a third photo confirms it: something near
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
def test_training_does_not_start_from_points_in_free_space(place, photos, left_out):
    scene = scene_with(place, photos)
    assert free_space_violations(scene, GREY, [None] * 4).tolist() == [left_out] + [False] * 40
    start = MethodHooks().first_gaussians(start_data(scene))
    np.testing.assert_array_equal(start.means, scene.points.xyz[left_out:].astype(np.float32))


def test_a_point_beside_a_near_one_may_be_right():
    wall = a_wall()
    place = (wall[19] - [2.5, 0.0, 0.0]) * 0.5 + [2.5, 0.0, 0.0]
    assert free_space_violations(scene_with(place, (0, 1)), GREY, [None] * 4)[0]
    wall[19, 2] = 8.0  # 0.6 of it is nearer than the point, which stands beside it in both photos
    assert not free_space_violations(scene_with(place, (0, 1), wall=wall), GREY, [None] * 4).any()


def test_points_in_a_line_enclose_nothing():
    wall = a_wall()
    wall[:, 1] = 0.0
    assert not free_space_violations(scene_with((1.0, 0.0, 5.9), (0, 1), wall=wall), GREY, [None] * 4).any()


def test_a_photo_that_masks_the_place_says_nothing_of_it():
    scene = scene_with((1.0, 0.0, 5.9), (0, 1))
    keep = torch.ones(80, 100)
    keep[:, :50] = 0.0  # photos 2 and 3 have the point left of their middle
    assert free_space_violations(scene, GREY, [None, None, 1.0 - keep, None])[0]
    assert not free_space_violations(scene, GREY, [None, None, keep, None]).any()


def test_photos_without_long_tracks_have_no_free_space():
    scene = scene_with((1.0, 0.0, 5.9), (0, 1), wall_photos=2)
    assert not free_space_violations(scene, GREY, [None] * 4).any()
    scan = SimpleNamespace(points=SparsePoints.without_tracks(np.ones((5, 3))), views=[], train=[])
    assert not free_space_violations(scan, [], []).any()


def test_points_of_the_user_are_all_started_from():
    scene = scene_with((1.0, 0.0, 5.9), (0, 1))
    hooks = MethodHooks(given=(scene.points.xyz, scene.points.rgb))
    assert len(hooks.first_gaussians(start_data(scene))) == 41


def photos_of(scene, place, shown, slope=0.0) -> list[torch.Tensor]:
    """Photos of a wall with waves of colour, at depth 10 + slope * x, and of a square around a place.

    Args:
        scene: of `scene_with`.
        place: its centre.
        shown: photo -> colour of the square.
        slope: of the wall along x.
    """
    found = []
    columns, rows = np.meshgrid(np.arange(100) + 0.5, np.arange(80) + 0.5)
    for k, view in enumerate(scene.train):
        camera = view.camera
        x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
        # on the ray centre + z (x, y, 1): z = 10 + slope (k + z x)
        z = (10.0 + slope * k) / (1.0 - slope * x)
        across, down = k + z * x, z * y
        photo = 0.5 + 0.4 * np.stack([np.sin(2 * across), np.cos(2 * down), np.sin(across + down)], axis=-1)
        if k in shown:
            (column, row), _ = (v[0] for v in camera.project(np.array([place])))
            photo[(abs(columns - column) < 5) & (abs(rows - row) < 5)] = shown[k]
        found.append(torch.from_numpy(photo.astype(np.float32)))
    return found


def sloped_wall(slope: float) -> np.ndarray:
    wall = a_wall()
    wall[:, 2] += slope * wall[:, 0]
    return wall


@pytest.mark.parametrize("slope", [0.0, 0.5])
@pytest.mark.parametrize(
    ("depth", "shown", "left_out"),
    [
        (7.0, {0: RED, 1: RED}, True),  # gone in photos 2 and 3
        (9.8, {0: RED, 1: RED}, False),  # as good as on the wall
        (7.0, {0: RED, 1: RED, 2: RED}, False),  # photo 3 alone sees the wall
        (7.0, {0: RED, 1: RED, 2: RED, 3: RED}, False),  # there, though two photos have no match
        # hidden by something else, of which no other photo shows the colour on the wall
        (7.0, {0: RED, 1: RED, 2: (0.1, 0.9, 0.1), 3: (0.1, 0.1, 0.9)}, False),
    ],
)
def test_photos_that_show_the_surface_behind_see_through_a_point(slope, depth, shown, left_out):
    place = (1.5, 0.3, depth + slope * 1.5)
    scene = scene_with(place, (0, 1), wall=sloped_wall(slope))
    photos = photos_of(scene, place, shown, slope)
    assert free_space_violations(scene, photos, [None] * 4).tolist() == [left_out] + [False] * 40


def test_a_photo_that_observes_a_point_does_not_see_through_it():
    place = (1.5, 0.3, 7.0)
    scene = scene_with(place, (0, 1, 2))
    assert not free_space_violations(scene, photos_of(scene, place, {0: RED, 1: RED}), [None] * 4).any()


def test_reduced_photos_show_the_same():
    place = (1.5, 0.3, 7.0)
    scene = scene_with(place, (0, 1))
    for shown, left_out in (({0: RED, 1: RED}, True), (dict.fromkeys(range(4), RED), False)):
        photos = [
            photo.repeat_interleave(4, 0).repeat_interleave(4, 1) for photo in photos_of(scene, place, shown)
        ]
        assert free_space_violations(scene, photos, [None] * 4)[0] == left_out
