"""Find what is fixed to the camera: a bonnet, a drone's legs, a rig, a watermark, a burnt-in time stamp.

Its features stay at the same pixel while the others move, so that most matches of a pair may say that the
camera stands still. The evidence is counted in cells of the photo, over all pairs that move: a cell is fixed
if its matches stay within a pixel in many photos, and hardly any of them moves a little. That tells it from
distant scenery and from the point that a camera circles, around which displacements grow gradually from 0.

A tripod has no pairs that move, and of a scene that stands still in most of its area nothing is taken out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ambiguous_wild.builder.records import FixedMask

if TYPE_CHECKING:
    from ambiguous_wild.builder.relative_poses import Pair

FIXED = "fixed.json"  # file of the stage `matches`: a list of `FixedMask`
CELLS = 64  # cells along the longer side
MAP_CELL = 5  # px of a cell in the map that becomes the mask
STILL_PX, STILL_SIDE = 1.0, 1600  # largest displacement of a still match, at most at this longer side, px
NEAR = 4.0  # the same of a match that moves a little, over that of a still one
MOVED = 0.02  # least displacement of a match that moves, over the longer side
MOVING = 15  # matches that move in a pair that counts
GAP = 3.0  # least number of still matches of a cell, over those that move a little
FIXED_SHARE = 0.25  # least share of still matches in a cell; a watermark shows the scene's features too
CELL_PHOTOS = (3, 0.1)  # photos in which a cell has a still match: at least, and their share
AREA_PHOTOS = (4, 0.25)  # the same of all areas together
AREA_CELLS = 3  # fixed cells in all, at least
RING = 3  # cells around an area whose matches must not move a little only
RING_MATCHES = 20  # matches in the ring that decide
SLOW_RING = 0.7  # largest share of them that moves less than `MOVED`: around distant scenery almost all do
MOVING_CELL = 3  # matches that move in and around a cell that is no part of an area, at least
LARGEST = 0.6  # largest share of the photo; more means that the scene stands still
CLOSED = 0.05  # gap between fixed cells that is closed, over the longer side
LASTING = 0.5  # least gradient that stays, over the median gradient, on the outline of what hardly changes
BORDER_PX = 3  # px of the map at the border of the photo that are no outline
CALM = 0.55  # largest change of such pixels, relative to the median pixel of the rest
MARGIN_PX = 2  # px of the map by which the mask is larger
SHOWN = 0.4  # least share of the gradient that stays in a photo that shows the area
SPANS = 0.6  # share of a side from which on an area spans it
COMPARED = 24  # photos whose pixels are compared


@dataclass(frozen=True)
class FixedArea:
    """The part of all photos of one camera and size that shows something fixed to the camera."""

    size: tuple[int, int]  # width and height of the photos, px
    photos: list[int]  # photos of this camera and size
    covered: np.ndarray  # [h, w] bool, reduced photo: True where it is
    slope: np.ndarray | None = (
        None  # [2, h, w] gradient along x and y, median over photos; None: not measured
    )

    @property
    def share(self) -> float:
        """Share of the photo."""
        return float(self.covered.mean())

    def covers(self, xy: np.ndarray) -> np.ndarray:
        """Tell which points [N, 2] px lie in it, [N] bool."""
        height, width = self.covered.shape
        column, row = (xy * [width / self.size[0], height / self.size[1]]).astype(int).T
        return self.covered[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]

    def keep_mask(self) -> np.ndarray:
        """Return the keep mask at the size of the photos, [H, W] uint8: 0 where it is, else 255."""
        covered = cv2.resize(self.covered.astype(np.float32), self.size, interpolation=cv2.INTER_LINEAR)
        return np.where(covered > 0.5, 0, 255).astype(np.uint8)

    def without(self, photos: Iterable[int]) -> FixedArea:
        """Return the area without some photos, which do not show it."""
        left_out = set(photos)
        return replace(self, photos=[k for k in self.photos if k not in left_out])

    def where(self) -> str:
        """Say where it lies: "lower right"; one word if it spans the other side, none if it spans both."""
        words = []
        for axis, names in ((1, ("upper", "middle", "lower")), (0, ("left", "middle", "right"))):
            line = np.flatnonzero(self.covered.any(axis=axis)) / self.covered.shape[1 - axis]
            low, high = float(line[0]), float(line[-1])
            if high - low < SPANS:
                words.append(names[int(3 * (low + high) / 2)])
        return " ".join(dict.fromkeys(words))

    def record(self, names: Sequence[str], mask: str) -> FixedMask:
        """Return the record of the area.

        Args:
            names: names of all photos.
            mask: file name of its keep mask.
        """
        width, height = self.size
        photos, share = [names[k] for k in self.photos], round(self.share, 4)
        where = self.where()
        return FixedMask(photos=photos, width=width, height=height, share=share, where=where, mask=mask)

    def shown_by(
        self,
        grey: np.ndarray,  # [H, W] uint8
    ) -> bool:
        """Tell whether a photo shows it: whether its gradient there contains that of the others."""
        if self.slope is None:
            return True
        photo = _slopes(_reduced([grey], self.covered.shape))[:, 0, self.covered]
        pattern = self.slope[:, self.covered]
        return bool((photo * pattern).sum() >= SHOWN * (pattern * pattern).sum())


def moving_matches(
    features: Sequence[np.ndarray], matches: Mapping[Pair, np.ndarray], areas: Sequence[FixedArea]
) -> dict[Pair, np.ndarray]:
    """Return the matches [K, 2] that touch no area, of the pairs that lose some."""
    covered = {photo: area.covers(features[photo]) for area in areas for photo in area.photos}
    left = {}
    for (a, b), rows in matches.items():
        touched = np.zeros(len(rows), bool)
        for photo, index in ((a, rows[:, 0]), (b, rows[:, 1])):
            if photo in covered:
                touched |= covered[photo][index]
        if touched.any():
            left[a, b] = rows[~touched]
    return left


def area_text(share: float, where: str) -> str:
    """Return "the lower 20 % of every photo", or "2 % of every photo (lower right)"."""
    percent = f"{100 * share:.0f} %" if share >= 0.01 else "under 1 %"
    if where and " " not in where:
        return f"the {where} {percent} of every photo"
    return f"{percent} of every photo" + (f" ({where})" if where else "")


@dataclass
class _MatchCounts:
    """Counts of matches by cell, over the pairs that move: [h, w] each."""

    still: np.ndarray
    near: np.ndarray
    slow: np.ndarray  # displaced by less than `MOVED`, and not still
    moving: np.ndarray
    shown: np.ndarray  # [N, h, w] bool: photos in which a cell has a still match


def find_fixed(
    features: Sequence[np.ndarray],  # a photo each: [N, 2] px
    sizes: Sequence[tuple[int, int]],  # width and height of each photo, px
    cameras: Sequence[int],  # camera number of each photo
    matches: Mapping[Pair, np.ndarray],  # [K, 2] features of the pair's photos
    read: Callable[[int], np.ndarray]
    | None = None,  # grey pixels of a photo, [H, W] uint8; None: no refinement
) -> list[FixedArea]:
    """Find the fixed areas, one a camera and size at most.

    Photos that share their camera with no other are grouped by size.
    """
    alone = {c for c in set(cameras) if list(cameras).count(c) == 1}
    groups: dict[tuple[int, tuple[int, int]], list[int]] = {}
    for photo, (camera, size) in enumerate(zip(cameras, sizes)):
        groups.setdefault((-1 if camera in alone else camera, size), []).append(photo)
    areas = (_of_group(photos, size, features, matches, read) for (_, size), photos in groups.items())
    return [area for area in areas if area is not None]


def _of_group(
    photos: list[int],
    size: tuple[int, int],
    features: Sequence[np.ndarray],
    matches: Mapping[Pair, np.ndarray],
    read: Callable[[int], np.ndarray] | None,
) -> FixedArea | None:
    """Find the fixed area of photos of one camera and size."""
    if len(photos) < AREA_PHOTOS[0]:
        return None
    numbers = {photo: k for k, photo in enumerate(photos)}
    pairs = {
        (numbers[a], numbers[b]): (features[a][rows[:, 0]], features[b][rows[:, 1]])
        for (a, b), rows in matches.items()
        if a in numbers and b in numbers
    }
    evidence = _count(pairs, size, len(photos))
    fixed = _fixed_cells(evidence)
    if not fixed.any():
        return None
    side = CELLS * MAP_CELL
    scale = side / max(size)
    shape = (max(round(size[1] * scale), 1), max(round(size[0] * scale), 1))
    large = cv2.resize(
        fixed.astype(np.uint8), None, fx=MAP_CELL, fy=MAP_CELL, interpolation=cv2.INTER_NEAREST
    )
    seeds = large[: shape[0], : shape[1]] > 0
    closed = _closed(seeds, round(CLOSED * side))
    kept = np.zeros_like(seeds)
    count, labels = cv2.connectedComponents(closed.astype(np.uint8), connectivity=8)
    for label in range(1, count):
        part = labels == label
        if _moves_around(_in_cells(part & seeds, fixed.shape), evidence):
            kept |= part
    cells = _in_cells(kept & seeds, fixed.shape)
    seen = int((evidence.shown & cells).any(axis=(1, 2)).sum())
    if cells.sum() < AREA_CELLS or seen < max(AREA_PHOTOS[0], AREA_PHOTOS[1] * len(photos)):
        return None
    moving, slope = _enlarged(_moving_cells(evidence), shape), None
    if read is not None:
        small = _reduced([read(k) for k in _some(photos)], shape)
        slopes = _slopes(small)
        slope = np.median(slopes, axis=1)
        kept = _grown(kept, moving, small, slopes)
    kept = _filled(_closed(kept, round(CLOSED * side)), moving)
    kept = cv2.dilate(kept.astype(np.uint8), _disc(MARGIN_PX)) > 0
    return FixedArea(size, photos, kept, slope) if kept.mean() <= LARGEST else None


def _count(
    pairs: Mapping[Pair, tuple[np.ndarray, np.ndarray]], size: tuple[int, int], photos: int
) -> _MatchCounts:
    """Count the matches of every cell by their displacement, over the pairs that move."""
    side = max(size)
    width, height = (int(np.ceil(CELLS * length / side - 1e-9)) for length in size)
    counts = np.zeros((4, height * width))
    shown = np.zeros((photos, height * width), bool)
    for (a, b), (first, second) in pairs.items():
        moved = np.linalg.norm(first - second, axis=1)
        still, near, moving = moved <= still_px(size), moved <= NEAR * still_px(size), moved > MOVED * side
        if moving.sum() < MOVING or moving.sum() <= (near & ~still).sum():
            continue
        column, row = np.clip((first * CELLS / side).astype(int), 0, [width - 1, height - 1]).T
        cell = row * width + column
        for k, chosen in enumerate((still, near & ~still, ~still & ~moving, moving)):
            counts[k] += np.bincount(cell[chosen], minlength=height * width)
        column, row = np.clip((second[moving] * CELLS / side).astype(int), 0, [width - 1, height - 1]).T
        counts[3] += np.bincount(row * width + column, minlength=height * width)
        shown[a, cell[still]] = shown[b, cell[still]] = True
    counts[3] /= 2  # both ends of a match that moves were counted
    still_count, near_count, slow_count, moving_count = counts.reshape(4, height, width)
    by_photo = shown.reshape(photos, height, width)
    return _MatchCounts(still_count, near_count, slow_count, moving_count, by_photo)


def still_px(size: tuple[int, int]) -> float:
    """Return the largest displacement of a still match, px of the photo."""
    return STILL_PX * max(1.0, max(size) / STILL_SIDE)


def _fixed_cells(evidence: _MatchCounts) -> np.ndarray:
    """Return the cells [h, w] bool that stay while the rest moves; each counts with its eight neighbours."""
    still, near, slow, moving = (
        _around(x) for x in (evidence.still, evidence.near, evidence.slow, evidence.moving)
    )
    box = np.ones((3, 3), np.uint8)
    photos = np.zeros(still.shape, int)
    for shown in evidence.shown:
        photos += cv2.dilate(shown.astype(np.uint8), box)
    active = int(evidence.shown.any(axis=(1, 2)).sum())
    often = photos >= max(CELL_PHOTOS[0], CELL_PHOTOS[1] * active)
    fixed = often & (still >= GAP * near) & (still >= FIXED_SHARE * (still + slow + moving))
    return fixed & (evidence.still > 0)


def _around(counts: np.ndarray) -> np.ndarray:
    """Sum over each cell and its eight neighbours."""
    return cv2.boxFilter(counts, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)


def _moves_around(cells: np.ndarray, evidence: _MatchCounts) -> bool:
    """Tell whether the matches around an area move as the scene does, and not a little only."""
    near = cv2.dilate(cells.astype(np.uint8), _disc(RING)) > 0
    ring = near & ~(cv2.dilate(cells.astype(np.uint8), _disc(1)) > 0)
    slow, moving = evidence.slow[ring].sum(), evidence.moving[ring].sum()
    return slow + moving < RING_MATCHES or slow <= SLOW_RING * (slow + moving)


def _moving_cells(evidence: _MatchCounts) -> np.ndarray:
    """Return the cells [h, w] bool whose matches move."""
    still, moving = _around(evidence.still), _around(evidence.moving)
    return (moving >= MOVING_CELL) & (still < FIXED_SHARE * (still + moving))


def _reduced(photos: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Return grey photos [H, W] at the size of the map, [N, h, w] float32."""
    size = (shape[1], shape[0])
    return np.stack([cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in photos]).astype(np.float32)


