"""Matched photos: their focal lengths, the motions of every pair, and matches that fit given poses."""

from __future__ import annotations

import copy
import heapq
import math
import sqlite3
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ambiguous_wild.builder.motions import (
    LEAST,
    Motion,
    Pair,
    agreed_motions,
    cycle_votes,
    focal_votes,
    motions_of_pairs,
)
from ambiguous_wild.io.safe_pycolmap import pycolmap

# A match fits within this distance of its epipolar line: a share of the longer side, between bounds in px.
FITS_PX, FITS_SHARE = (1.5, 3.0), 0.003
ALL_MAPPED = 200  # photos up to which COLMAP's mapper gets all: its adjustments grow faster than their number
MAPPED_PARTNERS = 5  # partners that the mapper gets of every photo, so that each can be placed by them


@dataclass
class Matched:
    """Photos with features and matched pairs, without poses; a photo's number is its index in `ids`."""

    ids: list[int]  # image ids of COLMAP
    names: list[str]
    cameras: list[Any]  # pycolmap.Camera of every photo
    features: list[np.ndarray]  # a photo each: [N, 2] px
    matches: dict[Pair, np.ndarray]  # [K, 2] features of the pair's photos; pairs with at least `LEAST`
    motions: dict[Pair, list[Motion]] = field(default_factory=dict)
    distorted: bool = True  # whether the lens's distortion is estimated; else there is none

    @classmethod
    def read(cls, database: Path) -> Matched:
        """Read COLMAP's database; motions are not in it."""
        db = pycolmap.Database.open(str(database))
        try:
            images = sorted(db.read_all_images(), key=lambda image: image.image_id)
            cameras = {camera.camera_id: camera for camera in db.read_all_cameras()}
            at = {image.image_id: k for k, image in enumerate(images)}
            matches = {}
            for number, rows in zip(*db.read_all_matches()):
                if len(rows) >= LEAST:
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

    def copy(self) -> Matched:
        """Return a copy with cameras of its own; features, matches and motions are shared."""
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

    def rays(self) -> list[np.ndarray]:
        """Return the features of every photo as x / z and y / z, [N, 2], by its present camera."""
        return [
            np.asarray(camera.cam_from_img(points)) if len(points) else points
            for camera, points in zip(self.cameras, self.features)
        ]

    def focal_px(self, photo: int) -> float:
        """Return the focal length of a photo's camera."""
        return float(self.cameras[photo].mean_focal_length())

    def misfit(
        self, pair: Pair, first: np.ndarray, second: np.ndarray, rays: Sequence[np.ndarray]
    ) -> np.ndarray:
        """Return the distances [K] of a pair's matches from their epipolar lines (Sampson); 1 = just fits.

        Args:
            pair: two photos.
            first: [3, 4] pose of the first photo, camera from world.
            second: [3, 4] pose of the second photo.
            rays: result of `rays`.
        """
        rows = self.matches[pair]
        essential = _essential(relative_pose(first, second))
        a, b = (np.column_stack([rays[k][rows[:, c]], np.ones(len(rows))]) for c, k in enumerate(pair))
        line, back = a @ essential.T, b @ essential
        size = (line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
        side = max(max(self.cameras[k].width, self.cameras[k].height) for k in pair)
        error = np.clip(FITS_SHARE * side, *FITS_PX) / np.sqrt(
            self.focal_px(pair[0]) * self.focal_px(pair[1])
        )
        return np.abs((b * line).sum(axis=1)) / np.sqrt(np.maximum(size, 1e-30)) / error

    def fit(
        self, pair: Pair, first: np.ndarray, second: np.ndarray, rays: Sequence[np.ndarray]
    ) -> np.ndarray:
        """Tell which matches of a pair fit two poses, [K] bool; arguments as in `misfit`."""
        return self.misfit(pair, first, second, rays) <= 1.0

    def fitting(self, poses: Mapping[int, np.ndarray]) -> dict[Pair, tuple[np.ndarray, np.ndarray]]:
        """Return of every placed pair its pose, second from first [3, 4], and the matches that fit it."""
        rays, fitting_pairs = self.rays(), {}
        for a, b in self.matches:
            if a in poses and b in poses:
                rows = np.flatnonzero(self.fit((a, b), poses[a], poses[b], rays))
                if len(rows) >= LEAST:
                    fitting_pairs[a, b] = relative_pose(poses[a], poses[b]), rows
        return fitting_pairs

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

    def find_motions(self, jobs: int) -> dict[Pair, tuple[int, int]]:
        """Find the motions of all pairs; return motion and way, by number, of pairs that agree."""
        focals_px = [self.focal_px(k) for k in range(len(self.ids))]
        self.motions = motions_of_pairs(self.rays(), focals_px, self.matches, jobs)
        return agreed_motions(self.motions, cycle_votes(self.motions))

    def poses(self, model: Any) -> dict[int, np.ndarray]:
        """Return the poses [3, 4], camera from world, of the photos that a model places."""
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

    def write_agreed(self, database: Path, agreed: Mapping[Pair, tuple[int, int]]) -> None:
        """Write cameras and one motion of every pair that agrees to the database, for COLMAP's mapper.

        Of more than `ALL_MAPPED` photos it gets some: `Placement` places the others, each in constant time.
        """
        db = pycolmap.Database.open(str(database))
        try:
            for camera in {camera.camera_id: camera for camera in self.cameras}.values():
                db.update_camera(camera)
        finally:
            db.close()
        if len(self.ids) > ALL_MAPPED:
            mapped = _well_connected(agreed)
            agreed = {pair: found for pair, found in agreed.items() if mapped.issuperset(pair)}
        verified = {}
        for pair, (number, decomposition) in agreed.items():
            motion = self.motions[pair][number]
            pose = np.column_stack([motion.rotations[decomposition], motion.translations[decomposition]])
            verified[pair] = pose, motion.matches
        self.write_verified(database, verified)

    def save_motions(self, path: Path) -> None:
        """Save pair, matches and ways of every motion as .npz."""
        every = [(pair, motion) for pair, motions in self.motions.items() for motion in motions]
        np.savez(
            path,
            pairs=np.array([pair for pair, _ in every], int).reshape(-1, 2),
            counts=np.array([[len(m.matches), len(m.rotations)] for _, m in every], int).reshape(-1, 2),
            matches=np.concatenate([np.zeros(0, int), *(m.matches for _, m in every)]),
            rotations=np.concatenate([np.zeros((0, 3, 3)), *(m.rotations for _, m in every)]),
            translations=np.concatenate([np.zeros((0, 3)), *(m.translations for _, m in every)]),
        )

    def load_motions(self, path: Path) -> None:
        """Load the motions that `save_motions` wrote."""
        with np.load(path, allow_pickle=False) as file:
            cuts = np.cumsum(file["counts"], axis=0)[:-1]
            matches = np.split(file["matches"], cuts[:, 0])
            decompositions = (np.split(file[name], cuts[:, 1]) for name in ("rotations", "translations"))
            self.motions = {pair: [] for pair in self.matches}
            for (a, b), *motion in zip(file["pairs"].tolist(), matches, *decompositions):
                self.motions[a, b].append(Motion(*motion))


def largest_group(pairs: Collection[Pair]) -> int:
    """Return the largest number of photos that pairs connect."""
    if not pairs:
        return 0
    ends = np.array(list(pairs)).T
    size = int(ends.max()) + 1
    label = connected_components(coo_array((np.ones(ends.shape[1]), tuple(ends)), (size, size)), False)[1]
    return int(np.bincount(label).max())


def connected_photos(database: Path) -> int:
    """Return the largest number of photos that the verified pairs of COLMAP's database connect."""
    with closing(sqlite3.connect(database)) as db:
        numbers = [row[0] for row in db.execute("SELECT pair_id FROM two_view_geometries WHERE rows > 0")]
    return largest_group([pycolmap.pair_id_to_image_pair(number) for number in numbers])


def _well_connected(pairs: Collection[Pair]) -> set[int]:
    """Choose photos so that each photo has `MAPPED_PARTNERS` chosen partners, or all that it has.

    Photos with no more partners are chosen too, because `Placement` asks more of those that the mapper did
    not place, and so are all pairs between parts that would fall apart, of which the mapper keeps only one.
    """
    partners: dict[int, set[int]] = {}
    for a, b in pairs:
        partners.setdefault(a, set()).add(b)
        partners.setdefault(b, set()).add(a)
    wanted = {photo: min(MAPPED_PARTNERS, len(others)) for photo, others in partners.items()}
    chosen: set[int] = set()
    # Gains only fall, so the largest is at the top of the heap if it is the same when it is counted anew.
    heap = [(-len(o) if len(o) > MAPPED_PARTNERS else -math.inf, photo) for photo, o in partners.items()]
    heapq.heapify(heap)
    while heap:
        listed, photo = heapq.heappop(heap)
        gain = sum(wanted[other] > 0 for other in partners[photo])
        if listed > -math.inf and gain < -listed:
            if gain:
                heapq.heappush(heap, (-gain, photo))
            continue
        chosen.add(photo)
        for other in partners[photo]:
            wanted[other] = max(wanted[other] - 1, 0)
    rows = [(a, b) for a, b in pairs if a in chosen and b in chosen]
    size = max(partners, default=-1) + 1
    ends = np.array(rows, int).reshape(-1, 2).T
    part = connected_components(coo_array((np.ones(len(rows)), tuple(ends)), (size, size)), False)[1]
    near = {photo: {part[k] for k in (others | {photo}) & chosen} for photo, others in partners.items()}
    return chosen.union(*(pair for pair in pairs if len(near[pair[0]] | near[pair[1]]) > 1))


def relative_pose(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the pose [3, 4] of the second camera from the first, given their poses [3, 4] from world."""
    rotation = second[:, :3] @ first[:, :3].T
    return np.column_stack([rotation, second[:, 3] - rotation @ first[:, 3]])


def _essential(pose: np.ndarray) -> np.ndarray:
    """Return the essential matrix [3, 3] of a pose, second from first [3, 4], whose scale is ignored."""
    x, y, z = pose[:, 3] / max(float(np.linalg.norm(pose[:, 3])), 1e-12)
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose[:, :3]
