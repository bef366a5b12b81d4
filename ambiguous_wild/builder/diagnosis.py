"""Refuse a reconstruction that holds too few photos or points, with the likely cause."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambiguous_wild.builder.collect import MIN_PHOTOS
from ambiguous_wild.builder.records import MatchResult, ModelSummary
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.safe_pycolmap import pycolmap

MIN_SHARE = 0.3  # share of the readable photos that must be registered, or most of the scene is missing
STILL_DEG = 0.5  # triangulation angle of pairs below which the camera did not move, ahead neither
MIN_POINTS = 10  # per registered photo; fewer determine neither poses nor surfaces
_STRONG_PAIRS = 60  # pairs with the most inliers, used for the diagnosis


@dataclass(frozen=True)
class PairFacts:
    """Figures of the matching, from COLMAP's database."""

    features: float  # median per photo
    tried: int
    verified: int
    inliers: float  # median over verified pairs
    degenerate: float  # share of verified pairs that show one plane only
    forward: float  # median |t_z| / |t| of the strongest pairs; 1 = straight along the view axis
    angle_deg: float  # median triangulation angle of the strongest pairs

    def sentence(self) -> str:
        """Describe the matching in figures, for an error message."""
        text = f"median {self.features:.0f} features a photo, {self.verified} of {self.tried} pairs verified"
        if self.verified:
            text += f" (median {self.inliers:.0f} inliers)"
        if math.isfinite(self.forward):
            text += f", motion {100 * self.forward:.0f} % along the view, parallax {self.angle_deg:.1f} deg"
        return text

    def reason(self, photos: int) -> str:
        """Return the likeliest cause of a failure and what to try."""
        if self.features < 200:
            return "too little texture or too much blur; try --max-features 8000 or sharper photos"
        if self.verified < photos - 1:
            return "photos overlap too little; take more photos, each sharing two thirds with the next"
        still = math.isfinite(self.angle_deg) and self.angle_deg < STILL_DEG
        if math.isfinite(self.forward) and self.forward > 0.8 and not still:
            return (
                "the camera moved straight ahead, which fixes no depth; walk sideways or round the subject, "
                "or try --mapper global"
            )
        if self.degenerate > 0.8 or (math.isfinite(self.angle_deg) and self.angle_deg < 2.0):
            return "a flat scene or a camera that only turned; move the camera between photos"
        return "matched pairs do not chain; add photos between the ones that fail, or try --max-features 8000"


def check_registered(
    model: ModelSummary | None,
    photos: int,
    skipped: int,
    database: Path,
    matches: MatchResult,
    part: int = 1,
    remarks: Sequence[str] = (),
) -> None:
    """Refuse a reconstruction that holds too few photos or points to be a scene.

    Args:
        model: COLMAP's best model; None if it built none.
        photos: number of photos that COLMAP got.
        skipped: number of photos left out before.
        database: COLMAP's database with features and matches.
        matches: result of the matching stage.
        part: component, by size; from the second on, the user asked for it however small it is.
        remarks: other possible causes, added to the error.

    Raises:
        AwError: with the counts, the figures of the matching, the likely cause and what to try.
    """
    registered, points = (model["images"], model["points"]) if model else (0, 0)
    needed = max(MIN_PHOTOS, math.ceil(MIN_SHARE * photos) if part == 1 else 0)
    few = points < MIN_POINTS * registered
    if registered >= needed and not few:
        return
    facts = pair_facts(database, matches)
    unread = f", {skipped} were left out" if skipped else ""
    outcome = f"{registered} of {photos} photos" + f" with {points} points" * few
    wanted = f"{needed}" + f" and {MIN_POINTS} points a photo" * few
    raise AwError(
        f"structure from motion registered {outcome}{unread}; a scene needs {wanted}: "
        f"{facts.sentence()}; likely {facts.reason(photos)}" + "".join(f"; {remark}" for remark in remarks)
    )


def verified_pairs(database: Path) -> dict[int, int]:
    """Return the verified pairs of COLMAP's database by its `pair_id`, with their inliers, the most first."""
    with closing(sqlite3.connect(database)) as db:
        query = "SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0 ORDER BY rows DESC, pair_id"
        return dict(db.execute(query).fetchall())


def pair_facts(database: Path, matches: MatchResult) -> PairFacts:
    """Measure features, matches, and motion between the pairs with the most inliers."""
    with closing(sqlite3.connect(database)) as db:
        features = [r[0] for r in db.execute("SELECT rows FROM keypoints")]
    pairs = verified_pairs(database)
    forward, angles = _motion(database, list(pairs)[:_STRONG_PAIRS])
    return PairFacts(
        features=float(np.median(features)) if features else 0.0,
        tried=matches["pairs"],
        verified=len(pairs),
        inliers=float(np.median(list(pairs.values()))) if pairs else 0.0,
        degenerate=matches["planar"] / len(pairs) if pairs else math.nan,
        forward=float(np.median(forward)) if forward else math.nan,
        angle_deg=float(np.median(angles)) if angles else math.nan,
    )


def _motion(database: Path, pair_ids: list[int]) -> tuple[list[float], list[float]]:
    """Return |t_z| / |t| and the triangulation angle in degrees of each pair whose pose can be estimated."""
    forward, angles = [], []
    db = pycolmap.Database.open(str(database))
    try:
        for pair_id in pair_ids:
            first, second = (db.read_image(i) for i in pycolmap.pair_id_to_image_pair(pair_id))
            geometry = db.read_two_view_geometry(first.image_id, second.image_id)
            points = [db.read_keypoints(i.image_id)[:, :2].astype(np.float64) for i in (first, second)]
            cameras = [db.read_camera(i.camera_id) for i in (first, second)]
            posed = pycolmap.estimate_two_view_geometry_pose(
                cameras[0], points[0], cameras[1], points[1], geometry
            )
            if not posed or geometry.cam2_from_cam1 is None:
                continue
            translation = np.asarray(geometry.cam2_from_cam1.translation)
            length = float(np.linalg.norm(translation))
            if length > 0:
                forward.append(abs(float(translation[2])) / length)
                angles.append(math.degrees(geometry.tri_angle))
    finally:
        db.close()
    return forward, angles
