"""Join parts of a capture that were placed alone.

The relative pose of two parts needs several photos at once: a single pair may show a distractor, and gives no
scale. A photo that has a pose in both parts is a hypothesis for the similarity between them, and so are the
pairs across the parts that agree on one rotation. The pairs that fit a hypothesis are the evidence, as for a
photo in `photo_placement`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ambiguous_wild.builder.matched import Matched
from ambiguous_wild.builder.motions import Pair, trace_of
from ambiguous_wild.builder.photo_placement import ALIKE_DEG, FITS, LEAST_PHOTOS, Placement, centre_of
from ambiguous_wild.builder.point_lookup import PointLookup

JOINED_BY = 2  # smallest number of pairs across two parts that must fit; they involve one more photo
# Smallest singular value of the equations for scale and shift, relative to the largest: along a straight path
# every scale fits.
LEAST_SPREAD = 0.02
MOST_PAIRS = 200  # pairs across two parts that are used, those with most matches
LEAST_DEPTHS = 8  # features of a photo with a depth in both parts, for the scale
ROUGHLY = 4.0  # a match fits within this many times the usual distance: the join is not adjusted yet
RIVALS = 0.5  # share of pairs that agree on another rotation, relative to those that fit, that refuses a join


@dataclass(frozen=True)
class Similarity:
    """Coordinates of the first part from those of the second: x = scale * rotation @ y + shift."""

    scale: float
    rotation: np.ndarray  # [3, 3]
    shift: np.ndarray  # [3]

    def moved(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose [3, 4], camera from world, in the coordinates of the first part."""
        rotation = pose[:, :3] @ self.rotation.T
        return np.column_stack([rotation, self.scale * pose[:, 3] - rotation @ self.shift])


def join(first: Placement, second: Placement) -> bool:
    """Add the photos of the second part to the first, if enough pairs fit; the first must then run again."""
    added = {photo: pose for photo, pose in second.poses.items() if photo not in first.poses}
    if not added or min(len(first.poses), len(second.poses)) < LEAST_PHOTOS:
        return False
    rotations = _rotations(first, second)
    alike = _alike(rotations)
    before = [list(camera.params) for camera in first.matched.cameras]  # params are a view
    _take_cameras(first, second, added)
    best: tuple[int, Similarity] | None = None
    for similarity in (*_by_photos(first, second), *_by_pairs(first, second, rotations, alike)):
        moved = {photo: similarity.moved(pose) for photo, pose in added.items()}
        fitting = _fitting(first, moved)
        if len(fitting) < JOINED_BY or len({photo for pair in fitting for photo in pair}) <= JOINED_BY:
            continue
        if best is not None and len(fitting) <= best[0]:
            continue
        if _rivals(rotations, alike, similarity, fitting) <= RIVALS * len(fitting):
            best = len(fitting), similarity
    if best is None:
        for camera, params in zip(first.matched.cameras, before):
            camera.params = params
        return False
    first.poses.update((photo, best[1].moved(pose)) for photo, pose in added.items())
    first.joined.append(frozenset(added))
    return True


def _take_cameras(first: Placement, second: Placement, added: Collection[int]) -> None:
    """Use the second part's cameras that no photo of the first has."""
    own = {first.matched.cameras[photo].camera_id for photo in first.poses}
    for photo in added:
        if first.matched.cameras[photo].camera_id not in own:
            first.matched.cameras[photo].params = second.matched.cameras[photo].params


@dataclass(frozen=True)
class Across:
    """The rotation of the second part to the first that one motion of a pair across them implies."""

    pair: Pair
    here: int  # photo of the first part
    there: int  # photo of the second part
    rotation: np.ndarray  # [3, 3] first from second
    direction: np.ndarray  # [3] from the photo of the first part to that of the second, in the first part


def _rotations(first: Placement, second: Placement) -> list[Across]:
    """Return the implied rotations of all motions of the pairs across two parts, the strongest pairs."""
    rows: list[Across] = []
    strongest = sorted(first.matched.motions.items(), key=lambda item: -sum(len(m.matches) for m in item[1]))
    for pair, motions in strongest:
        if len({row.pair for row in rows}) >= MOST_PAIRS:
            break
        for here, there in (pair, pair[::-1]):
            if here not in first.poses or there not in second.poses or {here, there} <= first.poses.keys():
                continue
            mine, theirs = first.poses[here][:, :3], second.poses[there][:, :3]
            for motion in motions:
                for rotation, shift in zip(motion.rotations, motion.translations):
                    centre = -rotation.T @ shift if here == pair[0] else shift
                    relative = rotation if here == pair[0] else rotation.T  # there from here
                    rows.append(Across(pair, here, there, mine.T @ relative.T @ theirs, mine.T @ centre))
    return rows


