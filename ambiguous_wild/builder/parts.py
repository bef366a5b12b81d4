"""Join parts of a capture that were placed alone.

The relative pose of two parts needs several photos at once: a single pair may show a distractor, and gives no
scale. A photo that has a pose in both parts is a hypothesis for the similarity between them, and the pairs
across the parts that fit it are the evidence, as for a photo in `placing`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ambiguous_wild.builder.matched import Matched
from ambiguous_wild.builder.motions import Pair, trace_of
from ambiguous_wild.builder.placing import ALIKE_DEG, FITS, LEAST_PHOTOS, Placement, Points

JOINED_BY = (
    2  # smallest number of pairs across two parts that must fit, and of photos that they involve a side
)
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
    best: tuple[int, Similarity] | None = None
    for similarity in _similarities(first, second):
        moved = {photo: similarity.moved(pose) for photo, pose in added.items()}
        fitting = _fitting(first, moved)
        inside = {a if a in moved else b for a, b in fitting}
        outside = {b if a in moved else a for a, b in fitting}
        if len(fitting) < JOINED_BY or len(inside | outside) < JOINED_BY + 1:
            continue
        if _largest_rival(first, moved, fitting) > RIVALS * len(fitting):
            continue
        if best is None or len(fitting) > best[0]:
            best = len(fitting), similarity
    if best is None:
        return False
    first.poses.update((photo, best[1].moved(pose)) for photo, pose in added.items())
    return True


def _similarities(first: Placement, second: Placement) -> Iterator[Similarity]:
    """Yield a hypothesis for each pose of a photo in both parts."""
    here, there = Points.read(first.matched, first.model), Points.read(second.matched, second.model)
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
                centre, from_ = (-p[:, :3].T @ p[:, 3] for p in (pose, other))
                yield Similarity(scale, rotation, centre - scale * rotation @ from_)


def _depths(photo: int, poses: list[np.ndarray], part: Placement, points: Points) -> list[dict[int, float]]:
    """Return for each pose of a photo the depths of its features in a part, by feature."""
    features, xyz = points.matched_with(photo, part.pairs[photo], part.poses)
    depths = [xyz @ pose[2, :3] + pose[2, 3] for pose in poses]
    return [{int(f): float(z) for f, z in zip(features, row) if z > 0} for row in depths]


def _across(first: Placement, moved: Mapping[int, np.ndarray]) -> Iterator[tuple[Pair, bool]]:
    """Yield the pairs across the parts that have a motion, and whether the second photo is a moved one."""
    for a, b in first.matched.matches:
        if first.matched.motions[a, b] and (a in moved) != (b in moved) and {a, b} & first.poses.keys():
            yield (a, b), b in moved


def _fitting(first: Placement, moved: Mapping[int, np.ndarray]) -> set[Pair]:
    """Return the pairs across the parts of which a motion fits."""
    matched: Matched = first.matched
    rays, poses = matched.rays(), {**moved, **first.poses}
    fitting = set()
    for (a, b), _ in _across(first, moved):
        near = matched.misfit((a, b), poses[a], poses[b], rays) <= ROUGHLY
        if any(near[motion.matches].mean() >= FITS for motion in matched.motions[a, b]):
            fitting.add((a, b))
    return fitting


def _largest_rival(first: Placement, moved: Mapping[int, np.ndarray], fitting: set[Pair]) -> int:
    """Count the other pairs across the parts that agree on one other rotation between them."""
    owners, rotations = [], []
    for number, (pair, second_moved) in enumerate(_across(first, moved)):
        if pair in fitting:
            continue
        mine, theirs = (pair[0], pair[1]) if second_moved else (pair[1], pair[0])
        for motion in first.matched.motions[pair]:
            for rotation in motion.rotations:
                relative = rotation if second_moved else rotation.T
                owners.append(number)
                rotations.append(moved[theirs][:, :3].T @ relative @ first.poses[mine][:, :3])
    if not owners:
        return 0
    stack, owner = np.array(rotations).reshape(-1, 9), np.array(owners)
    alike = stack @ stack.T > trace_of(ALIKE_DEG)
    return max(len(np.unique(owner[row])) for row in alike)
