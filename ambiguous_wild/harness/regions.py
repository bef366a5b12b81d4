"""PSNR on parts of a test view: pixels in a user's mask, covered by distractors in train views, well seen.

A pixel of a test view is *supported* where at least three train views show its static surface: elsewhere a
method extrapolates. It is *covered* where its static surface was behind a distractor in at least half of
the train views that look at it, and *uncovered* otherwise. It is a fact of the scene, not of a method's
render, so that every method is measured on the same pixels: surfaces come from the sparse points (inverse
depth, linear between them: exact on planes), distractors from the exact masks. A train view looks at a
surface that lies in its frame and not behind another static one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core import AwError, Camera, Scene, View
from ambiguous_wild.io.images import read_gray, read_keep_map
from ambiguous_wild.metrics import masks
from ambiguous_wild.vision.sparse_surface import (
    BEHIND,
    in_map,
    inside,
    inverse_depth,
    some_points,
    world_points,
)

COVERED_FROM = 0.5  # share of the train views that look at it
SUPPORTED_FROM = 3  # train views that show it
MOST_VIEWS = 64  # looked at for a test view where there are no exact masks

DistractorMask = Callable[[View], np.ndarray | None]  # [H, W] bool, True on distractors


@dataclass(frozen=True)
class Visibility:
    """How the train views look at the surface of each pixel of a test view."""

    shown: np.ndarray  # [H, W] float32: views that show it
    hidden: np.ndarray  # [H, W] float32: share of the views that look at it, but show a distractor

    @property
    def covered(self) -> np.ndarray:
        """[H, W] bool."""
        return self.hidden >= COVERED_FROM

    @property
    def supported(self) -> np.ndarray:
        """[H, W] bool."""
        return self.shown >= SUPPORTED_FROM


def train_visibility(scene: Scene, distractor: DistractorMask) -> dict[str, Visibility] | str:
    """Of every test view by name; or why that cannot be told.

    A train view without an exact mask shows no distractor, unless another has one: then it is left out.

    Args:
        scene: its sparse points say where surfaces are.
        distractor: the exact mask of a train view, None where there is none.
    """
    masks = [distractor(view) for view in scene.train]
    exact = any(mask is not None for mask in masks)
    known = [(view, mask) for view, mask in zip(scene.train, masks) if mask is not None or not exact]
    xyz = some_points(scene.points.sure_xyz)
    cameras = [view.camera for view, _ in known]
    depths = [inverse_depth(camera, xyz) for camera in cameras]
    found = {}
    for view in scene.test:
        inverse = inverse_depth(view.camera, xyz)
        if inverse is None:
            return f"too few sparse points lie in test view {view.name}"
        world = world_points(view.camera, inverse)
        looking, hidden = np.zeros((2, *inverse.shape), np.float32)
        for k in range(len(known)) if exact else _nearest(view.camera, cameras):
            sees, distracted = _seen(world, cameras[k], depths[k], known[k][1])
            looking += sees
            hidden += sees & distracted
        size = (view.camera.width, view.camera.height)
        maps = (looking - hidden, hidden / np.maximum(looking, 1.0))
        found[view.name] = Visibility(*(cv2.resize(m, size, interpolation=cv2.INTER_LINEAR) for m in maps))
    return found


def hides_anything(masks: Iterable[np.ndarray | None]) -> str:
    """Why no pixel can be covered, from the exact masks of the train views; empty where one may be."""
    known = [mask for mask in masks if mask is not None]
    if not known:
        return "no exact masks of the train photos (truth/distractor)"
    return "" if any(mask.any() for mask in known) else "no train photo shows a distractor"


def _nearest(camera: Camera, others: Sequence[Camera]) -> list[int]:
    """The cameras nearest to it: those that see the same surfaces, where there are hundreds."""
    distance = [float(np.linalg.norm(other.center - camera.center)) for other in others]
    return sorted(range(len(others)), key=lambda k: (distance[k], k))[:MOST_VIEWS]


def _seen(
    world: np.ndarray,  # [h, w, 3], NaN where not known
    camera: Camera,
    depth: np.ndarray | None,  # inverse, of the camera's static surface
    mask: np.ndarray | None,  # [H, W] bool, distractors
) -> tuple[np.ndarray, np.ndarray]:
    """Where the camera looks at a surface, and where it shows a distractor instead, bool [h, w]."""
    local = world @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    z = local[..., 2]
    ahead = z > 1e-9
    sees = ahead.copy()
    if depth is not None:
        x, y = in_map(camera, local, depth.shape)
        nearest = _look_up(depth, x, y, ahead)
        sees &= ~(nearest * z > BEHIND)  # NaN: nothing is known to stand before it
    shape = (camera.height, camera.width) if mask is None else mask.shape
    x, y = in_map(camera, local, shape)
    held = inside(x, y, shape)
    if mask is None:
        return sees & held, np.zeros(held.shape, bool)
    return sees & held, _look_up(mask.astype(np.uint8), x, y, ahead & held) > 0


def _look_up(picture: np.ndarray, x: np.ndarray, y: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The nearest pixel of a map at columns x and rows y, clamped; its first pixel where not `where`."""
    column = np.where(where, np.clip(np.rint(x), 0, picture.shape[1] - 1), 0).astype(np.intp)
    row = np.where(where, np.clip(np.rint(y), 0, picture.shape[0] - 1), 0).astype(np.intp)
    return picture[row, column]


