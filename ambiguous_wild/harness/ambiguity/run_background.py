"""The background as a trained run renders it, where other photos confirm it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ambiguous_wild.core import AwError, Camera, Scene, View
from ambiguous_wild.io import plain_yaml

if TYPE_CHECKING:
    from ambiguous_wild.harness.ambiguity.sources import Masks

OPAQUE = 0.9  # accumulated alpha from which something stands there
SEEN_BY = 2  # other photos that must see the surface unmasked
DEPTH_SLACK = 0.05  # relative difference of depth up to which two photos see the same surface


class RunBackground:
    """Renders of a run's Gaussians at the train cameras.

    A render says something about every pixel; it *knows* only what other photos saw. A pixel counts as known
    where the render is opaque and its surface is seen by two other photos outside their masks.
    """

    source = "run"

    def __init__(self, scene: Scene, run: Path, masks: Masks) -> None:
        """
        Raises:
            AwError: no finished run, or one of another scene or size.
        """
        check_run(scene, run)
        self.views, self.masks = list(scene.train), masks
        self._gaussians = _load(run)
        self._depth: dict[int, tuple[Camera, np.ndarray, np.ndarray]] = {}  # of the other photos, coarse

    def load(self, index: int, view: View) -> tuple[np.ndarray | None, np.ndarray | None]:
        """See `Background`."""
        if not self._depth:
            self._depth = {k: self._coarse(v) for k, v in enumerate(self.views)}
        image, alpha, depth = self._render(view.camera)
        known = alpha >= OPAQUE
        rows, cols = np.nonzero(known & self.masks.load(view))
        points = unproject(view.camera, rows, cols, depth[rows, cols])
        seen = np.zeros(len(rows), int)
        for other, coarse in self._depth.items():
            if other != index:
                seen += sees(*coarse, points)
        known[rows[seen < SEEN_BY], cols[seen < SEEN_BY]] = False
        return image, known

    def _render(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        from ambiguous_wild.splat.render import render

        drawn = render(self._gaussians, camera, sh_degree=self._gaussians.sh_degree)
        alpha = drawn.alpha.numpy()
        depth = drawn.depth.numpy() / np.maximum(alpha, 1e-6)
        return drawn.image.numpy().clip(0.0, 1.0), alpha, depth

    def _coarse(self, view: View) -> tuple[Camera, np.ndarray, np.ndarray]:
        """A camera of about a quarter of the size, its depth, and where it sees the static scene."""
        import cv2

        width, height = max(view.camera.width // 4, 16), max(view.camera.height // 4, 16)
        camera = view.camera.resized(width, height)
        _, alpha, depth = self._render(camera)
        # Any masked pixel masks the coarse one: it must not vouch for what it half sees.
        masked = self.masks.load(view).astype(np.uint8)
        static = cv2.resize(masked * 255, (width, height), interpolation=cv2.INTER_AREA) == 0
        return camera, depth, static & (alpha >= OPAQUE)


def check_run(scene: Scene, run: Path) -> None:
    """Make sure that the run is finished and of this scene.

    Raises:
        AwError: what is wrong, and what to do.
    """
    from ambiguous_wild.harness.running.identity import scene_identity

    path = run / "config.yaml"
    if not path.is_file() or not (run / "point_cloud.ply").is_file():
        raise AwError(
            f"{run} is no finished run (config.yaml and point_cloud.ply); give a folder of 'aw bench', "
            "RUNS/SCENE/METHOD/seed0"
        )
    try:
        config = plain_yaml.read_mapping(path)
        known, name = config["scene"]["sha256"], config["scene"]["name"]
    except (AwError, KeyError, TypeError) as error:
        raise AwError(f"{path} is damaged ({' '.join(str(error).split())}); train the run again") from None
    if known != scene_identity(scene):
        raise AwError(
            f"{run} was trained on scene {name!r} with other photos, split or size than {scene.root}; "
            "train on this one: 'aw bench --scene'"
        )


def unproject(
    camera: Camera,
    rows: np.ndarray,  # [P]
    cols: np.ndarray,  # [P]
    depth: np.ndarray,  # [P] z
) -> np.ndarray:  # [P, 3] world
    """World points of pixel centres at a depth."""
    x = (cols + 0.5 - camera.cx) / camera.fx * depth
    y = (rows + 0.5 - camera.cy) / camera.fy * depth
    rotation, translation = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    return (np.stack([x, y, depth], axis=1) - translation) @ rotation


def sees(
    camera: Camera,
    depth: np.ndarray,  # [h, w] z
    static: np.ndarray,  # [h, w] bool: opaque and outside the mask
    points: np.ndarray,  # [P, 3] world
) -> np.ndarray:  # [P] bool
    """Whether the camera sees each point: inside the picture, at its surface, outside the mask."""
    local = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    z = np.maximum(local[:, 2], 1e-9)
    cols = np.floor(np.clip(camera.fx * local[:, 0] / z + camera.cx, -1, camera.width)).astype(int)
    rows = np.floor(np.clip(camera.fy * local[:, 1] / z + camera.cy, -1, camera.height)).astype(int)
    inside = (local[:, 2] > 1e-6) & (cols >= 0) & (cols < camera.width) & (rows >= 0) & (rows < camera.height)
    r, c = rows.clip(0, camera.height - 1), cols.clip(0, camera.width - 1)
    return inside & static[r, c] & (np.abs(depth[r, c] - z) <= DEPTH_SLACK * z)


def _load(run: Path):
    import torch

    from ambiguous_wild.io.ply import read_splat_ply
    from ambiguous_wild.splat.gaussians import Gaussians

    arrays = read_splat_ply(run / "point_cloud.ply")
    found: dict[str, Any] = {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in arrays.items()}
    return Gaussians(**found)
