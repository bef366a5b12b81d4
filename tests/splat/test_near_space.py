"""The space close before a camera is kept empty; no training starts from points that photos contradict."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.core.scene import SparsePoints
from ambiguous_wild.splat.effects import near_space, with_effects
from ambiguous_wild.splat.effects.near_space import EVERY, NearSpace, free_space_violations
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.training_loop import train
from tests.splat.scenes import trainer_for


def data(seen_by=("a",)):
    """Photos a and b at the origin and at x = 100; 40 points 10 in front of a, seen by those named."""
    cameras = []
    for x in (0.0, 100.0):
        pose = np.eye(4)
        pose[0, 3] = -x
        cameras.append(Camera(100, 80, 100.0, 100.0, 50.0, 40.0, pose))
    views = [SimpleNamespace(name=name, split="train") for name in "ab"]
    rows = ["ab".index(name) for name in seen_by]
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-3, 3, (40, 2)), np.full(40, 10.0)])
    count = 40 * len(rows)
    points = SparsePoints(
        xyz, np.zeros((40, 3), np.uint8), np.zeros(40), np.arange(41) * len(rows),
        np.tile(np.array(rows, np.int32), 40), np.zeros((count, 2), np.float32),
    )  # fmt: skip
    return SimpleNamespace(scene=SimpleNamespace(points=points, views=views, train=views), cameras=cameras)


def near(seen_by=("a",)) -> NearSpace:
    effect = NearSpace()
    effect.setup(data(seen_by))
    return effect


@pytest.mark.parametrize(
    ("place", "held"),
    [
        ((0.0, 0.0, 5.9), True),
        ((0.0, 0.0, 6.1), False),  # six tenths of 10
        ((2.9, 0.0, 5.9), True),
        ((3.0, 0.0, 5.9), False),  # beside the picture
        ((0.0, 2.3, 5.9), True),
        ((0.0, 2.4, 5.9), False),
        ((0.0, 0.0, -1.0), False),  # behind the camera
        ((100.0, 0.0, 1.0), False),  # before b, which sees no points
    ],
)
def test_what_lies_nearer_than_the_points(place, held):
    assert near().holds(torch.tensor([place])).tolist() == [held]


def test_every_camera_that_sees_points_says_so():
    inside = torch.tensor([[100.0, 0.0, 1.0]])
    assert near(seen_by=("a", "b")).holds(inside).all()


def test_it_becomes_transparent_at_intervals():
    gaussians = Gaussians.from_points(
        np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 9.0], [1.0, 0.0, 10.0], [0.0, 1.0, 10.0]]),
        np.full((4, 3), 128, np.uint8),
    )
    before = gaussians.opacity_logits.clone()
    near().after_step(SimpleNamespace(iteration=EVERY + 1), gaussians)
    assert torch.equal(gaussians.opacity_logits, before)
    near().after_step(SimpleNamespace(iteration=EVERY), gaussians)
    assert float(torch.sigmoid(gaussians.opacity_logits[0])) < 0.001
    assert torch.equal(gaussians.opacity_logits[1:], before[1:])


@pytest.fixture
def started(scene, tmp_path, monkeypatch):
    """Makes a trainer whose cameras see all points of the wall; nothing belongs before the wall."""
    monkeypatch.setattr(near_space, "FEW_POINTS", 1)
    monkeypatch.setattr(near_space, "SHARE", 1.0)  # Gaussians that leave the wall are in the way
    every = lambda scene: [np.arange(len(scene.points))] * len(scene.train)  # noqa: E731
    monkeypatch.setattr(near_space, "tracks_of", every)  # the tiny scene has no tracks

    def start(folder, effects=("near",), iterations=260):
        parts = with_effects(MethodHooks(), list(effects))
        return trainer_for(scene, tmp_path / folder, parts=parts, iterations=iterations)

    return start


def test_density_control_takes_what_became_transparent(started):
    without, kept_empty = started("without", ()), started("near")
    train(without)
    train(kept_empty)
    assert kept_empty.effects.facts()["near"]["cameras"] > 0
    assert len(kept_empty.gaussians.means) < len(without.gaussians.means)


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
    assert free_space_violations(scene, [None] * 4).tolist() == [left_out] + [False] * 40
    start = MethodHooks().first_gaussians(SimpleNamespace(scene=scene, device="cpu", user_keep=[None] * 4))
    np.testing.assert_array_equal(start.means, scene.points.xyz[left_out:].astype(np.float32))


def test_a_point_beside_a_near_one_may_be_right():
    wall = a_wall()
    place = (wall[19] - [2.5, 0.0, 0.0]) * 0.5 + [2.5, 0.0, 0.0]
    assert free_space_violations(scene_with(place, (0, 1)), [None] * 4)[0]
    wall[19, 2] = 8.0  # 0.6 of it is nearer than the point, which stands beside it in both photos
    assert not free_space_violations(scene_with(place, (0, 1), wall=wall), [None] * 4).any()


def test_points_in_a_line_enclose_nothing():
    wall = a_wall()
    wall[:, 1] = 0.0
    assert not free_space_violations(scene_with((1.0, 0.0, 5.9), (0, 1), wall=wall), [None] * 4).any()


def test_a_photo_that_masks_the_place_says_nothing_of_it():
    scene = scene_with((1.0, 0.0, 5.9), (0, 1))
    keep = torch.ones(80, 100)
    keep[:, :50] = 0.0  # photos 2 and 3 have the point left of their middle
    assert free_space_violations(scene, [None, None, 1.0 - keep, None])[0]
    assert not free_space_violations(scene, [None, None, keep, None]).any()


def test_photos_without_long_tracks_have_no_free_space():
    scene = scene_with((1.0, 0.0, 5.9), (0, 1), wall_photos=2)
    assert not free_space_violations(scene, [None] * 4).any()
    scan = SimpleNamespace(points=SparsePoints.without_tracks(np.ones((5, 3))), views=[], train=[])
    assert not free_space_violations(scan, []).any()


def test_points_of_the_user_are_all_started_from():
    scene = scene_with((1.0, 0.0, 5.9), (0, 1))
    hooks = MethodHooks(given=(scene.points.xyz, scene.points.rgb))
    assert len(hooks.first_gaussians(SimpleNamespace(scene=scene, device="cpu", user_keep=[None] * 4))) == 41
