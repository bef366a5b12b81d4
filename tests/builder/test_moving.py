"""Features that move: their file, and masks of a distractor that no colour can tell."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.builder.moving_features import Votes, _number_motions, free_space_violation_counts
from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.export import export_scene
from ambiguous_wild.datasets.write import ImportSettings, import_scene
from ambiguous_wild.io.motion_points import (
    FILE,
    NO_POINTS,
    MotionPoints,
    read_motion_points,
    write_motion_points,
)
from ambiguous_wild.io.safe_pycolmap import pycolmap
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.motion import MotionConfig, MotionMask
from ambiguous_wild.methods.refinesplat.hyperparameters import RefineSplatConfig
from ambiguous_wild.methods.refinesplat.recipe import RefineSplatMask
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.vision.motion_maps import (
    CERTAIN,
    MOVES,
    certainly_moving,
    draw_points,
    moving_labels,
    moving_map,
)
from ambiguous_wild.vision.sam import SamInstances
from tests.builder import capture_maker
from tests.builder.capture_maker import HEIGHT, WIDTH, eyes, render

COUNT, SIDE = 12, 240  # photos; texels of the square that slides


def fine_wall(seed: int) -> np.ndarray:
    """Dots of two pixels on one grey: at the size that colours are compared at, all of it is alike."""
    rng = np.random.default_rng(seed)
    image = np.full((512, 512), 128, np.float32)
    for row, column in rng.integers(6, 506, (1500, 2)):
        cv2.circle(image, (int(column), int(row)), 3, float(128 + rng.choice([-90, 90])), -1)
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.fixture(scope="module")
def sliding(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    """A scene in which a square of the wall's own texture slides along it, and where it is: [H, W] bool."""
    folder = tmp_path_factory.mktemp("sliding")
    raw = folder / "raw"
    raw.mkdir()
    wall, where = {seed: fine_wall(seed) for seed in (1, 2, 3)}, {}
    original = capture_maker.texture
    try:
        for k, eye in enumerate(eyes(COUNT)):
            shown, marked = wall[1].copy(), np.zeros((512, 512, 3), np.uint8)
            top, left = 60 + 16 * k, 10 + 22 * k
            shown[top : top + SIDE, left : left + SIDE] = wall[3][:SIDE, :SIDE]
            marked[top : top + SIDE, left : left + SIDE] = 255
            photos = []
            for pixels in (shown, marked):
                textures = {1: pixels, 2: wall[2] if pixels is shown else 0 * marked}
                capture_maker.texture = textures.__getitem__
                photos.append(render(eye, np.array([0.0, 0.0, 5.2])))
            cv2.imwrite(str(raw / f"p{k:02d}.png"), photos[0])
            where[f"p{k:02d}.png"] = photos[1][..., 0] > 127
    finally:
        capture_maker.texture = original
    build_scene(raw, folder / "scene", BuildSettings(factor=1, max_features=1500), jobs=2)
    return folder / "scene", where


def train_data(scene: Path, cache: Path) -> TrainData:
    return load_train_data(load_scene(scene), device=torch.device("cpu"), seed=0, cache_dir=cache)


def overlap(masks: dict[str, np.ndarray], where: dict[str, np.ndarray]) -> tuple[float, float]:
    """Share of the square that is masked, and of the rest."""
    inside, outside = [], []
    for name, mask in masks.items():
        square = cv2.resize(where[name].astype(np.uint8), mask.shape[::-1]) > 0  # undistorted, a pixel less
        inside.append(mask[square].mean())
        outside.append(mask[~square].mean())
    return float(np.mean(inside)), float(np.mean(outside))


def first_masks(data: TrainData, motion: float) -> dict[str, np.ndarray]:
    config = RefineSplatConfig()
    policy = RefineSplatMask(replace(config, first_look=replace(config.first_look, motion=motion, least=0.0)))
    policy.setup(data)
    return {
        view.name: np.zeros(data.photos[k].shape[:2], bool)
        if (keep := policy.first[k]) is None
        else keep.numpy() < 0.5
        for k, view in enumerate(data.scene.train)
    }


def test_a_square_of_the_walls_texture_is_masked_by_its_motion_alone(sliding, tmp_path):
    scene, where = sliding
    data = train_data(scene, tmp_path)
    inside, outside = overlap(first_masks(data, 1.0), where)
    assert inside > 0.5 and outside < 0.05
    inside, outside = overlap(first_masks(data, 0.0), where)
    assert inside < 0.1
    alone = MotionMask(MotionConfig())
    alone.setup(data)
    masks = {view.name: keep.numpy() < 0.5 for view, keep in zip(data.scene.train, alone.keeps)}
    inside, outside = overlap(masks, where)
    assert inside > 0.7 and outside < 0.05


def test_points_lie_where_they_move(sliding):
    scene, where = sliding
    points = read_motion_points(scene)
    assert set(points) == {view.name for view in load_scene(scene).train}  # test photos say nothing
    for name, found in points.items():
        x, y = np.clip(found.xy * [WIDTH, HEIGHT], 0, [WIDTH - 1, HEIGHT - 1]).astype(int).T
        on = cv2.dilate(where[name].astype(np.uint8), np.ones((5, 5), np.uint8))[y, x] > 0
        assert on[found.moves].mean() > 0.9 and on[~found.moves].mean() < 0.05
        assert ((found.motion > 0) == found.moves).all()


