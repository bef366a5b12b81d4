"""Photos of an imported scene: linked if they can be used unchanged, else undistorted or reduced."""

from __future__ import annotations

import dataclasses
import os
import shutil
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.builder.resample import MAX_LOST, downsample_mask, downsample_photo, downsampled_size
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.datasets.foreign import ForeignScene
from ambiguous_wild.datasets.photo_names import find_photo
from ambiguous_wild.io.colmap_records import ONE_FOCAL, ColmapModel, ModelCamera, ModelImage
from ambiguous_wild.io.images import (
    MAX_PIXELS,
    file_colours,
    header_size,
    orientation,
    read_alpha,
    read_mask,
    read_png_rgb,
    upright,
    write_png,
)
from ambiguous_wild.io.lens import Lens, make_lens
from ambiguous_wild.io.photos import FROM_PROFILE
from ambiguous_wild.io.safe_pycolmap import pycolmap
from ambiguous_wild.io.scene_checks import other_pictures
from ambiguous_wild.io.scene_folder import refuse_same_stems, shipped_factors, without_suffix

ENOUGH_POINTS = 20  # points in a photo whose colours show which way it was turned
TURNED = 0.7  # a photo was turned if that reduces the difference of colours below this share
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
BACK = {5: 5, 6: 8, 7: 7, 8: 6}  # EXIF orientations that exchange the sides -> the one that undoes it


@dataclass(frozen=True)
class PhotoPlan:
    """How one photo is put into the scene."""

    image: ModelImage
    source: Path
    camera: ModelCamera  # at the size of `source`
    small: Path | None  # a downsampled copy that is linked
    convert: bool  # its pixels change, so a PNG is written
    orientation: int = 1  # EXIF orientation that was applied to the model's photo; COLMAP applies none


@dataclass(frozen=True)
class PlacedPhoto:
    """A photo that is in the scene folder."""

    image: ModelImage  # with its new name and positions
    camera: ModelCamera  # pinhole
    notes: tuple[str, ...]  # what was done to it
    source: str  # relative to the dataset


def at_photo_size(scene: ForeignScene) -> tuple[ForeignScene, float]:
    """Scale the scene's cameras and observations to the size of its photos.

    Returns:
        The scene, and how many times smaller than their cameras the photos are: the median; 1 = same size.
    """
    folder, cameras, taken = scene.photo_folder, dict(scene.model.cameras), dict[tuple[int, int, int], int]()
    images, ratios = {}, []
    for number, image in scene.model.images.items():
        images[number] = image
        camera = scene.model.cameras[image.camera_id]
        photo = find_photo(folder, image.name) if image.name in scene.split else None
        size = header_size(photo) if photo is not None else None
        if size is None or not _same_shape(size, (camera.width, camera.height)):
            continue  # `plan_photos` reports it
        ratios.append(camera.width / size[0])
        if abs(ratios[-1] - 1) < 0.02:
            continue
        if (key := (image.camera_id, *size)) not in taken:
            taken[key] = max(cameras) + 1
            cameras[taken[key]] = dataclasses.replace(resized(camera, *size), camera_id=taken[key])
        xys = image.xys * (np.array(size) / (camera.width, camera.height))
        images[number] = dataclasses.replace(image, camera_id=taken[key], xys=xys)
    used = {image.camera_id for image in images.values()}
    cameras = {number: camera for number, camera in cameras.items() if number in used}
    model = ColmapModel(cameras, images, scene.model.points)
    times = float(np.median(ratios)) if ratios and taken else 1.0
    return dataclasses.replace(scene, model=model) if taken else scene, times


