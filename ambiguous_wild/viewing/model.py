"""A trained model as it is shown: how it is drawn, its scene's frame, its export in other formats."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, Camera, Place, Scene, View
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.core.scene import together
from ambiguous_wild.io import compressed_ply, gltf, sog, spz
from ambiguous_wild.io.files import sweep_killed
from ambiguous_wild.io.images import read_png_rgb, to_uint8
from ambiguous_wild.io.ply import read_place, read_splat_ply, rescaled, splat_count
from ambiguous_wild.metrics.image import psnr


@dataclass(frozen=True)
class Space:
    """A scene's frame, world units."""

    up: np.ndarray  # [3] unit vector
    middle: np.ndarray  # [3] where the cameras look
    distance: float  # mean of the cameras from the middle
    extent: float  # radius of the camera positions, see `Scene.extent`


def space_of(scene: Scene) -> Space:
    """Up is the mean of the photos' own up; the middle lies at the median depth of what each photo shows."""
    views = together(scene.train or scene.views)
    poses = np.array([v.camera.cam_from_world for v in views])
    up = -poses[:, 1, :3].mean(axis=0)
    size = np.linalg.norm(up)
    up = up / size if size > 1e-6 else -poses[0, 1, :3]
    centers = np.array([v.camera.center for v in views])
    depths = np.array([_median_depth(pose, scene.points.xyz) for pose in poses])
    known = np.isfinite(depths)
    depths = np.where(known, depths, np.median(depths[known]) if known.any() else scene.extent)
    middle = (centers + poses[:, 2, :3] * depths[:, None]).mean(axis=0)
    distance = float(np.linalg.norm(centers - middle, axis=1).mean())
    return Space(up=up, middle=middle, distance=max(distance, 1e-6), extent=scene.extent)


def _median_depth(pose: np.ndarray, points: np.ndarray) -> float:
    """Of the points in a cone of 45 degrees around the view's axis; NaN where there is none."""
    if not len(points):
        return np.nan
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    ahead = (seen[:, 2] > 0) & (np.linalg.norm(seen[:, :2], axis=1) < seen[:, 2])
    return float(np.median(seen[ahead, 2])) if ahead.any() else np.nan


Arrays = Mapping[str, np.ndarray]  # raw parameters, see `io.ply.read_splat_ply`


@dataclass(frozen=True)
class RenderSettings:
    """How a method draws its Gaussians."""

    sh_degree: int = 3
    antialias: bool = False  # Mip-Splatting's 2D filter
    blur: float = 0.3  # px^2 added to both variances of a splat
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Model:
    """One method's model of a scene."""

    label: str  # unique among the models that are shown together
    ply: Path
    look: RenderSettings = field(default_factory=RenderSettings)
    psnr: Mapping[str, float] = field(default_factory=dict)  # dB by name of the test view
    masks: Path | None = None  # folder of keep maps of train views, white = keep
    reference: bool = False  # it saw exact masks or clean photos, so it is no rival

    def read(self) -> dict[str, np.ndarray]:
        """The Gaussians.

        Raises:
            AwError: no splat PLY.
        """
        return read_splat_ply(self.ply)

    @property
    def count(self) -> int:
        """Number of Gaussians, from the file's header."""
        return splat_count(self.ply)


class Renderer:
    """Renders one model on the CPU, with the kernels it was trained with."""

    def __init__(self, gaussians: Arrays, look: RenderSettings) -> None:
        """
        Args:
            gaussians: raw parameters; of none nothing can be drawn.
            look: how they are drawn.

        Raises:
            AwError: there is no Gaussian.
        """
        import torch

        from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians

        if not len(gaussians["means"]):
            raise AwError("the model has no Gaussian: there is nothing to draw")
        tensors: dict[str, Any] = {
            name: torch.from_numpy(np.array(gaussians[name], np.float32)) for name in PARAMETERS
        }
        self._gaussians = Gaussians(**tensors)
        self._look = look

    def __call__(self, camera: Camera) -> np.ndarray:  # [H, W, 3] uint8
        """The picture that a camera sees, as a run writes it to PNG."""
        import torch

        from ambiguous_wild.splat.render import render

        look = self._look
        with torch.no_grad():
            drawn = render(
                self._gaussians,
                camera,
                sh_degree=min(look.sh_degree, self._gaussians.sh_degree),
                background=look.background,
                antialias=look.antialias,
                blur=look.blur,
            )
        return to_uint8(drawn.image.numpy())


