"""Photos without their distractors: the model's render in place of what is masked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core import Camera, Scene, View
from ambiguous_wild.harness.trained_models import find_run_models
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.io.lens import Lens
from ambiguous_wild.viewing.model import Renderer
from ambiguous_wild.vision.sparse_surface import BEHIND

UNSEEN = 0.2  # share of what is masked in a photo that no other photo shows, above which it is left out
OPAQUE = 0.5  # alpha of the render from which the model has something there
STRIDE = 4  # px of the training size between pixels whose surface is looked for in other photos
GROW = 0.004  # of the longer side: what is replaced reaches this far over the rim of the mask
SPREAD = 0.03  # of the longer side: width of the Gaussian that takes the light beside the mask into it


class Inpainting:
    """Draws what is behind the masks of a run, in the light of each photo."""

    def __init__(self, run: Path, scene: Scene, keeps: Mapping[str, np.ndarray]) -> None:
        """
        Args:
            run: the run, with a model.
            scene: its scene.
            keeps: keep map of each train view, [h, w] in {0, 1}, by its name.

        Raises:
            AwError: the run has no model.
        """
        (trained,), _ = find_run_models([run])
        self._renderer = Renderer(trained.model.read(), trained.model.render_settings)
        self._keeps = keeps
        self._unseen = self._unseen_shares(scene.train)

    def why_not(self, name: str) -> str:
        """Return why a photo is left out; empty where it is not."""
        if self._unseen[name] <= UNSEEN:
            return ""
        return (
            f"more than {UNSEEN:.0%} of the masked area is visible in no other photo, so the model cannot "
            "know it; add photos that show it, from where nothing hides it"
        )

    def draw(
        self,
        view: View,
        photo: np.ndarray,  # [H, W, 3] uint8, as it was taken
        keep: np.ndarray,  # [H, W] bool
        lens: Lens | None,
    ) -> np.ndarray:  # [H, W, 3] uint8
        """Return the photo with the render where it is not kept, at the detail of training."""
        render = self._in_the_light_of(view)
        size = photo.shape[1], photo.shape[0]
        large = (
            cv2.resize(render, size, interpolation=cv2.INTER_LINEAR) if lens is None else lens.distort(render)
        )
        reach = max(1, round(GROW * max(size)))
        ring = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (4 * reach + 1, 4 * reach + 1))
        masked = cv2.dilate((~keep).astype(np.float32), ring)
        weight = cv2.GaussianBlur(masked, (0, 0), reach)[..., None]
        weight = np.maximum(weight, (~keep)[..., None])
        mixed = photo * (1 - weight) + 255 * np.clip(large, 0, 1) * weight
        return (mixed + 0.5).astype(np.uint8)

    def _in_the_light_of(self, view: View) -> np.ndarray:
        """Return the render, [h, w, 3] float32, with the colours of the photo beside the mask.

        Exposure and white balance differ from photo to photo, and the model has one for all.
        """
        keep = self._keeps[view.name].astype(np.float32)[..., None]
        render = self._renderer(view.camera).astype(np.float32) / 255
        difference = read_png_rgb(view.image_path).astype(np.float32) / 255 - render
        width = SPREAD * max(keep.shape)
        near = cv2.GaussianBlur(keep, (0, 0), width)[..., None]
        mean = (keep * difference).sum((0, 1)) / max(float(keep.sum()), 1.0)
        # Far inside the mask the mean over the photo is left.
        light = cv2.GaussianBlur(keep * difference, (0, 0), width) + 1e-3 * mean
        return render + light / (near + 1e-3)

    def _unseen_shares(self, views: tuple[View, ...]) -> dict[str, float]:
        """Return the share of each photo's masked pixels whose surface no other photo shows unmasked."""
        cameras = [view.camera for view in views]
        frames = [self._renderer.frame(camera) for camera in cameras]
        alphas = [frame.alpha.numpy().copy() for frame in frames]
        depths = [frame.depth.numpy() / np.maximum(alpha, 1e-6) for frame, alpha in zip(frames, alphas)]
        shares = {}
        for index, view in enumerate(views):
            masked = (self._keeps[view.name] == 0)[::STRIDE, ::STRIDE]
            rows, columns = np.nonzero(masked)
            if not len(rows):
                shares[view.name] = 0.0
                continue
            rows, columns = rows * STRIDE, columns * STRIDE
            depth, seen = depths[index][rows, columns], np.zeros(len(rows), bool)
            world = view.camera.unproject(np.stack([columns, rows], axis=1) + 0.5, depth)
            for other, camera in enumerate(cameras):
                if other != index:
                    seen |= self._shows(camera, depths[other], self._keeps[views[other].name], world)
            seen &= alphas[index][rows, columns] >= OPAQUE
            shares[view.name] = 1.0 - float(seen.mean())
        return shares

    @staticmethod
    def _shows(camera: Camera, depth: np.ndarray, keep: np.ndarray, world: np.ndarray) -> np.ndarray:
        """Return which points [N, 3] a camera shows: in its frame, behind nothing, and not masked."""
        pixels, z = camera.project(world)
        x, y = pixels.T
        inside = camera.has(pixels, z)
        column, row = np.where(inside, x, 0).astype(int), np.where(inside, y, 0).astype(int)
        return inside & (keep[row, column] > 0) & (z <= BEHIND * depth[row, column])
