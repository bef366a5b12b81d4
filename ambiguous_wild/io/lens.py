"""Lenses: photos, masks and points between a distorted camera and the pinhole camera that replaces it.

COLMAP chooses the pinhole camera (no blank pixels). Resampling is our own, because masks (nearest pixel) and
photos (bicubic, once, without another JPEG) need the same map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.colmap_records import ModelCamera
from ambiguous_wild.io.safe_pycolmap import pycolmap

MIN_SHARE, MAX_SHARE = 0.1, 1.1  # plausible shares of the photo that undistortion keeps
NEGLIGIBLE_PX = 0.1  # distortion below this everywhere is ignored
_GRID = 4  # px; between the points of such a grid the map back is linear to hundredths of a px


@dataclass(frozen=True)
class Lens:
    """A camera with distortion, the pinhole camera that replaces it, and the map between their pixels."""

    camera: Any  # pycolmap.Camera
    pinhole: ModelCamera
    # [H, W] float32 each: source of every pixel; None: no map needed
    map_xy: tuple[np.ndarray, np.ndarray] | None
    share: float = 1.0  # share of the photo that the pinhole camera sees
    shear: float = 0.0  # as in `ModelCamera`

    def remap(self, image: np.ndarray, *, nearest: bool) -> np.ndarray:
        """Resample an image [H, W] or [H, W, 3] of the distorted camera to the pinhole camera."""
        if self.map_xy is None:
            return image
        how = cv2.INTER_NEAREST if nearest else cv2.INTER_CUBIC
        # The map may reach half a pixel beyond the border, which reflection fills.
        return cv2.remap(image, *self.map_xy, how, borderMode=cv2.BORDER_REFLECT_101)

    def undistort_points(self, xys: np.ndarray) -> np.ndarray:
        """Map points [K, 2] px of the distorted camera to px of the pinhole camera."""
        if not len(xys):
            return xys
        fx, fy, cx, cy = self.pinhole.pinhole()
        xys = xys - self.shear * (xys[:, 1:] - self.camera.principal_point_y) * [1, 0]
        normalised = np.asarray(self.camera.cam_from_img(np.ascontiguousarray(xys)))
        return normalised * [fx, fy] + [cx, cy]

    def distort(self, picture: np.ndarray) -> np.ndarray:
        """Resample a picture of the pinhole camera to the pixels of the photo, the way back of `remap`.

        Args:
            picture: [h, w] or [h, w, 3] float32, the pinhole camera's frame at any size.

        Returns:
            [H, W] or [H, W, 3] float32, bilinear. What the pinhole camera does not see continues its border.
        """
        width, height = self.camera.width, self.camera.height
        scale = np.array([picture.shape[1], picture.shape[0]]) / [self.pinhole.width, self.pinhole.height]
        x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
        flat: np.ndarray = np.stack(np.meshgrid(x, y), axis=-1)
        if self.map_xy is not None:
            # Undistorting is iterative, so few points are undistorted, and those between are interpolated.
            rows, columns = (np.linspace(0, side, side // _GRID + 2) for side in (height, width))
            few = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
            seen = self.undistort_points(few).reshape(len(rows), len(columns), 2)
            down = _between(seen, height)
            flat = _between(down.transpose(1, 0, 2), width).transpose(1, 0, 2)
        source = (flat * scale - 0.5).astype(np.float32)  # OpenCV counts from pixel centres
        return cv2.remap(
            picture, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )


def _between(values: np.ndarray, side: int) -> np.ndarray:
    """Interpolate values [K, N, 2], at even distances from 0 to `side` px, at the centres of pixels."""
    at = (np.arange(side) + 0.5) * (len(values) - 1) / side
    low = at.astype(np.intp)
    part = (at - low)[:, None, None]
    return values[low] * (1 - part) + values[low + 1] * part


def make_lens(camera: ModelCamera) -> Lens:
    """Choose the pinhole camera and compute the map; source: COLMAP's undistort_camera.

    Where the distortion is negligible the photo stays as it is: COLMAP would shrink the camera by a pixel
    and shift it by half a pixel, which blurs.
    """
    try:
        lens = pycolmap.Camera(
            model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
        )
    except ValueError as error:
        raise AwError(f"this pycolmap has no camera model {camera.model}; update it ({error})") from None
    fx, fy = lens.focal_length_x, lens.focal_length_y
    same = (fx, fy, lens.principal_point_x, lens.principal_point_y)
    plain = ModelCamera(camera.camera_id, "PINHOLE", camera.width, camera.height, same)
    grid, source = _source_pixels(lens, plain, camera.shear)
    if np.abs(source - grid).max() < NEGLIGIBLE_PX:
        return Lens(lens, plain, None)
    flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    params = tuple(float(v) for v in flat.params)
    pinhole = ModelCamera(camera.camera_id, "PINHOLE", flat.width, flat.height, params)
    _, source = _source_pixels(lens, pinhole, camera.shear)
    index = (source - 0.5).astype(np.float32)  # OpenCV counts from pixel centres
    x, y = np.concatenate([source[0], source[:, -1], source[-1, ::-1], source[::-1, 0]]).T
    share = float(abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2 / (camera.width * camera.height))
    if not MIN_SHARE < share < MAX_SHARE:
        raise AwError(
            f"camera {camera.camera_id} ({camera.model}, parameters {list(camera.params)}): undistorted, it "
            f"sees {100 * share:.3g} % of its photo: check the parameters, or split the photos"
        )
    maps = np.ascontiguousarray(index[..., 0]), np.ascontiguousarray(index[..., 1])
    return Lens(lens, pinhole, maps, share, camera.shear)


def _source_pixels(lens: Any, pinhole: ModelCamera, shear: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pixel centres of the pinhole camera, and where the lens sees them: [H, W, 2] px each."""
    fx, fy, cx, cy = pinhole.pinhole()
    grid = np.stack(np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5), axis=-1)
    rays = np.concatenate([(grid - [cx, cy]) / [fx, fy], np.ones((*grid.shape[:2], 1))], axis=-1)
    source = np.asarray(lens.img_from_cam(rays.reshape(-1, 3))).reshape(grid.shape)
    source[..., 0] += shear * (source[..., 1] - lens.principal_point_y)
    return grid, source