VALID, COVERED, UNCOVERED = "psnr_valid", "psnr_covered", "psnr_uncovered"
SUPPORTED = "psnr_supported"


@dataclass(frozen=True)
class Regions:
    """Which pixels of which test view each region metric is about."""

    pixels: dict[str, dict[str, np.ndarray]]  # metric -> name of a test view -> [H, W] bool
    missing: dict[str, str]  # metric -> why it is missing for the whole scene


def _psnr(metric: str, drawn: np.ndarray, photo: np.ndarray, view: View, scene: Scene) -> float:
    """In dB, of [H, W, 3] uint8; NaN where the view has no such pixel. AwError: no view of the scene has.

    Pictures narrower than the view are its right part (the half-image protocol).
    """
    regions = find_regions(scene)
    if metric in regions.missing:
        raise AwError(regions.missing[metric])
    pixels = regions.pixels[metric].get(view.name)
    return math.nan if pixels is None else masks.psnr_valid(drawn, photo, pixels[:, -photo.shape[1] :])


psnr_covered, psnr_uncovered = partial(_psnr, COVERED), partial(_psnr, UNCOVERED)
psnr_supported, psnr_valid = partial(_psnr, SUPPORTED), partial(_psnr, VALID)

_last: list[tuple[Scene, Regions]] = []  # of the scene that was asked about last


def find_regions(scene: Scene) -> Regions:
    """The regions of a scene's test views; the cells of one scene share the answer.

    Raises:
        AwError: a mask of a test photo has another size than the photo.
    """
    if not _last or _last[0][0] is not scene:
        _last[:] = [(scene, _find_regions(scene))]
    return _last[0][1]


def _find_regions(scene: Scene) -> Regions:
    pixels: dict[str, dict[str, np.ndarray]] = {}
    missing: dict[str, str] = {}
    kept = {view.name: mask for view in scene.test if (mask := _user_keep(scene, view)) is not None}
    if kept:
        pixels[VALID] = kept
    else:
        missing[VALID] = "no test photo has a mask (masks/test/<stem>.png, white = measured)"
    exact = {view.name: true_distractor(scene, view) for view in scene.train}
    looks = train_visibility(scene, lambda view: exact[view.name])
    if isinstance(looks, str):
        return Regions(pixels, missing | dict.fromkeys((COVERED, UNCOVERED, SUPPORTED), looks))
    pixels[SUPPORTED] = {name: found.supported for name, found in looks.items()}
    if not any(mask.any() for mask in pixels[SUPPORTED].values()):
        missing[SUPPORTED] = "no surface in a test view is shown by three train views"
        del pixels[SUPPORTED]
    nothing = hides_anything(exact.values())
    covered = {name: found.covered for name, found in looks.items()}
    if not nothing and not any(mask.any() for mask in covered.values()):
        nothing = "nothing that a test view shows was hidden in half of the train views that look at it"
    if nothing:
        return Regions(pixels, missing | dict.fromkeys((COVERED, UNCOVERED), nothing))
    pixels[COVERED] = covered
    pixels[UNCOVERED] = {name: ~mask for name, mask in covered.items()}
    return Regions(pixels, missing)


def true_distractor(scene: Scene, view: View) -> np.ndarray | None:
    """[H, W] bool, True on distractors, where the capture brought the truth."""
    path = scene.root / "truth" / "distractor" / Path(view.name).with_suffix(".png")
    if not path.exists():
        return None
    mask = read_gray(path) >= 128
    return mask if mask.shape == (view.camera.height, view.camera.width) else None


def _user_keep(scene: Scene, view: View) -> np.ndarray | None:
    path = scene.root / "masks" / "test" / Path(view.name).with_suffix(".png")
    if not path.is_file():
        return None
    keep = read_keep_map(path) > 0
    if keep.shape != (view.camera.height, view.camera.width):
        raise AwError(
            f"mask {path} is {keep.shape[1]}x{keep.shape[0]} px, its photo is "
            f"{view.camera.width}x{view.camera.height} px; bring it to the photo's size or remove it"
        )
    return keep
