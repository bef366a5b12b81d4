"""Find features that move: inliers of another relative pose of the pair than that of the static scene.

Structure from motion discards these matches, but nothing else reveals a distractor that looks like the static
scene, or like itself a moment later. Features of a distractor that stands still in some photos are inliers of
the static scene; photos that show what lies behind their 3D points reveal them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ambiguous_wild.builder.matched import MatchedPhotos
from ambiguous_wild.builder.records import MotionResult
from ambiguous_wild.builder.registration import INLIER_RATIO
from ambiguous_wild.builder.relative_poses import MIN_INLIERS
from ambiguous_wild.builder.residual_flow import UNFIT_PX, flow_votes
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.colmap_records import ModelCamera
from ambiguous_wild.io.files import natural_key
from ambiguous_wild.io.images import read_gray
from ambiguous_wild.io.motion_points import FILE, NO_POINTS, MotionPoints, write_motion_points
from ambiguous_wild.io.safe_pycolmap import pycolmap

CLEARLY = 2.0  # a match moves if its epipolar error is this many times the largest of an inlier
MIN_CONSISTENT = 0.25  # share of the covisible photos that must be consistent with the pose of a photo
# A point is seen through by comparing it with at most this many points around it, no farther away than this
# share of the photo's longer side, which must be deeper by this factor.
AROUND, THROUGH, BEHIND = 12, 0.02, 1.2
MIN_THROUGH = 2  # photos that must see through a point
NEIGHBOURS = 0.05  # share of the longer side: points seen through that lie as near belong to one object
MIN_OBJECT_POINTS = 3  # points of one object


@dataclass
class Votes:
    """Votes of other photos on the features of one photo."""

    static: np.ndarray  # [N] photos that call a feature static
    moving: np.ndarray  # [N] photos that call it moving
    motions: list[np.ndarray] = field(default_factory=list)  # features of each motion but the static scene's
    covisible: int = 0  # photos with which it has a relative pose
    consistent: int = 0  # covisible photos of which a relative pose is consistent with its pose


def count_votes(
    matched: MatchedPhotos, poses: Mapping[int, np.ndarray], voters: Collection[int]
) -> dict[int, Votes]:
    """Count how many photos call each feature static or moving, by the matches among the voters.

    Args:
        matched: photos, with the relative poses of their pairs.
        poses: photo -> [3, 4] camera from world.
        voters: photos that vote and are voted on; test photos must not vote on train photos.
    """
    normalised = matched.normalised()
    votes = {k: Votes(*np.zeros((2, len(matched.features[k])), int)) for k in voters if k in poses}
    for (a, b), rows in matched.matches.items():
        if a not in votes or b not in votes:
            continue
        errors = matched.epipolar_error((a, b), poses[a], poses[b], normalised)
        relative_poses = matched.relative_poses.get((a, b), [])
        static = [
            bool(np.mean(errors[relative_pose.matches] <= 1.0) >= INLIER_RATIO)
            for relative_pose in relative_poses
        ]
        for photo in (a, b):
            votes[photo].covisible += bool(relative_poses)
            votes[photo].consistent += any(static)
        for relative_pose, is_static in zip(relative_poses, static):
            if is_static:
                inliers = rows[relative_pose.matches[errors[relative_pose.matches] <= 1.0]]
                votes[a].static[inliers[:, 0]] += 1
                votes[b].static[inliers[:, 1]] += 1
            # A relative pose of static scene and distractor together also has outliers.
            moving = rows[relative_pose.matches[errors[relative_pose.matches] > CLEARLY]]
            if len(moving) >= MIN_INLIERS:
                for photo, features in ((a, moving[:, 0]), (b, moving[:, 1])):
                    votes[photo].moving[features] += 1
                    votes[photo].motions.append(features)
    return votes


def free_space_violation_counts(
    model: pycolmap.Reconstruction, photos: Mapping[int, int]
) -> dict[int, np.ndarray]:
    """Count for every feature of a photo, [N], the photos that show what lies behind its 3D point.

    A distractor that stands still in some photos and is gone in others has points like the static scene. A
    photo sees through a point if the points that it observes around the point's projection, on at least three
    sides, lie behind it.

    Args:
        model: COLMAP's model with points.
        photos: image of the model -> photo; only these photos and their features are used.
    """
    row_of = {number: row for row, number in enumerate(model.points3D)}
    xyz = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    through, rows = np.zeros(len(xyz) + 1, int), {}  # the last row stands for features without a point
    for number, photo in photos.items():
        image = model.images[number]
        camera, pose = model.cameras[image.camera_id], image.cam_from_world().matrix()
        rows[photo] = np.array([row_of.get(p.point3D_id, -1) for p in image.points2D], int)
        own = np.unique(rows[photo][rows[photo] >= 0])
        local = xyz @ pose[:, :3].T + pose[:, 3]
        others = local[:, 2] > 0
        others[own] = False
        candidates, size = np.flatnonzero(others), np.array([camera.width, camera.height])
        if not len(own) or not len(candidates):
            continue
        xy, around = (np.asarray(camera.img_from_cam(local[which])) for which in (candidates, own))
        seen = np.flatnonzero(((xy >= 0) & (xy < size)).all(axis=1))  # NaN: outside of what the lens can show
        candidates, xy = candidates[seen], xy[seen]
        reach = THROUGH * size.max()
        away, near = cKDTree(around).query(xy, AROUND, distance_upper_bound=reach)
        some, near = np.isfinite(away), np.minimum(near, len(own) - 1)
        side = (around[near] > xy[:, None]) @ [1, 2]
        sides = np.zeros(len(candidates), int)
        for quarter in range(4):
            sides += (some & (side == quarter)).any(axis=1)
        behind = ~some | (local[own][near, 2] > BEHIND * local[candidates, 2][:, None])
        through[candidates] += (sides >= 3) & behind.all(axis=1)
    return {photo: through[numbers] for photo, numbers in rows.items()}


def motion_points(
    matched: MatchedPhotos,
    poses: Mapping[int, np.ndarray],
    train: Collection[str],
    pinholes: Mapping[str, ModelCamera],
    through: Mapping[int, np.ndarray],
) -> dict[str, MotionPoints]:
    """Return the static and moving points of the train photos, by name.

    A photo whose pose is consistent with few covisible ones gets no points, as all of it would seem to move.

    Args:
        matched: photos with the relative poses of their pairs and the model's cameras.
        poses: photo -> [3, 4] camera from world.
        train: names of the train photos.
        pinholes: name -> camera of the undistorted photo.
        through: photo -> result of `free_space_violation_counts`.
    """
    voters = {k: name for k, name in enumerate(matched.names) if name in train}
    normalised, points = matched.normalised(), {}
    for photo, votes in count_votes(matched, poses, voters).items():
        reach = NEIGHBOURS * max(matched.cameras[photo].width, matched.cameras[photo].height)
        for group in _group_features(matched.features[photo], through.get(photo, np.zeros(0)), reach):
            votes.moving[group] += through[photo][group]
            votes.motions.append(group)
        camera = pinholes[voters[photo]]
        fx, fy, cx, cy = camera.pinhole()
        xy = (normalised[photo] * [fx, fy] + [cx, cy]) / [camera.width, camera.height]
        # Only features that got votes and that undistortion leaves inside the photo are kept.
        vote_counts = (votes.static + votes.moving) * (votes.consistent >= MIN_CONSISTENT * votes.covisible)
        some = np.flatnonzero((vote_counts > 0) & ((xy >= 0) & (xy <= 1)).all(axis=1))
        # Features at one position that differ in orientation become one point: the one with most votes.
        some = some[np.argsort(-vote_counts[some], kind="stable")]
        some = np.sort(some[np.unique(matched.features[photo][some], axis=0, return_index=True)[1]])
        static, moving = (x.clip(max=255).astype(np.uint8) for x in (votes.static, votes.moving))
        motion = _number_motions(votes, moving > static)
        points[voters[photo]] = MotionPoints(
            xy[some].astype(np.float32), static[some], moving[some], motion[some]
        )
    return points


def _group_features(features: np.ndarray, through: np.ndarray, reach: float) -> list[np.ndarray]:
    """Group features that violate free space by object; a lone one is likely a point at a wrong depth.

    Args:
        features: [N, 2] px.
        through: [N], from `free_space_violation_counts`; empty if the photo was not checked.
        reach: largest distance in px between neighbours of one object.
    """
    gone = np.flatnonzero(through >= MIN_THROUGH)
    if not len(gone):
        return []
    links = cKDTree(features[gone]).query_pairs(reach, output_type="ndarray").T
    graph = coo_matrix((np.ones(links.shape[1]), links), (len(gone), len(gone)))
    group = connected_components(graph, directed=False)[1]
    return [gone[group == k] for k in np.flatnonzero(np.bincount(group) >= MIN_OBJECT_POINTS)]


def write_motion(
    folder: Path,
    database: Path,
    relative_poses: Path,
    model: Path,
    flat: Path,
    photos: Path,
    train: Collection[str],
    threads: int,
) -> MotionResult:
    """Write the motion points of a scene, and votes by optical flow in a sequence, into their stage's folder.

    Args:
        folder: folder of the stage.
        database: COLMAP's database with features and matches.
        relative_poses: file of the relative poses of pairs.
        model: folder of COLMAP's model, whose cameras have distortion.
        flat: folder of the model of the undistorted photos.
        photos: folder of the undistorted photos, of any size.
        train: names of the train photos.
        threads: pairs of photos at a time.
    """
    matched, colmap_model = MatchedPhotos.read(database), pycolmap.Reconstruction(str(model))
    matched.take_cameras(colmap_model)
    matched.load_relative_poses(relative_poses)
    undistorted = read_model(flat)
    pinholes = {image.name: undistorted.cameras[image.camera_id] for image in undistorted.images.values()}
    # A model from another program has no points of these features.
    number_of = {
        number: k
        for k, number in enumerate(matched.ids)
        if matched.names[k] in train
        and number in colmap_model.images
        and colmap_model.images[number].num_points2D() == len(matched.features[k])
    }
    through = free_space_violation_counts(colmap_model, number_of)
    points = motion_points(matched, matched.poses(colmap_model), train, pinholes, through)
    names = sorted((n for n in train if n in pinholes), key=natural_key)
    unfit = []
    for name, flow in flow_votes(undistorted, lambda n: read_gray(photos / n), names, threads):
        points[name] = dataclasses.replace(points.get(name, NO_POINTS), flow=flow.votes)
        if flow.residual_px > UNFIT_PX:
            unfit.append(name)
    write_motion_points(folder / FILE, points)
    return {
        "static": sum(int((~p.moves).sum()) for p in points.values()),
        "moving": sum(int(p.moves.sum()) for p in points.values()),
        "silent": sum(not p.informative for p in points.values()),
        "sequence": sum(p.flow is not None for p in points.values()),
        "unfit": unfit,
    }


def _number_motions(votes: Votes, moves: np.ndarray) -> np.ndarray:
    """Number the motions by size from 1: [N] int16, 0 for features that do not move, by `moves` [N] bool."""
    count = len(moves)
    chains = [features[moves[features]] for features in votes.motions]
    links = np.concatenate([np.zeros((2, 0), int), *(np.stack([c[:-1], c[1:]]) for c in chains)], axis=1)
    graph = coo_matrix((np.ones(links.shape[1]), links), (count, count))
    group = connected_components(graph, directed=False)[1]
    sizes = np.bincount(group[moves], minlength=group.max(initial=0) + 1)
    rank = np.empty(len(sizes), int)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(1, len(sizes) + 1)
    return np.where(moves, rank[group], 0).clip(max=32767).astype(np.int16)
