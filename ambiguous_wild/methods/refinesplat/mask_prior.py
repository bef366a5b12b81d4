"""Masks before any training: a pixel that no other photo shows at the same surface is a distractor.

Masks need a render, and the first renders also show distractors: a crowd that covers 45 % of every photo is
learnt before the first mask is made, and some of it stays. The sparse points lie on surfaces that several
photos saw in one place. So the surface behind every pixel is interpolated from them
(`vision/sparse_surface.py`) and looked up in the other photos; a pixel is kept in the first iterations only
if enough photos show its colour there. Depth is off by a pixel or two, so a colour may lie anywhere between
the least and the greatest around the place. Pixels without sparse points around them are kept, unless the
filter below spreads the answer of their neighbours.

The first answer is noisy, and wrong where distractors stand in most photos: few photos show the ground behind
a crowd. So the answer for every photo is smoothed along the edges of its colours (guided filter, He et al.,
ECCV 2010), and computed again without the pixels of other photos that were masked (`rounds`).

Later masks are made from renders, but the prior still scales their evidence
(`InitialMaskPriorConfig.weight`), because it does not depend on what the model has learnt.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.io.images import ximgproc
from ambiguous_wild.methods.refinesplat.maps import ViewQuantile, common_offset
from ambiguous_wild.methods.refinesplat.multiview import nearest_views
from ambiguous_wild.vision.sparse_surface import BEHIND, PIXELS, in_map, world_points

_SETTLED = 0.005  # a round in which a smaller share of pixels changes is the last
_SAME = 0.06  # difference of colour in [0, 1] up to which two photos show the same
_EDGE = 0.003  # variance of colours in [0, 1] that is an edge for the filter
_MIN_KNOWN = 0.1  # if surfaces are known for a smaller share of a photo, its answer does not limit masks
_WINDOW = np.ones((3, 3), np.uint8)  # px of the map in which the colour may lie


@dataclass(frozen=True)
class InitialMaskPriorConfig:
    """Which views are compared, and the largest difference of colour."""

    on: bool = True  # masks before training, from photos and sparse points
    views: int = 16  # nearest train views used; twice as many if the first answers show a crowd
    quantile: float = 0.3  # share of these views that must show the colour
    threshold: float = 0.02  # difference of colour in [0, 1] above which a pixel is masked at first
    normal: float = 3.0  # least difference as a multiple of what is normal in the photo
    # in a crowd fewer views show a surface: then this many are enough, if no other colour is shown by more;
    # 0 = not used. Crowd of seed 37, 700 iterations: 18.5 dB, with it 19.3
    consensus: int = 2
    # share of a photo that would be masked from which it shows a crowd; a scene does by the mean share
    crowd: float = 0.35
    known_by: int = 2  # a surface that fewer views see is not judged
    # most repetitions, each without what the last answers mask in the other photos; they end when answers
    # hardly change; 0 = none
    rounds: int = 8
    smooth: float = 5.0  # px of a map of 20 000 px, radius of the filter over each answer; 0 = none
    # if less of a photo would be masked, nothing is: so few distractors do no harm at the start
    least: float = 0.1
    # how much the features that move or stay (`vision/motion_maps.py`) raise or lower an answer, but in a
    # crowd; 0 = not used
    motion: float = 1.0
    weight: float = 1.5  # `structure`: largest factor or divisor of later evidence; 1 = unchanged
    # the weight in a crowd, because there the first renders show distractors
    crowd_weight: float = 6.0
    # later masks cover at most this many times what the prior masks of the photo, the surest pixels;
    # otherwise a surface that few photos show is masked whole and never learnt. Skull, cut-outs 11, 13, 1500
    # iterations: 15.3, 15.6 dB, with it 18.2, 16.5; 0 = no such limit
    most: float = 2.5
    most_least: float = 0.15  # least value of that limit, as a share of the photo

    def __post_init__(self) -> None:
        check_limits(
            self, "refinesplat.first_look",
            views=(1, math.inf), quantile=(0, 1), known_by=(1, math.inf), rounds=(0, 100), smooth=(0, 100),
            crowd=(0, 1), least=(0, 1), weight=(1, math.inf), crowd_weight=(1, math.inf),
            most_least=(0, 1),
            **dict.fromkeys(("threshold", "normal", "consensus", "most", "motion"), (0, math.inf)),
        )  # fmt: skip


@dataclass(frozen=True)
class InitialMaskPrior:
    """What the other photos show at the surfaces of one photo, on a map [h, w] of its frame."""

    passing: np.ndarray  # float32 in [0, 1]: 1 = distractor, 0 = other photos show it too, 0.5 = unknown
    least: float  # if a smaller share of the photo would be masked, nothing is
    weight: float  # largest factor of later evidence
    most: float = 1.0  # largest share of the photo that later masks cover
    # in a crowd later masks lie within those of the prior: the ground between people shows in few photos
    within: bool = False
    moves: np.ndarray | None = None  # bool, masked whatever later evidence says; None: nothing is

    def keep(self, shape: tuple[int, int]) -> np.ndarray | None:
        """Return the pixels that are kept at first, [H, W] bool; None if all are."""
        passing = self.passing > 0.5
        if passing.mean() < self.least:
            moving = self.moving(shape)
            return None if moving is None else ~moving
        return _resized(passing.astype(np.float32), shape) < 0.5

    def moving(self, shape: tuple[int, int]) -> np.ndarray | None:
        """Return the pixels that move for certain, [H, W] bool; None if unknown or none do."""
        if self.moves is None or not self.moves.any():
            return None
        return _resized(self.moves.astype(np.float32), shape) > 0.5

    def factor(self, shape: tuple[int, int]) -> np.ndarray:
        """Return the factor of the evidence of later masks, [H, W] float32 in [1 / weight, weight]."""
        return np.power(np.float32(self.weight), 2.0 * _resized(self.passing, shape) - 1.0)


def initial_mask_prior(
    cameras: Sequence[Camera],
    photos: Iterable[np.ndarray],
    surfaces: Sequence[np.ndarray | None],
    config: InitialMaskPriorConfig,
    moving: Sequence[np.ndarray | None] | None = None,
    certain: Sequence[np.ndarray | None] | None = None,
) -> list[InitialMaskPrior | None]:
    """Return the prior of every photo; None for one without sparse points or comparable views.

    Args:
        cameras: cameras of the photos.
        photos: [H, W, 3] in [0, 1].
        surfaces: inverse depths [h, w] of the sparse points (`static_surfaces`).
        config: thresholds.
        moving: what moves in each photo (`moving_map`), in the shape of its surface; None: unknown.
        certain: what moves for certain by optical flow (`certainly_moving`), [h, w] bool; None: no flow.
    """
    small = [
        None if inverse is None else _small(photo, inverse.shape)
        for photo, inverse in zip(photos, surfaces, strict=True)
    ]
    ranges = [None if s is None else (cv2.erode(s, _WINDOW), cv2.dilate(s, _WINDOW)) for s in small]
    near = nearest_views(cameras, 2 * config.views)

    moves = list(moving) if moving is not None else [None] * len(small)
    surely = list(certain) if certain is not None else [None] * len(small)

    def answer(
        view: int, views: int, before: Sequence[np.ndarray | None], masked: Sequence[np.ndarray | None]
    ) -> np.ndarray | None:
        inverse, ours = surfaces[view], small[view]
        if inverse is None or ours is None:
            return None
        movement, last = moves[view], before[view]
        # computed again in every round: kept, they would take 0.5 MB a photo
        world = world_points(cameras[view], inverse)
        seen = [
            _seen_by(ours, world, cameras[j], surface, limits, masked[j])
            for j in near[view][:views]
            if (surface := surfaces[j]) is not None and (limits := ranges[j]) is not None
        ]
        current = _judge(ours, seen, config)
        if current is None and movement is not None:
            current = np.full(ours.shape[:2], 0.5, np.float32)
        if current is None:
            return last
        current = _smoothed(current, ours, config.smooth)
        if movement is not None:
            current = np.clip(current + config.motion * (2.0 * movement - 1.0), 0.0, 1.0, dtype=np.float32)
        # half of the last answer: without it, two photos may mask each other in turn
        return current if last is None else 0.5 * (current + last)

    everything = range(len(small))
    nothing: list[np.ndarray | None] = [None] * len(small)
    answers = [answer(view, config.views, nothing, moves) for view in everything]
    views = config.views
    if masked_share(answers) >= config.crowd:
        views = 2 * views
        # features of a crowd are too few: renders get worse by 0.3 to 0.8 dB
        moves = [None if by_flow is None else m for m, by_flow in zip(moves, surely)]
        answers = [answer(view, config.views, nothing, moves) for view in everything]
    for _ in range(config.rounds):
        before, answers = answers, [answer(view, views, answers, answers) for view in everything]
        if _changed(before, answers) < _SETTLED:
            break
    crowd = masked_share(answers) >= config.crowd
    weight = config.crowd_weight if crowd else config.weight
    return [
        None
        if passing is None
        else InitialMaskPrior(passing, config.least, weight, _most(passing, inverse, config), crowd, sure)
        for passing, inverse, sure in zip(answers, surfaces, surely, strict=True)
    ]


def _most(answer: np.ndarray, inverse: np.ndarray | None, config: InitialMaskPriorConfig) -> float:
    """Return the share of the photo that later masks may cover."""
    if config.most <= 0 or inverse is None or np.isfinite(inverse).mean() < _MIN_KNOWN:
        return 1.0
    return min(max(config.most * masked_share([answer]), config.most_least), 1.0)


def masked_share(answers: Sequence[np.ndarray | None]) -> float:
    """Return the mean share of a photo that is masked, over photos with an answer; 0 if none has one."""
    shares = [float((answer > 0.5).mean()) for answer in answers if answer is not None]
    return float(np.mean(shares)) if shares else 0.0


def _changed(before: Sequence[np.ndarray | None], after: Sequence[np.ndarray | None]) -> float:
    """Return the share of pixels whose answer changed, over photos that have both answers."""
    both = [
        float(((a > 0.5) != (b > 0.5)).mean())
        for a, b in zip(before, after, strict=True)
        if a is not None and b is not None
    ]
    return float(np.mean(both)) if both else 0.0


def _small(photo: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    blurred = cv2.blur(np.ascontiguousarray(photo, dtype=np.float32), (3, 3))
    return cv2.resize(blurred, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)


@dataclass(frozen=True)
class _Seen:
    """What another view shows at the surfaces of this view."""

    low: np.ndarray  # [h, w, 3] float32, least colour around the place
    high: np.ndarray  # [h, w, 3] float32, greatest colour around the place
    offset: np.ndarray  # [3], difference in exposure of this view
    sees: np.ndarray  # [h, w] bool, surfaces in its picture that are not behind another one

    def outside(self, colour: np.ndarray) -> np.ndarray:
        """Return the distance of colours [..., 3] to the range, [...]; NaN where the view sees nothing."""
        own = colour - self.offset
        beyond = np.maximum(self.low - own, own - self.high)
        np.maximum(beyond, 0.0, out=beyond)
        # a sum of three is several times as fast as a mean over the last axis
        distance = (beyond[..., 0] + beyond[..., 1] + beyond[..., 2]) / np.float32(3.0)
        return np.where(self.sees, distance, np.float32(np.nan))

    def at(self, rows: np.ndarray) -> _Seen:
        return _Seen(self.low[rows], self.high[rows], self.offset, self.sees[rows])


def _seen_by(
    ours: np.ndarray,  # [h, w, 3] float32
    world: np.ndarray,  # [h, w, 3], NaN where not known
    camera: Camera,
    surface: np.ndarray,  # inverse depth of the other view
    limits: tuple[np.ndarray, np.ndarray],  # least and greatest colours around each of its pixels
    masked: np.ndarray | None = None,  # answer of the other view, [h, w]; above 0.5 it shows a distractor
) -> _Seen:
    local = world @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    x, y = in_map(camera, local, surface.shape)
    z = local[..., 2]
    inside = (z > 0) & (x >= 0) & (x <= surface.shape[1] - 1) & (y >= 0) & (y <= surface.shape[0] - 1)
    x, y = (np.where(inside, v, -9.0).astype(np.float32) for v in (x, y))
    nearest = cv2.remap(surface, x, y, cv2.INTER_NEAREST, borderValue=float("nan"))
    sees = inside & ~(nearest * z > BEHIND)
    if masked is not None:
        sees &= cv2.remap(masked, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) <= 0.5
    low, high = (cv2.remap(c, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for c in limits)
    return _Seen(low, high, _offset(ours - 0.5 * (low + high), sees), sees)


def _offset(difference: np.ndarray, sees: np.ndarray) -> np.ndarray:
    """Return the colour offset [3] of two photos from differences [h, w, 3] at every second pixel."""
    colours = torch.from_numpy(difference[::2, ::2][sees[::2, ::2]]).T[None] * 255.0  # [1, 3, P]
    if not colours.numel():
        return np.zeros(3, np.float32)
    everywhere = torch.ones_like(colours[:, 0], dtype=torch.bool)
    return (common_offset(colours, everywhere, _SAME)[0] / 255.0).numpy()


def _smoothed(answer: np.ndarray, photo: np.ndarray, smooth: float) -> np.ndarray:
    """Smooth an answer [h, w] so that it changes only where the colours [h, w, 3] do."""
    if smooth <= 0:
        return answer
    radius = max(round(smooth * math.sqrt(answer.size / PIXELS)), 1)
    return np.clip(ximgproc().guidedFilter(photo, answer, radius, _EDGE), 0.0, 1.0)


def _judge(ours: np.ndarray, seen: list[_Seen], config: InitialMaskPriorConfig) -> np.ndarray | None:
    """Return 1 = distractor, 0 = others show it too, 0.5 = unknown, [h, w] float32; None if all unknown."""
    if not seen:
        return None
    stack = np.stack([view.outside(ours) for view in seen])
    views = np.isfinite(stack).sum(axis=0)
    ranks = ViewQuantile(len(stack), config.quantile, "cpu")
    evidence = ranks.quantile_of(torch.from_numpy(stack), torch.from_numpy(views)).numpy()
    known = views >= config.known_by
    if not known.any():
        return None
    # the normal difference, as distractors cover less than half of a photo
    normal = float(np.quantile(evidence[known], 0.4))
    limit = max(config.threshold, config.normal * normal)
    passing = known & (evidence > limit)
    if config.consensus and passing.mean() >= config.crowd:
        at = passing & ((stack <= limit).sum(axis=0) >= config.consensus)
        passing[at] = ~_leads(ours[at], [view.at(at) for view in seen], stack[:, at], limit, config.views)
    return np.where(known, passing, np.float32(0.5)).astype(np.float32)


def _leads(ours: np.ndarray, seen: list[_Seen], outside: np.ndarray, limit: float, rivals: int) -> np.ndarray:
    """Return whether no rival colour at a place is shown by more views than our colour, [p] bool.

    Args:
        ours: [p, 3] colours of this view.
        seen: what n other views show at these places.
        outside: [n, p] distances of our colours to theirs.
        limit: distance up to which two colours are the same.
        rivals: number of nearest views whose colours are rivals.
    """
    support = (outside <= limit).sum(axis=0)
    most = np.zeros_like(support)
    for k, rival in enumerate(seen[:rivals]):
        colour = 0.5 * (rival.low + rival.high) + rival.offset
        backing = sum((other.outside(colour) <= limit).astype(np.int64) for other in seen)
        most = np.maximum(most, np.where(rival.sees & ~(outside[k] <= limit), backing, 0))
    return np.asarray(support >= most)


def _resized(x: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return cv2.resize(x, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
