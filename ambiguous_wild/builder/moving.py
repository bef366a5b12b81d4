"""Features that move: matches that fit another motion of their pair than the place's.

Structure from motion throws these matches away. A distractor that looks like the place, or like itself a
moment later, is told by nothing else.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ambiguous_wild.builder.matched import Matched
from ambiguous_wild.builder.motions import LEAST
from ambiguous_wild.builder.placing import FITS
from ambiguous_wild.builder.records import MotionResult
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.colmap_records import ModelCamera
from ambiguous_wild.io.motion_points import FILE, MotionPoints, write_motion_points
from ambiguous_wild.io.safe_pycolmap import pycolmap

CLEARLY = 2.0  # times what fits: by as much is a match off that moves
LEAST_FITTING = 0.25  # of a photo's partners must share a motion that fits its pose


@dataclass
class Votes:
    """Of the features of one photo."""

    static: np.ndarray  # [N] photos
    moving: np.ndarray  # [N] photos
    motions: list[np.ndarray] = field(default_factory=list)  # features of each motion that is not the place's
    partners: int = 0  # photos with which it shares a motion
    fitting: int = 0  # of these, photos of which some motion fits its pose


def count_votes(
    matched: Matched, poses: Mapping[int, np.ndarray], voters: Collection[int]
) -> dict[int, Votes]:
    """What the matches of the voters with each other say of their features.

    Args:
        matched: with motions.
        poses: photo -> [3, 4] camera from world.
        voters: photos that are shown; test photos must say nothing of train photos.
    """
    rays = matched.rays()
    votes = {k: Votes(*np.zeros((2, len(matched.features[k])), int)) for k in voters if k in poses}
    for (a, b), rows in matched.matches.items():
        if a not in votes or b not in votes:
            continue
        off, found = matched.misfit((a, b), poses[a], poses[b], rays), matched.motions.get((a, b), [])
        fits = [bool(np.mean(off[motion.matches] <= 1.0) >= FITS) for motion in found]
        for photo in (a, b):
            votes[photo].partners += bool(found)
            votes[photo].fitting += any(fits)
        for motion, fit in zip(found, fits):
            of_motion = off[motion.matches]
            if fit:
                fitting = rows[motion.matches[of_motion <= 1.0]]
                votes[a].static[fitting[:, 0]] += 1
                votes[b].static[fitting[:, 1]] += 1
            # a motion fitted to the place and to a distractor together has some that are off, too
            moving = rows[motion.matches[of_motion > CLEARLY]]
            if len(moving) >= LEAST:
                for photo, features in ((a, moving[:, 0]), (b, moving[:, 1])):
                    votes[photo].moving[features] += 1
                    votes[photo].motions.append(features)
    return votes


def motion_points(
    matched: Matched,
    poses: Mapping[int, np.ndarray],
    names: Mapping[str, str],
    pinholes: Mapping[str, ModelCamera],
) -> dict[str, MotionPoints]:
    """Points of the train photos, by their names in the scene.

    A photo whose pose fits few of its partners has none: all of it would seem to move.

    Args:
        matched: with motions, and with the model's cameras.
        poses: photo -> [3, 4] camera from world.
        names: of the train photos, work name -> name in the scene.
        pinholes: of the undistorted photos, by these names.
    """
    voters = {k: names[name] for k, name in enumerate(matched.names) if name in names}
    rays, found = matched.rays(), {}
    for photo, votes in count_votes(matched, poses, voters).items():
        camera = pinholes[voters[photo]]
        fx, fy, cx, cy = camera.pinhole()
        xy = (rays[photo] * [fx, fy] + [cx, cy]) / [camera.width, camera.height]
        # undistortion cuts the rim off
        heard = (votes.static + votes.moving) * (votes.fitting >= LEAST_FITTING * votes.partners)
        some = np.flatnonzero((heard > 0) & ((xy >= 0) & (xy <= 1)).all(axis=1))
        # several features of one place, turned otherwise, are one point: that with most votes
        some = some[np.argsort(-heard[some], kind="stable")]
        some = np.sort(some[np.unique(matched.features[photo][some], axis=0, return_index=True)[1]])
        static, moving = (x.clip(max=255).astype(np.uint8) for x in (votes.static, votes.moving))
        motion = _together(votes, moving > static)
        found[voters[photo]] = MotionPoints(
            xy[some].astype(np.float32), static[some], moving[some], motion[some]
        )
    return found


def write_motion(
    folder: Path, database: Path, motions: Path, model: Path, flat: Path, names: Mapping[str, str]
) -> MotionResult:
    """Write the motion points of a scene into the folder of their stage.

    Args:
        folder: of the stage.
        database: with features and matches.
        motions: file of the motions.
        model: folder of COLMAP's model, with the lenses.
        flat: folder of the model of the undistorted photos.
        names: of the train photos, work name -> name in the scene.
    """
    matched, found = Matched.read(database), pycolmap.Reconstruction(str(model))
    matched.take_cameras(found)
    matched.load_motions(motions)
    undistorted = read_model(flat)
    pinholes = {image.name: undistorted.cameras[image.camera_id] for image in undistorted.images.values()}
    points = motion_points(matched, matched.poses(found), names, pinholes)
    write_motion_points(folder / FILE, points)
    return {
        "static": sum(int((~p.moves).sum()) for p in points.values()),
        "moving": sum(int(p.moves.sum()) for p in points.values()),
        "silent": sum(not len(p.xy) for p in points.values()),
    }


def _together(votes: Votes, moves: np.ndarray) -> np.ndarray:
    """[N] int16 motions from 1, by size, of the features that move [N] bool; 0 = does not."""
    count = len(moves)
    chains = [features[moves[features]] for features in votes.motions]
    links = np.concatenate([np.zeros((2, 0), int), *(np.stack([c[:-1], c[1:]]) for c in chains)], axis=1)
    graph = coo_matrix((np.ones(links.shape[1]), links), (count, count))
    group = connected_components(graph, directed=False)[1]
    sizes = np.bincount(group[moves], minlength=group.max(initial=0) + 1)
    rank = np.empty(len(sizes), int)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(1, len(sizes) + 1)
    return np.where(moves, rank[group], 0).clip(max=32767).astype(np.int16)