FORMATS: Mapping[str, tuple[str, Callable[[Path], dict[str, np.ndarray]]]] = {
    "compressed-ply": (".compressed.ply", compressed_ply.read_compressed_ply),
    "spz": (".spz", spz.read_spz),
    "sog": (".sog", sog.read_sog),
    "gltf": (".glb", gltf.read_gltf),
}


@dataclass(frozen=True)
class Exported:
    """One file. dB are means over the views; None = there was nothing to measure on."""

    format: str
    path: Path
    bytes: int
    share: float  # of the plain PLY's size
    gaussians: int  # those that are not finite are left out
    psnr_to_model: float | None  # its renders against the model's, dB; inf = the same pictures
    psnr: float | None  # its renders against the photos, dB
    lost_db: float | None  # the model's PSNR against the photos minus that
    place: Place = UNMOVED  # user's coordinates are the file's / scale + centre; glTF holds them itself


def export(
    model: Model,
    folder: Path,
    formats: Sequence[str],
    views: Sequence[View] = (),
    *,
    name: str = "point_cloud",
) -> list[Exported]:
    """Write the formats into a folder, each atomically, read them back and measure them.

    Files are in the units of the scene's files, where their format holds these: SPZ's sizes and, of large
    units, SOG's positions do not. What remains to be done stands in each file (`Exported.place`).

    Args:
        model: its PLY stays as it is.
        folder: made where there is none.
        formats: of `FORMATS`.
        views: to render for the loss, usually the test views; none = only sizes.
        name: of the files, without ending.

    Raises:
        AwError: unknown format, a model that cannot be read, or nothing in it that is finite.
    """
    for wanted in formats:
        if wanted not in FORMATS:
            raise unknown("format", wanted, FORMATS)
    gaussians, place = model.read(), read_place(model.ply)
    plain = model.ply.stat().st_size
    photos = [read_png_rgb(view.image_path) for view in views]
    before = _renders(gaussians, model.look, views)
    found = []
    for wanted in dict.fromkeys(formats):
        ending, read = FORMATS[wanted]
        path = folder / f"{name}{ending}"
        sweep_killed(path)
        units = place.scale
        if wanted == "spz" or (wanted == "sog" and units < 1):
            units = 1.0
        left = Place(place.centre, place.scale / units)
        count = _write(wanted, path, rescaled(gaussians, 1 / units), model.look, left)
        if not count:
            raise AwError(f"{model.ply} holds no Gaussian that is finite: there is nothing to export")
        after = _renders(rescaled(read(path), units), model.look, views)
        old, new = _mean(before, photos), _mean(after, photos)
        size = path.stat().st_size
        found.append(
            Exported(
                format=wanted,
                path=path,
                bytes=size,
                share=size / plain,
                gaussians=count,
                psnr_to_model=_mean(after, before),
                psnr=new,
                lost_db=None if old is None or new is None else old - new,
                place=UNMOVED if wanted == "gltf" else left,
            )
        )
    return found


def _write(wanted: str, path: Path, gaussians: Arrays, look: RenderSettings, place: Place) -> int:
    if wanted == "spz":
        return spz.write_spz(path, gaussians, antialias=look.antialias, place=place)
    write = {
        "compressed-ply": compressed_ply.write_compressed_ply,
        "sog": sog.write_sog,
        "gltf": gltf.write_gltf,
    }
    return write[wanted](path, gaussians, place=place)


def _renders(
    gaussians: Mapping[str, np.ndarray], look: RenderSettings, views: Sequence[View]
) -> list[np.ndarray]:
    if not views:
        return []
    renderer = Renderer(gaussians, look)
    return [renderer(view.camera) for view in views]


def _mean(renders: Sequence[np.ndarray], photos: Sequence[np.ndarray]) -> float | None:
    values = [psnr(render, photo) for render, photo in zip(renders, photos)]
    if not values:
        return None
    return math.inf if math.inf in values else sum(values) / len(values)
