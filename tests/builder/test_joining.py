"""Parts of a capture that were placed alone are joined where several pairs agree, and only there."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder import photo_placement
from ambiguous_wild.builder.joining import Similarity, join
from ambiguous_wild.builder.matched import Matched, largest_group
from ambiguous_wild.builder.motions import Motion
from ambiguous_wild.builder.photo_placement import Placement, _cells, centre_of
from ambiguous_wild.builder.point_lookup import PointLookup
from ambiguous_wild.builder.pose_hypothesis import PoseHypothesis
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


def motion(first: np.ndarray, second: np.ndarray, count: int, wrong: np.ndarray | None = None) -> Motion:
    rotation = second[:, :3] @ first[:, :3].T
    shift = second[:, 3] - rotation @ first[:, 3]
    if wrong is not None:
        rotation = wrong @ rotation
    return Motion(np.arange(count), rotation[None], shift[None] / np.linalg.norm(shift))


def parts(across: dict[tuple[int, int], np.ndarray | None], bend: float = 1.0) -> tuple[Placement, Placement]:
    """Two parts; `across`: pairs between them, and what turns their motion wrongly."""
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
    matched = Matched([*range(1, 7)], [f"{k}.jpg" for k in range(6)], [camera] * 6, pixels, matches)
    for (a, b), rows in matches.items():
        matched.motions[a, b] = [motion(poses[a], poses[b], len(rows), across.get((a, b)))]
    found = []
    for photos in (HERE, THERE):
        part = Placement.__new__(Placement)
        part.matched, part.seed, part.joined = matched, 0, []
        part.pairs = [[p for p in matches if k in p] for k in range(6)]
        part.poses = {k: poses[k] for k in photos}
        part.model = SimpleNamespace(points3D={})
        part.cells = [_cells(xy, WIDTH, HEIGHT) for xy in pixels]
        found.append(part)
    back = Similarity(1 / WORLD.scale, WORLD.rotation.T, -WORLD.rotation.T @ WORLD.shift / WORLD.scale)
    for part in found:
        centres = np.array([-p[:, :3].T @ p[:, 3] for p in part.poses.values()])
        part.radius = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    found[1].radius /= WORLD.scale
    found[1].poses = {k: back.moved(p) for k, p in found[1].poses.items()}  # in a world of its own
    return found[0], found[1]


def errors(part: Placement) -> tuple[float, float]:
    """Largest angle in degrees, and largest distance of a position."""
    turned, moved = [], []
    for k, found in part.poses.items():
        trace = float((found[:, :3] * pose(k)[:, :3]).sum())
        turned.append(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))))
        centres = [-p[:, :3].T @ p[:, 3] for p in (found, pose(k))]
        moved.append(np.linalg.norm(centres[0] - centres[1]))
    return max(turned), max(moved)


def test_two_pairs_that_agree_join_two_parts_exactly():
    first, second = parts({(2, 3): None, (1, 4): None})
    assert join(first, second) and first.poses.keys() == {*HERE, *THERE}
    turned, moved = errors(first)
    assert turned < 1e-3 and moved < 1e-3
    assert first.joined == [frozenset(THERE)]


def test_pairs_that_agree_on_the_rotation_are_no_rivals():
    """Before the parts are adjusted together, many pairs of the right rotation do not fit."""
    same = np.eye(3)
    first, second = parts({(2, 3): None, (1, 4): None, (0, 3): same, (1, 3): same})
    assert join(first, second)


def test_lenses_that_only_the_second_part_has_come_with_it():
    first, second = parts({(2, 3): None, (1, 4): None})
    own = [pycolmap.Camera(camera_id=k, model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT,
                           params=[550.0, 320, 240, 0]) for k in range(6)]  # fmt: skip
    first.matched = replace(first.matched, cameras=own)
    for k in HERE:
        own[k].params = [FOCAL, 320, 240, 0]
    assert join(first, second)
    assert [camera.params[0] for camera in own] == [FOCAL] * 6
    first, second = parts({(2, 3): None})
    own[4].params = [550.0, 320, 240, 0]
    first.matched = replace(first.matched, cameras=own)
    assert not join(first, second) and own[4].params[0] == 550.0


def test_a_photo_with_a_pose_in_both_parts_joins_them_along_a_straight_path():
    first, second = parts({(1, 3): None, (2, 3): None, (2, 4): None}, bend=0.0)
    for part in (first, second):
        part.model = SimpleNamespace(points3D=observed(part))
    first.matched.ids[:] = range(6)
    assert join(first, second)
    moved = [np.linalg.norm(centre_of(first.poses[k]) - centre_of(pose(k, 0.0))) for k in range(6)]
    assert max(moved) < 0.05


def observed(part: Placement) -> dict[int, SimpleNamespace]:
    """The points that the photos of a part show, in its world."""
    there = 3 in part.poses
    back = (POINTS - WORLD.shift) @ WORLD.rotation / WORLD.scale if there else POINTS
    seen: dict[int, set[int]] = {k: set() for k in part.poses}
    for (a, b), rows in part.matched.matches.items():
        for k in {a, b} & seen.keys():
            seen[k] |= set(rows[:, 0].tolist())
    found = {}
    for row, xyz in enumerate(back):
        elements = [SimpleNamespace(image_id=k, point2D_idx=row) for k in seen if row in seen[k]]
        if len(elements) >= 2:
            found[row] = SimpleNamespace(xyz=xyz, track=SimpleNamespace(elements=elements))
    return found


def test_a_straight_path_leaves_the_scale_open():
    first, second = parts({(2, 3): None, (1, 4): None}, bend=0.0)
    assert not join(first, second)


@pytest.mark.parametrize(
    "across",
    [
        {(2, 3): None},  # a single pair gives no scale, and may show a distractor
        {(2, 3): None, (1, 4): cv2.Rodrigues(np.radians([0.0, 50.0, 0.0]))[0]},
        {},
    ],
)
def test_one_pair_does_not_join_parts_nor_do_two_that_contradict_each_other(across):
    first, second = parts(across)
    assert not join(first, second)
    assert first.poses.keys() == set(HERE)


def test_pairs_that_agree_on_something_else_prevent_a_join():
    wrong = cv2.Rodrigues(np.radians([0.0, 50.0, 0.0]))[0]
    first, second = parts({(2, 3): None, (1, 4): None, (0, 3): wrong, (0, 4): wrong, (1, 3): wrong})
    for a, b in ((0, 3), (0, 4), (1, 3)):  # the same rotation between the parts
        turned = pose(b)[:, :3] @ wrong @ pose(a)[:, :3].T
        first.matched.motions[a, b] = [
            Motion(np.arange(20), turned[None], first.matched.motions[a, b][0].translations)
        ]
    assert not join(first, second)


def test_only_the_largest_part_that_links_connect_is_kept():
    part, _ = parts({})
    part.poses = {k: pose(k) for k in range(6)}
    assert part.components() == [{0, 1, 2}, {3, 4, 5}]
    assert part.components(without=[1, 4, 5]) == [{0, 2}, {3}]
    others = part._keep_largest()
    assert [sorted(other) for other in others] == [[3, 4, 5]] and part.poses.keys() == {0, 1, 2}


def test_a_single_link_does_not_connect_two_groups_but_a_photo_with_one():
    part, _ = parts({(2, 3): None})
    part.poses = {k: pose(k) for k in range(6)}
    assert (2, 3) in part.links()
    assert part.components() == [{0, 1, 2}, {3, 4, 5}]
    del part.poses[5]
    assert part.components() == [{0, 1, 2, 3, 4}]  # two photos at the end of a chain
    part, _ = parts({(2, 3): None, (1, 4): None})
    part.poses = {k: pose(k) for k in range(6)}
    assert part.components() == [set(range(6))]
    part, _ = parts({(2, 3): None})
    part.poses, part.joined = {k: pose(k) for k in range(6)}, [frozenset(THERE)]
    assert part.components() == [set(range(6))]


@pytest.mark.parametrize(("most", "whole"), [(None, True), (2, False)])
def test_a_photo_connects_two_groups_only_if_its_matches_are_not_crowded(most, whole):
    """Photo 2 alone has links to the other group: with all its matches, or with those in one corner."""
    part, _ = parts({(2, 3): None, (2, 4): None, (2, 5): None})
    part.poses = {k: pose(k) for k in range(6)}
    for other in THERE:
        pixels = part.matched.features[2][part.matched.matches[2, other][:, 0]]
        rows = np.argsort(pixels.sum(axis=1))[:most]
        motion = part.matched.motions[2, other][0]
        part.matched.motions[2, other] = [replace(motion, matches=rows)]
    assert part.components() == ([set(range(6))] if whole else [{0, 1, 2}, {3, 4, 5}])


def test_pairs_whose_matches_are_crowded_join_no_parts():
    first, second = parts({(2, 3): None, (1, 4): None})
    for (a, b), (motion,) in first.matched.motions.items():
        if (a, b) in ((2, 3), (1, 4)):
            pixels = first.matched.features[a][first.matched.matches[a, b][:, 0]]
            rows = np.argsort(pixels.sum(axis=1))[:4]
            first.matched.motions[a, b] = [replace(motion, matches=rows)]
    assert not join(first, second)


def placed_with_noise(weak: int | None) -> Placement:
    """Six photos of one scene, 0.3 px off; of the weak one a few points are left."""
    part, _ = parts({})
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(part.matched.cameras[0])
    part.poses = {k: pose(k) for k in range(6)}
    rng = np.random.default_rng(3)
    for k, p in part.poses.items():
        xy = part.matched.features[k] + rng.normal(0.0, 0.3, (len(POINTS), 2))
        image = pycolmap.Image(name=f"{k}.jpg", keypoints=xy, camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(p))
    for number, xyz in enumerate(POINTS):
        seen = [k for k in part.poses if shown_in(k)[number] and (k != weak or number % 40 == 0)]
        if len(seen) > 1:
            track = pycolmap.Track([pycolmap.TrackElement(k + 1, number) for k in seen])
            model.add_point3D(xyz, track)
    part.model, part.provisional = model, set()
    return part


def shown_in(photo: int) -> np.ndarray:
    local = POINTS @ pose(photo)[:, :3].T + pose(photo)[:, 3]
    xy = local[:, :2] / local[:, 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2]
    return (local[:, 2] > 0) & ((xy >= 0) & (xy < [WIDTH, HEIGHT])).all(axis=1)


@pytest.mark.parametrize("weak", [None, 0, 4])
def test_the_photo_is_provisional_whose_rotation_the_matches_leave_open(weak, monkeypatch):
    """Also photo 0, which the adjustment holds: relative to it all others are open."""
    monkeypatch.setattr(photo_placement, "UNSURE", np.array([np.radians(0.25), np.inf]))
    part = placed_with_noise(weak)
    part.name_unsure()
    assert part.provisional == (set() if weak is None else {weak})
    poses = {k: part.model.images[k + 1].cam_from_world().matrix() for k in range(6)}
    assert all(np.allclose(x, pose(k), atol=1e-12) for k, x in poses.items())  # the model stays as it is


def test_an_open_model_and_photos_of_few_points_are_provisional(monkeypatch):
    monkeypatch.setattr(photo_placement, "UNSURE", np.array([np.radians(0.01), np.inf]))
    part = placed_with_noise(None)
    part.name_unsure()
    assert part.provisional == set(range(6))
    monkeypatch.setattr(photo_placement, "LEAST_POINTS", 10)
    monkeypatch.setattr(photo_placement, "UNSURE", np.array([np.radians(0.25), np.inf]))
    part = placed_with_noise(4)
    part.name_unsure()
    assert part.provisional == {4}


def test_little_evidence_is_enough_only_where_nothing_speaks_against_it():
    part, _ = parts({})
    points = PointLookup(part.matched, [np.full(len(POINTS), -1)] * 6, np.zeros((0, 3)), np.zeros(0, int))

    def place(partners: int, area: float, spread: float) -> PoseHypothesis:
        return PoseHypothesis(pose(0), frozenset(range(partners)), area, spread)

    nobody = PoseHypothesis(None, frozenset(), 0.0)
    assert part._unopposed(0, place(2, 0.1, 0.5), nobody, points)
    assert not part._unopposed(0, place(2, 0.1, 0.5), place(1, 0.1, 0.5), points)  # one other disagrees
    assert not part._unopposed(0, place(7, 0.1, 0.1), nobody, points)  # crowded, as those of a distractor
    assert not part._unopposed(0, place(7, 0.01, 0.5), nobody, points)
    assert not part._unopposed(0, place(1, 0.9, 0.9), nobody, points)  # no point fixes its distance
    rows = np.arange(len(POINTS))
    observed = PointLookup(part.matched, [rows] * 6, POINTS, np.full(len(POINTS), 3))
    assert part._unopposed(0, place(1, 0.9, 0.9), nobody, observed)


def test_the_spread_of_matches_is_relative_to_their_number():
    part, _ = parts({})
    part.cells = [np.repeat(np.arange(100), 10)]
    assert part._spread(0, [np.arange(0, 1000, 10)]) > 1.4  # one in each cell: more even than at random
    assert part._spread(0, [np.arange(100)]) < 0.2  # all in ten cells
    assert part._spread(0, []) == 0.0


def test_no_more_photos_can_be_placed_than_pairs_connect():
    assert largest_group([(0, 1), (1, 2), (4, 5)]) == 3
    assert largest_group([]) == 0
