"""Estimate the relative poses of two photos, and which of them is that of the static scene.

A pair of photos may show several rigid motions, each with a relative pose: that of the static scene, and one
of every distractor in both photos, which may have most of the matches. But the static scene is consistent:
the rotation from a photo to a second, and on to a third, equals that from the first to the third. A relative
pose gets votes from the triplets that it closes, each weighted by the votes of the other two relative poses.

Several motions a pair, made consistent over all pairs: Arrigoni and Pajdla, "Robust motion segmentation from
pairwise matches" (ICCV 2019). They label points; here the relative poses register the photos.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from ambiguous_wild.io.safe_pycolmap import pycolmap

MIN_INLIERS = 15  # smallest number of inliers of a relative pose
MAX_RELATIVE_POSES = 3  # of a pair
DECOMPOSITIONS = 3  # of a relative pose, at most: a plane allows two more
ERROR_PX = 2.0  # largest epipolar error of an inlier
CYCLE_DEG = 4.0  # largest rotation left over around a closed triplet
ROUNDS = 4  # rounds of voting
PRIOR = 0.1  # triplets that the share of its matches counts for in the vote on a relative pose
CONSISTENT_DEG = 5.0  # largest angle between a relative pose and the averaged rotations of its photos
SWEEPS = 10  # largest number of sweeps over all photos
CONFIDENCE, TRIALS = 0.9999, 1000  # of RANSAC
PLANE_SHARE = 0.7  # share of the inliers on one plane above which the pose is ambiguous
FUNDAMENTAL_PX = 1.5  # largest distance of a match from its epipolar line
FOCALS = 0.3 * 1.02 ** np.arange(116)  # over the longer side: 118 to 20 degrees of view
FOCAL_USUAL = 0.8  # default; phones and drones have about 0.7, other cameras 0.8 to 1.4
FOCAL_PAIRS = 10  # pairs used a photo, those with most matches
FOCAL_LEAST = 10  # fundamental matrices needed to determine a focal length
FOCAL_MATCHES = 100  # matches above which a matrix gets no more weight
FOCAL_UNEQUAL = 0.1  # relative difference of singular values that counts as wrong
FOCAL_CLEAR = 0.75  # largest cost of the best focal length, relative to the median cost
FOCAL_BETTER = 0.85  # the same, relative to the cost of the focal length it would replace
FOCAL_TURNS = 3  # rounds in which each camera's focal length is chosen given the others
_CHUNK = 20_000  # triplets voted on at a time


@dataclass(frozen=True)
class RelativePose:
    """A relative pose of a pair, with its inliers; where a plane leaves it open, all its decompositions."""

    matches: np.ndarray  # [K] indices of the pair's matches, the inliers
    rotations: np.ndarray  # [W, 3, 3] second from first; several where a plane leaves the pose open
    translations: np.ndarray  # [W, 3] of unit length


Pair = tuple[int, int]
_End = tuple[int, np.ndarray, np.ndarray]  # other photo, rotations from it [K, 3, 3], their votes [K]
NormalisedPoints = Sequence[np.ndarray]  # of every photo: [N, 2] features as x / z and y / z in its camera


def relative_poses_of_pairs(
    normalised: NormalisedPoints,
    focals_px: Sequence[float],
    matches: Mapping[Pair, np.ndarray],  # (a, b) -> [K, 2] indices of features
    jobs: int,
) -> dict[Pair, list[RelativePose]]:
    """Estimate the relative poses of every pair, the one with most inliers first; the same for any `jobs`."""

    def one(item: tuple[Pair, np.ndarray]) -> list[RelativePose]:
        (a, b), rows = item
        error = ERROR_PX / float(np.sqrt(focals_px[a] * focals_px[b]))
        return estimate_relative_poses(normalised[a][rows[:, 0]], normalised[b][rows[:, 1]], error)

    cv2.setNumThreads(1)  # each thread works on one pair
    todo = sorted(matches.items(), key=lambda item: item[0])
    with ThreadPoolExecutor(jobs) as pool:
        return dict(zip((pair for pair, _ in todo), pool.map(one, todo)))


def estimate_relative_poses(first: np.ndarray, second: np.ndarray, error: float) -> list[RelativePose]:
    """Estimate the relative poses of matched features, one after another.

    Args:
        first: [K, 2] normalised coordinates in the first photo.
        second: [K, 2] their matches in the second.
        error: largest epipolar error of an inlier, in the same units.
    """
    left = np.arange(len(first))
    models: list[RelativePose] = []
    while len(models) < MAX_RELATIVE_POSES and len(left) >= MIN_INLIERS:
        a, b = first[left], second[left]
        try:
            essential, mask = cv2.findEssentialMat(
                a, b, np.eye(3), method=cv2.USAC_MAGSAC, prob=CONFIDENCE, threshold=error, maxIters=TRIALS
            )
        except cv2.error:  # OpenCV gives up on some degenerate samples
            break
        if essential is None or mask is None or np.count_nonzero(mask) < MIN_INLIERS:
            break
        inside = mask.ravel() > 0
        _, rotation, translation, _ = cv2.recoverPose(essential[:3], a[inside], b[inside], np.eye(3))
        poses = [(rotation, translation.ravel()), *_plane_poses(a[inside], b[inside], error)][:DECOMPOSITIONS]
        poses = [_refined(pose, a[inside], b[inside]) for pose in poses]
        models.append(
            RelativePose(
                left[inside],
                np.array([r for r, _ in poses]),
                np.array([t for _, t in poses]),
            )
        )
        left = left[~inside]
    return models


def _refined(
    pose: tuple[np.ndarray, np.ndarray], a: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Refine a pose to the least error: with a long lens, RANSAC's is off by several degrees."""
    first, second = (np.column_stack([x, np.ones(len(x))]) for x in (a, b))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    start = pycolmap.Rigid3d(np.column_stack(pose))
    refined = pycolmap.refine_relative_pose(start, first, second, np.ones(len(a), bool))
    if refined is None:
        return pose
    matrix = np.asarray(refined["cam2_from_cam1"].matrix())
    return matrix[:, :3], matrix[:, 3]


