"""Components that were registered alone are merged where several pairs agree, and only there."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder import registration
from ambiguous_wild.builder.component_merging import Similarity, merge_components
from ambiguous_wild.builder.matched import MatchedPhotos, PointLookup, largest_component
from ambiguous_wild.builder.pose_hypothesis import PoseHypothesis
from ambiguous_wild.builder.registration import Registration, _cells, centre_of
from ambiguous_wild.builder.relative_poses import RelativePose
from ambiguous_wild.io.safe_pycolmap import pycolmap

FOCAL, WIDTH, HEIGHT = 500.0, 640, 480
RNG = np.random.default_rng(0)
POINTS = RNG.uniform((-6, -2, 4), (6, 2, 9), (400, 3))
HERE, THERE = (0, 1, 2), (3, 4, 5)
WORLD = Similarity(2.5, cv2.Rodrigues(np.radians([20.0, -40.0, 10.0]))[0], np.array([3.0, -1.0, 2.0]))


def pose(photo: int, bend: float = 1.0) -> np.ndarray:
    """Along a path that bends, or a straight one; each turned a little."""
    rotation = cv2.Rodrigues(np.radians([2.0 * photo, 5.0 * photo - 12.0, 0.0]))[0]
    centre = [1.2 * photo - 3.0, bend * np.sin(2.0 * photo), 0.5 * bend * np.cos(1.3 * photo)]
    return np.column_stack([rotation, -rotation @ centre])


def relative_pose(
    first: np.ndarray, second: np.ndarray, count: int, wrong: np.ndarray | None = None
) -> RelativePose:
    rotation = second[:, :3] @ first[:, :3].T
    shift = second[:, 3] - rotation @ first[:, 3]
    if wrong is not None:
        rotation = wrong @ rotation
    return RelativePose(np.arange(count), rotation[None], shift[None] / np.linalg.norm(shift))


def components_of(
    across: dict[tuple[int, int], np.ndarray | None], bend: float = 1.0
) -> tuple[Registration, Registration]:
    """Two components; `across`: pairs between them, and what turns their relative pose wrongly."""
    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[FOCAL, 320, 240, 0]
    )
    poses = {k: pose(k, bend) for k in (*HERE, *THERE)}
    pixels, shown = [], []
    for p in poses.values():
        local = POINTS @ p[:, :3].T + p[:, 3]
        xy = local[:, :2] / local[:, 2:] * FOCAL + [320, 240]
        pixels.append(xy)
        shown.append((local[:, 2] > 0) & ((xy >= 0) & (xy < [WIDTH, HEIGHT])).all(axis=1))
    pairs = [(0, 1), (0, 2), (1, 2), (3, 4), (3, 5), (4, 5), *across]
    matches = {}
    for a, b in sorted(pairs):
        both = np.flatnonzero(shown[a] & shown[b])
        matches[a, b] = np.column_stack([both, both])
        if across.get((a, b)) is not None:
            matches[a, b] = np.column_stack([both, np.roll(both, 7)])  # of something else
    matched = MatchedPhotos([*range(1, 7)], [f"{k}.jpg" for k in range(6)], [camera] * 6, pixels, matches)
    for (a, b), rows in matches.items():
        matched.relative_poses[a, b] = [relative_pose(poses[a], poses[b], len(rows), across.get((a, b)))]
    found = []
    for photos in (HERE, THERE):
        component = Registration.__new__(Registration)
        component.matched, component.seed, component.merged = matched, 0, []
        component.pairs = [[p for p in matches if k in p] for k in range(6)]
        component.poses = {k: poses[k] for k in photos}
        component.model = SimpleNamespace(points3D={})
        component.cells = [_cells(xy, WIDTH, HEIGHT) for xy in pixels]
        found.append(component)
    back = Similarity(1 / WORLD.scale, WORLD.rotation.T, -WORLD.rotation.T @ WORLD.shift / WORLD.scale)
    for component in found:
        centres = np.array([-p[:, :3].T @ p[:, 3] for p in component.poses.values()])
        component.radius = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    found[1].radius /= WORLD.scale
    found[1].poses = {k: back.transform_pose(p) for k, p in found[1].poses.items()}  # in a world of its own
    return found[0], found[1]


def connected(component: Registration, without: Sequence[int] = ()) -> list[set[int]]:
    return component.components(component.find_links(), without)


def errors(component: Registration) -> tuple[float, float]:
    """Largest angle in degrees, and largest distance of a position."""
    turned, moved = [], []
    for k, found in component.poses.items():
        trace = float((found[:, :3] * pose(k)[:, :3]).sum())
        turned.append(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))))
        centres = [-p[:, :3].T @ p[:, 3] for p in (found, pose(k))]
        moved.append(np.linalg.norm(centres[0] - centres[1]))
    return max(turned), max(moved)


def test_two_pairs_that_agree_merge_two_components_exactly():
    first, second = components_of({(2, 3): None, (1, 4): None})
    assert merge_components(first, second) and first.poses.keys() == {*HERE, *THERE}
    turned, moved = errors(first)
    assert turned < 1e-3 and moved < 1e-3
    assert first.merged == [frozenset(THERE)]


def test_pairs_that_agree_on_the_rotation_do_not_compete():
    """Before the components are adjusted together, many pairs of the right rotation have few inliers."""
    same = np.eye(3)
    first, second = components_of({(2, 3): None, (1, 4): None, (0, 3): same, (1, 3): same})
    assert merge_components(first, second)


def test_lenses_that_only_the_second_component_has_come_with_it():
    first, second = components_of({(2, 3): None, (1, 4): None})
    own = [pycolmap.Camera(camera_id=k, model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT,
                           params=[550.0, 320, 240, 0]) for k in range(6)]  # fmt: skip
    first.matched = replace(first.matched, cameras=own)
    for k in HERE:
        own[k].params = [FOCAL, 320, 240, 0]
    assert merge_components(first, second)
    assert [camera.params[0] for camera in own] == [FOCAL] * 6
    first, second = components_of({(2, 3): None})
    own[4].params = [550.0, 320, 240, 0]
    first.matched = replace(first.matched, cameras=own)
    assert not merge_components(first, second) and own[4].params[0] == 550.0


def test_a_photo_with_a_pose_in_both_components_merges_them_along_a_straight_path():
    first, second = components_of({(1, 3): None, (2, 3): None, (2, 4): None}, bend=0.0)
    for component in (first, second):
        component.model = SimpleNamespace(points3D=observed(component))
    first.matched.ids[:] = range(6)
    assert merge_components(first, second)
    moved = [np.linalg.norm(centre_of(first.poses[k]) - centre_of(pose(k, 0.0))) for k in range(6)]
    assert max(moved) < 0.05


def observed(component: Registration) -> dict[int, SimpleNamespace]:
    """The points that the photos of a component show, in its world."""
    there = 3 in component.poses
    back = (POINTS - WORLD.shift) @ WORLD.rotation / WORLD.scale if there else POINTS
    seen: dict[int, set[int]] = {k: set() for k in component.poses}
    for (a, b), rows in component.matched.matches.items():
        for k in {a, b} & seen.keys():
            seen[k] |= set(rows[:, 0].tolist())
    found = {}
    for row, xyz in enumerate(back):
        elements = [SimpleNamespace(image_id=k, point2D_idx=row) for k in seen if row in seen[k]]
        if len(elements) >= 2:
            found[row] = SimpleNamespace(xyz=xyz, track=SimpleNamespace(elements=elements))
    return found


@pytest.mark.parametrize(
    ("across", "bend"),
    [
        ({(2, 3): None}, 1.0),  # a single pair gives no scale, and may show a distractor
        ({(2, 3): None, (1, 4): cv2.Rodrigues(np.radians([0.0, 50.0, 0.0]))[0]}, 1.0),  # a contradiction
        ({(2, 3): None, (1, 4): None}, 0.0),  # along a straight path every scale is possible
        ({}, 1.0),
    ],
)
def test_too_little_evidence_merges_nothing(across, bend):
    first, second = components_of(across, bend)
    assert not merge_components(first, second) and first.poses.keys() == set(HERE)


def test_pairs_that_agree_on_something_else_prevent_a_merge():
    wrong = cv2.Rodrigues(np.radians([0.0, 50.0, 0.0]))[0]
    first, second = components_of({(2, 3): None, (1, 4): None, (0, 3): wrong, (0, 4): wrong, (1, 3): wrong})
    for a, b in ((0, 3), (0, 4), (1, 3)):  # the same rotation between the parts
        turned = pose(b)[:, :3] @ wrong @ pose(a)[:, :3].T
        first.matched.relative_poses[a, b] = [
            RelativePose(np.arange(20), turned[None], first.matched.relative_poses[a, b][0].translations)
        ]
    assert not merge_components(first, second)


def test_only_the_largest_component_is_kept():
    component, _ = components_of({})
    component.poses = {k: pose(k) for k in range(6)}
    assert connected(component) == [{0, 1, 2}, {3, 4, 5}]
    assert connected(component, without=[1, 4, 5]) == [{0, 2}, {3}]
    others = component._keep_largest()
    assert [sorted(other) for other in others] == [[3, 4, 5]] and component.poses.keys() == {0, 1, 2}


@pytest.mark.parametrize(
    ("across", "photos", "merged", "expected"),
    [
        ({(2, 3): None}, 6, [], [{0, 1, 2}, {3, 4, 5}]),
        ({(2, 3): None}, 5, [], [{0, 1, 2, 3, 4}]),  # two photos at the end of a chain
        ({(2, 3): None, (1, 4): None}, 6, [], [{*range(6)}]),
        ({(2, 3): None}, 6, [frozenset(THERE)], [{*range(6)}]),
    ],
)
def test_a_single_link_does_not_connect_two_groups_but_a_photo_with_one(across, photos, merged, expected):
    component, _ = components_of(across)
    component.poses, component.merged = {k: pose(k) for k in range(photos)}, merged
    assert (2, 3) in component.find_links() and connected(component) == expected


@pytest.mark.parametrize(("most", "whole"), [(None, True), (60, True), (20, False)])
def test_a_photo_connects_two_groups_only_if_its_inliers_cover_much_of_it(most, whole):
    """Photo 2 alone has links to the other group: with all its matches, or with those nearest to a corner."""
    component, _ = components_of({(2, 3): None, (2, 4): None, (2, 5): None})
    component.poses = {k: pose(k) for k in range(6)}
    for other in THERE:
        pixels = component.matched.features[2][component.matched.matches[2, other][:, 0]]
        rows = np.argsort(pixels.sum(axis=1))[:most]
        relative_pose = component.matched.relative_poses[2, other][0]
        component.matched.relative_poses[2, other] = [replace(relative_pose, matches=rows)]
    assert connected(component) == ([set(range(6))] if whole else [{0, 1, 2}, {3, 4, 5}])


def test_pairs_whose_inliers_are_clustered_merge_no_components():
    first, second = components_of({(2, 3): None, (1, 4): None})
    for (a, b), (relative_pose,) in first.matched.relative_poses.items():
        if (a, b) in ((2, 3), (1, 4)):
            pixels = first.matched.features[a][first.matched.matches[a, b][:, 0]]
            rows = np.argsort(pixels.sum(axis=1))[:4]
            first.matched.relative_poses[a, b] = [replace(relative_pose, matches=rows)]
    assert not merge_components(first, second)


def registered_with_noise(weak: int | None) -> Registration:
    """Six photos of one scene, 0.3 px off; of the weak one a few points are left."""
    component, _ = components_of({})
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(component.matched.cameras[0])
    component.poses = {k: pose(k) for k in range(6)}
    rng = np.random.default_rng(3)
    for k, p in component.poses.items():
        xy = component.matched.features[k] + rng.normal(0.0, 0.3, (len(POINTS), 2))
        image = pycolmap.Image(name=f"{k}.jpg", keypoints=xy, camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(p))
    for number, xyz in enumerate(POINTS):
        seen = [k for k in component.poses if shown_in(k)[number] and (k != weak or number % 40 == 0)]
        if len(seen) > 1:
            track = pycolmap.Track([pycolmap.TrackElement(k + 1, number) for k in seen])
            model.add_point3D(xyz, track)
    component.model, component.provisional = model, set()
    return component


def shown_in(photo: int) -> np.ndarray:
    local = POINTS @ pose(photo)[:, :3].T + pose(photo)[:, 3]
    xy = local[:, :2] / local[:, 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2]
    return (local[:, 2] > 0) & ((xy >= 0) & (xy < [WIDTH, HEIGHT])).all(axis=1)


@pytest.mark.parametrize("weak", [None, 0, 4])
def test_the_photo_is_provisional_whose_rotation_the_matches_leave_open(weak, monkeypatch):
    """Also photo 0, which the adjustment holds: relative to it all others are open."""
    monkeypatch.setattr(registration, "UNSURE", np.array([np.radians(0.25), np.inf]))
    component = registered_with_noise(weak)
    component.mark_provisional()
    assert component.provisional == (set() if weak is None else {weak})
    poses = {k: component.model.images[k + 1].cam_from_world().matrix() for k in range(6)}
    assert all(np.allclose(x, pose(k), atol=1e-12) for k, x in poses.items())  # the model stays as it is


@pytest.mark.parametrize(("longer_sides", "doubted"), [(1.9, set()), (2.1, {4}), (0.4, {4})])
def test_a_photo_whose_own_camera_has_an_unusual_focal_length_is_provisional(longer_sides, doubted):
    component = registered_with_noise(None)
    camera = copy.deepcopy(component.matched.cameras[4])
    camera.camera_id, camera.params = 2, [longer_sides * WIDTH, *camera.params[1:]]
    component.matched.cameras[4] = camera
    component.mark_provisional()
    assert component.provisional == doubted


def test_an_open_model_and_photos_of_few_points_are_provisional(monkeypatch):
    monkeypatch.setattr(registration, "UNSURE", np.array([np.radians(0.01), np.inf]))
    component = registered_with_noise(None)
    component.mark_provisional()
    assert component.provisional == set(range(6))
    monkeypatch.setattr(registration, "MIN_POINTS", 10)
    monkeypatch.setattr(registration, "UNSURE", np.array([np.radians(0.25), np.inf]))
    component = registered_with_noise(4)
    component.mark_provisional()
    assert component.provisional == {4}


def test_little_evidence_is_enough_only_where_nothing_speaks_against_it():
    component, _ = components_of({})
    points = PointLookup(
        component.matched, [np.full(len(POINTS), -1)] * 6, np.zeros((0, 3)), np.zeros(0, int)
    )

    def hypothesis(support: int, area: float, coverage: float) -> PoseHypothesis:
        return PoseHypothesis(pose(0), frozenset(range(support)), area, coverage)

    nobody = PoseHypothesis(None, frozenset(), 0.0)
    assert component._unopposed(0, hypothesis(2, 0.1, 0.5), nobody, points)
    assert not component._unopposed(
        0, hypothesis(2, 0.1, 0.5), hypothesis(1, 0.1, 0.5), points
    )  # one other disagrees
    assert not component._unopposed(
        0, hypothesis(7, 0.1, 0.1), nobody, points
    )  # clustered, as those of a distractor
    assert not component._unopposed(0, hypothesis(7, 0.01, 0.5), nobody, points)
    assert not component._unopposed(0, hypothesis(1, 0.9, 0.9), nobody, points)  # no point fixes its distance
    rows = np.arange(len(POINTS))
    observed = PointLookup(component.matched, [rows] * 6, POINTS, np.full(len(POINTS), 3))
    assert component._unopposed(0, hypothesis(1, 0.9, 0.9), nobody, observed)


def test_the_coverage_of_inliers_is_relative_to_their_number():
    component, _ = components_of({})
    component.cells = [np.repeat(np.arange(100), 10)]
    assert (
        component._coverage(0, [np.arange(0, 1000, 10)]) > 1.4
    )  # one in each cell: more even than at random
    assert component._coverage(0, [np.arange(100)]) < 0.2  # all in ten cells
    assert component._coverage(0, []) == 0.0


def test_no_more_photos_can_be_registered_than_pairs_connect():
    assert largest_component([(0, 1), (1, 2), (4, 5)]) == 3
    assert largest_component([]) == 0