def plan_photos(scene: ForeignScene) -> list[PhotoPlan]:
    """Find every photo of the split and check its size.

    Raises:
        AwError: photos are absent, are no images, or have another shape than their cameras.
    """
    folder = scene.photo_folder
    absent, wrong, plans = [], [], []
    for image in sorted(scene.model.images.values(), key=lambda i: i.name):
        if image.name not in scene.split:
            continue
        source = find_photo(folder, image.name)
        if source is None:
            absent.append(image.name)
            continue
        camera = scene.model.cameras[image.camera_id]
        size = header_size(source)
        if size is None:
            wrong.append(f"{image.name} (no image)")
        elif size[0] * size[1] > MAX_PIXELS:
            wrong.append(
                f"{image.name} ({size[0]}x{size[1]}, more than {MAX_PIXELS // 1_000_000} megapixels)"
            )
        elif (tag := _orientation(scene.model, image, source, size)) is None:
            turned = ", turned" if _same_shape(size[::-1], (camera.width, camera.height)) else ""
            needed = f"its camera {camera.width}x{camera.height}{turned}"
            wrong.append(f"{image.name} ({size[0]}x{size[1]}, {needed})")
        else:
            size = size[::-1] if tag > 4 else size
            plans.append(_plan(scene, image, source, camera, size, tag))
    refuse_same_stems(scene.root, sorted(scene.split))
    total = len(scene.split)
    if absent:
        there = shortlist(sorted(p.name for p in scene.root.iterdir() if p.is_dir()))
        factors = shipped_factors(scene.root)
        where, cure = f"{folder}", "copy all of the dataset"
        if not folder.is_dir():
            where = f"{scene.photos}, which is absent; {scene.root} holds {there}"
            cure += f", or read a reduced copy by --factor {factors[0]}" if factors else ""
        raise AwError(
            f"{len(absent)} of {total} photos that the model registers are not in {where}: "
            f"{shortlist(absent, 3)}; {cure}, or list those that are there: train_list.txt, test_list.txt"
        )
    if wrong:
        raise AwError(
            f"{len(wrong)} of {total} photos in {folder} do not fit the model: {shortlist(wrong, 3)}; use "
            "the photos that the model was built from"
        )
    if other := other_pictures([(plan.small, plan.source) for plan in plans if plan.small is not None]):
        raise AwError(
            f"{scene.root}: photos in images_{scene.factor} do not show what their full photos show "
            f"({shortlist(other, 3)}); remove images_{scene.factor} to make it anew"
        )
    return plans


def _orientation(model: ColmapModel, image: ModelImage, source: Path, size: tuple[int, int]) -> int | None:
    """Return the EXIF orientation if the model was made of the upright photo, else 1; None: neither fits.

    The shape of the camera decides; where both shapes fit, the colours of the points do.
    """
    tag, camera = orientation(source), model.cameras[image.camera_id]
    shape = (camera.width, camera.height)
    fits = _same_shape(size, shape), tag > 1 and _same_shape(size[::-1] if tag > 4 else size, shape)
    if not all(fits):
        return 1 if fits[0] else tag if fits[1] else None
    lens = lens_of(resized(camera, *size))
    # Points are projected, because not every model has observations.
    xyz = model.points.xyz @ image.cam_from_world()[:3, :3].T + image.tvec
    front = xyz[:, 2] > 0
    xyz, colours = xyz[front], model.points.rgb[front].astype(float)
    fx, fy, cx, cy = lens.pinhole.pinhole()
    x, y = (xyz[:, :2] / xyz[:, 2:] * (fx, fy) + (cx, cy)).T
    shown = (x >= 0) & (x < lens.pinhole.width) & (y >= 0) & (y < lens.pinhole.height)
    if shown.sum() < ENOUGH_POINTS:
        return 1
    at = y[shown].astype(int), x[shown].astype(int)
    stored = read_png_rgb(source)
    flat = (lens.remap(pixels, nearest=False)[at] for pixels in (stored, upright(stored, tag)))
    as_is, turned = (float(np.abs(pixels - colours[shown]).mean()) for pixels in flat)
    return tag if turned < TURNED * as_is else 1


def _plan(
    scene: ForeignScene,
    image: ModelImage,
    source: Path,
    camera: ModelCamera,
    size: tuple[int, int],
    tag: int,
) -> PhotoPlan:
    lens = lens_of(resized(camera, *size)) if camera.model not in PINHOLES else None
    wide = scene.max_width is not None and size[0] > scene.max_width
    convert = (
        (lens is not None and lens.map_xy is not None)
        or wide
        or scene.background is not None
        or tag > 1
        or bool(file_colours(source).name)
    )
    small = None
    if scene.factor > 1 and not convert and not scene.only_small:
        small = find_photo(scene.root / f"images_{scene.factor}", image.name)
        found = header_size(small) if small is not None else None
        if found is not None and not _same_shape(found, size):
            raise AwError(
                f"{small} is {found[0]}x{found[1]}, another shape than {source} ({size[0]}x{size[1]}): it is "
                f"no copy of it; remove images_{scene.factor} to make it anew"
            )
    at_size = camera if not (convert or scene.only_small) else resized(camera, *size)
    return PhotoPlan(image, source, at_size, small, convert, tag)


