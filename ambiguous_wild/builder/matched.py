"""Matched photos: their focal lengths, the relative poses of every pair, and the inliers of given poses.

`PointLookup` finds the 3D points that a photo may show, by its matches.
"""

from __future__ import annotations

import copy
import heapq
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.builder.diagnosis import verified_pairs
from ambiguous_wild.builder.overlap_graph import component_labels
from ambiguous_wild.builder.relative_poses import (
    MIN_INLIERS,
    Pair,
    RelativePose,
    consistent_relative_poses,
    cycle_votes,
    focal_votes,
    relative_poses_of_pairs,
)
from ambiguous_wild.io.safe_pycolmap import pycolmap

# Largest epipolar error of an inlier: a share of the longer side, between bounds in px.
INLIER_PX, INLIER_SHARE = (1.5, 3.0), 0.003
ALL_MAPPED = 200  # photos up to which COLMAP's mapper gets all: its adjustments grow faster than their number
MAPPED_COVISIBLE = 5  # covisible photos that the mapper gets of every photo, so that these register it


@dataclass
class MatchedPhotos:
    """Photos with features and matched pairs, without poses; a photo's number is its index in `ids`."""

    ids: list[int]  # image ids of COLMAP
    names: list[str]
    cameras: list[Any]  # pycolmap.Camera of every photo
    features: list[np.ndarray]  # a photo each: [N, 2] px
    matches: dict[Pair, np.ndarray]  # [K, 2] features of the pair's photos; pairs with at least `MIN_INLIERS`
    relative_poses: dict[Pair, list[RelativePose]] = field(default_factory=dict)
    distorted: bool = True  # whether the lens's distortion is estimated; else there is none

    @classmethod
    def read(cls, database: Path) -> MatchedPhotos:
        """Read COLMAP's database; relative poses are not in it."""
        db = pycolmap.Database.open(str(database))
        try:
            images = sorted(db.read_all_images(), key=lambda image: image.image_id)
            cameras = {camera.camera_id: camera for camera in db.read_all_cameras()}
            at = {image.image_id: k for k, image in enumerate(images)}
            matches = {}
            for number, rows in zip(*db.read_all_matches()):
                if len(rows) >= MIN_INLIERS:
                    first, second = pycolmap.pair_id_to_image_pair(number)
                    matches[at[first], at[second]] = np.asarray(rows)
            return cls(
                list(at),
                [image.name for image in images],
                [cameras[image.camera_id] for image in images],
                [np.asarray(db.read_keypoints(i))[:, :2].astype(np.float64) for i in at],
                dict(sorted(matches.items())),
            )
        finally:
            db.close()

    def copy(self) -> MatchedPhotos:
        """Return a copy with cameras of its own; features, matches and relative poses are shared."""
        cameras = {camera.camera_id: copy.deepcopy(camera) for camera in self.cameras}
        return replace(self, cameras=[cameras[camera.camera_id] for camera in self.cameras])

    def replace_matches(self, database: Path, matches: Mapping[Pair, np.ndarray]) -> None:
        """Replace the matches [K, 2] of some pairs in the database."""
        db = pycolmap.Database.open(str(database))
        try:
            with pycolmap.DatabaseTransaction(db):
                for (a, b), rows in matches.items():
                    db.delete_matches(self.ids[a], self.ids[b])
                    db.write_matches(self.ids[a], self.ids[b], np.ascontiguousarray(rows, np.uint32))
        finally:
            db.close()

    def normalised(self) -> list[np.ndarray]:
        """Return the features of every photo in normalised coordinates, [N, 2] x / z and y / z."""
        return [
            np.asarray(camera.cam_from_img(points)) if len(points) else points
            for camera, points in zip(self.cameras, self.features)
        ]

    def focal_px(self, photo: int) -> float:
        """Return the focal length of a photo's camera."""
        return float(self.cameras[photo].mean_focal_length())

    def epipolar_error(
        self, pair: Pair, first: np.ndarray, second: np.ndarray, normalised: Sequence[np.ndarray]
    ) -> np.ndarray:
        """Return the Sampson errors [K] of a pair's matches, relative to the largest of an inlier.

        Args:
            pair: two photos.
            first: [3, 4] pose of the first photo, camera from world.
            second: [3, 4] pose of the second photo.
            normalised: result of `normalised`.
        """
        rows = self.matches[pair]
        essential = _essential(pose_between(first, second))
        a, b = (np.column_stack([normalised[k][rows[:, c]], np.ones(len(rows))]) for c, k in enumerate(pair))
        line, back = a @ essential.T, b @ essential
        size = (line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
        side = max(max(self.cameras[k].width, self.cameras[k].height) for k in pair)
        error = np.clip(INLIER_SHARE * side, *INLIER_PX) / np.sqrt(
            self.focal_px(pair[0]) * self.focal_px(pair[1])
        )
        return np.abs((b * line).sum(axis=1)) / np.sqrt(np.maximum(size, 1e-30)) / error

    def inliers(
        self, pair: Pair, first: np.ndarray, second: np.ndarray, normalised: Sequence[np.ndarray]
    ) -> np.ndarray:
        """Tell which matches of a pair are inliers of two poses, [K] bool; see `epipolar_error`."""
        return self.epipolar_error(pair, first, second, normalised) <= 1.0

    def verified_pairs(self, poses: Mapping[int, np.ndarray]) -> dict[Pair, tuple[np.ndarray, np.ndarray]]:
        """Return of every registered pair its relative pose, second from first [3, 4], and the inliers."""
        normalised, verified = self.normalised(), {}
        for a, b in self.matches:
            if a in poses and b in poses:
                rows = np.flatnonzero(self.inliers((a, b), poses[a], poses[b], normalised))
                if len(rows) >= MIN_INLIERS:
                    verified[a, b] = pose_between(poses[a], poses[b]), rows
        return verified

    def write_verified(self, database: Path, verified: Mapping[Pair, tuple[np.ndarray, np.ndarray]]) -> None:
        """Replace the database's verified pairs: their poses, second from first [3, 4], and matches."""
        db = pycolmap.Database.open(str(database))
        try:
            db.clear_two_view_geometries()
            with pycolmap.DatabaseTransaction(db):
                for (a, b), (pose, rows) in verified.items():
                    essential = _essential(pose)
                    first, second = (np.linalg.inv(self.cameras[k].calibration_matrix()) for k in (a, b))
                    geometry = pycolmap.TwoViewGeometry()
                    geometry.config = int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
                    geometry.E, geometry.F = essential, second.T @ essential @ first
                    geometry.cam2_from_cam1 = pycolmap.Rigid3d(pose)
                    geometry.inlier_matches = np.ascontiguousarray(self.matches[a, b][rows], np.uint32)
                    db.write_two_view_geometry(self.ids[a], self.ids[b], geometry)
        finally:
            db.close()

    def find_focals(self, by_exif: Mapping[str, float], jobs: int) -> None:
        """Set the focal lengths of the cameras by votes of pairs.

        Args:
            by_exif: name -> focal length over the longer side, of photos whose EXIF has it.
            jobs: threads.
        """
        sides = [max(camera.width, camera.height) for camera in self.cameras]
        numbers = [camera.camera_id for camera in self.cameras]
        centred = [f - [c.width / 2, c.height / 2] for f, c in zip(self.features, self.cameras)]
        stated = {number: by_exif[name] for number, name in zip(numbers, self.names) if name in by_exif}
        focals = focal_votes(centred, sides, numbers, stated, self.matches, jobs)
        for camera, side in zip(self.cameras, sides):
            camera.params = [focals[camera.camera_id] * side, *camera.params[1:]]

    def find_relative_poses(self, jobs: int) -> dict[Pair, tuple[int, int]]:
        """Find the relative poses of all pairs; see `consistent_relative_poses` for what is returned."""
        focals_px = [self.focal_px(k) for k in range(len(self.ids))]
        self.relative_poses = relative_poses_of_pairs(self.normalised(), focals_px, self.matches, jobs)
        return consistent_relative_poses(self.relative_poses, cycle_votes(self.relative_poses))

    def poses(self, model: Any) -> dict[int, np.ndarray]:
        """Return the poses [3, 4], camera from world, of the photos that a model registers."""
        return {
            k: np.asarray(model.images[i].cam_from_world().matrix())
            for k, i in enumerate(self.ids)
            if i in model.images and model.images[i].has_pose
        }

    def take_cameras(self, model: Any) -> float:
        """Use the cameras of a model; return the median relative change of focal length over its photos."""
        before = np.array([self.focal_px(k) for k in range(len(self.ids))])
        for camera in self.cameras:
            if camera.camera_id in model.cameras:
                camera.params = model.cameras[camera.camera_id].params
        after = np.array([self.focal_px(k) for k in range(len(self.ids))])
        changes = np.abs(after / before - 1.0)[list(self.poses(model))]
        return float(np.median(changes)) if len(changes) else 0.0

    def write_consistent(self, database: Path, consistent: Mapping[Pair, tuple[int, int]]) -> None:
        """Write cameras and the consistent relative poses to the database, for COLMAP's mapper.

        Of more than `ALL_MAPPED` photos it gets some: `Registration` adds the others, each in constant time.
        """
        db = pycolmap.Database.open(str(database))
        try:
            for camera in {camera.camera_id: camera for camera in self.cameras}.values():
                db.update_camera(camera)
        finally:
            db.close()
        if len(self.ids) > ALL_MAPPED:
            mapped = _well_connected(consistent)
            consistent = {pair: found for pair, found in consistent.items() if mapped.issuperset(pair)}
        verified = {}
        for pair, (number, decomposition) in consistent.items():
            relative = self.relative_poses[pair][number]
            pose = np.column_stack([relative.rotations[decomposition], relative.translations[decomposition]])
            verified[pair] = pose, relative.matches
        self.write_verified(database, verified)

    def save_relative_poses(self, path: Path) -> None:
        """Save pair, inliers and decompositions of every relative pose as .npz."""
        every = [
            (pair, relative)
            for pair, relative_poses in self.relative_poses.items()
            for relative in relative_poses
        ]
        np.savez(
            path,
            pairs=np.array([pair for pair, _ in every], int).reshape(-1, 2),
            counts=np.array([[len(m.matches), len(m.rotations)] for _, m in every], int).reshape(-1, 2),
            matches=np.concatenate([np.zeros(0, int), *(m.matches for _, m in every)]),
            rotations=np.concatenate([np.zeros((0, 3, 3)), *(m.rotations for _, m in every)]),
            translations=np.concatenate([np.zeros((0, 3)), *(m.translations for _, m in every)]),
        )

    def load_relative_poses(self, path: Path) -> None:
        """Load the relative poses that `save_relative_poses` wrote."""
        with np.load(path, allow_pickle=False) as file:
            cuts = np.cumsum(file["counts"], axis=0)[:-1]
            matches = np.split(file["matches"], cuts[:, 0])
            decompositions = (np.split(file[name], cuts[:, 1]) for name in ("rotations", "translations"))
            self.relative_poses = {pair: [] for pair in self.matches}
            for (a, b), *relative in zip(file["pairs"].tolist(), matches, *decompositions):
                self.relative_poses[a, b].append(RelativePose(*relative))


@dataclass
class PointLookup:
    """Points of a model, found by the features that observe them: the 2D-3D matches of a photo."""

    matched: MatchedPhotos
    rows: list[np.ndarray]  # a photo each: [N] row of `xyz` that a feature observes, -1 without a point
    xyz: np.ndarray  # [P, 3]
    views: np.ndarray  # [P] number of photos that observe the point

    @classmethod
    def read(cls, matched: MatchedPhotos, model: Any) -> PointLookup:
        at = {number: k for k, number in enumerate(matched.ids)}
        rows = [np.full(len(f), -1) for f in matched.features]
        xyz, views = np.zeros((len(model.points3D), 3)), np.zeros(len(model.points3D), int)
        for row, point in enumerate(model.points3D.values()):
            xyz[row] = point.xyz
            elements = point.track.elements
            views[row] = len({e.image_id for e in elements})
            for element in elements:
                rows[at[element.image_id]][element.point2D_idx] = row
        return cls(matched, rows, xyz, views)

    def matched_with(
        self, photo: int, pairs: Sequence[Pair], poses: Mapping[int, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return features [K] of a photo, and their points [K, 3], which at least two others observe."""
        own = np.zeros(len(self.xyz), int)
        own[np.unique(self.rows[photo][self.rows[photo] >= 0])] = 1
        links = [np.zeros((0, 2), int)]
        for pair in pairs:
            side = pair.index(photo)
            if pair[1 - side] in poses:
                matches = self.matched.matches[pair].astype(int)
                seen = self.rows[pair[1 - side]][matches[:, 1 - side]]
                links.append(np.column_stack([matches[:, side], seen])[seen >= 0])
        both = np.unique(np.concatenate(links), axis=0)
        both = both[self.views[both[:, 1]] - own[both[:, 1]] >= 2]
        return both[:, 0], self.xyz[both[:, 1]]


def largest_component(pairs: Collection[Pair]) -> int:
    """Return the largest number of photos that pairs connect."""
    if not pairs:
        return 0
    return int(np.bincount(component_labels(1 + max(map(max, pairs)), pairs)).max())


def connected_photos(database: Path) -> int:
    """Return the largest number of photos that the verified pairs of COLMAP's database connect."""
    return largest_component([pycolmap.pair_id_to_image_pair(number) for number in verified_pairs(database)])


def _well_connected(pairs: Collection[Pair]) -> set[int]:
    """Choose photos so that each photo has `MAPPED_COVISIBLE` chosen covisible ones, or all that it has.

    Photos with no more are chosen too, because `Registration` asks more of those that the mapper did not
    register, and so are all pairs between components that would fall apart: the mapper keeps one component.
    """
    covisible: dict[int, set[int]] = {}
    for a, b in pairs:
        covisible.setdefault(a, set()).add(b)
        covisible.setdefault(b, set()).add(a)
    wanted = {photo: min(MAPPED_COVISIBLE, len(others)) for photo, others in covisible.items()}
    chosen: set[int] = set()
    # Gains only fall, so the largest is at the top of the heap if it is the same when it is counted anew.
    heap = [(-len(o) if len(o) > MAPPED_COVISIBLE else -math.inf, photo) for photo, o in covisible.items()]
    heapq.heapify(heap)
    while heap:
        listed, photo = heapq.heappop(heap)
        gain = sum(wanted[other] > 0 for other in covisible[photo])
        if listed > -math.inf and gain < -listed:
            if gain:
                heapq.heappush(heap, (-gain, photo))
            continue
        chosen.add(photo)
        for other in covisible[photo]:
            wanted[other] = max(wanted[other] - 1, 0)
    rows = [(a, b) for a, b in pairs if a in chosen and b in chosen]
    component = component_labels(max(covisible, default=-1) + 1, rows)
    near = {photo: {component[k] for k in (others | {photo}) & chosen} for photo, others in covisible.items()}
    return chosen.union(*(pair for pair in pairs if len(near[pair[0]] | near[pair[1]]) > 1))


def pose_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the pose [3, 4] of the second camera from the first, given their poses [3, 4] from world."""
    rotation = second[:, :3] @ first[:, :3].T
    return np.column_stack([rotation, second[:, 3] - rotation @ first[:, 3]])


def _essential(pose: np.ndarray) -> np.ndarray:
    """Return the essential matrix [3, 3] of a pose, second from first [3, 4], whose scale is ignored."""
    x, y, z = pose[:, 3] / max(float(np.linalg.norm(pose[:, 3])), 1e-12)
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose[:, :3]
