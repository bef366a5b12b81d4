"""What moves between neighbouring frames of a sequence: optical flow less the rigid flow of the static scene.

Smooth cloth has no features, and cloth of the wall's colour differs from no render. Optical flow sees both
where frames follow each other closely. The matches of a static pixel lie on its epipolar lines, at one depth.
So one depth is fitted to all matches of a pixel; what is left is its residual flow. Motion along the epipolar
line may look like another depth; then nothing is said, because so does the view through a window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from ambiguous_wild.core.machine import in_order
from ambiguous_wild.io.colmap_records import ColmapModel

SIDE = 480  # px, longer side of the frames that flow is computed on
MAP_PIXELS = 20_000  # of a map of votes
REACH = 2  # frames before and after
FEWEST_FRAMES = 6  # a sequence has at least this many
PROBES = 8  # pairs that decide whether photos are a sequence
# Least share of the matches inside the other frame that return: in the median of the probed pairs of a
# sequence, and in a pair that votes. Simulated walks of single photos have 0.75, with another place for each
# distractor, simulated and real videos 0.83 to 0.98.
SEQUENCE, FLOWS = 0.8, 0.5
ERROR_PX, ERROR_SHARE = 1.0, 0.05  # largest forward-backward error: px, and share of the flow
FAR_PX = 20.0  # median flow of the camera's rotation from which flow starts there, too
COMPARED = 5  # px of a map, side of the window in which two matches are compared
LEAST_PX = 0.35  # least uncertainty of a match
MOST_PX = 3.0  # typical residual above which the poses of a pair do not fit, and it has no votes
UNFIT_PX = 1.0  # typical residual from which a photo's pose is named in a warning
MOVES, STAYS = 4.0, 2.0  # residual in units of its uncertainty, from which or up to which a frame votes
FITS = 4  # of the depth, each with weights from the residuals of the last
# A pixel stays if points surround it within this share of the longer side, and an inverse depth explains its
# match that is at least this share of the least of theirs and at most that of the greatest.
AROUND, BEHIND, IN_FRONT = 0.12, 0.7, 1.3
POINTS_FROM = 4  # frames before and after, whose points make that surface


@dataclass(frozen=True)
class SequenceFrame:
    """A photo of the sequence and its camera, undistorted."""

    grey: np.ndarray  # [h, w] uint8
    intrinsics: np.ndarray  # [3, 3], pixel centres are whole numbers
    cam_from_world: np.ndarray  # [4, 4]

    @property
    def map_shape(self) -> tuple[int, int]:
        """Shape of its map of votes."""
        scale = min(1.0, (MAP_PIXELS / self.grey.size) ** 0.5)
        return max(round(self.grey.shape[0] * scale), 1), max(round(self.grey.shape[1] * scale), 1)

    def map_positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y in px of the centres of the map's pixels, [h, w] float32 each."""
        (h, w), (rows, columns) = self.map_shape, self.grey.shape
        x, y = (np.arange(w) + 0.5) * (columns / w) - 0.5, (np.arange(h) + 0.5) * (rows / h) - 0.5
        return np.meshgrid(x.astype(np.float32), y.astype(np.float32))

    def contains(self, xy: np.ndarray) -> np.ndarray:
        """Return which positions [h, w, 2] in px lie in the frame, [h, w] bool."""
        return np.all((xy >= -0.5) & (xy < np.array(self.grey.shape[::-1]) - 0.5), axis=-1)

    def rotation_flow(self, other: SequenceFrame) -> np.ndarray:
        """Return the flow [H, W, 2] float32 that the rotation between two frames causes, of far points."""
        rotation = other.cam_from_world[:3, :3] @ self.cam_from_world[:3, :3].T
        x, y = self.map_positions()  # far fewer pixels, as the field is smooth
        xy = np.dstack([x, y, np.ones_like(x)])
        ahead = xy @ (other.intrinsics @ rotation @ np.linalg.inv(self.intrinsics)).T
        there = ahead[..., :2] / np.maximum(ahead[..., 2:], 1e-6)
        flow = np.clip(there - xy[..., :2], -SIDE, SIDE).astype(np.float32)
        return cv2.resize(flow, self.grey.shape[::-1])


