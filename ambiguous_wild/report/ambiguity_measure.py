"""Score every train photo; photos are read one at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.io.images import load_image_float
from ambiguous_wild.io.motion_points import MotionPoints, read_motion_points
from ambiguous_wild.methods.refinesplat.structure import GREY, correlation
from ambiguous_wild.metrics import ambiguity as am
from ambiguous_wild.metrics import semantic as sem
from ambiguous_wild.report.ambiguity_sources import Background, Masks, load_mask, stem
from ambiguous_wild.vision.moving import MOVES, moving_map

KINDS = ("colour", "structure", "features", "motion")
TOLD = 0.5  # share of a distractor's pixels from which on an evidence tells it
CORRELATED = 0.5  # with the background; below, the structure at a pixel is another one


@dataclass(frozen=True)
class Distractor:
    """One distractor of a photo; None = this evidence says nothing of it."""

    label: int
    pixels: int  # of the photo as the features see it
    colour: bool | None  # most of its pixels differ from their background
    structure: bool | None  # most do in structure
    motion: bool | None  # most lie where features move
    features: bool | None = None  # no static region of another photo resembles it as static ones each other

    @property
    def told_by(self) -> tuple[str, ...]:
        """The kinds of evidence that tell it."""
        return tuple(kind for kind in KINDS if getattr(self, kind))


def distractors(
    regions: np.ndarray,
    photo: np.ndarray,
    behind: np.ndarray | None,
    known: np.ndarray | None,
    segments: np.ndarray,
    points: MotionPoints | None,
) -> list[Distractor]:
    """Every region of a photo that is not tiny, without what features say.

    Args:
        regions: [h, w] int from 1, 0 = none.
        photo: [H, W, 3] in [0, 1].
        behind: its background, [H, W, 3]; None: unknown.
        known: [H, W] bool, where the background is known; None: everywhere.
        segments: [h, w] int32, of the photo at the size of `regions`.
        points: features that move and stay; None: the scene does not say.
    """
    shape = (regions.shape[1], regions.shape[0])
    differs = unlike = sure = moves = None
    if behind is not None:
        differs = am.colour_residual(photo, behind) > am.COLOUR_THRESHOLD
        import torch

        ours, theirs = (torch.from_numpy((image @ GREY).astype(np.float32)) for image in (photo, behind))
        unlike = correlation(ours, theirs).numpy() < CORRELATED
        sure = np.ones(differs.shape, bool) if known is None else known
        differs, unlike, sure = (
            cv2.resize(x.astype(np.uint8), shape, interpolation=cv2.INTER_NEAREST) > 0
            for x in (differs, unlike, sure)
        )
    if points is not None:
        moves = moving_map(points, segments, regions.shape)
    found = []
    for label, pixels in enumerate(np.bincount(regions.ravel())):
        if label == 0 or pixels < max(sem.MIN_SHARE * regions.size, 1):
            continue
        at = regions == label
        found.append(
            Distractor(
                label,
                int(pixels),
                _most(differs, at, sure),
                _most(unlike, at, sure),
                None if moves is None or bool(np.all(moves[at] == 0.5)) else _most(moves > MOVES, at, None),
            )
        )
    return found


def _most(yes: np.ndarray | None, at: np.ndarray, sure: np.ndarray | None) -> bool | None:
    if yes is None:
        return None
    where = at if sure is None else at & sure
    return bool(yes[where].mean() >= TOLD) if where.any() else None


BINS = np.linspace(0.0, math.sqrt(3.0), 53)  # of the residual; 0.3 is on no edge, so counts are kept apart
# longer side of the photos that labhog, whose cells are of 4 px, sees: its scores must not hang on the size
LOOKS_PX = 240
FIT_PHOTOS = 24  # features look at so many photos, evenly chosen
Bar = Callable[[list[View]], Iterable[View]]


@dataclass(frozen=True)
class Measured:
    """One train photo."""

    name: str
    counts: am.ColourCounts
    histogram: np.ndarray  # [52] int64, residual over the known distractor pixels
    matches: list[sem.RegionMatch]  # of its distractors
    distractors: list[Distractor]


@dataclass(frozen=True)
class SceneFeatures:
    """Features of a measurement, for maps: the mean that was subtracted, and each distractor's feature."""

    spec: str  # of the features
    features: Any
    whitened: bool
    mean: np.ndarray  # [C]
    whiten: np.ndarray  # [C, C]
    distractors: list[sem.Regions]  # per photo, whitened where the features are
    statics: list[sem.Regions]
    anchors: sem.Anchors
    usual: float  # the cosine from which a match is as good as those within the static scene; NaN unknown
    objects: bool  # compared with static objects that the user named, not with every static region