def _plane_poses(a: np.ndarray, b: np.ndarray, error: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the poses that explain matches on one plane; none where they lie on no plane."""
    try:
        plane, mask = cv2.findHomography(a, b, cv2.USAC_MAGSAC, error, maxIters=TRIALS, confidence=CONFIDENCE)
    except cv2.error:
        return []
    if plane is None or np.count_nonzero(mask) < PLANE_SHARE * len(a):
        return []
    inside = mask.ravel() > 0
    normalised = np.column_stack([a[inside], np.ones(inside.sum())])
    _, rotations, translations, normals = cv2.decomposeHomographyMat(plane, np.eye(3))
    poses = []
    for rotation, translation, normal in zip(rotations, translations, normals):
        length = float(np.linalg.norm(translation))
        # The plane lies in front of the camera.
        if length > 1e-6 and np.median(normalised @ normal.ravel()) > 0:
            poses.append((rotation, translation.ravel() / length))
    return poses


def focal_votes(
    features: Sequence[np.ndarray],  # a photo each: [N, 2] px from the principal point
    sides_px: Sequence[int],  # longer side of each photo
    cameras: Sequence[int],  # camera number of each photo
    exif_focals: Mapping[int, float],  # camera -> focal length over the longer side, by EXIF
    matches: Mapping[Pair, np.ndarray],
    jobs: int,
) -> dict[int, float]:
    """Estimate the focal length over the longer side of every camera from pairs' fundamental matrices.

    An essential matrix has two equal singular values. A fundamental matrix of a rigid motion becomes one with
    the right focal lengths; one fitted to anything else favours no focal length. A camera whose matrices do
    not decide, as on a plane, keeps the focal length of EXIF, else gets that of the others or `FOCAL_USUAL`.
    """
    pairs, matrices, weights = _fundamentals(features, sides_px, matches, jobs)
    ends = np.array([[cameras[a], cameras[b]] for a, b in pairs], int).reshape(-1, 2)
    others = float(np.median(list(exif_focals.values()))) if exif_focals else FOCAL_USUAL
    focals = {c: exif_focals.get(c, others) for c in sorted(set(cameras))}
    unknown = [c for c in focals if c not in exif_focals]

    def best(rows: np.ndarray, moving: Sequence[int]) -> float | None:
        if len(rows) < FOCAL_LEAST:
            return None
        moves = np.isin(ends[rows], moving)
        fixed = np.array([[focals[c] for c in pair] for pair in ends[rows]])
        costs = []
        for focal in FOCALS:
            first, second = np.where(moves, focal, fixed).T
            unequal = _inequality(matrices[rows], first, second) / FOCAL_UNEQUAL
            costs.append(np.average(np.minimum(unequal, 1.0), weights=weights[rows]))
        lowest = int(np.argmin(costs))
        now = np.median([focals[camera] for camera in moving])
        limit = max(
            FOCAL_CLEAR * np.median(costs), FOCAL_BETTER * costs[int(np.argmin(np.abs(FOCALS - now)))]
        )
        return float(FOCALS[lowest]) if costs[lowest] < limit and 0 < lowest < len(FOCALS) - 1 else None

    together = best(np.arange(len(ends)), unknown) if unknown else None
    if together is not None:
        focals.update(dict.fromkeys(unknown, together))
    for _ in range(FOCAL_TURNS if len(focals) > 1 or not unknown else 0):
        for camera in focals:
            alone = best(np.flatnonzero((ends == camera).any(axis=1)), [camera])
            focals[camera] = focals[camera] if alone is None else alone
    return focals


def _fundamentals(
    features: Sequence[np.ndarray], sides_px: Sequence[int], matches: Mapping[Pair, np.ndarray], jobs: int
) -> tuple[list[Pair], np.ndarray, np.ndarray]:
    """Return pairs, some twice, fundamental matrices [N, 3, 3] in units of the longer sides, weights [N]."""

    def one(pair: Pair) -> list[tuple[Pair, np.ndarray, int]]:
        (a, b), rows = pair, matches[pair]
        first, second = features[a][rows[:, 0]], features[b][rows[:, 1]]
        fitted: list[tuple[Pair, np.ndarray, int]] = []
        while len(fitted) < MAX_RELATIVE_POSES - 1 and len(first) >= MIN_INLIERS:
            try:
                matrix, mask = cv2.findFundamentalMat(
                    first, second, cv2.USAC_MAGSAC, FUNDAMENTAL_PX, CONFIDENCE, TRIALS
                )
            except cv2.error:  # OpenCV gives up on some degenerate samples
                break
            if matrix is None or matrix.shape != (3, 3) or np.count_nonzero(mask) < MIN_INLIERS:
                break
            scaled = np.diag([sides_px[b]] * 2 + [1]) @ matrix @ np.diag([sides_px[a]] * 2 + [1])
            fitted.append((pair, scaled, int(np.count_nonzero(mask))))
            outside = mask.ravel() == 0
            first, second = first[outside], second[outside]
        return fitted

    cv2.setNumThreads(1)  # each thread works on one pair
    strongest = sorted(matches, key=lambda pair: (-len(matches[pair]), pair))[: FOCAL_PAIRS * len(features)]
    with ThreadPoolExecutor(jobs) as pool:
        votes = [vote for fitted in pool.map(one, strongest) for vote in fitted]
    return (
        [pair for pair, _, _ in votes],
        np.array([matrix for _, matrix, _ in votes]).reshape(-1, 3, 3),
        np.minimum([count for _, _, count in votes], FOCAL_MATCHES).astype(float),
    )


def _inequality(matrices: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return (s1 - s2) / (s1 + s2), [N], of the singular values of each K2' F K1, a matrix of rank two."""
    ones = np.ones_like(first)
    essential = matrices * np.stack([first, first, ones], -1)[:, None, :]
    essential = essential * np.stack([second, second, ones], -1)[:, :, None]
    square = essential @ essential.transpose(0, 2, 1)
    total = np.trace(square, axis1=1, axis2=2)
    product = np.sqrt(np.maximum(total**2 - (square**2).sum(axis=(1, 2)), 0.0) / 2)
    return np.sqrt(np.maximum(total - 2 * product, 0.0) / np.maximum(total + 2 * product, 1e-30))


def cycle_votes(pairs: Mapping[Pair, Sequence[RelativePose]]) -> dict[Pair, np.ndarray]:
    """Return the share of triplets that each relative pose closes, by decomposition: (a, b) -> [M, W].

    Triplets are weighted by the votes of the other two relative poses. A pair in no triplet, the only link
    between two components perhaps, has the shares of its matches that are inliers of each.
    """
    connected = sorted(pair for pair, found in pairs.items() if found)
    at = {pair: k for k, pair in enumerate(connected)}
    rotations = np.full((len(connected), MAX_RELATIVE_POSES * DECOMPOSITIONS, 3, 3), np.nan)
    prior = np.zeros((len(connected), MAX_RELATIVE_POSES * DECOMPOSITIONS))
    for pair, k in at.items():
        total = sum(len(relative.matches) for relative in pairs[pair])
        for m, relative in enumerate(pairs[pair]):
            columns = slice(m * DECOMPOSITIONS, m * DECOMPOSITIONS + len(relative.rotations))
            rotations[k, columns] = relative.rotations
            prior[k, columns] = len(relative.matches) / total
    exists = ~np.isnan(rotations[:, :, 0, 0])
    edges = _triplets(connected, at)
    closings = [_closed(rotations, edges, start) for start in range(0, len(edges), _CHUNK)]
    rows = np.concatenate([np.zeros((0, 4), int), *closings])
    votes = exists.astype(float)
    for _ in range(ROUNDS):
        votes = _vote(votes, prior, edges, rows)
    return {pair: votes[k].reshape(MAX_RELATIVE_POSES, DECOMPOSITIONS) for pair, k in at.items()}


def _triplets(pairs: Sequence[Pair], at: Mapping[Pair, int]) -> np.ndarray:
    """Return all triplets [T, 3]: (a, b), (b, c), (a, c) with a < b < c, as indices into `pairs`."""
    after: dict[int, set[int]] = {}
    for a, b in pairs:
        after.setdefault(a, set()).add(b)
    edges = [(at[a, b], at[b, c], at[a, c]) for a, b in pairs for c in sorted(after[a] & after.get(b, set()))]
    return np.array(edges, np.intp).reshape(-1, 3)


def _closed(rotations: np.ndarray, edges: np.ndarray, start: int) -> np.ndarray:
    """Return the triplets whose rotations compose to the identity, [R, 4]: triplet, relative pose by edge."""
    first, second, direct = rotations[edges[start : start + _CHUNK].T]
    around = np.einsum("tbxz,tazy->tabxy", second, first)
    trace = np.einsum("tabxy,tcxy->tabc", around, direct)
    # Relative poses that do not exist are NaN, which is never larger.
    return np.argwhere(trace > rotation_trace(CYCLE_DEG)) + np.array((start, 0, 0, 0))


def _vote(votes: np.ndarray, prior: np.ndarray, edges: np.ndarray, closed: np.ndarray) -> np.ndarray:
    best = votes.max(axis=1)
    count, columns = votes.shape
    gained, possible = np.zeros((count, columns)), np.zeros(count)
    for k in range(3):
        p, q = (x for x in range(3) if x != k)
        np.add.at(possible, edges[:, k], best[edges[:, p]] * best[edges[:, q]])
        rows = closed[:, 0]
        weight = votes[edges[rows, p], closed[:, 1 + p]] * votes[edges[rows, q], closed[:, 1 + q]]
        top = np.zeros((len(edges), columns))
        np.maximum.at(top, (rows, closed[:, 1 + k]), weight)
        np.add.at(gained, edges[:, k], top)
    return (gained + PRIOR * prior) / (possible[:, None] + PRIOR)


def consistent_relative_poses(
    pairs: Mapping[Pair, Sequence[RelativePose]],
    votes: Mapping[Pair, np.ndarray],  # as `cycle_votes` returns them
) -> dict[Pair, tuple[int, int]]:
    """Average the rotations; return of each pair the relative pose and decomposition that agree with them.

    Rotations are chosen photo by photo, as most votes of the covisible photos want it, until none changes.
    Each of them counts once, however many matches it has. Pairs without such a relative pose are left out.
    """
    ends: dict[int, list[_End]] = {}
    for (a, b), shares in votes.items():
        turns = [
            (r, shares[m, w])
            for m, relative in enumerate(pairs[a, b])
            for w, r in enumerate(relative.rotations)
        ]
        turns = [(r, vote) for r, vote in turns if vote > 0]
        if turns:
            forth, weight = np.array([r for r, _ in turns]), np.array([vote for _, vote in turns])
            ends.setdefault(b, []).append((a, forth, weight))
            ends.setdefault(a, []).append((b, forth.transpose(0, 2, 1), weight))
    rotations: dict[int, np.ndarray] = {}
    for start in sorted(ends, key=lambda k: -sum(weight.max() for _, _, weight in ends[k])):
        if start not in rotations:
            rotations[start] = np.eye(3)
            _propagate_rotations(start, ends, rotations)
    for _ in range(SWEEPS):
        changed = 0
        for photo in ends:
            before = rotations[photo]
            rotations[photo] = _rotation(ends[photo], rotations, before)
            changed += not _alike(before[None], rotations[photo], CYCLE_DEG)[0]
        if not changed:
            break
    consistent = {}
    for (a, b), shares in votes.items():
        if a in rotations and b in rotations:
            wanted = rotations[b] @ rotations[a].T
            inlier = [
                (shares[m, w], -m, -w)
                for m, relative in enumerate(pairs[a, b])
                for w in np.flatnonzero(_alike(relative.rotations, wanted, CONSISTENT_DEG))
            ]
            if inlier:
                _, m, w = max(inlier)
                consistent[a, b] = -m, -int(w)
    return consistent


def _propagate_rotations(
    start: int, ends: Mapping[int, list[_End]], rotations: dict[int, np.ndarray]
) -> None:
    """Initialise the rotations of the photos that pairs connect with `start`, those with most votes first."""
    gain: dict[int, float] = {}
    photo = start
    while True:
        for other, _, weight in ends[photo]:
            if other not in rotations:
                gain[other] = gain.get(other, 0.0) + float(weight.max())
        if not gain:
            return
        photo = max(gain, key=lambda k: (gain[k], -k))
        del gain[photo]
        rotations[photo] = _rotation(ends[photo], rotations, np.eye(3))


def _rotation(ends: Sequence[_End], rotations: Mapping[int, np.ndarray], otherwise: np.ndarray) -> np.ndarray:
    """Return the rotation of a photo on which most covisible photos agree, each with one relative pose."""
    turns, weights, owners = [], [], []
    for other, forth, weight in ends:
        if other in rotations:
            turns += list(forth @ rotations[other])
            weights += list(weight)
            owners += [other] * len(weight)
    if not turns:
        return otherwise
    stack, weight, owner = np.array(turns), np.array(weights), np.unique(owners, return_inverse=True)[1]
    flat = stack.reshape(-1, 9)
    alike = flat @ flat.T > rotation_trace(CONSISTENT_DEG)
    best = np.zeros((len(flat), owner.max() + 1))
    for column in range(best.shape[1]):
        mine = owner == column
        best[:, column] = np.where(alike[:, mine], weight[mine], 0.0).max(axis=1)
    group = alike[int(np.argmax(best.sum(axis=1)))]
    left, _, right = np.linalg.svd((stack[group] * weight[group, None, None]).sum(axis=0))
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def _alike(rotations: np.ndarray, wanted: np.ndarray, angle_deg: float) -> np.ndarray:
    """Tell which rotations [N, 3, 3] differ by less than an angle from the wanted one: [N] bool."""
    return (rotations * wanted).sum(axis=(1, 2)) > rotation_trace(angle_deg)


def rotation_trace(angle_deg: float) -> float:
    """Return the trace of a rotation by an angle."""
    return 1.0 + 2.0 * float(np.cos(np.radians(angle_deg)))
