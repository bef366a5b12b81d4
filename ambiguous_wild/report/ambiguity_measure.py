"""Score the ambiguity of every train photo; photos are read one at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.harness.sheets import evenly_spaced
from ambiguous_wild.io.images import load_image_float, read_gray
from ambiguous_wild.io.motion_points import MotionPoints, read_motion_points
from ambiguous_wild.io.scene_folder import without_suffix
from ambiguous_wild.methods.refinesplat.structure import GREY, correlation
from ambiguous_wild.metrics import ambiguity as am
from ambiguous_wild.metrics import semantic as sem
from ambiguous_wild.report.ambiguity_sources import Background, DistractorMasks, load_mask
from ambiguous_wild.vision.motion_maps import MOVES, moving_map

KINDS = ("colour", "structure", "features", "motion")
REVEALED_FROM = 0.5  # share of a distractor's pixels at which a kind of evidence reveals it
CORRELATED = 0.5  # correlation with the background below which the structure at a pixel differs
BINS = np.linspace(0.0, math.sqrt(3.0), 53)  # edges of the residual's histogram
# longer side of the photos for labhog, which has cells of 4 px: scores must not depend on the photos' size
LOOKS_PX = 240
FIT_PHOTOS = 24  # number of evenly spaced photos that features are fitted to


@dataclass(frozen=True)
class MeasuredDistractor:
    """One distractor of a photo, and whether each kind of evidence reveals it; None = not available."""

    label: int
    pixels: int  # of the photo as the features see it
    colour: bool | None  # most pixels differ from their background in colour
    structure: bool | None  # most pixels differ from their background in structure
    motion: bool | None  # most pixels lie where features move
    features: bool | None = None  # it resembles static regions of other photos less than these each other

    @property
    def told_by(self) -> tuple[str, ...]:
        """The kinds of evidence that reveal it."""
        return tuple(kind for kind in KINDS if getattr(self, kind))


def distractors(
    regions: np.ndarray,
    photo: np.ndarray,
    behind: np.ndarray | None,
    known: np.ndarray | None,
    segments: np.ndarray,
    points: MotionPoints | None,
) -> list[MeasuredDistractor]:
    """Return the distractors of a photo that are not tiny, without the evidence of features.

    Args:
        regions: labels of the distractors, [h, w] int from 1, 0 = none.
        photo: [H, W, 3] in [0, 1].
        behind: the background, [H, W, 3]; None: unknown.
        known: [H, W] bool, where the background is known; None: everywhere.
        segments: segments of the photo, [h, w] int32, at the size of `regions`.
        points: moving and static features; None: the scene has none.
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
    large = []
    for label, pixels in enumerate(np.bincount(regions.ravel())):
        if label == 0 or pixels < max(sem.MIN_SHARE * regions.size, 1):
            continue
        at = regions == label
        large.append(
            MeasuredDistractor(
                label,
                int(pixels),
                _most(differs, at, sure),
                _most(unlike, at, sure),
                None if moves is None or bool(np.all(moves[at] == 0.5)) else _most(moves > MOVES, at, None),
            )
        )
    return large


def _most(yes: np.ndarray | None, at: np.ndarray, sure: np.ndarray | None) -> bool | None:
    if yes is None:
        return None
    where = at if sure is None else at & sure
    return bool(yes[where].mean() >= REVEALED_FROM) if where.any() else None


Bar = Callable[[list[View]], Iterable[View]]


@dataclass(frozen=True)
class PhotoMeasures:
    """The measurements of one train photo."""

    name: str
    counts: am.ColourCounts
    histogram: np.ndarray  # [52] int64, residual over distractor pixels with a known background
    matches: list[sem.RegionMatch]  # of its distractors
    distractors: list[MeasuredDistractor]