def feature_family(spec: str) -> str:
    """The name of a back end without size and options: ``labhog``, ``dinov2-small``."""
    from ambiguous_wild.vision.backends import parse

    return parse(spec).name


def weight_free(spec: str) -> bool:
    """Whether the features carry no pretrained meaning: they are whitened over the scene."""
    from ambiguous_wild.vision.backends import DINO

    return feature_family(spec) not in DINO


def measure(
    scene: Scene,
    masks: Masks,
    background: Background,
    *,
    features: str = "labhog",
    objects: Path | None = None,
    cache: Path | None = None,
    progress: Bar = iter,
) -> tuple[list[Measured], SceneFeatures]:
    """Score every train photo.

    Args:
        scene: to measure.
        masks: of its distractors.
        background: what is behind them.
        features: a back end's name, see `vision.backends`.
        objects: masks of the static objects to compare with, white = object; None: every static segment.
        cache: for features that learn from the scene.
        progress: wraps the list of views, for a bar.

    Raises:
        AwError: masks, photos or features that cannot be used.
    """
    import torch
    from scipy import ndimage

    from ambiguous_wild.vision.segments import GraphSegments

    views = list(scene.train)
    backend = fitted(scene, features, cache)
    segments = GraphSegments()
    statistics = sem.ChannelStatistics()
    named = _object_masks(objects, views) if objects is not None else None
    points = read_motion_points(scene.root)
    moving, static, every, scores, told = [], [], [], [], []
    for index, view in enumerate(progress(views)):
        photo, distractor = load_photo(view), masks.load(view)
        behind, known = background.load(index, view)
        counts = am.colour_counts(photo, behind, distractor, known=known)
        use = distractor if known is None else distractor & known
        residual = am.colour_residual(photo, behind)[use] if behind is not None else np.empty(0)
        seen, hidden = seen_by(features, photo), small_mask(features, distractor)
        with torch.no_grad():
            grid = backend(torch.from_numpy(seen)).numpy()
        statistics.add(grid)
        regions, _ = ndimage.label(hidden)
        whole = segments.labels(torch.from_numpy(seen))
        parts = np.where(hidden, 0, whole)
        moving.append(sem.region_means(grid, regions, sem.MIN_SHARE))
        every.append(sem.region_means(grid, parts, sem.MIN_SHARE))
        static.append(every[-1])
        if named is not None:
            things = _objects(features, named, view, hidden)
            static[-1] = sem.region_means(grid, things, sem.MIN_SHARE)
        told.append(distractors(regions, photo, behind, known, whole, points.get(view.name)))
        scores.append((view.name, counts, np.histogram(residual, BINS)[0]))
    mean, whiten = statistics.whitening()
    whitened = weight_free(features)
    if whitened:
        moving = [r.whitened(mean, whiten) for r in moving]
        static = [r.whitened(mean, whiten) for r in static]
        every = [r.whitened(mean, whiten) for r in every]
    found = sem.matches(moving, static)
    anchors, usual = sem.anchors(static, every), sem.usual_match(every)
    look = SceneFeatures(
        features, backend, whitened, mean, whiten, moving, static, anchors, usual, objects is not None
    )
    measured = []
    for score, matches, found_in_photo in zip(scores, found, told):
        cosines = {match.label: match.cosine for match in matches}
        sure = not math.isnan(usual)
        regions_of_photo = [
            replace(d, features=cosines[d.label] < usual if sure and d.label in cosines else None)
            for d in found_in_photo
        ]
        measured.append(Measured(*score, matches, regions_of_photo))
    return measured, look