def _slopes(photos: np.ndarray) -> np.ndarray:
    """Return the gradients along x and y of photos [N, h, w], [2, N, h, w]."""
    return np.array([[cv2.Sobel(p, cv2.CV_32F, *d) for p in photos] for d in ((1, 0), (0, 1))])


def _grown(
    seeds: np.ndarray,  # [h, w] bool
    moving: np.ndarray,  # [h, w] bool
    photos: np.ndarray,  # [N, h, w] float32
    slopes: np.ndarray,  # [2, N, h, w], their gradients
) -> np.ndarray:
    """Add connected pixels that hardly change from photo to photo, if their outline stays too.

    An even sky hardly changes either, but its outline does. The gradient's median over photos is that of what
    stays: Dekel et al., "On the effectiveness of visible watermarks" (CVPR 2017).
    """
    change = cv2.blur(np.median(np.abs(photos - np.median(photos, axis=0)), axis=0), (3, 3))
    if seeds.all():
        return seeds
    calm = ((change < CALM * np.median(change[~seeds])) & ~moving).astype(np.uint8)
    calm = cv2.morphologyEx(calm, cv2.MORPH_OPEN, _disc(2))
    lasting = np.hypot(*np.median(slopes, axis=1))
    lasting /= np.maximum(np.median(np.hypot(*slopes), axis=0), 1.0)
    lasting = cv2.dilate(lasting, _disc(1))
    inside = np.zeros_like(seeds)
    inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    grown = seeds.copy()
    _, labels = cv2.connectedComponents(calm | seeds.astype(np.uint8), connectivity=4)
    for label in np.unique(labels[seeds]):
        part = labels == label
        outline = inside & part & ~(cv2.erode(part.astype(np.uint8), _disc(1), borderValue=1) > 0)
        if not outline.any() or np.median(lasting[outline]) >= LASTING:
            grown |= part
    return grown