def _alike(rows: Sequence[Across]) -> np.ndarray:
    """Tell which rows imply the same rotation, [N, N] bool."""
    stack = np.array([row.rotation for row in rows]).reshape(-1, 9)
    return stack @ stack.T > trace_of(ALIKE_DEG)


def _rivals(
    rows: Sequence[Across], alike: np.ndarray, similarity: Similarity, fitting: Collection[Pair]
) -> int:
    """Return the largest number of pairs that agree on one rotation other than that of the similarity."""
    others = [
        k
        for k, row in enumerate(rows)
        if row.pair not in fitting and np.sum(row.rotation * similarity.rotation) < trace_of(ALIKE_DEG)
    ]
    if not others:
        return 0
    owners = np.unique([rows[k].pair for k in others], axis=0, return_inverse=True)[1].ravel()
    owned = np.eye(owners.max() + 1)[owners]  # [N, P], the pair of each row
    return int((alike[np.ix_(others, others)] @ owned > 0).sum(axis=1).max())


def _by_pairs(
    first: Placement, second: Placement, across: Sequence[Across], same: np.ndarray
) -> Iterator[Similarity]:
    """Yield the similarities on which pairs across the parts agree, the rotation first, then directions."""
    known: set[frozenset[tuple[int, int]]] = set()
    for which in same:
        alike = [row for row, use in zip(across, which) if use]
        ends = frozenset((row.here, row.there) for row in alike)
        if len(ends) < JOINED_BY or ends in known:
            continue
        known.add(ends)
        left, _, right = np.linalg.svd(sum(row.rotation for row in alike))
        rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        # The photo of the second part lies on a ray from that of the first: cross(ray, s Q y + t - x) = 0.
        rows, values = [], []
        for row in alike:
            ray = np.cross(np.eye(3), row.direction).T  # ray @ v = cross(direction, v)
            rows.append(np.column_stack([ray @ rotation @ centre_of(second.poses[row.there]), ray]))
            values.append(ray @ centre_of(first.poses[row.here]))
        system = np.concatenate(rows) * [1 / second.radius, 1.0, 1.0, 1.0]
        scale, *shift = np.linalg.lstsq(system, np.concatenate(values), rcond=None)[0]
        spread = np.linalg.svd(system, compute_uv=False)
        if scale > 0 and spread[-1] > LEAST_SPREAD * spread[0]:
            yield Similarity(float(scale) / second.radius, rotation, np.array(shift))


def _by_photos(first: Placement, second: Placement) -> Iterator[Similarity]:
    """Yield the similarity that each pose of a photo in both parts implies."""
    here, there = PointLookup.read(first.matched, first.model), PointLookup.read(second.matched, second.model)
    for photo in sorted({*first.poses, *second.poses}):
        mine = [first.poses[photo]] if photo in first.poses else first.resections(photo, here)
        theirs = [second.poses[photo]] if photo in second.poses else second.resections(photo, there)
        depths = _depths(photo, mine, first, here), _depths(photo, theirs, second, there)
        for pose, near in zip(mine, depths[0]):
            for other, far in zip(theirs, depths[1]):
                both = sorted(near.keys() & far.keys())
                if len(both) < LEAST_DEPTHS:
                    continue
                scale = float(np.median([near[k] / far[k] for k in both]))
                rotation = pose[:, :3].T @ other[:, :3]
                yield Similarity(scale, rotation, centre_of(pose) - scale * rotation @ centre_of(other))


def _depths(
    photo: int, poses: list[np.ndarray], part: Placement, points: PointLookup
) -> list[dict[int, float]]:
    """Return for each pose of a photo the depths of its features in a part, by feature."""
    features, xyz = points.matched_with(photo, part.pairs[photo], part.poses)
    depths = [xyz @ pose[2, :3] + pose[2, 3] for pose in poses]
    return [{int(f): float(z) for f, z in zip(features, row) if z > 0} for row in depths]


def _fitting(first: Placement, moved: Mapping[int, np.ndarray]) -> set[Pair]:
    """Return the pairs across the parts of which a motion fits that is crowded in neither photo."""
    matched: Matched = first.matched
    rays, poses = matched.rays(), {**moved, **first.poses}
    fitting = set()
    for (a, b), motions in matched.motions.items():
        if not motions or (a in moved) == (b in moved) or not {a, b} <= poses.keys():
            continue
        near = matched.misfit((a, b), poses[a], poses[b], rays) <= ROUGHLY
        for motion in motions:
            if near[motion.matches].mean() < FITS:
                continue
            rows = matched.matches[a, b][motion.matches].T
            places = (first.place(k, None, {((a, b), 0): row}) for k, row in zip((a, b), rows))
            if not any(place.crowded for place in places):
                fitting.add((a, b))
                break
    return fitting
