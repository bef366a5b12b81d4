"""PSNR on parts of a test view: in a user's mask, behind distractors of train views, seen by enough views, or
looking as other photos show it.

A pixel of a test view is *supported* where at least three train views show its static surface; elsewhere a
method extrapolates. It is *covered* where a distractor hides its static surface in at least half of the train
views that look at it, and *uncovered* otherwise. Where test photos may hold distractors, a pixel is
*consistent* if at least half of the train photos that look at its surface show its colour there. Regions
depend on the scene alone, not on a render, so that all methods are measured on the same pixels: surfaces come
from the sparse points (inverse depth, linear between them, exact on planes), distractors from the exact
masks. A train view looks at a surface that is in its frame and not behind another static surface.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from ambiguous_wild.core import AwError, Camera, Scene, View
from ambiguous_wild.harness.chosen_effects import mixed_tests
from ambiguous_wild.io.images import read_gray, read_png_rgb
from ambiguous_wild.metrics import mask_scores
from ambiguous_wild.splat.data import load_keep
from ambiguous_wild.vision.sparse_surface import (
    BEHIND,
    in_map,
    inside,
    inverse_depth,
    subsample_points,
    world_points,
)

COVERED_FROM = 0.5  # share of the train views that look at a pixel's surface
SUPPORTED_FROM = 3  # number of train views that show it
MAX_VIEWS = 64  # number of train views compared with a test view where there are no exact masks
AGREEING_FROM = 0.5  # share of the train photos that look at a pixel's surface and show its colour there
COMPARED = 16  # train photos compared with a test photo
COLOUR_RANGE = 0.04  # by which a colour may leave what the pixels around show, of [0, 1]

Visibility = tuple[np.ndarray, np.ndarray]
VALID, COVERED, UNCOVERED = "psnr_valid", "psnr_covered", "psnr_uncovered"
SUPPORTED, CONSISTENT = "psnr_supported", "psnr_consistent"


def train_visibility(scene: Scene, masks: Sequence[np.ndarray | None]) -> dict[str, Visibility] | str:
    """Compute how often train views show the surface of each pixel of a test view; or return why they cannot.

    If no train view has an exact mask, none shows distractors; otherwise views without a mask are left out.

    Args:
        scene: the scene; its sparse points give the surfaces.
        masks: the exact mask of each train view, [H, W] bool, or None.

    Returns:
        By the name of the test view: the number of views that show the surface, [H, W] float32; and the share
        of the views looking at it that show a distractor instead, [H, W] float32.
    """
    exact = any(mask is not None for mask in masks)
    used = [(view, mask) for view, mask in zip(scene.train, masks) if mask is not None or not exact]
    xyz = subsample_points(scene.points.sure_xyz)
    cameras = [view.camera for view, _ in used]
    depths = [inverse_depth(camera, xyz) for camera in cameras]
    visibility = {}
    for view in scene.test:
        inverse = inverse_depth(view.camera, xyz)
        if inverse is None:
            return f"too few sparse points lie in test view {view.name}"
        world = world_points(view.camera, inverse)
        looking, hidden = np.zeros((2, *inverse.shape), np.float32)
        for k in range(len(used)) if exact else _nearest(view.camera, cameras):
            sees, distracted = _seen(world, cameras[k], depths[k], used[k][1])
            looking += sees
            hidden += sees & distracted
        size = (view.camera.width, view.camera.height)
        shown, share = (
            cv2.resize(m, size, interpolation=cv2.INTER_LINEAR)
            for m in (looking - hidden, hidden / np.maximum(looking, 1.0))
        )
        visibility[view.name] = shown, share
    return visibility


def photo_consistency(scene: Scene) -> dict[str, np.ndarray] | str:
    """Find the pixels of each test photo whose colour train photos show on the same surface.

    Photos are compared at the size of the depth maps. A train photo shows a colour if that lies between the
    darkest and the brightest pixel around the place, because interpolated depths are a pixel or two wrong.
    Before, the photo's channels are scaled to the test photo's, for photos of another exposure.

    Returns:
        By the name of the test view: [H, W] bool, False where fewer than three train photos show the surface;
        or why no pixel can be compared.
    """
    xyz = subsample_points(scene.points.sure_xyz)
    cameras = [view.camera for view in scene.train]
    depths = [inverse_depth(camera, xyz) for camera in cameras]
    photos = {k: _small(scene.train[k], depth.shape) for k, depth in enumerate(depths) if depth is not None}
    consistent = {}
    for view in scene.test:
        inverse = inverse_depth(view.camera, xyz)
        if inverse is None:
            continue
        world, photo = world_points(view.camera, inverse), _small(view, inverse.shape)
        looking, agreeing = np.zeros((2, *inverse.shape), np.float32)
        for k in [k for k in _nearest(view.camera, cameras) if k in photos][:COMPARED]:
            sees, _ = _seen(world, cameras[k], depths[k], None)
            looking += sees
            agreeing += sees & _shown(photo, world, sees, cameras[k], photos[k])
        agree = (looking >= SUPPORTED_FROM) & (agreeing >= AGREEING_FROM * looking)
        # agreement by chance within a distractor is small, and beside its rim a pixel holds some of it
        most = cv2.erode(cv2.medianBlur(agree.astype(np.uint8), 5), np.ones((3, 3), np.uint8))
        size = (view.camera.width, view.camera.height)
        consistent[view.name] = cv2.resize(most, size, interpolation=cv2.INTER_NEAREST) > 0
    return consistent or "too few sparse points lie in the test views"


def _shown(
    photo: np.ndarray,  # [h, w, 3], of the test view
    world: np.ndarray,  # [h, w, 3], its surface
    sees: np.ndarray,  # [h, w] bool, where the camera looks at it
    camera: Camera,
    other: np.ndarray,  # [h', w', 3], the camera's photo
) -> np.ndarray:
    """Return where the other photo shows the same colour, [h, w] bool."""
    if not sees.any():
        return sees
    local = camera.to_camera(world)
    x, y = in_map(camera, local, other.shape[:2])
    around = np.ones((3, 3), np.uint8)
    low, high = (_look_up(f(other, around), x, y, sees) for f in (cv2.erode, cv2.dilate))
    gain = np.median(photo[sees] / np.maximum((low + high)[sees] / 2, 0.02), axis=0)
    return np.all((photo >= gain * low - COLOUR_RANGE) & (photo <= gain * high + COLOUR_RANGE), axis=-1)


def _small(view: View, shape: tuple[int, ...]) -> np.ndarray:
    """Return a photo reduced to a map's size, [h, w, 3] float32 in [0, 1]."""
    photo = read_png_rgb(view.image_path).astype(np.float32) / 255.0
    return cv2.resize(photo, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)


