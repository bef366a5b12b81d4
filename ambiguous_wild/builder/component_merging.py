"""Merge components of the pose graph that were registered alone.

The similarity between two components needs several photos at once: a single pair may show a distractor, and
gives no scale. A photo that has a pose in both is a hypothesis for it, and so are the pairs across them that
agree on one rotation. Pairs with enough inliers under a hypothesis support it, as for a photo in
`registration`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ambiguous_wild.builder.matched import MatchedPhotos, PointLookup
from ambiguous_wild.builder.registration import (
    ALIKE_DEG,
    INLIER_RATIO,
    MIN_MODEL_PHOTOS,
    Registration,
    centre_of,
)
from ambiguous_wild.builder.relative_poses import Pair, rotation_trace

MIN_MERGE_PAIRS = 2  # pairs across two components that must support the merge; they involve one more photo
# Smallest singular value of the equations for scale and shift, relative to the largest: along a straight path
# every scale fits.
MIN_CONDITION = 0.02
MAX_PAIRS = 200  # pairs across two components that are used, those with most matches
MIN_DEPTHS = 8  # features of a photo with a depth in both components, for the scale
ROUGHLY = 4.0  # inliers lie within this many times the usual distance: the merge is not adjusted yet
# Pairs that agree on another rotation, relative to those that support the merge, from which on it is refused.
COMPETING_PAIRS = 0.5


@dataclass(frozen=True)
class Similarity:
    """Coordinates of the first component from those of the second: x = scale * rotation @ y + shift."""

    scale: float
    rotation: np.ndarray  # [3, 3]
    shift: np.ndarray  # [3]

    def transform_pose(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose [3, 4], camera from world, in the coordinates of the first component."""
        rotation = pose[:, :3] @ self.rotation.T
        return np.column_stack([rotation, self.scale * pose[:, 3] - rotation @ self.shift])


def merge_components(first: Registration, second: Registration) -> bool:
    """Add the photos of the second component if enough pairs support it; the first must then run again."""
    added = {photo: pose for photo, pose in second.poses.items() if photo not in first.poses}
    if not added or min(len(first.poses), len(second.poses)) < MIN_MODEL_PHOTOS:
        return False
    rotations = _implied_rotations(first, second)
    alike = _alike(rotations)
    before = [list(camera.params) for camera in first.matched.cameras]  # params are a view
    _take_cameras(first, second, added)
    best: tuple[int, Similarity] | None = None
    for similarity in (
        *_similarities_from_photos(first, second),
        *_similarities_from_pairs(first, second, rotations, alike),
    ):
        moved = {photo: similarity.transform_pose(pose) for photo, pose in added.items()}
        support = _supporting_pairs(first, moved)
        photos = {photo for pair in support for photo in pair}
        if len(support) < MIN_MERGE_PAIRS or len(photos) <= MIN_MERGE_PAIRS:
            continue
        if best is not None and len(support) <= best[0]:
            continue
        if _competing_pairs(rotations, alike, similarity, support) <= COMPETING_PAIRS * len(support):
            best = len(support), similarity
    if best is None:
        for camera, params in zip(first.matched.cameras, before):
            camera.params = params
        return False
    first.poses.update((photo, best[1].transform_pose(pose)) for photo, pose in added.items())
    first.merged.append(frozenset(added))
    return True


def _take_cameras(first: Registration, second: Registration, added: Collection[int]) -> None:
    """Use the second component's cameras that no photo of the first has."""
    own = {first.matched.cameras[photo].camera_id for photo in first.poses}
    for photo in added:
        if first.matched.cameras[photo].camera_id not in own:
            first.matched.cameras[photo].params = second.matched.cameras[photo].params


@dataclass(frozen=True)
class ImpliedRotation:
    """The rotation between two components that a relative pose of a pair across them implies."""

    pair: Pair
    first_photo: int  # of the first component
    second_photo: int  # of the second component
    rotation: np.ndarray  # [3, 3] first from second
    direction: np.ndarray  # [3] from the first photo to the second, in the first component


def _implied_rotations(first: Registration, second: Registration) -> list[ImpliedRotation]:
    """Return the rotations that the relative poses of the strongest pairs across two components imply."""
    rows: list[ImpliedRotation] = []
    of_pairs = first.matched.relative_poses.items()
    strongest = sorted(of_pairs, key=lambda item: -sum(len(relative.matches) for relative in item[1]))
    for pair, relative_poses in strongest:
        if len({row.pair for row in rows}) >= MAX_PAIRS:
            break
        for photo_a, photo_b in (pair, pair[::-1]):
            if (
                photo_a not in first.poses
                or photo_b not in second.poses
                or {photo_a, photo_b} <= first.poses.keys()
            ):
                continue
            rotation_a, rotation_b = first.poses[photo_a][:, :3], second.poses[photo_b][:, :3]
            for relative_pose in relative_poses:
                for rotation, shift in zip(relative_pose.rotations, relative_pose.translations):
                    centre = -rotation.T @ shift if photo_a == pair[0] else shift
                    relative = rotation if photo_a == pair[0] else rotation.T  # photo_b from photo_a
                    rows.append(
                        ImpliedRotation(
                            pair,
                            photo_a,
                            photo_b,
                            rotation_a.T @ relative.T @ rotation_b,
                            rotation_a.T @ centre,
                        )
                    )
    return rows