@dataclass(frozen=True)
class FlowMatches:
    """Matches of one frame's map in another frame."""

    xy: np.ndarray  # [h, w, 2] float32, px of the other frame
    error_px: np.ndarray  # [h, w] float32, forward-backward error
    consistent: np.ndarray  # [h, w] bool, whether that error is small
    differs: np.ndarray  # [h, w] float32, mean absolute difference of grey around the pixel
    inside: np.ndarray  # [h, w] bool, whether it lies in the other frame

    @property
    def consistent_share(self) -> float:
        """Share of the matches inside the other frame that are consistent."""
        return float((self.consistent & self.inside).sum() / max(self.inside.sum(), 1))


@dataclass(frozen=True)
class FlowVotes:
    """What a photo's neighbours in the sequence show of it."""

    votes: np.ndarray  # [2, h, w] uint8, frames in which a pixel stays, and in which it moves
    # robust deviation of the residual flow of its median neighbour, the lower of two; NaN without one, inf if
    # by their poses the two show nothing in common
    residual_px: float


def flow_votes(
    model: ColmapModel, read: Callable[[str], np.ndarray], names: Sequence[str], threads: int
) -> Iterator[tuple[str, FlowVotes]]:
    """Count for each pixel the neighbouring frames that show that it stays or moves.

    Args:
        model: of the undistorted photos, with points.
        read: returns a photo by its name, [H, W] uint8.
        names: photos in the order in which they were taken.
        threads: pairs at a time.

    Yields:
        Each name with its votes; nothing if the photos are no sequence.
    """
    images, count = {image.name: image for image in model.images.values()}, len(names)
    if count < FEWEST_FRAMES:
        return
    # flow needs frames of one size, and undistorted photos of several cameras differ by some pixels
    first = model.cameras[images[names[0]].camera_id]
    scale = min(1.0, SIDE / max(first.width, first.height))
    size = max(round(first.width * scale), 1), max(round(first.height * scale), 1)

    @lru_cache(maxsize=REACH + 2 + 2 * threads)
    def frame(k: int) -> SequenceFrame:
        image = images[names[k]]
        camera = model.cameras[image.camera_id]
        fx, fy, cx, cy = camera.pinhole()
        sx, sy = size[0] / camera.width, size[1] / camera.height
        intrinsics = np.array([[fx * sx, 0, cx * sx - 0.5], [0, fy * sy, cy * sy - 0.5], [0, 0, 1.0]])
        grey = cv2.resize(read(names[k]), size, interpolation=cv2.INTER_AREA)
        return SequenceFrame(grey, intrinsics, image.cam_from_world())

    probed: dict[tuple[int, int], tuple[FlowMatches, FlowMatches]] = {}

    def pair(ab: tuple[int, int]) -> tuple[FlowMatches, FlowMatches]:
        return probed.get(ab) or _matches(frame(ab[0]), frame(ab[1]))

    probes = [(k, k + 1) for k in np.unique(np.linspace(0, count - 2, PROBES).astype(int)).tolist()]
    probed.update(zip(probes, in_order(pair, probes, threads), strict=True))
    if np.median([there.consistent_share for there, _ in probed.values()]) < SEQUENCE:
        return
    tracked = any((image.point_ids >= 0).any() for image in images.values())
    matches_of: dict[int, dict[int, FlowMatches]] = {k: {} for k in range(count)}
    pairs = [(a, b) for b in range(count) for a in range(max(b - REACH, 0), b)]
    of_pairs = in_order(pair, pairs, threads)
    for latest in range(count + REACH):
        for earlier in range(max(latest - REACH, 0), latest if latest < count else 0):
            matches_of[earlier][latest], matches_of[latest][earlier] = next(of_pairs)
        if (complete := latest - REACH) >= 0:
            near = range(max(complete - POINTS_FROM, 0), min(complete + POINTS_FROM + 1, count))
            ids = np.unique(np.concatenate([images[names[n]].point_ids for n in near]))
            xyz = model.points.xyz[np.isin(model.points.ids, ids)]
            others = [
                (frame(n), m) for n, m in matches_of.pop(complete).items() if m.consistent_share >= FLOWS
            ]
            yield names[complete], count_votes(frame(complete), others, xyz if tracked else None)