def why_nothing_covered(masks: Iterable[np.ndarray | None]) -> str:
    """Return why the exact masks of the train views cannot cover any pixel; empty if they may."""
    exact = [mask for mask in masks if mask is not None]
    if not exact:
        return "no exact masks of the train photos (truth/distractor)"
    return "" if any(mask.any() for mask in exact) else "no train photo shows a distractor"


def _nearest(camera: Camera, others: Sequence[Camera]) -> list[int]:
    """Return the indices of the nearest cameras; of hundreds, these see the same surfaces."""
    distance = [float(np.linalg.norm(other.center - camera.center)) for other in others]
    return sorted(range(len(others)), key=lambda k: (distance[k], k))[:MAX_VIEWS]


def _seen(
    world: np.ndarray,  # [h, w, 3], NaN where unknown
    camera: Camera,
    depth: np.ndarray | None,  # inverse depth of the camera's static surface
    mask: np.ndarray | None,  # [H, W] bool, distractors
) -> tuple[np.ndarray, np.ndarray]:
    """Return where the camera looks at each surface, and where it shows a distractor instead, [h, w] bool."""
    local = camera.to_camera(world)
    z = local[..., 2]
    ahead = z > 1e-9
    sees = ahead.copy()
    if depth is not None:
        x, y = in_map(camera, local, depth.shape)
        nearest = _look_up(depth, x, y, ahead)
        sees &= ~(nearest * z > BEHIND)  # False for NaN: no known surface is in front of it
    shape = (camera.height, camera.width) if mask is None else mask.shape
    x, y = in_map(camera, local, shape)
    held = inside(x, y, shape)
    if mask is None:
        return sees & held, np.zeros(held.shape, bool)
    return sees & held, _look_up(mask.astype(np.uint8), x, y, ahead & held) > 0


