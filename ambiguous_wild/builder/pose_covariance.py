"""How well the matches determine the poses of a model: COLMAP's covariance of a joint adjustment.

COLMAP's covariance is relative to the first photo, and to the distance of the second from it. An
S-transformation (Baarda 1973, "S-transformations and criterion matrices") makes it relative to all photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ambiguous_wild.io.safe_pycolmap import pycolmap

UNSURE = np.array([np.radians(0.4), 0.02])  # 2.5 of these are 1 degree, and 5 % of the path's radius
ROUNDS = 20  # of weighting the photos anew, at most
TRIES = 3  # adjustments at most
SETTLED = 1e-3  # change of the standard deviations, relative to `UNSURE`, that ends the rounds


@dataclass(frozen=True)
class JointCovariance:
    """A joint adjustment, its covariance, and the standard deviations of the poses."""

    covariance: Any  # pycolmap.BACovariance
    model: Any  # pycolmap.Reconstruction, adjusted
    deviations: dict[int, np.ndarray]  # image id -> rotation in radians, position in radii of the path


def joint_covariance(
    model: Any,  # pycolmap.Reconstruction; it does not change
    photos: Sequence[int],  # image ids, those with most observations first
    options: Any,  # pycolmap.BundleAdjustmentOptions
) -> JointCovariance | None:
    """Adjust all photos together and return how well they are determined; None: not at all.

    One photo whose lens nothing determines may leave all of them open: then the last ones have no deviation.
    """
    joint = None
    for left_out in range(TRIES):
        adjusted = pycolmap.Reconstruction(model)
        config = pycolmap.BundleAdjustmentConfig()
        used = sorted(photos[: len(photos) - left_out])
        for number in used:
            config.add_image(number)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, adjusted)
        adjuster.solve()
        wanted = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.ALL)
        covariance = pycolmap.estimate_ba_covariance(wanted, adjusted, adjuster)
        if covariance is None or len(used) < 2:
            break
        deviations = _pose_deviations(covariance, adjusted, used)
        if joint is None or deviations:
            joint = JointCovariance(covariance, adjusted, deviations)
        if deviations:
            break
    return joint


def _pose_deviations(covariance: Any, model: Any, photos: Sequence[int]) -> dict[int, np.ndarray]:
    """Return the standard deviations as in `JointCovariance`; empty where they are not finite.

    A photo weighs the less the less certain it is: one that could be anywhere does not make the others
    uncertain.
    """
    poses = np.array([model.images[k].cam_from_world().matrix() for k in photos])
    turns = poses[:, :, :3].transpose(0, 2, 1)  # world from camera
    centres = -(turns @ poses[:, :, 3:])[..., 0]
    centres -= centres.mean(axis=0)
    radius = max(float(np.linalg.norm(centres, axis=1).max()), 1e-12)
    change = np.zeros((len(photos), 6, 6))  # from Ceres' tangent of a pose
    change[:, :3, :3] = 2 * np.eye(3)  # that of a quaternion is half of the angle
    change[:, 3:, :3] = -2 * turns @ _cross(poses[:, :, 3]) / radius
    change[:, 3:, 3:] = -turns / radius
    with np.errstate(invalid="ignore"):
        blocks = change[:, None] @ _blocks(covariance, photos, poses) @ change.transpose(0, 2, 1)
    if not np.isfinite(blocks).all():
        return {}
    similarities = np.zeros((len(photos), 6, 7))  # by a small similarity of the world
    similarities[:, 3:, :3] = np.eye(3)
    similarities[:, :3, 3:6], similarities[:, 3:, 3:6] = -poses[:, :, :3], -_cross(centres / radius)
    similarities[:, 3:, 6] = centres / radius
    joint, flat = blocks.transpose(0, 2, 1, 3).reshape((6 * len(photos),) * 2), similarities.reshape(-1, 7)
    own = blocks[np.arange(len(photos)), np.arange(len(photos))]
    deviations = _deviations(own)
    for _ in range(ROUNDS):
        weighted = np.repeat(1 / (UNSURE**2 + deviations**2), 3, axis=1).reshape(-1, 1) * flat
        fit = np.linalg.solve(flat.T @ weighted, weighted.T)  # [7, 6 N]: the similarity that errors cause
        moved = fit @ joint
        shared = similarities @ moved.reshape(7, len(photos), 6).transpose(1, 0, 2)
        removed = similarities @ (moved @ fit.T) @ similarities.transpose(0, 2, 1)
        before, deviations = deviations, _deviations(own - shared - shared.transpose(0, 2, 1) + removed)
        if (np.abs(deviations - before) < SETTLED * UNSURE).all():
            break
    return dict(zip(photos, deviations))


def _blocks(covariance: Any, photos: Sequence[int], poses: np.ndarray) -> np.ndarray:
    """Return COLMAP's covariance [N, N, 6, 6] of the photos; what it keeps constant has none."""
    own = [covariance.get_cam_cov_from_world(k) for k in photos]
    free = [list(range(6)) if block is not None else [] for block in own]
    for k, block in enumerate(own):
        if block is not None and len(block) < 6:
            # COLMAP keeps constant the coordinate of the second photo in which it is farthest from the first.
            first = poses[free.index([])]
            between = first[:, 3] - first[:, :3] @ poses[k, :, :3].T @ poses[k, :, 3]
            free[k].remove(3 + int(np.argmax(np.abs(between))))
    blocks = np.zeros((len(photos), len(photos), 6, 6))
    for k, rows in enumerate(free):
        for j, columns in enumerate(free[: k + 1]):
            if rows and columns:
                pair = photos[k], photos[j]
                block = own[k] if j == k else covariance.get_cam_cross_cov_from_world(*pair)
                blocks[k, j][np.ix_(rows, columns)] = block
                blocks[j, k] = blocks[k, j].T
    return blocks


def _deviations(blocks: np.ndarray) -> np.ndarray:
    """Return the largest standard deviations [N, 2] of the halves of each 6 x 6 block."""
    halves = (blocks[:, :3, :3], blocks[:, 3:, 3:])
    return np.column_stack([np.sqrt(np.linalg.eigvalsh(half)[:, -1].clip(0.0)) for half in halves])


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices [N, 3, 3] of the cross product with vectors [N, 3] from the left."""
    return np.cross(vectors[:, None], np.eye(3)).transpose(0, 2, 1)