def test_a_scene_from_elsewhere_can_be_asked_what_moves(sliding, tmp_path):
    scene, where = sliding
    left_out = export_scene(scene, "nerfstudio", tmp_path / "elsewhere").left_out
    assert "features that move (motion.npz)" in left_out
    with pytest.raises(AwError, match="--motion"):
        imported = import_scene(tmp_path / "elsewhere", tmp_path / "without").scene
        MotionMask(MotionConfig()).setup(train_data(imported, tmp_path))
    imported = import_scene(tmp_path / "elsewhere", tmp_path / "with", ImportSettings(motion=True)).scene
    alone = MotionMask(MotionConfig())
    data = train_data(imported, tmp_path)
    alone.setup(data)
    masks = {Path(v.name).name: keep.numpy() < 0.5 for v, keep in zip(data.scene.train, alone.keeps)}
    inside, outside = overlap(masks, where)
    assert inside > 0.7 and outside < 0.05


def test_poses_that_do_not_fit_the_photos_tell_nothing(sliding, tmp_path):
    export_scene(sliding[0], "nerfstudio", tmp_path / "turned")
    path = tmp_path / "turned" / "transforms.json"
    facts = json.loads(path.read_text())
    for k, frame in enumerate(facts["frames"]):
        turn = cv2.Rodrigues(np.radians(np.random.default_rng(k).uniform(-4, 4, 3)))[0]
        pose = np.array(frame["transform_matrix"])
        pose[:3, :3] = pose[:3, :3] @ turn
        frame["transform_matrix"] = pose.tolist()
    path.write_text(json.dumps(facts))
    with pytest.raises(AwError, match="fit the given poses"):
        import_scene(tmp_path / "turned", tmp_path / "scene", ImportSettings(motion=True))
    assert not (tmp_path / "scene").exists()


def test_what_moves_is_a_prompt(tmp_path):
    class Disc(SamInstances):
        name = "disc"

        def __init__(self):
            """Without weights."""

        def labels(self, photo):
            return np.zeros(photo.shape[:2], np.int32)

        def at_points(self, photo, groups, outside):
            np.testing.assert_allclose(groups, [[[12, 10]] * 3])
            np.testing.assert_allclose(outside, [[108, 90]])
            mask = np.zeros((1, 100, 120), bool)
            mask[0, :40, :50] = True
            return mask

    points = two_points()
    points = MotionPoints(*(np.concatenate([x[:1], x[:1], x]) for x in list(vars(points).values())[:4]))
    labels = moving_labels(Disc(), torch.zeros(100, 120, 3), np.ones((100, 120), np.int32), points, tmp_path)
    assert (labels[:40, :50] == 2).all() and (labels[40:] == 1).all()
    assert moving_map(points, labels, (100, 120))[38, 48] > 0.6  # far from the feature, in its segment


def two_points() -> MotionPoints:
    """One that moves and one that stays."""
    return MotionPoints(
        np.array([[0.1, 0.1], [0.9, 0.9]], np.float32),
        np.array([0, 3], np.uint8),
        np.array([2, 0], np.uint8),
        np.array([1, 0], np.int16),
    )