def _look_up(picture: np.ndarray, x: np.ndarray, y: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return the nearest pixels of a map at columns x and rows y, clamped; the first pixel where masked."""
    column = np.where(where, np.clip(np.rint(x), 0, picture.shape[1] - 1), 0).astype(np.intp)
    row = np.where(where, np.clip(np.rint(y), 0, picture.shape[0] - 1), 0).astype(np.intp)
    return picture[row, column]


@dataclass(frozen=True)
class Regions:
    """The pixels of each test view that each region metric measures."""

    pixels: dict[str, dict[str, np.ndarray]]  # metric -> name of a test view -> [H, W] bool
    missing: dict[str, str]  # metric -> why it is missing for the whole scene


def _psnr(metric: str, drawn: np.ndarray, photo: np.ndarray, view: View, scene: Scene) -> float:
    """Return the PSNR in dB of pictures [H, W, 3] uint8; NaN if the view has no such pixel.

    Pictures narrower than the view are its right part (the half-image protocol).

    Raises:
        AwError: no view of the scene has such a pixel.
    """
    regions = find_regions(scene)
    if metric in regions.missing:
        raise AwError(regions.missing[metric])
    pixels = regions.pixels[metric].get(view.name)
    return math.nan if pixels is None else mask_scores.psnr_valid(drawn, photo, pixels[:, -photo.shape[1] :])


psnr_covered, psnr_uncovered = partial(_psnr, COVERED), partial(_psnr, UNCOVERED)
psnr_supported, psnr_valid = partial(_psnr, SUPPORTED), partial(_psnr, VALID)
psnr_consistent = partial(_psnr, CONSISTENT)

_last: list[tuple[Scene, Regions]] = []  # a cache of the latest scene only
_finding = threading.Lock()  # metrics ask on several threads


def find_regions(scene: Scene) -> Regions:
    """Return the regions of a scene's test views; they are computed once for all cells of the scene.

    Raises:
        AwError: a mask of a test photo has another size than the photo.
    """
    with _finding:
        if not _last or _last[0][0] is not scene:
            _last[:] = [(scene, _find_regions(scene))]
        return _last[0][1]


def valid_pixels(scene: Scene) -> dict[str, np.ndarray] | str:
    """Return what masks of test photos keep, [H, W] bool by the name of the view; or why it is missing."""
    masks = {view.name: load_keep(view, with_alpha=False) for view in scene.test}
    kept = {name: keep > 0 for name, keep in masks.items() if keep is not None}
    if not kept:
        return "no test photo has a mask (masks/test/<stem>.png, white = measured)"
    if not any(mask.any() for mask in kept.values()):
        return "the masks in masks/test leave no pixel to measure (white = measured)"
    return kept


def consistent_pixels(scene: Scene) -> dict[str, np.ndarray] | str:
    """Return `photo_consistency` where test photos may hold distractors; or why it is missing."""
    consistent = photo_consistency(scene) if mixed_tests(scene) else "test photos hold no distractors"
    if isinstance(consistent, str) or any(mask.any() for mask in consistent.values()):
        return consistent
    return "no pixel of a test photo looks as train photos show its surface"


def static_pixels(scene: Scene, metric: str) -> dict[str, np.ndarray] | str:
    """Return the pixels of `VALID` or `CONSISTENT` without the other regions, whose surfaces take longer."""
    return valid_pixels(scene) if metric == VALID else consistent_pixels(scene)


def _find_regions(scene: Scene) -> Regions:
    pixels: dict[str, dict[str, np.ndarray]] = {}
    missing: dict[str, str] = {}
    for metric in (VALID, CONSISTENT):
        found = static_pixels(scene, metric)
        if isinstance(found, str):
            missing[metric] = found
        else:
            pixels[metric] = found
    masks_of_train = [exact_distractor(scene, view) for view in scene.train]
    visibility = other_size(scene) or train_visibility(scene, masks_of_train)
    if isinstance(visibility, str):
        return Regions(pixels, missing | dict.fromkeys((COVERED, UNCOVERED, SUPPORTED), visibility))
    pixels[SUPPORTED] = {name: shown >= SUPPORTED_FROM for name, (shown, _) in visibility.items()}
    if not any(mask.any() for mask in pixels[SUPPORTED].values()):
        missing[SUPPORTED] = "no surface in a test view is shown by three train views"
        del pixels[SUPPORTED]
    reason = why_nothing_covered(masks_of_train)
    covered = {name: hidden >= COVERED_FROM for name, (_, hidden) in visibility.items()}
    if not reason and not any(mask.any() for mask in covered.values()):
        reason = "no surface of a test view is hidden in half of the train views that look at it"
    if reason:
        return Regions(pixels, missing | dict.fromkeys((COVERED, UNCOVERED), reason))
    pixels[COVERED] = covered
    pixels[UNCOVERED] = {name: ~mask for name, mask in covered.items()}
    return Regions(pixels, missing)


def exact_distractor(scene: Scene, view: View) -> np.ndarray | None:
    """Return the exact mask of a photo, [H, W] bool, True on distractors; None if the capture has none."""
    return _exact(scene, view, "distractor")


def other_size(scene: Scene) -> str:
    """Return that the exact masks of train photos are of another size than these; empty if one is not."""
    there = [view for view in scene.train if scene.truth_file("distractor", view).exists()]
    if not there or any(exact_distractor(scene, view) is not None for view in there):
        return ""
    return "the exact masks are not of the photos' size; load the scene at the factor it was built for"


def exact_shadow(scene: Scene, view: View) -> np.ndarray | None:
    """Return where distractors change a photo without being there, [H, W] bool; None if nowhere."""
    return _exact(scene, view, "shadow")


def _exact(scene: Scene, view: View, part: str) -> np.ndarray | None:
    path = scene.truth_file(part, view)
    if not path.exists():
        return None
    mask = read_gray(path) >= 128
    return mask if mask.shape == (view.camera.height, view.camera.width) else None