def _matches(first: SequenceFrame, second: SequenceFrame) -> tuple[FlowMatches, FlowMatches]:
    """Return the matches of the first frame's map in the second, and of the second's in the first.

    Flow reaches some 60 px. Where the camera's rotation moves the scene as far, flow from that start is a
    second candidate: the first follows what moves with the camera, the second what is static.
    """
    there, back = _candidate(first, second, None, None)
    rotations = first.rotation_flow(second), second.rotation_flow(first)
    if np.median(np.linalg.norm(rotations[0], axis=2)) >= FAR_PX:
        pairs = zip((there, back), _candidate(first, second, *rotations))
        there, back = (_better(*both) for both in pairs)
    return there, back


def _candidate(
    first: SequenceFrame, second: SequenceFrame, start: np.ndarray | None, start_back: np.ndarray | None
) -> tuple[FlowMatches, FlowMatches]:
    there, back = _flow(first.grey, second.grey, start), _flow(second.grey, first.grey, start_back)
    return _matched(first, second, there, back), _matched(second, first, back, there)


def _flow(first: np.ndarray, second: np.ndarray, start: np.ndarray | None) -> np.ndarray:
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return flow.calc(first, second, start)  # type: ignore[arg-type]


def _matched(frame: SequenceFrame, other: SequenceFrame, there: np.ndarray, back: np.ndarray) -> FlowMatches:
    x, y = frame.map_positions()
    flow = cv2.remap(there, x, y, cv2.INTER_LINEAR)
    xy = np.dstack([x, y]) + flow
    backward = cv2.remap(
        back, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e4, 1e4)
    )
    error_px = np.linalg.norm(flow + backward, axis=2)
    looks = cv2.remap(other.grey, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    differs = cv2.absdiff(looks, cv2.remap(frame.grey, x, y, cv2.INTER_LINEAR))
    consistent = error_px <= ERROR_PX + ERROR_SHARE * np.linalg.norm(flow, axis=2)
    differs = cv2.blur(differs.astype(np.float32), (COMPARED, COMPARED))
    return FlowMatches(xy, error_px, consistent, differs, other.contains(xy))


def _better(one: FlowMatches, two: FlowMatches) -> FlowMatches:
    """Choose at each pixel the match that is consistent, of two the one that looks more alike."""
    second = two.consistent & (~one.consistent | (two.differs < one.differs))
    return FlowMatches(
        np.where(second[..., None], two.xy, one.xy),
        *(
            np.where(second, getattr(two, n), getattr(one, n))
            for n in ("error_px", "consistent", "differs", "inside")
        ),
    )


def count_votes(
    frame: SequenceFrame, others: Sequence[tuple[SequenceFrame, FlowMatches]], xyz: np.ndarray | None
) -> FlowVotes:
    """Count the frames in which each pixel stays or moves.

    Args:
        frame: the frame of the map.
        others: neighbours, with the map's matches in them.
        xyz: [M, 3] points of the static scene that are visible around the frame; None: the model has no
            tracks, as imported ones may, and then nothing is known of depths.
    """
    votes = np.zeros((2, *frame.map_shape), np.uint8)
    least, greatest = surrounding_inverse_depths(frame, np.zeros((0, 3)) if xyz is None else xyz)
    neighbours = [_neighbour(frame, other, matches, (least, greatest)) for other, matches in others]
    inverse, residuals = np.zeros(least.shape), [np.zeros(least.shape)] * len(others)
    for _ in range(FITS):
        above, below = np.zeros(least.shape), np.full(least.shape, 1e-12)
        for n, residual in zip(neighbours, residuals):
            unit = n.sigma_px * (1.0 + (residual / STAYS) ** 2) * (n.away[..., 2] + inverse * n.shift[2])
            for axis in range(2):
                slope = n.xy[..., axis] * n.shift[2] - n.shift[axis]
                above += n.valid / unit**2 * slope * (n.away[..., axis] - n.xy[..., axis] * n.away[..., 2])
                below += n.valid / unit**2 * slope**2
        inverse = np.maximum(above / below, 0.0)
        residuals = [n.residual(inverse) for n in neighbours]
    around = inverse if xyz is None else np.clip(inverse, BEHIND * least, IN_FRONT * greatest)
    for n, residual in zip(neighbours, residuals):
        votes[0] += n.valid & ((least > 0) | (xyz is None)) & (n.residual(around) <= STAYS)
        votes[1] += n.valid & (residual >= MOVES) & np.isfinite(residual)
    typical_px = [n.typical_px(inverse) for n in neighbours]
    median_px = float(np.quantile(typical_px, 0.5, method="lower")) if typical_px else np.nan
    return FlowVotes(votes, median_px)


@dataclass(frozen=True)
class _Neighbour:
    """Another frame: a static pixel of inverse depth r is at the projection of `away` + r * `shift` in it."""

    away: np.ndarray  # [h, w, 3]
    shift: np.ndarray  # [3]
    xy: np.ndarray  # [h, w, 2] px, the matches
    sigma_px: np.ndarray  # [h, w], uncertainty of the matches
    valid: np.ndarray  # [h, w] bool: the match is consistent, and the frame shows the static surface, too

    def project(self, inverse: np.ndarray) -> np.ndarray:
        """Return x and y in px, [h, w, 2], of pixels of these inverse depths [h, w]."""
        ahead = self.away + inverse[..., None] * self.shift
        return np.asarray(ahead[..., :2] / np.maximum(ahead[..., 2:], 1e-6))

    def typical_px(self, inverse: np.ndarray) -> float:
        """Return the robust deviation of the residual flow: errors of poses and flow are alike in a pair."""
        distance = np.linalg.norm(self.project(inverse) - self.xy, axis=2)
        return 1.48 * float(np.median(distance[self.valid])) if self.valid.any() else np.inf

    def residual(self, inverse: np.ndarray) -> np.ndarray:
        """Return the residual flow [h, w] in units of its uncertainty; inf if the poses do not fit."""
        typical = self.typical_px(inverse)
        if typical > MOST_PX:
            return np.full(inverse.shape, np.inf)
        distance = np.linalg.norm(self.project(inverse) - self.xy, axis=2)
        return np.asarray(distance / np.maximum(self.sigma_px, typical))


def _neighbour(
    frame: SequenceFrame, other: SequenceFrame, matches: FlowMatches, depths: tuple[np.ndarray, np.ndarray]
) -> _Neighbour:
    x, y = frame.map_positions()
    relative = other.cam_from_world @ np.linalg.inv(frame.cam_from_world)
    rays = np.dstack([x, y, np.ones_like(x)]) @ np.linalg.inv(frame.intrinsics).T
    neighbour = _Neighbour(
        rays @ (other.intrinsics @ relative[:3, :3]).T,
        other.intrinsics @ relative[:3, 3],
        matches.xy,
        np.maximum(LEAST_PX, matches.error_px),
        matches.consistent,
    )
    # what leaves the frame finds a wrong match in it
    shown = [other.contains(neighbour.project(inverse)) for inverse in depths]
    return replace(neighbour, valid=matches.consistent & shown[0] & shown[1])


def surrounding_inverse_depths(frame: SequenceFrame, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest inverse depth of the points around each pixel of a frame's map.

    Returns:
        [h, w] float64 each; 0 where points surround the pixel on fewer than four sides.
    """
    h, w = frame.map_shape
    local = xyz @ frame.cam_from_world[:3, :3].T + frame.cam_from_world[:3, 3]
    local = local[local[:, 2] > 1e-6]
    x, y = (local @ frame.intrinsics.T)[:, :2].T / local[:, 2]
    columns = np.floor((x + 0.5) * (w / frame.grey.shape[1])).astype(np.int64)
    rows = np.floor((y + 0.5) * (h / frame.grey.shape[0])).astype(np.int64)
    inside = (columns >= 0) & (columns < w) & (rows >= 0) & (rows < h)
    least, greatest = np.full((h, w), np.inf), np.zeros((h, w))
    at = rows[inside], columns[inside]
    np.minimum.at(least, at, 1.0 / local[inside, 2])
    np.maximum.at(greatest, at, 1.0 / local[inside, 2])
    reach = max(round(AROUND * max(h, w)), 1)
    window, surrounded = np.ones((reach, reach), np.uint8), np.ones((h, w), bool)
    low, high = np.full((h, w), np.inf), np.zeros((h, w))
    for anchor in ((0, 0), (0, reach - 1), (reach - 1, 0), (reach - 1, reach - 1)):
        lows = cv2.erode(least, window, anchor=anchor, borderType=cv2.BORDER_CONSTANT, borderValue=np.inf)
        highs = cv2.dilate(greatest, window, anchor=anchor, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
        surrounded &= np.isfinite(lows)
        low, high = np.minimum(low, lows), np.maximum(high, highs)
    return np.where(surrounded, low, 0.0), np.where(surrounded, high, 0.0)