def fitted(scene: Scene, spec: str, cache: Path | None) -> Any:
    """The features by name, fitted to the scene's train photos.

    Raises:
        AwError: unknown, without weights, or no folder for what they learn.
    """
    import torch

    from ambiguous_wild.methods.refinesplat.inputs import train_tracks
    from ambiguous_wild.vision.backends import make_features
    from ambiguous_wild.vision.protocols import SceneFeatures

    backend = make_features(spec)
    views = list(scene.train)
    if isinstance(backend, SceneFeatures):
        photos = [torch.from_numpy(seen_by(spec, load_photo(v))) for v in views]
        backend.fit_scene(photos, train_tracks(scene), cache)
        return backend
    # fitted to the photos it will be applied to
    chosen = sorted({round(i) for i in np.linspace(0, len(views) - 1, min(FIT_PHOTOS, len(views)))})
    backend.fit([torch.from_numpy(seen_by(spec, load_photo(views[i]))) for i in chosen])
    return backend


def cosine_map(look: SceneFeatures, index: int, photo: np.ndarray) -> np.ndarray | None:  # [h, w] in [-1, 1]
    """How like the photo's largest distractor each cell of it is; None where it has no distractor."""
    import torch

    regions = look.distractors[index]
    if not len(regions):
        return None
    which = int(np.argmax(regions.pixels))
    direction = regions.means[which] / max(float(np.linalg.norm(regions.means[which])), 1e-12)
    with torch.no_grad():
        grid = look.features(torch.from_numpy(seen_by(look.spec, photo))).numpy().astype(np.float64)
    if look.whitened:
        grid = (grid - look.mean) @ look.whiten
    return grid @ direction / np.maximum(np.linalg.norm(grid, axis=2), 1e-12)


def load_photo(view: View) -> np.ndarray:  # [H, W, 3] float32 in [0, 1]
    """The photo as measured."""
    return load_image_float(view.image_path)


def seen_by(features: str, photo: np.ndarray) -> np.ndarray:  # [h, w, 3]
    """The photo as the features see it: labhog no larger than `LOOKS_PX`, others as it is."""
    import cv2

    size = _size(features, photo.shape)
    return photo if size is None else cv2.resize(photo, size, interpolation=cv2.INTER_AREA)


def small_mask(features: str, mask: np.ndarray) -> np.ndarray:  # [h, w] bool
    """A mask [H, W] at the size of `seen_by`."""
    import cv2

    size = _size(features, mask.shape)
    if size is None:
        return mask
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def _size(features: str, shape: tuple[int, ...]) -> tuple[int, int] | None:
    """(width, height) to be made; None: as it is."""
    scale = LOOKS_PX / max(shape[:2])
    if feature_family(features) != "labhog" or scale >= 1:
        return None
    return max(round(shape[1] * scale), 1), max(round(shape[0] * scale), 1)


def _objects(
    features: str, named: dict[str, Path], view: View, distractor: np.ndarray
) -> np.ndarray:  # [h, w] int
    """The static objects of a photo from 1, without what distractors hide; 0 throughout without a mask.

    Distractors and objects are at the size of `seen_by`.
    """
    from scipy import ndimage

    if view.name not in named:
        return np.zeros(distractor.shape, int)
    mask = small_mask(features, load_mask(named[view.name], view))
    return np.asarray(ndimage.label(mask & ~distractor)[0])


def _object_masks(folder: Path, views: list[View]) -> dict[str, Path]:
    if not folder.is_dir():
        raise AwError(f"there is no folder {folder} of object masks (--objects)")
    found = {v.name: folder / f"{stem(v)}.png" for v in views if (folder / f"{stem(v)}.png").is_file()}
    if not found:
        raise AwError(
            f"{folder} holds no mask of a train photo: name them as the photos, {stem(views[0])}.png"
        )
    return found
