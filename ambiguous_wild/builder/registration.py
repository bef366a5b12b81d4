"""Register every photo at the pose that its covisible photos support, and name those without such a pose.

COLMAP's mapper gives a photo the pose with most inliers. If a distractor has more matches than the static
scene, the pose is wrong, and the model does not show it, as it is consistent with itself. Covisible photos
do: a pose from a distractor is supported by the few photos that show the distractor alike alone, and its
inliers cover a small part of the picture only.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ambiguous_wild.builder.bundle_adjustment import (
    bundle_adjustment_options,
    deterministic_pipeline_options,
    plausible_distortion,
)
from ambiguous_wild.builder.matched import MatchedPhotos, PointLookup
from ambiguous_wild.builder.overlap_graph import bridges, connected_components, overlap_graph
from ambiguous_wild.builder.pose_covariance import UNSURE, JointCovariance, joint_covariance
from ambiguous_wild.builder.pose_hypothesis import (
    AREA_NEW,
    MIN_SUPPORT,
    MIN_SUPPORT_NEW,
    PoseHypothesis,
    rejection_reason,
)
from ambiguous_wild.builder.records import CameraFact
from ambiguous_wild.builder.relative_poses import Pair, rotation_trace
from ambiguous_wild.builder.retrieval import FEW_PHOTOS
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.io.safe_pycolmap import pycolmap

if TYPE_CHECKING:
    import networkx as nx

INLIER_RATIO = 0.5  # least share of inliers of a relative pose for a covisible photo to support a hypothesis
MIN_MODEL_PHOTOS = 3  # smallest number of photos of a model
ALIKE_DEG, SAME_DEG = 5.0, 1.0  # largest angle of rotations that agree, and of poses that are the same
NEAR_DEG = 3.0  # largest angle of poses that may be the same one, found twice
SAME_SHARE = 0.1  # of the path's radius: largest distance of positions that are the same
GRID = 12  # cells a side of the grid on which the area of matches is measured
RELIABLE_MERGE = 4  # pairs across two components; with fewer, the smaller one is provisional
USUAL_FOCAL = 0.5, 2.0  # over the longer side: another one, of a single photo, may be that of a distractor
MIN_POINTS = 6  # points, which two others observe, that fix the scale for a photo with the support of one
MAX_RESECTIONS = 3  # poses tried for a photo, at most
RESECTION_PX, RESECTION_LEAST = 6.0, 15  # largest error and smallest number of the inliers of a resection
ROUNDS = 8  # rounds of registering all photos anew, besides those that only add photos
SPLITS = 5  # times at most that photos without a link to the others are taken out
TAKEN_OUT = 2  # times a photo is taken out before it stays out
LOOSE_PX, TIGHT_PX = 4.0, 2.0  # observations with a larger error are removed, first and last
COVARIANCE_LIMIT = 400  # photos: the poses' covariance is a dense matrix
ADJUSTMENTS = 3  # joint adjustments at most
STILL = 2e-3  # share of changed observations that ends them; share of moved photos that ends the rounds


class Registration:
    """Poses, points and cameras of a component of the pose graph, by the support of covisible photos."""

    def __init__(self, matched: MatchedPhotos, database: Path, model: Any, seed: int) -> None:
        """Start from COLMAP's model; the verified pairs of the database will be replaced."""
        self.matched, self.database, self.model, self.seed = matched, database, model, seed
        self.pairs: list[list[Pair]] = [[] for _ in matched.ids]  # pairs of each photo
        for pair in matched.matches:
            for photo in pair:
                self.pairs[photo].append(pair)
        self.cells = [_cells(f, c.width, c.height) for f, c in zip(matched.features, matched.cameras)]
        self.poses: dict[int, np.ndarray] = {}  # photo -> [3, 4] camera from world
        self.accepted: dict[int, PoseHypothesis] = {}  # of the registered photos
        self.left_out: dict[int, str] = {}  # photo -> reason
        self.provisional: set[int] = set()  # registered photos with little evidence
        self.hypotheses: dict[int, np.ndarray] = {}  # best pose of photos, those left out among them
        self.links: dict[Pair, int] = {}  # of the poses after `run`, see `find_links`
        self.split_off: list[dict[int, np.ndarray]] = []  # poses of photos that agree among themselves alone
        self.merged: list[frozenset[int]] = []  # photos of components that were registered alone, then merged
        self.covariance: JointCovariance | None = None  # of the model, by `mark_provisional`
        self._use_model(model)

    def run(self) -> None:
        """Register all photos anew, one after another, until none moves, or hardly any of many."""
        times_out = [0] * len(self.matched.ids)
        for _ in range(SPLITS):
            if len(self.poses) < MIN_MODEL_PHOTOS:  # COLMAP does not adjust fewer photos
                break
            self._register_until_stable(times_out)
            components = self._keep_largest()
            if not components and len(self.poses) >= MIN_MODEL_PHOTOS:
                self._triangulate_and_adjust(final=True)
                components = self._keep_largest()
            if not components:
                break
            self.split_off += [poses for poses in components if len(poses) >= MIN_MODEL_PHOTOS]
        else:
            if len(self.poses) >= MIN_MODEL_PHOTOS:
                self._triangulate_and_adjust(final=True)
        self.links = self.find_links()
        reliable = self.components(self.links, self.provisional)[:1]
        reliable = [component for component in reliable if len(component) >= MIN_MODEL_PHOTOS]
        self.provisional = set(self.poses).difference(*reliable)
        for component in self.merged:
            if sum((a in component) != (b in component) for a, b in self.links) < RELIABLE_MERGE:
                smaller = min(component & self.poses.keys(), self.poses.keys() - component, key=len)
                self.provisional |= smaller
        for photo in range(len(times_out)):
            if photo not in self.poses:
                self.left_out.setdefault(photo, "too few registered photos agree with it in the end")

    def accept_all(self) -> None:
        """Accept the poses of the model as they are, with the photos that support each."""
        normalised = self.matched.normalised()
        self.accepted = {k: self._score(k, pose, normalised) for k, pose in self.poses.items()}
        self.links = self.find_links()

    def _register_until_stable(self, times_out: list[int]) -> None:
        """Register all photos anew until none moves; `times_out` counts how often each was taken out."""
        rounds, moved, pairs = 0, True, False
        while moved and rounds <= ROUNDS and len(self.poses) >= MIN_MODEL_PHOTOS:
            before = set(self.poses)
            self._triangulate_and_adjust(final=False, pairs=pairs)
            moved = self._register_all(times_out, only_out=rounds == ROUNDS)
            rounds += not set(self.poses) > before
            if not moved and not pairs and self.left_out:
                # Where photos overlap little, points that two of them observe are all that a third has.
                moved = pairs = True

    def _keep_largest(self) -> list[dict[int, np.ndarray]]:
        """Keep the largest component; return the poses of the others.

        Each is consistent in itself, but nothing fixes where it is from the largest.
        """
        others = self.components(self.find_links())[1:]
        return [{photo: self.poses.pop(photo) for photo in sorted(photos)} for photos in others]

    def find_links(self) -> dict[Pair, int]:
        """Return the registered pairs of which a relative pose has enough inliers, with their inliers."""
        normalised, links = self.matched.normalised(), {}
        for a, b in self.matched.matches:
            if a in self.poses and b in self.poses:
                inlier = self.matched.inliers((a, b), self.poses[a], self.poses[b], normalised)
                if any(
                    inlier[relative.matches].mean() >= INLIER_RATIO
                    for relative in self.matched.relative_poses[a, b]
                ):
                    links[a, b] = int(np.count_nonzero(inlier))
        return links

    def _across_merge(self, first: int, second: int) -> bool:
        """Tell whether a pair lies across components that several pairs merged."""
        return any((first in component) != (second in component) for component in self.merged)

    def components(self, all_links: Mapping[Pair, int], without: Collection[int] = ()) -> list[set[int]]:
        """Return the components of the pose graph, the largest first.

        A single link between two groups of photos does not connect them: it may show a distractor, and it
        gives no scale. Nor does a single photo whose inliers with one of them cover little of it. A single
        link does connect one or two photos with a group, and components that several pairs merged.

        Args:
            all_links: result of `find_links`.
            without: photos whose links are not used.
        """
        photos = sorted(set(self.poses) - set(without))
        at = {photo: k for k, photo in enumerate(photos)}
        links = [(at[a], at[b], n) for (a, b), n in all_links.items() if a in at and b in at]
        graph = overlap_graph(len(photos), links)
        weak = {pair for pair in bridges(graph) if not self._across_merge(*(photos[k] for k in pair))}
        graph.remove_edges_from(weak)
        self._cut_small_areas(graph, photos)
        components = [set(group) for group in connected_components(graph)]
        for _, a, b in sorted((-n, a, b) for a, b, n in links if (a, b) in weak):
            first, second = (next(group for group in components if k in group) for k in (a, b))
            if min(len(first), len(second)) < MIN_MODEL_PHOTOS:
                components.remove(second)
                first |= second
        named = [{photos[k] for k in group} for group in components]
        return sorted(named, key=lambda group: (-len(group), min(group)))

    def _cut_small_areas(self, graph: nx.Graph, photos: Sequence[int]) -> None:
        """Remove the links of a photo with a group that it alone connects, if they may show a distractor."""
        import networkx as nx

        normalised = self.matched.normalised()
        for k in sorted(nx.articulation_points(graph)):
            photo = photos[k]
            linked = {j for j in graph[k] if not self._across_merge(photo, photos[j])}
            evidence = self._score(photo, self.poses[photo], normalised).evidence
            sides = []
            for side in nx.connected_components(nx.restricted_view(graph, [k], [])):
                pairs = {(min(photo, photos[j]), max(photo, photos[j])) for j in linked & side}
                of_side = {key: rows for key, rows in evidence.items() if key[0] in pairs}
                sides.append((self.hypothesis(photo, self.poses[photo], of_side), side))
            sides.sort(key=lambda item: -item[0].weight)
            for hypothesis, side in sides[1:]:
                if len(side) >= MIN_MODEL_PHOTOS and hypothesis.area < AREA_NEW:
                    graph.remove_edges_from([(k, j) for j in linked & side])

    def cameras(self) -> list[CameraFact]:
        """Return the focal length of every camera; its standard deviation by `mark_provisional`."""
        facts: list[CameraFact] = []
        for number, photos in self._photos_of_cameras().items():
            block = None
            if self.covariance is not None:
                params = self.covariance.model.cameras[number].params
                block = self.covariance.covariance.get_other_params_cov(params)
            deviation = np.inf if block is None else float(np.sqrt(block[0][0]))
            facts.append(
                {
                    "photos": [self.matched.names[photo] for photo in photos],
                    "focal_px": round(self.matched.focal_px(photos[0]), 2),
                    "focal_sd_px": round(deviation, 2) if np.isfinite(deviation) else None,
                }
            )
        return facts

    def mark_provisional(self) -> None:
        """Estimate the covariance; photos whose poses it leaves open are provisional, all if most are.

        So is a photo with a camera of its own and an unusual focal length: a distractor that covers much of
        it bends both.
        """
        self.covariance = self._joint_covariance()
        self.provisional |= {k for k in self.poses if self._observations(k) < MIN_POINTS}
        for photos in self._photos_of_cameras().values():
            camera = self.matched.cameras[photos[0]]
            ratio = camera.mean_focal_length() / max(camera.width, camera.height)
            if len(photos) == 1 and not USUAL_FOCAL[0] <= ratio <= USUAL_FOCAL[1]:
                self.provisional |= set(photos)
        deviations = self.covariance.deviations if self.covariance else {}
        if deviations:
            sure = {k for k in self.poses if (deviations.get(self.matched.ids[k], np.inf) <= UNSURE).all()}
            most = 2 * len(sure) >= len(deviations)
            self.provisional |= self.poses.keys() - (sure if most else set())

    def _photos_of_cameras(self) -> dict[int, list[int]]:
        """Return the registered photos of every camera, by its id."""
        return grouped(self.poses, lambda photo: int(self.matched.cameras[photo].camera_id))

    def _observations(self, photo: int) -> int:
        return int(self.model.images[self.matched.ids[photo]].num_points3D)

    def _joint_covariance(self) -> JointCovariance | None:
        if not MIN_MODEL_PHOTOS <= len(self.poses) <= COVARIANCE_LIMIT:
            return None
        # A photo with fewer points leaves all of them open.
        photos = [k for k in self.poses if self._observations(k) >= MIN_POINTS]
        ids = [self.matched.ids[k] for k in sorted(photos, key=self._observations, reverse=True)]
        options = bundle_adjustment_options(self.matched.distorted, len(self.poses), final=True)
        return joint_covariance(self.model, ids, options)

    def _register_all(self, times_out: list[int], only_out: bool) -> bool:
        """Register all photos; tell whether more than a few changed, or an added one may help others in."""
        normalised, points = self.matched.normalised(), PointLookup.read(self.matched, self.model)
        moves: dict[int, np.ndarray | None] = {}
        self.accepted, self.left_out, self.provisional, self.hypotheses = {}, {}, set(), {}
        for photo in range(len(self.matched.ids)):
            pose_now = self.poses.get(photo)
            best, competing = self._best(photo, pose_now, normalised, points)
            if best.pose is not None and best.support:
                self.hypotheses[photo] = best.pose
            few = pose_now is None and best.area < AREA_NEW
            reason = rejection_reason(best, competing, MIN_SUPPORT_NEW if few else MIN_SUPPORT)
            if reason is None and len(best.support) < MIN_SUPPORT_NEW:
                self.provisional.add(photo)
            if reason is not None and self._unopposed(photo, best, competing, points):
                self.provisional.add(photo)
                reason = None
            if reason is None and pose_now is None and (only_out or times_out[photo] >= TAKEN_OUT):
                reason = "its partners do not settle on a pose"
            if reason is not None:
                self.left_out[photo] = reason
                if pose_now is not None:
                    moves[photo] = None
                    times_out[photo] += 1
                continue
            self.accepted[photo] = best
            if not only_out and not self._same(best.pose, pose_now):
                moves[photo] = best.pose
        added = moves.keys() - self.poses.keys()
        for photo, pose in moves.items():
            if pose is None:
                del self.poses[photo]
            else:
                self.poses[photo] = pose
        near = (pair for photo in added for pair in self.pairs[photo] if self.matched.relative_poses[pair])
        helps = any(photo not in self.poses for pair in near for photo in pair)
        return helps or len(moves) > STILL * len(self.matched.ids)

    def _best(
        self, photo: int, now: np.ndarray | None, normalised: Sequence[np.ndarray], points: PointLookup
    ) -> tuple[PoseHypothesis, PoseHypothesis]:
        """Return the hypothesis with most weight, and the strongest competing one."""
        hypotheses = [] if now is None else [self._score(photo, now, normalised)]
        hypotheses += [self._score(photo, pose, normalised) for pose in self.resections(photo, points)]
        best = max(
            hypotheses,
            key=lambda hypothesis: hypothesis.weight,
            default=PoseHypothesis(None, frozenset(), 0.0),
        )
        elsewhere = []
        for hypothesis in hypotheses:
            if hypothesis is best or self._same(hypothesis.pose, best.pose):
                continue
            evidence = hypothesis.evidence
            if _rotation_deg(hypothesis.pose, best.pose) < NEAR_DEG:
                # It may be the same pose, less precise: evidence for both counts for the best only.
                evidence = {k: rows for k, rows in evidence.items() if k not in best.evidence}
            elsewhere.append(self.hypothesis(photo, hypothesis.pose, evidence))
        elsewhere = [hypothesis for hypothesis in elsewhere if len(hypothesis.support) >= MIN_SUPPORT]
        elsewhere.append(self._competing_rotation(photo, best.support))
        return best, max(
            elsewhere,
            key=lambda hypothesis: hypothesis.weight,
            default=PoseHypothesis(None, frozenset(), 0.0),
        )

    def _unopposed(
        self, photo: int, best: PoseHypothesis, competing: PoseHypothesis, points: PointLookup
    ) -> bool:
        """Tell whether little evidence for a pose is enough, because nothing speaks against it."""
        if competing.support or best.clustered:
            return False
        if len(best.support) >= MIN_SUPPORT:
            return True
        if not best.support or best.pose is None or best.area < AREA_NEW:
            return False
        features, xyz = points.matched_with(photo, self.pairs[photo], self.poses)
        local = xyz @ best.pose[:, :3].T + best.pose[:, 3]
        front = local[:, 2] > 0
        pixels = np.asarray(self.matched.cameras[photo].img_from_cam(local[front])).reshape(-1, 2)
        off = np.linalg.norm(pixels - self.matched.features[photo][features[front]], axis=1)
        return bool(np.count_nonzero(off < RESECTION_PX) >= MIN_POINTS)

    def _score(self, photo: int, pose: np.ndarray, normalised: Sequence[np.ndarray]) -> PoseHypothesis:
        """Score a pose hypothesis: a photo supports it if most matches of a relative pose are inliers."""
        evidence = {}
        for pair in self.pairs[photo]:
            other = pair[0] + pair[1] - photo
            if other not in self.poses:
                continue
            ends = (pose, self.poses[other]) if pair[0] == photo else (self.poses[other], pose)
            inlier = self.matched.inliers(pair, *ends, normalised)
            for number, relative in enumerate(self.matched.relative_poses[pair]):
                if inlier[relative.matches].mean() >= INLIER_RATIO:
                    rows = relative.matches[inlier[relative.matches]]
                    evidence[pair, number] = self.matched.matches[pair][rows, pair.index(photo)]
        return self.hypothesis(photo, pose, evidence)

    def hypothesis(
        self, photo: int, pose: np.ndarray | None, evidence: Mapping[tuple[Pair, int], np.ndarray]
    ) -> PoseHypothesis:
        support = frozenset(a + b - photo for (a, b), _ in evidence)
        rows = list(evidence.values())
        return PoseHypothesis(pose, support, self._area(photo, rows), self._coverage(photo, rows), evidence)

    def _competing_rotation(self, photo: int, agree: frozenset[int]) -> PoseHypothesis:
        """Return the strongest competing hypothesis: most relative poses that agree in rotation."""
        owners, turns, rows = [], [], []
        for pair in self.pairs[photo]:
            other = pair[0] + pair[1] - photo
            if other not in self.poses or other in agree:
                continue
            for relative in self.matched.relative_poses[pair]:
                for rotation in relative.rotations:
                    owners.append(other)
                    turns.append((rotation if pair[1] == photo else rotation.T) @ self.poses[other][:, :3])
                    rows.append(self.matched.matches[pair][relative.matches, pair.index(photo)])
        if not owners:
            return PoseHypothesis(None, frozenset(), 0.0)
        stack = np.array(turns).reshape(-1, 9)
        alike = stack @ stack.T > rotation_trace(ALIKE_DEG)
        groups = [np.flatnonzero(row) for row in alike]
        largest = max(groups, key=lambda group: len({owners[k] for k in group}))
        area = self._area(photo, [rows[k] for k in largest])
        return PoseHypothesis(None, frozenset(owners[k] for k in largest), area)

    def _same(self, first: np.ndarray | None, second: np.ndarray | None) -> bool:
        """Tell whether two poses are the same."""
        if first is None or second is None:
            return False
        apart = float(np.linalg.norm(centre_of(first) - centre_of(second)))
        return _rotation_deg(first, second) < SAME_DEG and apart < SAME_SHARE * self.radius

    def _area(self, photo: int, rows: Sequence[np.ndarray]) -> float:
        """Return the share of the photo's grid cells with features that hold one of the features `rows`."""
        if not rows:
            return 0.0
        cells = self.cells[photo]
        return len(np.unique(cells[np.concatenate(rows)])) / len(np.unique(cells))

    def _coverage(self, photo: int, rows: Sequence[np.ndarray]) -> float:
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
        while len(poses) < MAX_RESECTIONS and len(left) >= RESECTION_LEAST:
            answer = pycolmap.estimate_and_refine_absolute_pose(
                pixels[left], xyz[left], self.matched.cameras[photo], options
            )
            if answer is None or answer["num_inliers"] < RESECTION_LEAST:
                break
            poses.append(np.asarray(answer["cam_from_world"].matrix()))
            left = left[~np.asarray(answer["inlier_mask"])]
        return poses

    def _triangulate_and_adjust(self, *, final: bool, pairs: bool = True) -> None:
        """Triangulate all inliers of the poses, then adjust jointly.

        Args:
            final: adjust until nothing changes.
            pairs: also triangulate points that only two photos observe.
        """
        matched = self.matched
        matched.write_verified(self.database, matched.verified_pairs(self.poses))
        db = pycolmap.Database.open(str(self.database))
        try:
            cache = pycolmap.DatabaseCache.create(db, pycolmap.DatabaseCacheOptions(load_all_images=True))
        finally:
            db.close()
        options = deterministic_pipeline_options(self.seed)
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
            careful = final and (error == TIGHT_PX or len(self.poses) <= FEW_PHOTOS)
            mapper.iterative_global_refinement(
                ADJUSTMENTS if careful else 1,
                STILL,
                options.mapper,
                bundle_adjustment_options(matched.distorted, len(self.poses), final=careful),
                options.triangulation,
            )
        mapper.end_reconstruction(False)
        if self.matched.distorted and not plausible_distortion(model):
            self.matched.distorted = False
            for camera in self.matched.cameras:
                camera.params = [*camera.params[:3], 0.0]
            self._triangulate_and_adjust(final=final, pairs=pairs)
            return
        self._use_model(model)

    def _use_model(self, model: Any) -> None:
        """Use the cameras and poses of a model."""
        self.model = model
        self.covariance = None
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


def _rotation_deg(first: np.ndarray | None, second: np.ndarray | None) -> float:
    """Return the rotation angle between two poses [3, 4]; 180 where one is unknown."""
    if first is None or second is None:
        return 180.0
    trace = float((first[:, :3] * second[:, :3]).sum())
    return float(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0))))
