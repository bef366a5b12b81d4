"""Place every photo where its partners agree, and name those that have no such place.

COLMAP's mapper places a photo where most of its matches fit. If a distractor has more matches than the
static scene, the photo is placed wrongly, and the model does not show it, as it is consistent with itself.
Partners do: a photo placed by a distractor fits only the few photos that show the distractor alike, and only
in a small part of the picture.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ambiguous_wild.builder.adjustment import adjustment_options, pipeline_options, plausible
from ambiguous_wild.builder.matched import Matched
from ambiguous_wild.builder.motions import Pair, trace_of
from ambiguous_wild.builder.overlap_graph import bridges, graph_of, groups
from ambiguous_wild.builder.point_lookup import PointLookup
from ambiguous_wild.builder.pose_covariance import UNSURE, JointCovariance, joint_covariance
from ambiguous_wild.builder.pose_hypothesis import (
    AGREE,
    AGREE_NEW,
    AREA_NEW,
    PoseHypothesis,
    reason_against,
)
from ambiguous_wild.builder.records import CameraFact
from ambiguous_wild.builder.retrieval import FEW
from ambiguous_wild.io.safe_pycolmap import pycolmap

if TYPE_CHECKING:
    import networkx as nx

FITS = 0.5  # share of a motion's matches that must fit for a partner to agree
LEAST_PHOTOS = 3  # smallest number of photos of a model
ALIKE_DEG, SAME_DEG = 5.0, 1.0  # largest angle of rotations that agree, and of poses that are one place
NEAR_DEG = 3.0  # largest angle of poses that may be one place found twice
SAME_SHARE = 0.1  # of the path's radius: largest distance of positions that are one place
GRID = 12  # cells a side of the grid on which the area of matches is measured
FIRMLY_JOINED = 4  # pairs across two parts of a capture; with fewer, the smaller part is provisional
LEAST_POINTS = 6  # points, which two others observe, that fix how far a photo with one partner is from it
PLACES = 3  # largest number of places tried for a photo
RESECTION_PX, RESECTION_LEAST = 6.0, 15  # largest error and smallest number of the points of a place
ROUNDS = 8  # rounds of placing anew, besides those that only add photos
SPLITS = 5  # times at most that photos without a link to the others are taken out
TAKEN_OUT = 2  # times a photo is taken out before it stays out
LOOSE_PX, TIGHT_PX = 4.0, 2.0  # observations with a larger error are removed, first and last
COVARIANCE_LIMIT = 400  # photos: the poses' covariance is a dense matrix
ADJUSTMENTS = 3  # joint adjustments at most
STILL = 2e-3  # share of changed observations that ends them, and share of moved photos that ends placing


class Placement:
    """Poses, points and cameras of a capture, placed by the votes of partners."""

    def __init__(self, matched: Matched, database: Path, model: Any, seed: int) -> None:
        """Start from COLMAP's model; the verified pairs of the database will be replaced."""
        self.matched, self.database, self.model, self.seed = matched, database, model, seed
        self.pairs: list[list[Pair]] = [[] for _ in matched.ids]  # pairs of each photo
        for pair in matched.matches:
            for photo in pair:
                self.pairs[photo].append(pair)
        self.cells = [_cells(f, c.width, c.height) for f, c in zip(matched.features, matched.cameras)]
        self.poses: dict[int, np.ndarray] = {}  # photo -> [3, 4] camera from world
        self.places: dict[int, PoseHypothesis] = {}  # of the placed photos
        self.left_out: dict[int, str] = {}  # photo -> reason
        self.provisional: set[int] = set()  # placed photos with little evidence
        self.hypotheses: dict[int, np.ndarray] = {}  # best pose of photos, those left out among them
        self.split_off: list[dict[int, np.ndarray]] = []  # poses of photos that agree among themselves alone
        self.joined: list[frozenset[int]] = []  # photos of parts that were placed alone and then joined
        self._use_model(model)

    def run(self) -> None:
        """Place all photos anew, one after another, until none moves, or hardly any of many."""
        times_out = [0] * len(self.matched.ids)
        for _ in range(SPLITS):
            if len(self.poses) < LEAST_PHOTOS:  # COLMAP does not adjust fewer photos
                break
            self._place_until_stable(times_out)
            parts = self._keep_largest()
            if not parts and len(self.poses) >= LEAST_PHOTOS:
                self._triangulate_and_adjust(final=True)
                parts = self._keep_largest()
            if not parts:
                break
            self.split_off += [part for part in parts if len(part) >= LEAST_PHOTOS]
        else:
            if len(self.poses) >= LEAST_PHOTOS:
                self._triangulate_and_adjust(final=True)
        firm = self.components(self.provisional)[:1]
        firm = [part for part in firm if len(part) >= LEAST_PHOTOS]
        self.provisional = set(self.poses).difference(*firm)
        links = self.links() if self.joined else {}
        for part in self.joined:
            if sum((a in part) != (b in part) for a, b in links) < FIRMLY_JOINED:
                smaller = min(part & self.poses.keys(), self.poses.keys() - part, key=len)
                self.provisional |= smaller
        for photo in range(len(times_out)):
            if photo not in self.poses:
                self.left_out.setdefault(photo, "too few placed photos agree with it in the end")

    def _place_until_stable(self, times_out: list[int]) -> None:
        """Place all photos anew until none moves; `times_out` counts how often each was taken out."""
        rounds, moved, pairs = 0, True, False
        while moved and rounds <= ROUNDS and len(self.poses) >= LEAST_PHOTOS:
            before = set(self.poses)
            self._triangulate_and_adjust(final=False, pairs=pairs)
            moved = self._place_all(times_out, only_out=rounds == ROUNDS)
            rounds += not set(self.poses) > before
            if not moved and not pairs and self.left_out:
                # Where photos overlap little, points that two of them observe are all that a third has.
                moved = pairs = True

    def _keep_largest(self) -> list[dict[int, np.ndarray]]:
        """Keep the largest part that links connect; return the poses of the others.

        Each is consistent in itself, but nothing fixes where it is from the largest.
        """
        others = self.components()[1:]
        return [{photo: self.poses.pop(photo) for photo in sorted(part)} for part in others]

    def links(self) -> dict[Pair, int]:
        """Return the placed pairs of which a motion fits, with the number of their matches that fit."""
        rays, links = self.matched.rays(), {}
        for a, b in self.matched.matches:
            if a in self.poses and b in self.poses:
                fits = self.matched.fit((a, b), self.poses[a], self.poses[b], rays)
                if any(fits[motion.matches].mean() >= FITS for motion in self.matched.motions[a, b]):
                    links[a, b] = int(np.count_nonzero(fits))
        return links

    def _joins(self, first: int, second: int) -> bool:
        """Tell whether a pair lies across parts that several pairs joined."""
        return any((first in part) != (second in part) for part in self.joined)

    def components(self, without: Collection[int] = ()) -> list[set[int]]:
        """Return the placed photos that links connect, the largest group first.

        A single link between two groups of photos does not connect them: it may show a distractor, and it
        gives no scale. Nor does a single photo whose matches with one of them are crowded. A single link does
        connect one or two photos with a group, and parts that several pairs joined.

        Args:
            without: photos whose links are not used.
        """
        photos = sorted(set(self.poses) - set(without))
        at = {photo: k for k, photo in enumerate(photos)}
        links = [(at[a], at[b], n) for (a, b), n in self.links().items() if a in at and b in at]
        graph = graph_of(len(photos), links)
        weak = {pair for pair in bridges(graph) if not self._joins(*(photos[k] for k in pair))}
        graph.remove_edges_from(weak)
        self._cut_crowded(graph, photos)
        parts = [set(part) for part in groups(graph)]
        for _, a, b in sorted((-n, a, b) for a, b, n in links if (a, b) in weak):
            first, second = (next(part for part in parts if k in part) for k in (a, b))
            if min(len(first), len(second)) < LEAST_PHOTOS:
                parts.remove(second)
                first |= second
        named = [{photos[k] for k in part} for part in parts]
        return sorted(named, key=lambda part: (-len(part), min(part)))

    def _cut_crowded(self, graph: nx.Graph, photos: Sequence[int]) -> None:
        """Remove the links of a photo with a group that it alone connects, if they may show a distractor."""
        import networkx as nx

        rays = self.matched.rays()
        for k in sorted(nx.articulation_points(graph)):
            photo = photos[k]
            linked = {j for j in graph[k] if not self._joins(photo, photos[j])}
            evidence = self._judge(photo, self.poses[photo], rays).evidence
            sides = []
            for side in nx.connected_components(nx.restricted_view(graph, [k], [])):
                pairs = {(min(photo, photos[j]), max(photo, photos[j])) for j in linked & side}
                held = {key: rows for key, rows in evidence.items() if key[0] in pairs}
                sides.append((self.place(photo, self.poses[photo], held), side))
            sides.sort(key=lambda item: -item[0].weight)
            for place, side in sides[1:]:
                if len(side) >= LEAST_PHOTOS and place.crowded and place.area < AREA_NEW:
                    graph.remove_edges_from([(k, j) for j in linked & side])

    def cameras(self) -> list[CameraFact]:
        """Return the focal length of every camera, with its standard deviation if it can be estimated."""
        numbers: dict[int, list[int]] = {}
        for photo in self.poses:
            numbers.setdefault(self.matched.cameras[photo].camera_id, []).append(photo)
        found = self._covariance
        facts: list[CameraFact] = []
        for number, photos in numbers.items():
            spread = None
            if found is not None:
                spread = found.covariance.get_other_params_cov(found.model.cameras[number].params)
            deviation = np.inf if spread is None else float(np.sqrt(spread[0][0]))
            facts.append(
                {
                    "photos": [self.matched.names[photo] for photo in photos],
                    "focal_px": round(self.matched.focal_px(photos[0]), 2),
                    "focal_sd_px": round(deviation, 2) if np.isfinite(deviation) else None,
                }
            )
        return facts

    def name_unsure(self) -> None:
        """Make photos provisional whose poses the matches leave open; all, if that holds for most."""
        self.provisional |= {k for k in self.poses if self._observations(k) < LEAST_POINTS}
        deviations = self._covariance.deviations if self._covariance else {}
        if deviations:
            sure = {k for k in self.poses if (deviations.get(self.matched.ids[k], np.inf) <= UNSURE).all()}
            most = 2 * len(sure) >= len(deviations)
            self.provisional |= self.poses.keys() - (sure if most else set())

    def _observations(self, photo: int) -> int:
        return int(self.model.images[self.matched.ids[photo]].num_points3D)

    @cached_property
    def _covariance(self) -> JointCovariance | None:
        if not LEAST_PHOTOS <= len(self.poses) <= COVARIANCE_LIMIT:
            return None
        # A photo with fewer points leaves all of them open.
        photos = [k for k in self.poses if self._observations(k) >= LEAST_POINTS]
        ids = [self.matched.ids[k] for k in sorted(photos, key=self._observations, reverse=True)]
        options = adjustment_options(self.matched.distorted, len(self.poses), final=True)
        return joint_covariance(self.model, ids, options)

    def _place_all(self, times_out: list[int], only_out: bool) -> bool:
        """Place all photos; tell whether more than a few changed, or an added one may help others in."""
        rays, points = self.matched.rays(), PointLookup.read(self.matched, self.model)
        moves: dict[int, np.ndarray | None] = {}
        self.places, self.left_out, self.provisional, self.hypotheses = {}, {}, set(), {}
        for photo in range(len(self.matched.ids)):
            pose_now = self.poses.get(photo)
            best, rival = self._best(photo, pose_now, rays, points)
            if best.pose is not None and best.partners:
                self.hypotheses[photo] = best.pose
            few = pose_now is None and best.area < AREA_NEW
            reason = reason_against(best, rival, AGREE_NEW if few else AGREE)
            if reason is None and len(best.partners) < AGREE_NEW:
                self.provisional.add(photo)
            if reason is not None and self._unopposed(photo, best, rival, points):
                self.provisional.add(photo)
                reason = None
            if reason is None and pose_now is None and (only_out or times_out[photo] >= TAKEN_OUT):
                reason = "its partners do not settle on a place"
            if reason is not None:
                self.left_out[photo] = reason
                if pose_now is not None:
                    moves[photo] = None
                    times_out[photo] += 1
                continue
            self.places[photo] = best
            if not only_out and not self._same(best.pose, pose_now):
                moves[photo] = best.pose
        added = moves.keys() - self.poses.keys()
        for photo, pose in moves.items():
            if pose is None:
                del self.poses[photo]
            else:
                self.poses[photo] = pose
        near = (pair for photo in added for pair in self.pairs[photo] if self.matched.motions[pair])
        helps = any(photo not in self.poses for pair in near for photo in pair)
        return helps or len(moves) > STILL * len(self.matched.ids)

    def _best(
        self, photo: int, now: np.ndarray | None, rays: Sequence[np.ndarray], points: PointLookup
    ) -> tuple[PoseHypothesis, PoseHypothesis]:
        """Return the place with most weight, and the strongest place elsewhere."""
        places = [] if now is None else [self._judge(photo, now, rays)]
        places += [self._judge(photo, pose, rays) for pose in self.resections(photo, points)]
        best = max(places, key=lambda place: place.weight, default=PoseHypothesis(None, frozenset(), 0.0))
        elsewhere = []
        for place in places:
            if place is best or self._same(place.pose, best.pose):
                continue
            evidence = place.evidence
            if _turn_deg(place.pose, best.pose) < NEAR_DEG:
                # It may be the same place, less precise: evidence for both counts for the best only.
                evidence = {k: rows for k, rows in evidence.items() if k not in best.evidence}
            elsewhere.append(self.place(photo, place.pose, evidence))
        elsewhere = [place for place in elsewhere if len(place.partners) >= AGREE]
        elsewhere.append(self._rival_by_motions(photo, best.partners))
        return best, max(
            elsewhere, key=lambda place: place.weight, default=PoseHypothesis(None, frozenset(), 0.0)
        )

    def _unopposed(
        self, photo: int, best: PoseHypothesis, rival: PoseHypothesis, points: PointLookup
    ) -> bool:
        """Tell whether little evidence for a place is enough, because nothing speaks against it."""
        if rival.partners or best.crowded:
            return False
        if len(best.partners) >= AGREE:
            return True
        if not best.partners or best.pose is None or best.area < AREA_NEW:
            return False
        features, xyz = points.matched_with(photo, self.pairs[photo], self.poses)
        local = xyz @ best.pose[:, :3].T + best.pose[:, 3]
        front = local[:, 2] > 0
        pixels = np.asarray(self.matched.cameras[photo].img_from_cam(local[front])).reshape(-1, 2)
        off = np.linalg.norm(pixels - self.matched.features[photo][features[front]], axis=1)
        return bool(np.count_nonzero(off < RESECTION_PX) >= LEAST_POINTS)

    def _judge(self, photo: int, pose: np.ndarray, rays: Sequence[np.ndarray]) -> PoseHypothesis:
        """Score a pose hypothesis: a placed photo supports it if most matches of a relative pose fit."""
        evidence = {}
        for pair in self.pairs[photo]:
            other = pair[0] + pair[1] - photo
            if other not in self.poses:
                continue
            ends = (pose, self.poses[other]) if pair[0] == photo else (self.poses[other], pose)
            fits = self.matched.fit(pair, *ends, rays)
            for number, motion in enumerate(self.matched.motions[pair]):
                if fits[motion.matches].mean() >= FITS:
                    rows = motion.matches[fits[motion.matches]]
                    evidence[pair, number] = self.matched.matches[pair][rows, pair.index(photo)]
        return self.place(photo, pose, evidence)

    def place(
        self, photo: int, pose: np.ndarray | None, evidence: Mapping[tuple[Pair, int], np.ndarray]
    ) -> PoseHypothesis:
        partners = frozenset(a + b - photo for (a, b), _ in evidence)
        rows = list(evidence.values())
        return PoseHypothesis(pose, partners, self._area(photo, rows), self._spread(photo, rows), evidence)

    def _rival_by_motions(self, photo: int, agree: frozenset[int]) -> PoseHypothesis:
        """Return the strongest rival: the largest cluster of relative poses that agree in rotation."""
        owners, turns, rows = [], [], []
        for pair in self.pairs[photo]:
            other = pair[0] + pair[1] - photo
            if other not in self.poses or other in agree:
                continue
            for motion in self.matched.motions[pair]:
                for rotation in motion.rotations:
                    owners.append(other)
                    turns.append((rotation if pair[1] == photo else rotation.T) @ self.poses[other][:, :3])
                    rows.append(self.matched.matches[pair][motion.matches, pair.index(photo)])
        if not owners:
            return PoseHypothesis(None, frozenset(), 0.0)
        stack = np.array(turns).reshape(-1, 9)
        alike = stack @ stack.T > trace_of(ALIKE_DEG)
        groups = [np.flatnonzero(row) for row in alike]
        largest = max(groups, key=lambda group: len({owners[k] for k in group}))
        area = self._area(photo, [rows[k] for k in largest])
        return PoseHypothesis(None, frozenset(owners[k] for k in largest), area)

    def _same(self, first: np.ndarray | None, second: np.ndarray | None) -> bool:
        """Tell whether two poses are one place."""
        if first is None or second is None:
            return False
        apart = float(np.linalg.norm(centre_of(first) - centre_of(second)))
        return _turn_deg(first, second) < SAME_DEG and apart < SAME_SHARE * self.radius

    def _area(self, photo: int, rows: Sequence[np.ndarray]) -> float:
        """Return the share of the photo's grid cells with features that hold one of the features `rows`."""
        if not rows:
            return 0.0
        cells = self.cells[photo]
        return len(np.unique(cells[np.concatenate(rows)])) / len(np.unique(cells))

    def _spread(self, photo: int, rows: Sequence[np.ndarray]) -> float:
        """Return the number of cells that hold the features `rows`, over that of as many drawn at random."""
        if not rows:
            return 0.0
        cells = self.cells[photo]
        chosen = np.unique(np.concatenate(rows))
        shares = np.bincount(cells) / len(cells)
        return len(np.unique(cells[chosen])) / float((1 - (1 - shares) ** len(chosen)).sum())

    def resections(self, photo: int, points: PointLookup) -> list[np.ndarray]:
        """Find poses [3, 4] of a photo from points that at least two other photos determine."""
        features, xyz = points.matched_with(photo, self.pairs[photo], self.poses)
        pixels = self.matched.features[photo][features]
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = RESECTION_PX
        options.ransac.random_seed = self.seed
        poses: list[np.ndarray] = []
        left = np.arange(len(features))
        while len(poses) < PLACES and len(left) >= RESECTION_LEAST:
            answer = pycolmap.estimate_and_refine_absolute_pose(
                pixels[left], xyz[left], self.matched.cameras[photo], options
            )
            if answer is None or answer["num_inliers"] < RESECTION_LEAST:
                break
            poses.append(np.asarray(answer["cam_from_world"].matrix()))
            left = left[~np.asarray(answer["inlier_mask"])]
        return poses

    def _triangulate_and_adjust(self, *, final: bool, pairs: bool = True) -> None:
        """Triangulate all matches that fit the poses, then adjust jointly.

        Args:
            final: adjust until nothing changes.
            pairs: also triangulate points that only two photos observe.
        """
        matched = self.matched
        matched.write_verified(self.database, matched.fitting(self.poses))
        db = pycolmap.Database.open(str(self.database))
        try:
            cache = pycolmap.DatabaseCache.create(db, pycolmap.DatabaseCacheOptions(load_all_images=True))
        finally:
            db.close()
        options = pipeline_options(self.seed)
        options.triangulation.ignore_two_view_tracks = not pairs  # twice the points to begin training with
        model = pycolmap.Reconstruction()
        model.load(cache)
        for camera in matched.cameras:
            model.cameras[camera.camera_id].params = camera.params
        mapper = pycolmap.IncrementalMapper(cache)
        mapper.begin_reconstruction(model)
        for photo, pose in self.poses.items():
            image = model.images[matched.ids[photo]]
            image.frame.set_cam_from_world(  # type: ignore[union-attr]
                image.camera_id, pycolmap.Rigid3d(pose)
            )
            mapper.observation_manager.register_frame(image.frame_id)
        for photo in self.poses:
            mapper.triangulate_image(options.triangulation, matched.ids[photo])
        mapper.complete_and_merge_tracks(options.triangulation)
        for error in (LOOSE_PX, TIGHT_PX) if final else (LOOSE_PX,):
            options.mapper.filter_max_reproj_error = error
            careful = final and (error == TIGHT_PX or len(self.poses) <= FEW)
            mapper.iterative_global_refinement(
                ADJUSTMENTS if careful else 1,
                STILL,
                options.mapper,
                adjustment_options(matched.distorted, len(self.poses), final=careful),
                options.triangulation,
            )
        mapper.end_reconstruction(False)
        if self.matched.distorted and not plausible(model):
            self.matched.distorted = False
            for camera in self.matched.cameras:
                camera.params = [*camera.params[:3], 0.0]
            self._triangulate_and_adjust(final=final, pairs=pairs)
            return
        self._use_model(model)

    def _use_model(self, model: Any) -> None:
        """Use the cameras and poses of a model."""
        self.model = model
        self.__dict__.pop("_covariance", None)
        self.matched.take_cameras(model)
        self.poses = self.matched.poses(model)
        centres = np.array([centre_of(pose) for pose in self.poses.values()]).reshape(-1, 3)
        apart = np.linalg.norm(centres - np.median(centres, axis=0), axis=1) if len(centres) else np.zeros(1)
        self.radius = float(np.median(apart))  # radius of the path of cameras


def _cells(features: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the cell [N] of a grid over the photo in which each feature [N, 2] lies."""
    column, row = np.clip(features / [width, height] * GRID, 0, GRID - 1).astype(int).T
    return column * GRID + row


def centre_of(pose: np.ndarray) -> np.ndarray:
    """Return the position of a camera with pose [3, 4], camera from world."""
    return -pose[:, :3].T @ pose[:, 3]


def _turn_deg(first: np.ndarray | None, second: np.ndarray | None) -> float:
    """Return the angle between two poses [3, 4]; 180 where one is unknown."""
    if first is None or second is None:
        return 180.0
    trace = float((first[:, :3] * second[:, :3]).sum())
    return float(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0))))