@lru_cache(maxsize=4)  # a map of a photo of 12 megapixels takes 98 MB
def lens_of(camera: ModelCamera) -> Lens:
    """Return the lens of a camera; cached, because most datasets have one camera for all photos."""
    if camera.model not in PINHOLES:
        return make_lens(camera)
    size = (camera.width, camera.height)
    lens = pycolmap.Camera(model=camera.model, width=size[0], height=size[1], params=list(camera.params))
    return Lens(lens, ModelCamera(camera.camera_id, "PINHOLE", *size, camera.pinhole()), None)


def _same_shape(size: tuple[int, int], wanted: tuple[int, int]) -> bool:
    return abs(size[0] * wanted[1] / wanted[0] - size[1]) <= max(2.0, 0.02 * size[1])


def resized(camera: ModelCamera, width: int, height: int) -> ModelCamera:
    """Return the camera of the same photo at another size, which does not change lens distortion."""
    if (camera.width, camera.height) == (width, height):
        return camera
    sx, sy = width / camera.width, height / camera.height
    values = list(camera.params)
    if camera.model in ONE_FOCAL:
        # The model has one focal length for both axes, whose scales differ by rounding only.
        values[0] *= (sx + sy) / 2
        values[1], values[2] = values[1] * sx, values[2] * sy
    else:
        for index, scale in enumerate((sx, sy, sx, sy)):
            values[index] *= scale
    return dataclasses.replace(camera, width=width, height=height, params=tuple(values))


def place_photo(plan: PhotoPlan, scene: ForeignScene, folder: Path) -> PlacedPhoto:
    """Put the photo into the scene folder at full size and at the factor; existing files stay.

    Args:
        plan: what `plan_photos` decided.
        scene: the dataset's scene.
        folder: the unfinished scene folder.
    """
    stem = without_suffix(plan.image.name)
    lens = lens_of(plan.camera)
    notes: list[str] = []
    full = folder / (f"images_{scene.factor}" if scene.only_small else "images")
    factor = 1 if scene.only_small else scene.factor
    pinhole = lens.pinhole
    if not plan.convert:
        name = _as(plan.image.name, plan.source.suffix)
        link_file(plan.source, full / name)
        if factor > 1:
            if plan.small is not None:
                link_file(plan.small, folder / f"images_{factor}" / _as(name, plan.small.suffix))
            else:
                notes.append(f"downsampled by {factor}")
                _reduce(read_png_rgb(plan.source), folder / f"images_{factor}" / f"{stem}.png", factor)
        image = dataclasses.replace(plan.image, name=name)
        return _placed(scene, plan, image, pinhole, notes)
    name = f"{stem}.png"
    wide = scene.max_width is not None and pinhole.width > scene.max_width
    target = pinhole
    if wide and scene.max_width is not None:
        height = max(1, round(pinhole.height * scene.max_width / pinhole.width))
        target = resized(pinhole, scene.max_width, height)
        notes.append(f"reduced to {scene.max_width} px")
    if lens.map_xy is not None:
        lost = f" without {100 * (1 - lens.share):.0f} % of the photo" if lens.share < MAX_LOST else ""
        notes.insert(0, f"undistorted{lost}")
    if plan.orientation > 1:
        notes.insert(0, f"turned upright (EXIF orientation {plan.orientation})")
    if profile := file_colours(plan.source).name:
        notes.insert(0, f"{FROM_PROFILE} {profile}")
    if scene.background is not None:
        notes.insert(0, "composited over a background of {}, {}, {}".format(*scene.background))
    small = folder / f"images_{factor}" / name
    if not (full / name).is_file() or (factor > 1 and not small.is_file()):
        pixels = lens.remap(upright(_read(plan.source, scene.background), plan.orientation), nearest=False)
        if wide:
            pixels = downsample_photo(pixels, target.width, target.height)
        write_png(full / name, pixels)
        if factor > 1:
            _reduce(pixels, small, factor)
    if factor > 1:
        notes.append(f"downsampled by {factor}")
    xys = _points_at(plan, scene, lens)
    scale = np.array([target.width / pinhole.width, target.height / pinhole.height])
    image = dataclasses.replace(plan.image, name=name, xys=xys * scale)
    return _placed(scene, plan, image, target, notes)


