"""Masks corrected by hand: the file that the page of `aw view` saves and `aw bench --corrections` reads.

    {"version": 1, "scene": NAME, "photos": {PHOTO: "data:image/png;base64,..."}}

A picture has the aspect of its photo: 0 = distractor, 255 = static, grey = as the method says.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambiguous_wild.core import AwError, Camera, Scene
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.io.files import sha256_file, write_bytes
from ambiguous_wild.io.page_parts import png_of
from ambiguous_wild.io.untrusted import read_bytes, read_json

CORRECTIONS = "corrections.json"
VERSION = 1
MAX_SIDE = 4096  # px of a picture
LEAST_SHARE = 0.02  # of the photo's width
MAX_BYTES = 100_000_000
_MASKED, _STATIC = 64, 192  # codes below and above: what the resizing of a page leaves near black and white


@dataclass(frozen=True)
class CorrectionsFile:
    """A file of corrections, and the hash of its content when the run was planned."""

    path: Path
    sha256: str

    @classmethod
    def of(cls, path: Path) -> CorrectionsFile:
        """Hash the file.

        Raises:
            AwError: it cannot be read.
        """
        read_bytes(path, MAX_BYTES)
        return cls(path.resolve(), sha256_file(path))

    def record(self) -> dict[str, str]:
        """Return the entry in config.yaml."""
        return {"sha256": self.sha256, "path": str(self.path)}

    def copy(self, target: Path) -> None:
        """Write the file's content to `target`, unless it is there."""
        if not target.is_file() or sha256_file(target) != self.sha256:
            write_bytes(target, [read_bytes(self.path, MAX_BYTES)])

    def masks(self, scene: Scene) -> dict[str, np.ndarray]:
        """Return the corrections [h, w] uint8 of the scene's train photos, by the photo's name.

        Raises:
            AwError: the file has changed, is of another scene, damaged or empty, or names no train photo.
        """
        if sha256_file(self.path) != self.sha256:
            raise AwError(f"{self.path} has changed since the run was planned; bench again")
        content = read_json(self.path)
        photos = content.get("photos") if isinstance(content, dict) else None
        if not isinstance(photos, dict) or content.get("version") != VERSION:
            raise AwError(
                f"{self.path} holds no corrections of version {VERSION}: save them in the page of 'aw view'"
            )
        if content.get("scene") != scene.name:
            raise AwError(
                f"{self.path} corrects scene {content.get('scene')!r}, not {scene.name!r}: give the file of "
                "this scene"
            )
        if not photos:
            raise AwError(
                f"{self.path} corrects no photo: correct a mask in the page of 'aw view', then save"
            )
        cameras = {view.name: view.camera for view in scene.train}
        for name in photos:
            if name in {view.name for view in scene.test}:
                raise AwError(f"{self.path} corrects {name}, a test photo: only train photos have masks")
            if name not in cameras:
                raise unknown(f"train photo in {self.path}", name, list(cameras))
        return {name: self._picture(name, text, cameras[name]) for name, text in photos.items()}

    def _picture(self, name: str, text: object, camera: Camera) -> np.ndarray:
        where = f"{self.path}: the correction of {name}"
        picture = png_of(text, MAX_SIDE, MAX_SIDE)
        if picture is None:
            raise AwError(
                f"{where} is no whole PNG of up to {MAX_SIDE} px; save it in the page of 'aw view' again"
            )
        height, width = picture.shape
        expected = width * camera.height / camera.width
        if abs(height - expected) > 1 or width < LEAST_SHARE * camera.width:
            raise AwError(f"{where} is {width}x{height} px, the photo {camera.width}x{camera.height}")
        return picture


def recorded_corrections(record: dict[str, str] | None) -> CorrectionsFile | None:
    """Return the file that the key "corrections" of a run's config.yaml names; None without the key."""
    return CorrectionsFile(Path(record["path"]), record["sha256"]) if record else None


def corrected(
    keep: np.ndarray | None, correction: np.ndarray | None, camera: Camera
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Apply a correction to the capture's own keep map.

    Args:
        keep: [H, W] float32, 1 = static; None = all is.
        correction: [h, w] uint8; None = the photo was not corrected.
        camera: of the photo, H x W.

    Returns:
        the keep map, and what was marked by hand: 1 = static, -1 = distractor, 0 = nothing; both [H, W]
        float32 or None.
    """
    if correction is None:
        return keep, None
    import cv2

    resized = cv2.resize(correction, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
    by_hand = (resized > _STATIC).astype(np.float32) - (resized < _MASKED)
    own = np.ones_like(by_hand) if keep is None else keep
    return np.where(by_hand == 0, own, by_hand > 0).astype(np.float32), by_hand.astype(np.float32)