def test_the_file_comes_back_and_a_damaged_one_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    points = {
        name: MotionPoints(
            rng.random((count, 2), np.float32),
            rng.integers(0, 9, count, np.uint8),
            rng.integers(0, 9, count, np.uint8),
            rng.integers(0, 3, count, np.int16),
        )
        for name, count in (("a.png", 5), ("b.png", 0), ("c.png", 3))
    }
    points["b.png"] = replace(points["b.png"], flow=rng.integers(0, 5, (2, 6, 8), np.uint8))
    assert read_motion_points(tmp_path) == {}
    write_motion_points(tmp_path / FILE, points)
    again = read_motion_points(tmp_path)
    assert list(again) == list(points)
    for name, found in again.items():
        np.testing.assert_array_equal(found.xy, points[name].xy)
        np.testing.assert_array_equal(found.moving, points[name].moving)
        np.testing.assert_array_equal(found.motion, points[name].motion)
        assert found.flow is None if name != "b.png" else (found.flow == points[name].flow).all()
    whole = (tmp_path / FILE).read_bytes()
    for bad in (b"", b"no zip", whole[: len(whole) // 2]):
        (tmp_path / FILE).write_bytes(bad)
        with pytest.raises(AwError, match="damaged"):
            read_motion_points(tmp_path)
    for bit in rng.integers(0, 8 * len(whole), 200).tolist():  # never another error
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        (tmp_path / FILE).write_bytes(flipped)
        with suppress(AwError):
            read_motion_points(tmp_path)
    for xy in (np.nan, -0.1, 1.5):
        write_motion_points(
            tmp_path / FILE, {"a.png": replace(points["c.png"], xy=np.full((3, 2), xy, np.float32))}
        )
        with pytest.raises(AwError, match="do not fit together"):
            read_motion_points(tmp_path)
    two = MotionPoints(
        np.zeros((2, 2), np.float32), np.zeros(1, np.uint8), np.zeros(2, np.uint8), np.zeros(2, np.int16)
    )
    write_motion_points(tmp_path / FILE, {"a": two})
    with pytest.raises(AwError, match="do not fit together"):
        read_motion_points(tmp_path)


def test_a_feature_that_stays_does_not_cut_a_motion_in_two():
    votes = Votes(np.array([0, 0, 3, 0, 0, 0]), np.array([1, 1, 1, 1, 0, 1]), [np.array([0, 1, 2, 3])])
    moves = votes.moving > votes.static
    assert _number_motions(votes, moves).tolist() == [1, 1, 0, 1, 0, 2]


def test_nothing_near_says_nothing():
    points = two_points()
    labels = np.zeros((100, 120), np.int32)
    labels[:30, :40] = 1
    answer = moving_map(points, labels, (100, 120))
    assert answer[10, 12] > 0.7 and answer[90, 108] < 0.3
    assert answer[25, 35] > 0.5  # far away, but in the feature's segment
    assert answer[50, 60] == pytest.approx(0.5, abs=1e-3)


def test_frames_vote_on_pixels_and_segments_without_features():
    flow = np.zeros((2, 50, 60), np.uint8)
    flow[1, :10, :20] = 4
    flow[0, 25:] = 4
    points = replace(NO_POINTS, flow=flow)
    assert points.informative and not NO_POINTS.informative
    labels = np.zeros((100, 120), np.int32)
    labels[:20, :60] = 1  # its left two thirds move, by flow; nothing is known of the rest
    answer = moving_map(points, labels, (100, 120))
    assert answer[10, 20] > CERTAIN and answer[80, 60] < 0.2
    assert MOVES < answer[10, 50] < CERTAIN
    assert answer[40, 100] == pytest.approx(0.5)
    certain = certainly_moving(points, answer)
    assert certain[10, 20] and not certain[10, 50] and not certain[80, 60]
    features = replace(two_points(), moving=np.array([3, 0], np.uint8))
    alone = moving_map(features, labels, (100, 120))
    assert alone.max() > CERTAIN and certainly_moving(features, alone) is None
    silent = replace(features, flow=0 * flow)
    assert certainly_moving(silent, moving_map(silent, labels, (100, 120))) is None
    photo = draw_points(np.full((100, 120, 3), 128, np.uint8), points)
    assert photo[10, 20, 0] > photo[10, 20, 1] and photo[80, 60, 1] > photo[80, 60, 0]


def test_what_stands_in_some_photos_and_is_gone_in_others_is_seen_through():
    rng, cameras = np.random.default_rng(0), 10
    wall = np.column_stack([rng.uniform(-4, 4, (4000, 2)), np.full(4000, 6.0)])
    parcel = np.column_stack([rng.uniform(-0.4, 0.4, (60, 2)), np.full(60, 4.0)])
    board = parcel + np.array([1.5, 0.0, 0.0])  # stands in all photos
    xyz = np.concatenate([wall, parcel, board])
    kind = np.repeat([0, 1, 2], [len(wall), len(parcel), len(board)])
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.PINHOLE, 400.0, 640, 480)
    model.add_camera_with_trivial_rig(camera)
    tracks: dict[int, list[tuple[int, int]]] = {}
    shown = {}  # image -> rows of xyz, one a feature
    for number in range(1, cameras + 1):
        moved = xyz - [0.15 * (number - 5), 0.0, 0.0]
        xy = 400.0 * moved[:, :2] / moved[:, 2:] + [320, 240]
        there = ((xy >= 0) & (xy < [640, 480])).all(axis=1) & ((kind != 1) | (number <= 4))
        for thing in (1, 2):  # hides the wall behind it
            mine = xy[there & (kind == thing)]
            if len(mine):
                hidden = ((xy > mine.min(0)) & (xy < mine.max(0))).all(axis=1)
                there &= ~hidden | (kind != 0)
        shown[number] = np.flatnonzero(there)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-0.15 * (number - 5), 0.0, 0.0]))
        image = pycolmap.Image(f"p{number:02d}", keypoints=xy[shown[number]], camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
        for feature, row in enumerate(shown[number]):
            tracks.setdefault(row, []).append((number, feature))
    for row, places in tracks.items():
        if len(places) > 1:
            elements = [pycolmap.TrackElement(*place) for place in places]
            model.add_point3D(xyz[row], pycolmap.Track(elements), np.zeros(3, np.uint8))
    through = free_space_violation_counts(model, {number: number for number in range(1, cameras + 1)})
    of_kind = [np.concatenate([through[n][kind[shown[n]] == k] for n in shown]) for k in range(3)]
    assert np.mean(of_kind[1] >= 4) > 0.9  # the six photos that it is gone in, less the borders
    assert of_kind[0].max() == 0 and np.mean(of_kind[2] >= 2) < 0.02