def _placed(
    scene: ForeignScene, plan: PhotoPlan, image: ModelImage, camera: ModelCamera, notes: list[str]
) -> PlacedPhoto:
    source = plan.source.relative_to(scene.root).as_posix()
    return PlacedPhoto(image, camera, tuple(notes) or ("linked",), source)


def _as(name: str, suffix: str) -> str:
    return name if name.endswith(suffix) else without_suffix(name) + suffix


def _points_at(plan: PhotoPlan, scene: ForeignScene, lens: Lens) -> np.ndarray:
    """Map observations [K, 2] px of the model's camera to px of the pinhole camera."""
    camera = scene.model.cameras[plan.image.camera_id]
    scale = np.array([plan.camera.width / camera.width, plan.camera.height / camera.height])
    return lens.undistort_points(plan.image.xys * scale)


def _read(path: Path, background: tuple[int, int, int] | None) -> np.ndarray:
    """Read [H, W, 3] uint8; a photo with alpha is composited over the background."""
    if background is None:
        return read_png_rgb(path)
    data = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if data is None or data.dtype not in (np.uint8, np.uint16) or data.ndim != 3 or data.shape[2] != 4:
        return read_png_rgb(path)
    data = data // 257 if data.dtype == np.uint16 else data
    alpha = data[..., 3:].astype(np.float32) / 255
    rgb = data[..., 2::-1].astype(np.float32)
    behind = np.array(background, np.float32) * (1 - alpha)
    return np.asarray(rgb * alpha + behind + 0.5).astype(np.uint8)


def _reduce(pixels: np.ndarray, path: Path, factor: int) -> None:
    if path.is_file():
        return
    width, height = downsampled_size(pixels.shape[1], pixels.shape[0], factor)
    write_png(path, downsample_photo(pixels, width, height))


def place_mask(plan: PhotoPlan, placed: PlacedPhoto, scene: ForeignScene, folder: Path) -> bool:
    """Write the keep mask of a photo, mask file times alpha, at the size that is trained on.

    Returns:
        Whether the photo's alpha hides pixels.

    Raises:
        AwError: it has another size than its photo, or is no mask.
    """
    mask = scene.masks.get(plan.image.name)
    alpha = read_alpha(plan.source) if scene.background is None else None
    side = scene.split[plan.image.name]
    target = folder / "masks" / side / f"{without_suffix(placed.image.name)}.png"
    if target.is_file() or (mask is None and alpha is None):
        return alpha is not None
    alpha = upright(alpha, plan.orientation) if alpha is not None else None
    pixels = upright(read_mask(mask), orientation(mask)) if mask is not None else np.asarray(alpha)
    stored = header_size(plan.source) or (plan.camera.width, plan.camera.height)
    size = stored[::-1] if plan.orientation > 4 else stored
    height, width = pixels.shape
    # A mask may be drawn on the photo as stored or as shown, whatever the model was made of.
    turned = plan.orientation if plan.orientation > 4 else BACK.get(orientation(plan.source), 1)
    if size != (width, height) == size[::-1] and turned > 4:
        pixels = upright(pixels, turned)
        height, width = pixels.shape
    final = (placed.camera.width, placed.camera.height)
    if scene.factor > 1 and not scene.only_small:
        final = downsampled_size(*final, scene.factor)
    if (width, height) == size:
        flat = lens_of(plan.camera).remap(pixels, nearest=True) if plan.convert else pixels
    elif (width, height) == final and not plan.convert:
        flat = pixels
    else:
        raise AwError(
            f"{mask} is {width}x{height} but its photo {plan.source.name} {size[0]}x{size[1]}: it is the "
            "mask of another size or photo; correct it, or pass --no-masks"
        )
    if mask is not None and alpha is not None:
        hidden = lens_of(plan.camera).remap(alpha, nearest=True) if plan.convert else alpha
        flat = np.minimum(flat, cv2.resize(hidden, flat.shape[::-1], interpolation=cv2.INTER_NEAREST))
    if (flat.shape[1], flat.shape[0]) != final:
        flat = downsample_mask(flat, *final)
    write_png(target, np.where(flat >= 128, 255, 0).astype(np.uint8))
    return alpha is not None


def link_file(source: Path, target: Path) -> None:
    """Link `source` at `target` without copying: hard, else symbolic, else a copy."""
    if target.exists():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    real = source.resolve()
    for link in (os.link, os.symlink):
        try:
            link(real, target)
            return
        except OSError:  # the target is on another disk, or its file system has no links
            continue
    shutil.copyfile(real, target)
