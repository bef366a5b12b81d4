"""PSNR on parts of a test view: pixels in a user's mask, covered by distractors in train views, well seen."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.harness.running.covered import hides_anything, train_looks
from ambiguous_wild.io.images import read_gray, read_keep_map
from ambiguous_wild.metrics.masks import psnr_valid

VALID, COVERED, UNCOVERED = "psnr_valid", "psnr_covered", "psnr_uncovered"
SUPPORTED = "psnr_supported"


@dataclass(frozen=True)
class Regions:
    """Which pixels of which test view each region metric is about."""

    pixels: dict[str, dict[str, np.ndarray]]  # metric -> name of a test view -> [H, W] bool
    missing: dict[str, str]  # metric -> why it is missing for the whole scene

    def psnr(
        self,
        name: str,  # of the test view
        drawn: np.ndarray,  # [H, W, 3] uint8
        photo: np.ndarray,  # [H, W, 3] uint8
    ) -> dict[str, float]:
        """The region metrics of one view in dB; one that has no pixel in the view is left out.

        Pictures narrower than the view are its right part (the half-image protocol).
        """
        values = {}
        for metric, views in self.pixels.items():
            if name not in views:
                continue
            value = psnr_valid(drawn, photo, views[name][:, -photo.shape[1] :])
            if not math.isnan(value):
                values[metric] = value
        return values


@dataclass(frozen=True, eq=False)
class _Same:
    """A scene as a key of a cache: equal only to itself."""

    scene: Scene

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.scene is self.scene

    def __hash__(self) -> int:
        return id(self.scene)


def find_regions(scene: Scene) -> Regions:
    """The regions of a scene's test views; the cells of one scene share the answer.

    Raises:
        AwError: a mask of a test photo has another size than the photo.
    """
    return _find_regions(_Same(scene))


@lru_cache(maxsize=1)
def _find_regions(key: _Same) -> Regions:
    scene = key.scene
    pixels: dict[str, dict[str, np.ndarray]] = {}
    missing: dict[str, str] = {}
    kept = {view.name: mask for view in scene.test if (mask := _user_keep(scene, view)) is not None}
    if kept:
        pixels[VALID] = kept
    else:
        missing[VALID] = "no test photo has a mask (masks/test/<stem>.png, white = measured)"
    exact = {view.name: true_distractor(scene, view) for view in scene.train}
    looks = train_looks(scene, lambda view: exact[view.name])
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
    path = scene.root / "truth" / "distractor" / Path(view.name).with_suffix(".png").name
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