@dataclass(frozen=True)
class MeasuredScene:
    """A scene, what its distractors are compared with, the measurements of its train photos, and features."""

    scene: Scene
    masks: DistractorMasks
    background: Background
    photos: list[PhotoMeasures]
    features: str  # name of the back end
    backend: Any
    whitened: bool
    mean: np.ndarray  # [C], subtracted if whitened
    whiten: np.ndarray  # [C, C]
    distractors: list[sem.RegionFeatures]  # of each photo, whitened if the features are
    anchors: sem.Anchors
    usual: float  # cosine at which a match is as good as those within the static scene; NaN = unknown
    objects: bool  # compared with the objects of --objects, not with every static region

    def cosine_map(self, index: int, photo: np.ndarray) -> np.ndarray | None:  # [h, w] in [-1, 1]
        """Return the cosine of each cell with the photo's largest distractor; None if it has none."""
        import torch

        regions = self.distractors[index]
        if not len(regions):
            return None
        which = int(np.argmax(regions.pixels))
        direction = regions.means[which] / max(float(np.linalg.norm(regions.means[which])), 1e-12)
        with torch.no_grad():
            grid = self.backend(torch.from_numpy(seen_by(self.features, photo))).numpy().astype(np.float64)
        if self.whitened:
            grid = (grid - self.mean) @ self.whiten
        return grid @ direction / np.maximum(np.linalg.norm(grid, axis=2), 1e-12)


def feature_family(spec: str) -> str:
    """Return the name of a back end without size and options: ``labhog``, ``dinov2-small``."""
    from ambiguous_wild.vision.backends import parse_spec

    return parse_spec(spec).name


def weight_free(spec: str) -> bool:
    """Return whether the features have no pretrained weights; such features are whitened over the scene."""
    from ambiguous_wild.vision.weight_registry import DINO

    return feature_family(spec) not in DINO


def measure(
    scene: Scene,
    masks: DistractorMasks,
    background: Background,
    *,
    features: str = "labhog",
    objects: Path | None = None,
    progress: Bar = iter,
) -> MeasuredScene:
    """Score every train photo.

    Args:
        scene: the scene.
        masks: masks of its distractors.
        background: the background behind them.
        features: name of a back end, see `vision.backends`.
        objects: folder with masks of static objects to compare with, white = object; None: those of a
            simulated capture, else all segments.
        progress: wraps the list of views, to show a bar.

    Raises:
        AwError: masks, photos or features cannot be used.
    """
    import torch
    from scipy import ndimage

    from ambiguous_wild.vision.segments import GraphSegments

    views = list(scene.train)
    backend = _fitted(scene, features)
    segments = GraphSegments()
    statistics = sem.ChannelStatistics()
    exact = scene.root / "truth" / "objects"
    numbered = objects is None and exact.is_dir()  # each object has a number, not all are white
    objects = exact if numbered else objects
    named = _object_masks(objects, views) if objects is not None else None
    points = read_motion_points(scene.root)
    moving, static, every, scores, evidence = [], [], [], [], []
    for index, view in enumerate(progress(views)):
        photo, distractor = load_image_float(view.image_path), masks.load(view)
        behind, known = background.load(index, view)
        counts = am.colour_counts(photo, behind, distractor, known=known)
        use = distractor if known is None else distractor & known
        residual = am.colour_residual(photo, behind)[use] if behind is not None else np.empty(0)
        seen, hidden = seen_by(features, photo), small_mask(features, distractor)
        with torch.no_grad():
            grid = backend(torch.from_numpy(seen)).numpy()
        statistics.add(grid)
        regions = _instances(scene, masks, view, hidden)
        whole = segments.labels(torch.from_numpy(seen))
        moving.append(sem.region_means(grid, regions, sem.MIN_SHARE))
        every.append(sem.region_means(grid, np.where(hidden, 0, whole), sem.MIN_SHARE))
        static.append(every[-1])
        if named is not None:
            things = np.zeros(hidden.shape, int)  # a photo without a mask has no objects
            if view.name in named and numbered:
                size = hidden.shape[1], hidden.shape[0]
                things = cv2.resize(read_gray(named[view.name]), size, interpolation=cv2.INTER_NEAREST)
            elif view.name in named:
                white = small_mask(features, load_mask(named[view.name], view))
                things = ndimage.label(white & ~hidden)[0]
            static[-1] = sem.region_means(grid, np.where(hidden, 0, things), sem.MIN_SHARE)
        evidence.append(distractors(regions, photo, behind, known, whole, points.get(view.name)))
        scores.append((view.name, counts, np.histogram(residual, BINS)[0]))
    mean, whiten = statistics.whitening()
    whitened = weight_free(features)
    if whitened:
        moving, static, every = ([r.whitened(mean, whiten) for r in rs] for rs in (moving, static, every))
    anchors, usual = sem.anchors(static, every), sem.usual_match(every)
    photos = []
    for score, of_photo, in_photo in zip(scores, sem.matches(moving, static), evidence):
        cosines = {} if math.isnan(usual) else {match.label: match.cosine for match in of_photo}
        in_photo = [
            replace(d, features=cosines[d.label] < usual if d.label in cosines else None) for d in in_photo
        ]
        photos.append(PhotoMeasures(*score, of_photo, in_photo))
    return MeasuredScene(
        scene, masks, background, photos, features, backend, whitened, mean, whiten, moving, anchors, usual,
        named is not None,
    )  # fmt: skip


