"""Undistort photos, masks and truth to pinhole cameras, with one map a camera.

COLMAP chooses the pinhole camera (no blank pixels). Resampling is our own, because masks (nearest pixel) and
photos (bicubic, once, without another JPEG) need the same map.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np

from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import ScreenedPhoto, UndistortResult
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.colmap_model import write_model
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera, ModelImage
from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.safe_pycolmap import pycolmap

TRUTH_PARTS = ("distractor", "clean")
MOST_LOST = 0.9  # share of the photo that is kept, below which a message says so
LEAST_SHARE, MOST_SHARE = 0.1, 1.1  # plausible shares of the photo that undistortion keeps
NEGLIGIBLE_PX = 0.1  # distortion below this everywhere is ignored


@dataclasses.dataclass(frozen=True)
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
        rays = np.asarray(self.camera.cam_from_img(np.ascontiguousarray(xys)))
        return rays * [fx, fy] + [cx, cy]


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
    if not LEAST_SHARE < share < MOST_SHARE:
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


def undistort(
    folder: Path,
    model: ColmapModel,
    facts: list[ScreenedPhoto],
    read: Callable[[ScreenedPhoto], np.ndarray],
    masks: Path | None,
    truth: Path | None,
    *,
    jobs: int,
    bar: Bar,
) -> UndistortResult:
    """Write `images/`, `masks/`, `truth/` at full size and `sparse/0` of the registered photos.

    Args:
        folder: folder of the stage, empty.
        model: the chosen model, named by work names.
        facts: screened photos.
        read: gives a photo's pixels, [H, W, 3] uint8, upright.
        masks: folder of `<work name>.png`, or None.
        truth: the capture's truth folder, or None.
        jobs: threads.
        bar: progress.
    """
    by_name = {f["work_name"]: f for f in facts}
    lenses: dict[int, Lens] = {}
    shared = len(model.cameras) < len(model.images)
    if shared:
        lenses = {number: make_lens(camera) for number, camera in model.cameras.items()}
    bar.start("undistorting", len(model.images))

    def one(image: ModelImage) -> tuple[ModelImage, ModelCamera, list[str]]:
        fact = by_name[image.name]
        lens = lenses[image.camera_id] if shared else make_lens(model.cameras[image.camera_id])
        name = fact["stem"] + ".png"
        write_png(folder / "images" / name, lens.remap(read(fact), nearest=False))
        if masks is not None:
            mask = read_gray(masks / f"{image.name}.png")
            write_png(folder / "masks" / name, lens.remap(mask, nearest=True))
        parts = _truth(folder, lens, fact, truth) if truth is not None else []
        bar.step()
        flat = dataclasses.replace(image, name=name, xys=lens.undistort_points(image.xys))
        return flat, lens.pinhole, parts

    with ThreadPoolExecutor(jobs) as pool:
        done = list(pool.map(one, model.images.values()))
    bar.finish()
    if lenses and (least := min(lens.share for lens in lenses.values())) < MOST_LOST:
        bar.say(f"undistortion leaves {least:.0%} of the photos, the middle of what the lens sees")
    cameras, images = {c.camera_id: c for _, c, _ in done}, {image.image_id: image for image, _, _ in done}
    write_model(folder / "sparse" / "0", ColmapModel(cameras, images, model.points))
    photos_with = {part: sum(part in parts for _, _, parts in done) for part in TRUTH_PARTS}
    return {"truth": photos_with if truth is not None else None}


def _truth(folder: Path, lens: Lens, fact: ScreenedPhoto, truth: Path) -> list[str]:
    """Undistort the truth of one photo: the mask by nearest pixel, the clean photo like the photo."""
    parts = PurePosixPath(fact["source"]).with_suffix("").parts
    original = "/".join(parts[parts[0] in ("train", "test", "images") :])
    written = []
    for part in TRUTH_PARTS:
        path = truth / part / f"{original}.png"
        if not path.is_file():
            continue
        pixels = read_gray(path) if part == "distractor" else read_png_rgb(path)
        if pixels.shape[:2] != (fact["height"], fact["width"]):
            raise AwError(
                f"{path} is {pixels.shape[1]}x{pixels.shape[0]} but its photo "
                f"{fact['width']}x{fact['height']}: the truth belongs to another capture; remove truth/ "
                "or make the capture again"
            )
        flat = lens.remap(pixels, nearest=part == "distractor")
        write_png(folder / "truth" / part / f"{fact['stem']}.png", flat)
        written.append(part)
    return written
