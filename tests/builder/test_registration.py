"""Photos are registered rightly though a distractor has more matches than the static scene."""

from __future__ import annotations

import json
from collections import defaultdict
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder import sfm
from ambiguous_wild.builder.bundle_adjustment import bundle_adjustment_options
from ambiguous_wild.builder.matched import MAPPED_COVISIBLE, MatchedPhotos, PointLookup, _well_connected
from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.pose_hypothesis import PoseHypothesis, rejection_reason
from ambiguous_wild.builder.registration import Registration
from ambiguous_wild.builder.relative_poses import (
    RelativePose,
    consistent_relative_poses,
    cycle_votes,
    estimate_relative_poses,
    focal_votes,
)
from ambiguous_wild.builder.retrieval import FEW_PHOTOS
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.core import AwError
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.safe_pycolmap import pycolmap
from ambiguous_wild.simulate.capture_writer import simulate
from ambiguous_wild.simulate.presets import PRESETS, resized
from tests.builder.capture_maker import FOCAL, eyes, texture, write_capture

TARGET = np.array([0.0, 0.0, 5.2])


def angle_deg(rotation: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))


def looking(eye: np.ndarray) -> np.ndarray:
    """Rotation of the maker's camera, from world."""
    z = (TARGET - eye) / np.linalg.norm(TARGET - eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def turned(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    return cv2.Rodrigues(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis))[0]


def seen(points: np.ndarray, rotation: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """[N, 2] normalised coordinates of points [N, 3]."""
    local = (points - centre) @ rotation.T
    return local[:, :2] / local[:, 2:]


def test_a_distractor_with_most_matches_does_not_register_its_photos(tmp_path):
    """COLMAP's mapper alone turns the first photo by more than 20 degrees here."""
    count, size, corners = 8, (170, 190), {0: (40, 60), 5: (50, 70), 7: (40, 90)}
    paths = write_capture(tmp_path / "raw", count)
    for k, (top, left) in corners.items():
        photo = cv2.imread(str(paths[k]))
        pasted = cv2.resize(texture(9), size[::-1], interpolation=cv2.INTER_AREA)
        photo[top : top + size[0], left : left + size[1]] = pasted
        cv2.imwrite(str(paths[k]), photo, [cv2.IMWRITE_JPEG_QUALITY, 95])
    settings = BuildSettings(factor=1, max_features=800)
    info = build_scene(tmp_path / "raw", tmp_path / "scene", settings, jobs=2).info
    model = read_model(tmp_path / "scene" / "sparse" / "0")
    found = {int(i.name[1:3]): i.cam_from_world()[:3, :3] for i in model.images.values()}
    true = {k: looking(eye) for k, eye in enumerate(eyes(count))}
    off = {
        k: np.median([angle_deg((found[k] @ found[j].T) @ (true[k] @ true[j].T).T) for j in found if j != k])
        for k in found
    }
    assert len(found) >= count - 1 and max(off.values()) < 1.0
    assert model.points.rgb.mean() > 40  # else training starts black
    assert {p["source"] for p in info["lost"]} == {f"p{k:02d}.jpg" for k in set(true) - set(found)}
    assert info["cameras"][0]["focal_px"] == pytest.approx(FOCAL, rel=0.03)
    registered = [p for p in info["photos"].values() if p["split"]]
    assert len(registered) == len(found) and all(p["partners"] >= 2 for p in registered)


@pytest.mark.slow
def test_outward_views_keep_the_focal_length_that_the_pairs_voted_for(tmp_path):
    """COLMAP's mapper takes 339 px here, and the adjustment of its model 346."""
    simulate(resized(PRESETS["yard"], width=480), tmp_path / "raw", seed=2)
    info = build_scene(tmp_path / "raw", tmp_path / "scene", BuildSettings(factor=1), jobs=2).info
    true = json.loads((tmp_path / "raw" / "truth" / "cameras.json").read_text())["IMG_0001.jpg"]["fx"]
    assert info["counts"]["registered"] == 38
    assert info["cameras"][0]["focal_px"] == pytest.approx(true, rel=0.005)


def test_a_pair_has_the_relative_poses_of_the_static_scene_and_of_the_distractor():
    rng = np.random.default_rng(0)
    static = rng.uniform([-2, -2, 4], [2, 2, 8], (60, 3))
    mover = rng.uniform([-1, -1, 3], [1, 1, 4], (140, 3))
    eye, rotation = np.array([0.6, 0.1, 0.2]), turned((0, 1, 0), 6)
    other_eye, other = np.array([-0.2, 0.8, 0.1]), turned((0.2, 0.3, 1), 20)
    first = np.concatenate([seen(static, np.eye(3), np.zeros(3)), seen(mover, np.eye(3), np.zeros(3))])
    second = np.concatenate([seen(static, rotation, eye), seen(mover, other, other_eye)])
    found = estimate_relative_poses(first, second, 1e-3)
    assert len(found) >= 2
    assert angle_deg(found[0].rotations[0] @ other.T) < 0.5 and (found[0].matches >= 60).mean() > 0.95
    assert angle_deg(found[1].rotations[0] @ rotation.T) < 0.5 and (found[1].matches < 60).mean() > 0.95


def test_a_plane_leaves_several_decompositions_and_the_right_one_is_among_them():
    rng = np.random.default_rng(1)
    flat = np.column_stack([rng.uniform(-2, 2, (80, 2)), np.zeros(80)]) @ turned((1, 0.4, 0), 40).T + [
        0,
        0,
        6,
    ]
    eye, rotation = np.array([1.5, 0.2, 0.3]), turned((0, 1, 0.1), -12)
    (found, *_) = estimate_relative_poses(seen(flat, np.eye(3), np.zeros(3)), seen(flat, rotation, eye), 1e-3)
    assert len(found.rotations) > 1
    assert min(angle_deg(r @ rotation.T) for r in found.rotations) < 0.5


def _motion(rotation: np.ndarray, matches: int = 20) -> RelativePose:
    return RelativePose(np.arange(matches), rotation[None], np.array([[1.0, 0.0, 0.0]]))


@pytest.mark.parametrize("photos", [6, 52])  # 52 have 22 100 triplets: more than are voted on at a time
def test_relative_poses_that_close_triplets_win_over_more_matches(photos):
    true = [turned((0.1 * k, 1, 0), 9.0 * k) for k in range(photos)]
    rng = np.random.default_rng(2)
    pairs = {}
    for a in range(photos):
        for b in range(a + 1, photos):
            wrong = _motion(turned(tuple(rng.normal(size=3)), 40), matches=500)
            pairs[a, b] = [wrong, _motion(true[b] @ true[a].T)]
    votes = cycle_votes(pairs)
    assert all(v[1, 0] > 0.9 and v[0, 0] < 0.2 for v in votes.values())
    assert consistent_relative_poses(pairs, votes) == dict.fromkeys(pairs, (1, 0))
    pairs[0, 1] = pairs[0, 1][:1]  # of one pair only the distractor is left: it is dropped
    votes = cycle_votes(pairs)
    assert set(consistent_relative_poses(pairs, votes)) == set(pairs) - {(0, 1)}


def test_a_long_lens_still_tells_how_far_the_camera_turned():
    """RANSAC's own pose is off by 2 degrees in the median here."""
    rng, off = np.random.default_rng(5), []
    for _ in range(15):
        points = np.array([0, 0, 12]) + rng.uniform(-1, 1, (120, 3))
        rotation = turned((0.1, 1, 0), 20)
        centre = np.array([0, 0, 12]) - rotation.T @ [0, 0, 12]
        noise = rng.normal(0, 0.5 / 2400, (2, 120, 2))
        first = seen(points, np.eye(3), np.zeros(3)) + noise[0]
        second = seen(points, rotation, centre) + noise[1]
        second[:36] = rng.permutation(second[:36])  # wrong matches
        found = estimate_relative_poses(first, second, 2.0 / 2400)[0]
        off.append(angle_deg(found.rotations[0].T @ rotation))
    assert np.median(off) < 1.0


@pytest.mark.parametrize("focal", [0.7, 1.4])
def test_focal_length_by_votes_of_pairs_among_wrong_ones(focal):
    rng = np.random.default_rng(3)
    points = rng.uniform([-2, -2, 5], [2, 2, 9], (90, 3))
    side = 1000
    poses = [
        (turned((0.3, 1, 0.1), 5.0 * k - 12), np.array([0.7 * k - 2, 0.3 * (-1) ** k, 0.2 * k]))
        for k in range(6)
    ]
    photos = [focal * side * seen(points, *pose) + rng.normal(0, 0.2, (90, 2)) for pose in poses]
    for photo in photos:  # a third of the matches fits nothing
        photo[60:] = rng.uniform(-side / 2, side / 2, (30, 2))
    rows = np.column_stack([np.arange(90), np.arange(90)])
    matches = {(a, b): rows for a in range(6) for b in range(a + 1, 6)}
    found = focal_votes(photos, [side] * 6, [1] * 6, {}, matches, 1)
    assert found[1] == pytest.approx(focal, rel=0.04)
    flat = dict.fromkeys(matches, rows[:0])
    assert focal_votes(photos, [side] * 6, [1] * 6, {1: 0.66}, flat, 1) == {1: 0.66}  # EXIF is all there is


def test_a_photo_without_a_clear_pose_is_named_with_the_reason():
    def hypothesis(support: int, area: float) -> PoseHypothesis:
        return PoseHypothesis(np.eye(4)[:3], frozenset(range(support)), area)

    nothing = hypothesis(0, 0)
    assert rejection_reason(hypothesis(9, 0.6), hypothesis(7, 0.15), 2) is None
    assert "two poses: 6 photos agree on one, 5 on another" in str(
        rejection_reason(hypothesis(6, 0.2), hypothesis(5, 0.19), 2)
    )
    assert "no registered photo" in str(rejection_reason(nothing, nothing, 2))
    assert "only 2 registered photos" in str(rejection_reason(hypothesis(2, 0.4), nothing, 3))
    assert "small part" in str(rejection_reason(hypothesis(5, 0.07), nothing, 2))
    clustered = PoseHypothesis(
        np.eye(4)[:3], frozenset(range(5)), 0.25, 0.2
    )  # as the matches of a distractor are
    assert "small part" in str(rejection_reason(clustered, nothing, 2))
    assert rejection_reason(hypothesis(5, 0.25), nothing, 2) is None


def test_only_many_photos_are_adjusted_iteratively():
    sizes = FEW_PHOTOS, FEW_PHOTOS + 1
    few, many = (bundle_adjustment_options(True, photos, final=True).ceres for photos in sizes)
    assert few.auto_select_solver_type and not many.auto_select_solver_type
    assert many.solver_options.linear_solver_type.name == "ITERATIVE_SCHUR"


def test_relative_poses_come_back_from_their_file(tmp_path):
    matched = MatchedPhotos(
        [1, 2, 3], ["a", "b", "c"], [], [], {(0, 1): np.zeros((30, 2)), (1, 2): np.zeros((9, 2))}
    )
    matched.relative_poses = {
        (0, 1): [_motion(turned((1, 0, 0), 5)), _motion(turned((0, 1, 0), 7), 4)],
        (1, 2): [],
    }
    matched.save_relative_poses(tmp_path / "m.npz")
    again = MatchedPhotos(matched.ids, matched.names, [], [], matched.matches)
    again.load_relative_poses(tmp_path / "m.npz")
    assert again.relative_poses[1, 2] == [] and len(again.relative_poses[0, 1]) == 2
    for one, other in zip(matched.relative_poses[0, 1], again.relative_poses[0, 1]):
        np.testing.assert_array_equal(one.matches, other.matches)
        np.testing.assert_array_equal(one.rotations, other.rotations)


def set_in_worker(monkeypatch, statement: str) -> None:
    """Run a statement in COLMAP's process before its task."""
    worker = "import sys; from ambiguous_wild.builder import matched, registration, pose_hypothesis; "
    worker += "from ambiguous_wild.builder import sfm_worker; "
    worker += f"{statement}; sys.argv = ['worker', sys.argv[1]]; sfm_worker.main()"
    real = sfm.subprocess.Popen

    def changed(command, **options):
        return real([command[0], "-c", worker, command[-1]], **options)

    monkeypatch.setattr(sfm.subprocess, "Popen", changed)


def test_of_many_photos_the_mapper_gets_some_and_all_are_registered(tmp_path, monkeypatch):
    ring = [(a, (a + step) % 300) for a in range(300) for step in range(1, 9)]
    chosen = _well_connected(ring)
    support = {k: {a + b - k for a, b in ring if k in (a, b)} for k in range(300)}
    assert all(len(others & chosen) >= MAPPED_COVISIBLE for others in support.values())
    assert len(chosen) < 150
    ends = sorted(support.keys() - chosen)[:3]  # of pairs between two places; 600 has few partners
    ring += [(a + 300, b + 300) for a, b in ring] + [(k, k + 300) for k in ends] + [(20, 600), (21, 600)]
    assert {*ends, *(k + 300 for k in ends), 600} <= _well_connected(ring)
    write_capture(tmp_path / "raw", 12)
    set_in_worker(monkeypatch, "matched.ALL_MAPPED, matched.MAPPED_COVISIBLE = 6, 3")
    settings = BuildSettings(factor=1, max_features=800)
    build_scene(tmp_path / "raw", tmp_path / "scene", settings, jobs=2)
    model = read_model(tmp_path / "scene" / "sparse" / "0")
    found = {int(i.name[1:3]): i.cam_from_world()[:3, :3] for i in model.images.values()}
    true = {k: looking(eye) for k, eye in enumerate(eyes(12))}
    off = [angle_deg((found[k] @ found[0].T) @ (true[k] @ true[0].T).T) for k in found]
    assert len(found) == 12 and max(off) < 1.0


def test_the_change_of_focal_length_is_that_of_the_photos_the_mapper_got():
    """Photos have lenses of their own, and the mapper got one in five."""

    def camera(number: int, focal: float) -> pycolmap.Camera:
        params = [focal, 50, 40, 0]
        return pycolmap.Camera(camera_id=number, model="SIMPLE_RADIAL", width=100, height=80, params=params)

    cameras = [camera(number, 100.0) for number in range(1, 11)]
    matched = MatchedPhotos([*range(1, 11)], [*"abcdefghij"], cameras, [np.zeros((0, 2))] * 10, {})
    model = pycolmap.Reconstruction()
    for number in (1, 2):
        model.add_camera_with_trivial_rig(camera(number, 110.0))
        image = pycolmap.Image(image_id=number, camera_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    assert matched.take_cameras(model) == pytest.approx(0.1)


def test_photos_that_come_in_one_by_one_are_all_registered(monkeypatch):
    """Of many photos few changes end the rounds, but not while an added photo may bring the next one in."""

    class Path(Registration):
        def __init__(self) -> None:
            self.matched = SimpleNamespace(
                ids=range(1000), relative_poses=defaultdict(lambda: [1]), normalised=list
            )
            self.pairs = [[(k - 1, k)] * (k > 0) + [(k, k + 1)] * (k < 999) for k in range(1000)]
            self.poses = dict.fromkeys(range(980), np.eye(3, 4))
            self.split_off, self.merged = [], []

        def _best(self, photo, now, normalised, points):
            pose = None if photo > len(self.poses) else np.eye(3, 4)
            none = PoseHypothesis(None, frozenset(), 0.0)
            return (none if pose is None else PoseHypothesis(pose, frozenset((1, 2, 3)), 1.0)), none

        def _same(self, first, second):
            return second is not None

        def find_links(self):
            return {pair: 1 for pairs in self.pairs for pair in pairs if set(pair) <= self.poses.keys()}

        def _triangulate_and_adjust(self, *, final, pairs=True):
            pass

    monkeypatch.setattr(PointLookup, "read", lambda matched, model: None)
    monkeypatch.setattr(Path, "model", None, raising=False)
    placement = Path()
    placement.run()
    assert len(placement.poses) == 1000 and not placement.left_out


def test_a_model_whose_photos_do_not_agree_ends_in_a_refusal(tmp_path, monkeypatch):
    """Photos are taken out until too few are left: one line, not a crash of COLMAP."""
    write_capture(tmp_path / "raw", 6)
    set_in_worker(
        monkeypatch,
        "registration.MIN_SUPPORT = registration.MIN_SUPPORT_NEW = pose_hypothesis.LITTLE_AREA = 99",
    )
    with pytest.raises(AwError, match="registered 0 of 6 photos"):
        build_scene(tmp_path / "raw", tmp_path / "scene", BuildSettings(max_features=500, sfm="fast"))
    assert [p.name for p in tmp_path.iterdir()] == ["raw"]