def _instances(scene: Scene, masks: DistractorMasks, view: View, hidden: np.ndarray) -> np.ndarray:
    """Label the distractors of a mask [h, w] bool: by numbers of a simulated capture, else by connection."""
    from scipy import ndimage

    path = scene.truth_file("instances", view)
    if masks.source != "truth" or not path.is_file():
        return np.asarray(ndimage.label(hidden)[0])
    size = hidden.shape[1], hidden.shape[0]
    return np.where(hidden, cv2.resize(read_gray(path), size, interpolation=cv2.INTER_NEAREST), 0)


def _fitted(scene: Scene, spec: str) -> Any:
    """Make features by name and fit them to the scene's train photos.

    Raises:
        AwError: the features are unknown, lack weights, or have no folder for what they learn.
    """
    import torch

    from ambiguous_wild.methods.refinesplat.inputs import train_tracks
    from ambiguous_wild.vision.backends import make_features
    from ambiguous_wild.vision.sceneconv import SceneConv

    backend = make_features(spec)
    views = list(scene.train)
    views = views if isinstance(backend, SceneConv) else evenly_spaced(views, FIT_PHOTOS)
    photos = [torch.from_numpy(seen_by(spec, load_image_float(v.image_path))) for v in views]
    if isinstance(backend, SceneConv):
        backend.fit_scene(photos, train_tracks(scene), None)
    else:
        backend.fit(photos)
    return backend


def seen_by(features: str, photo: np.ndarray) -> np.ndarray:  # [h, w, 3]
    """Return the photo as the features see it: for labhog at most `LOOKS_PX` large, else unchanged."""
    size = _size(features, photo.shape)
    return photo if size is None else cv2.resize(photo, size, interpolation=cv2.INTER_AREA)


def small_mask(features: str, mask: np.ndarray) -> np.ndarray:  # [h, w] bool
    """Return a mask [H, W] at the size of `seen_by`."""
    size = _size(features, mask.shape)
    if size is None:
        return mask
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def _size(features: str, shape: tuple[int, ...]) -> tuple[int, int] | None:
    """Return the (width, height) that the features see; None: unchanged."""
    scale = LOOKS_PX / max(shape[:2])
    if feature_family(features) != "labhog" or scale >= 1:
        return None
    return max(round(shape[1] * scale), 1), max(round(shape[0] * scale), 1)


def _object_masks(folder: Path, views: list[View]) -> dict[str, Path]:
    if not folder.is_dir():
        raise AwError(f"there is no folder {folder} of object masks (--objects)")
    masks = {v.name: path for v in views if (path := folder / f"{without_suffix(v.name)}.png").is_file()}
    if not masks:
        like = f"{without_suffix(views[0].name)}.png"
        raise AwError(f"{folder} holds no mask of a train photo: name them as the photos, {like}")
    return masks