def _alike(rows: Sequence[ImpliedRotation]) -> np.ndarray:
    """Tell which rows imply the same rotation, [N, N] bool."""
    stack = np.array([row.rotation for row in rows]).reshape(-1, 9)
    return stack @ stack.T > rotation_trace(ALIKE_DEG)


def _competing_pairs(
    rows: Sequence[ImpliedRotation], alike: np.ndarray, similarity: Similarity, support: Collection[Pair]
) -> int:
    """Return the largest number of pairs that agree on one rotation other than that of the similarity."""
    others = [
        k
        for k, row in enumerate(rows)
        if row.pair not in support and np.sum(row.rotation * similarity.rotation) < rotation_trace(ALIKE_DEG)
    ]
    if not others:
        return 0
    owners = np.unique([rows[k].pair for k in others], axis=0, return_inverse=True)[1].ravel()
    owned = np.eye(owners.max() + 1)[owners]  # [N, P], the pair of each row
    return int((alike[np.ix_(others, others)] @ owned > 0).sum(axis=1).max())


def _similarities_from_pairs(
    first: Registration, second: Registration, across: Sequence[ImpliedRotation], same: np.ndarray
) -> Iterator[Similarity]:
    """Yield the similarities on which pairs across them agree, the rotation first, then directions."""
    known: set[frozenset[tuple[int, int]]] = set()
    for which in same:
        alike = [row for row, use in zip(across, which) if use]
        ends = frozenset((row.first_photo, row.second_photo) for row in alike)
        if len(ends) < MIN_MERGE_PAIRS or ends in known:
            continue
        known.add(ends)
        left, _, right = np.linalg.svd(sum(row.rotation for row in alike))
        rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        # The photo of the second lies on a ray from that of the first: cross(ray, s Q y + t - x) = 0.
        rows, values = [], []
        for row in alike:
            ray = np.cross(np.eye(3), row.direction).T  # ray @ v = cross(direction, v)
            rows.append(np.column_stack([ray @ rotation @ centre_of(second.poses[row.second_photo]), ray]))
            values.append(ray @ centre_of(first.poses[row.first_photo]))
        system = np.concatenate(rows) * [1 / second.radius, 1.0, 1.0, 1.0]
        scale, *shift = np.linalg.lstsq(system, np.concatenate(values), rcond=None)[0]
        singular_values = np.linalg.svd(system, compute_uv=False)
        if scale > 0 and singular_values[-1] > MIN_CONDITION * singular_values[0]:
            yield Similarity(float(scale) / second.radius, rotation, np.array(shift))


def _similarities_from_photos(first: Registration, second: Registration) -> Iterator[Similarity]:
    """Yield the similarity that each pose of a photo in both components implies."""
    first_points, second_points = (
        PointLookup.read(first.matched, first.model),
        PointLookup.read(second.matched, second.model),
    )
    for photo in sorted({*first.poses, *second.poses}):
        first_poses = [first.poses[photo]] if photo in first.poses else first.resections(photo, first_points)
        second_poses = (
            [second.poses[photo]] if photo in second.poses else second.resections(photo, second_points)
        )
        depths = (
            _depths(photo, first_poses, first, first_points),
            _depths(photo, second_poses, second, second_points),
        )
        for pose, near in zip(first_poses, depths[0]):
            for other, far in zip(second_poses, depths[1]):
                both = sorted(near.keys() & far.keys())
                if len(both) < MIN_DEPTHS:
                    continue
                scale = float(np.median([near[k] / far[k] for k in both]))
                rotation = pose[:, :3].T @ other[:, :3]
                yield Similarity(scale, rotation, centre_of(pose) - scale * rotation @ centre_of(other))


def _depths(
    photo: int, poses: list[np.ndarray], component: Registration, points: PointLookup
) -> list[dict[int, float]]:
    """Return for each pose of a photo the depths of its features in a component, by feature."""
    features, xyz = points.matched_with(photo, component.pairs[photo], component.poses)
    depths = [xyz @ pose[2, :3] + pose[2, 3] for pose in poses]
    return [{int(f): float(z) for f, z in zip(features, row) if z > 0} for row in depths]


def _supporting_pairs(first: Registration, moved: Mapping[int, np.ndarray]) -> set[Pair]:
    """Return the pairs across with a relative pose whose inliers are clustered in neither photo."""
    matched: MatchedPhotos = first.matched
    normalised, poses = matched.normalised(), {**moved, **first.poses}
    support = set()
    for (a, b), relative_poses in matched.relative_poses.items():
        if not relative_poses or (a in moved) == (b in moved) or not {a, b} <= poses.keys():
            continue
        near = matched.epipolar_error((a, b), poses[a], poses[b], normalised) <= ROUGHLY
        for relative_pose in relative_poses:
            if near[relative_pose.matches].mean() < INLIER_RATIO:
                continue
            rows = matched.matches[a, b][relative_pose.matches].T
            hypotheses = (first.hypothesis(k, None, {((a, b), 0): row}) for k, row in zip((a, b), rows))
            if not any(hypothesis.clustered for hypothesis in hypotheses):
                support.add((a, b))
                break
    return support
