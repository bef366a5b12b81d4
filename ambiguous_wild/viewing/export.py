"""A model in other file formats, with their size and what the rounding costs in dB."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambiguous_wild.core import AwError, View
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.io.splat_formats import compressed_ply, gltf, sog, spz
from ambiguous_wild.metrics.image import psnr
from ambiguous_wild.viewing.model import Look, Model, Renderer

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


def export(
    model: Model,
    folder: Path,
    formats: Sequence[str],
    views: Sequence[View] = (),
    *,
    name: str = "point_cloud",
) -> list[Exported]:
    """Write the formats into a folder, each atomically, read them back and measure them.

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
    gaussians = model.read()
    plain = model.ply.stat().st_size
    photos = [read_png_rgb(view.image_path) for view in views]
    before = _renders(gaussians, model.look, views)
    found = []
    for wanted in dict.fromkeys(formats):
        ending, read = FORMATS[wanted]
        path = folder / f"{name}{ending}"
        count = _write(wanted, path, gaussians, model.look)
        if not count:
            raise AwError(f"{model.ply} holds no Gaussian that is finite: there is nothing to export")
        after = _renders(read(path), model.look, views)
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
            )
        )
    return found


def _write(wanted: str, path: Path, gaussians: Mapping[str, np.ndarray], look: Look) -> int:
    if wanted == "spz":
        return spz.write_spz(path, gaussians, antialias=look.antialias)
    write = {
        "compressed-ply": compressed_ply.write_compressed_ply,
        "sog": sog.write_sog,
        "gltf": gltf.write_gltf,
    }
    return write[wanted](path, gaussians)


def _renders(gaussians: Mapping[str, np.ndarray], look: Look, views: Sequence[View]) -> list[np.ndarray]:
    if not views:
        return []
    renderer = Renderer(gaussians, look)
    return [renderer(view.camera) for view in views]


def _mean(renders: Sequence[np.ndarray], photos: Sequence[np.ndarray]) -> float | None:
    values = [psnr(render, photo) for render, photo in zip(renders, photos)]
    if not values:
        return None
    return math.inf if math.inf in values else sum(values) / len(values)