def _closed(area: np.ndarray, reach: int) -> np.ndarray:
    """Close gaps of an area [h, w] bool up to a width in px, and such gaps to the border of the photo."""
    padded = np.pad(area, reach)
    inner = slice(reach, 2 * reach)
    for view in (padded, padded[::-1], padded.T, padded.T[::-1]):  # what is near a border goes on beyond it
        view[:reach] = view[inner].any(axis=0)
    shut = cv2.morphologyEx(padded.astype(np.uint8), cv2.MORPH_CLOSE, _disc(reach // 2))
    return np.asarray(shut[reach:-reach, reach:-reach] > 0)


def _filled(
    area: np.ndarray,  # [h, w] bool
    moving: np.ndarray,  # [h, w] bool
) -> np.ndarray:
    """Fill the parts of the photo that an area cuts off and in which nothing moves."""
    count, labels = cv2.connectedComponents((~area).astype(np.uint8), connectivity=4)
    filled = area.copy()
    for label in range(1, count):
        part = labels == label
        if not (part & moving).any():
            filled |= part
    return filled


def _some(photos: list[int]) -> list[int]:
    """Choose photos spread over the capture."""
    return [photos[k] for k in np.unique(np.linspace(0, len(photos) - 1, COMPARED).round().astype(int))]


def _in_cells(area: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the cells [h, w] bool of which a map [H, W] bool has a pixel."""
    padded = np.zeros((shape[0] * MAP_CELL, shape[1] * MAP_CELL), bool)
    padded[: area.shape[0], : area.shape[1]] = area
    return np.asarray(padded.reshape(shape[0], MAP_CELL, shape[1], MAP_CELL).any(axis=(1, 3)))


def _enlarged(cells: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return cells [h, w] bool as a map of a shape."""
    return np.kron(cells, np.ones((MAP_CELL, MAP_CELL), bool))[: shape[0], : shape[1]]


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
