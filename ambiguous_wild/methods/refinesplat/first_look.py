"""Masks before any training: a pixel that no other photo shows at the same surface is a distractor.

Masks need a render, and the first renders also show distractors: with a crowd that covers 45 % of every
photo, the crowd is learnt before the first mask is made, and some of it stays. The sparse points lie on
surfaces that several photos saw in one place. So the surface behind every pixel is taken from them
(`vision/sparse_surface.py`) and looked up in the other photos; a pixel is kept in the first iterations only
if enough of them show its colour there. Depth is off by a pixel or two, so a colour may lie anywhere between
the least and the greatest around the place. Pixels without sparse points around them are kept, unless the
filter below carries the answer of their neighbours to them.

The first answer is noisy, and where distractors stand in most photos it is wrong: the ground behind a crowd
is shown by few. So the answer of every photo is smoothed along the edges of its colours (guided filter, He
et al., ECCV 2010), and asked again, without the pixels of other photos that were masked (`rounds`).

Later masks are made from renders, but the first look still scales their evidence (`FirstLookConfig.weight`):
it does not depend on what the model has learnt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.refinesplat.multiview import nearest_views
from ambiguous_wild.methods.refinesplat.ranks import Ranks, common_offset
from ambiguous_wild.vision.sparse_surface import BEHIND, PIXELS, in_map, world_points

_SETTLED = 0.005  # share of pixels: if fewer change in a round, it is the last
_SAME = 0.06  # difference of colour in [0, 1] up to which two photos show the same
_EDGE = 0.003  # variance of colours in [0, 1] that is an edge for the filter
_FEW = 0.1  # of a photo: if surfaces are known for less, its answer says nothing of a mask's size
_WINDOW = np.ones((3, 3), np.uint8)  # px of the map around the place where a colour may lie


@dataclass(frozen=True)
class FirstLookConfig:
    """Which views are compared, and the largest difference of colour."""

    on: bool = True  # masks before training, from photos and sparse points
    views: int = 16  # nearest train views used; twice as many if the first answers show a crowd
    quantile: float = 0.3  # of their differences: this share of views must show the colour
    threshold: float = 0.02  # difference of colour in [0, 1] above which a pixel is masked at first
    normal: float = 3.0  # and above this many times what is normal in the photo
    # in a crowd fewer views show a surface: this many others are enough if no other colour is shown there by
    # more; 0 = not used. Crowd of seed 37, 700 iterations: 18.5 dB, with it 19.3
    consensus: int = 2
    # a photo of which as much would be masked shows a crowd; a scene does, if it is as much in the mean
    crowd: float = 0.35
    known_by: int = 2  # with fewer views that see it, a surface is not judged
    # how often at most it is asked again, without what the last answers mask in the other photos; it ends
    # when they hardly change; 0 = never
    rounds: int = 8
    smooth: float = 5.0  # px of a map of 20 000 px, radius of the filter over each answer; 0 = none
    # of a photo: if less would be masked, nothing is; so few distractors do no harm at the start
    least: float = 0.1
    # how much the features that move or stay (`vision/moving.py`) raise or lower an answer, but in a crowd;
    # 0 = not used
    motion: float = 1.0
    weight: float = 1.5  # `structure`: later evidence is multiplied or divided by up to this; 1 = unchanged
    # the weight in a crowd, where the first renders show distractors; other photos show the background
    crowd_weight: float = 6.0
    # later masks cover at most this many times what the first look masks of the photo, the surest pixels; a
    # surface that few photos show is else masked whole and never learnt. Skull, cut-outs 11, 13, 1500
    # iterations: 15.3, 15.6 dB, with it 18.2, 16.5; 0 = no such limit
    most: float = 2.5
    most_least: float = 0.15  # of a photo: the limit is no less

    def __post_init__(self) -> None:
        check_limits(
            self, "refinesplat.first_look",
            views=(1, math.inf), quantile=(0, 1), known_by=(1, math.inf), rounds=(0, 100), smooth=(0, 100),
            crowd=(0, 1), least=(0, 1), weight=(1, math.inf), crowd_weight=(1, math.inf),
            most_least=(0, 1),
            **dict.fromkeys(("threshold", "normal", "consensus", "most", "motion"), (0, math.inf)),
        )  # fmt: skip


@dataclass(frozen=True)
class FirstLook:
    """What the other photos show at the surfaces of one photo, on a map [h, w] of its frame."""

    passing: np.ndarray  # float32 in [0, 1]: 1 = distractor, 0 = the others show it too, 0.5 = unknown
    least: float  # of the photo: if less would be masked, nothing is
    weight: float  # of later evidence
    most: float = 1.0  # of the photo: later masks cover no more

    def keep(self, shape: tuple[int, int]) -> np.ndarray | None:
        """Pixels that are kept at first, [H, W] bool; None if all are."""
        passing = self.passing > 0.5
        if passing.mean() < self.least:
            return None
        return _resized(passing.astype(np.float32), shape) < 0.5

    def factor(self, shape: tuple[int, int]) -> np.ndarray:
        """Factor of the evidence of later masks, [H, W] float32 in [1 / weight, weight]."""
        return np.power(np.float32(self.weight), 2.0 * _resized(self.passing, shape) - 1.0)


def first_look(
    cameras: Sequence[Camera],
    photos: Sequence[np.ndarray],
    surfaces: Sequence[np.ndarray | None],
    config: FirstLookConfig,
    moving: Sequence[np.ndarray | None] | None = None,
) -> list[FirstLook | None]:
    """The first look at every photo; None for a photo without sparse points or comparable views.

    Args:
        cameras: of the photos.
        photos: [H, W, 3] in [0, 1].
        surfaces: inverse depths [h, w] of the sparse points (`static_surfaces`).
        config: how to judge.
        moving: what moves in each photo (`moving_map`), of its surface's shape; None: nothing is known.
    """
    small = [
        None if inverse is None else _small(photo, inverse.shape)
        for photo, inverse in zip(photos, surfaces, strict=True)
    ]
    ranges = [None if s is None else (cv2.erode(s, _WINDOW), cv2.dilate(s, _WINDOW)) for s in small]
    near = nearest_views(cameras, 2 * config.views)

    moves = list(moving) if moving is not None else [None] * len(small)

    def answer(
        view: int, views: int, before: Sequence[np.ndarray | None], masked: Sequence[np.ndarray | None]
    ) -> np.ndarray | None:
        inverse, ours = surfaces[view], small[view]
        if inverse is None or ours is None:
            return None
        mine, last = moves[view], before[view]
        # computed again in every round: kept, they would take 0.5 MB a photo
        world = world_points(cameras[view], inverse)
        seen = [
            _seen_by(ours, world, cameras[j], surface, limits, masked[j])
            for j in near[view][:views]
            if (surface := surfaces[j]) is not None and (limits := ranges[j]) is not None
        ]
        found = _judge(ours, seen, config)
        if found is None and mine is not None:
            found = np.full(ours.shape[:2], 0.5, np.float32)
        if found is None:
            return last
        found = _smoothed(found, ours, config.smooth)
        if mine is not None:
            found = np.clip(found + config.motion * (2.0 * mine - 1.0), 0.0, 1.0, dtype=np.float32)
        # half of the last answer: without it, two photos may mask each other in turn
        return found if last is None else 0.5 * (found + last)

    everything = range(len(small))
    nothing: list[np.ndarray | None] = [None] * len(small)
    answers = [answer(view, config.views, nothing, moves) for view in everything]
    views = config.views
    if masked_share(answers) >= config.crowd:
        moves, views = (
            nothing,
            2 * views,
        )  # features of a crowd are too few: renders get worse by 0.3 to 0.8 dB
        answers = [answer(view, config.views, nothing, nothing) for view in everything]
    for _ in range(config.rounds):
        before, answers = answers, [answer(view, views, answers, answers) for view in everything]
        if _changed(before, answers) < _SETTLED:
            break
    weight = config.crowd_weight if masked_share(answers) >= config.crowd else config.weight
    return [
        None if found is None else FirstLook(found, config.least, weight, _most(found, inverse, config))
        for found, inverse in zip(answers, surfaces, strict=True)
    ]


def _most(answer: np.ndarray, inverse: np.ndarray | None, config: FirstLookConfig) -> float:
    """Share of the photo that later masks may cover."""
    if config.most <= 0 or inverse is None or np.isfinite(inverse).mean() < _FEW:
        return 1.0
    return min(max(config.most * masked_share([answer]), config.most_least), 1.0)


def masked_share(answers: Sequence[np.ndarray | None]) -> float:
    """Share of a photo that is masked, in the mean of all that have an answer; 0 if none has."""
    shares = [float((found > 0.5).mean()) for found in answers if found is not None]
    return float(np.mean(shares)) if shares else 0.0


def _changed(before: Sequence[np.ndarray | None], after: Sequence[np.ndarray | None]) -> float:
    """Share of the pixels whose answer is another one, over the photos that have two."""
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
    """What another view shows at our surfaces."""

    low: np.ndarray  # [h, w, 3] float32, least colour around the place
    high: np.ndarray  # greatest
    offset: np.ndarray  # [3], of our exposure
    sees: np.ndarray  # [h, w] bool, whether the surface is in its picture and not behind another one

    def outside(self, colour: np.ndarray) -> np.ndarray:
        """Distance of colours [..., 3] to the range, [...]; NaN where it sees nothing."""
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
    masked: np.ndarray | None = None,  # its own answer, [h, w]; above 0.5 it shows a distractor
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
    """Colour offset [3] of two photos from differences [h, w, 3] in [0, 1] at every second pixel."""
    colours = torch.from_numpy(difference[::2, ::2][sees[::2, ::2]]).T[None] * 255.0  # [1, 3, P]
    if not colours.numel():
        return np.zeros(3, np.float32)
    everywhere = torch.ones_like(colours[:, 0], dtype=torch.bool)
    return (common_offset(colours, everywhere, _SAME)[0] / 255.0).numpy()


def _smoothed(answer: np.ndarray, photo: np.ndarray, smooth: float) -> np.ndarray:
    """An answer [h, w] that changes only where the colours [h, w, 3] do."""
    if smooth <= 0:
        return answer
    radius = max(round(smooth * math.sqrt(answer.size / PIXELS)), 1)
    return np.clip(cv2.ximgproc.guidedFilter(photo, answer, radius, _EDGE), 0.0, 1.0)


def _judge(ours: np.ndarray, seen: list[_Seen], config: FirstLookConfig) -> np.ndarray | None:
    """1 = distractor, 0 = the others show it too, 0.5 = unknown, [h, w] float32; None if nothing is known."""
    if not seen:
        return None
    stack = np.stack([view.outside(ours) for view in seen])
    views = np.isfinite(stack).sum(axis=0)
    ranks = Ranks(len(stack), config.quantile, "cpu")
    evidence = ranks.quantile_of(torch.from_numpy(stack), torch.from_numpy(views)).numpy()
    known = views >= config.known_by
    if not known.any():
        return None
    # normal difference: distractors cover less than half of a photo, else nothing could be decided
    normal = float(np.quantile(evidence[known], 0.4))
    limit = max(config.threshold, config.normal * normal)
    passing = known & (evidence > limit)
    if config.consensus and passing.mean() >= config.crowd:
        at = passing & ((stack <= limit).sum(axis=0) >= config.consensus)
        passing[at] = ~_leads(ours[at], [view.at(at) for view in seen], stack[:, at], limit, config.views)
    return np.where(known, passing, np.float32(0.5)).astype(np.float32)


def _leads(ours: np.ndarray, seen: list[_Seen], outside: np.ndarray, limit: float, rivals: int) -> np.ndarray:
    """Whether no colour that others show at a place is shown by more of them than ours, [p] bool.

    Args:
        ours: [p, 3] colours.
        seen: what n others show at these places.
        outside: [n, p] distances of our colours to theirs.
        limit: distance up to which two colours are the same.
        rivals: of so many views, the nearest, the colours are compared with ours.
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
