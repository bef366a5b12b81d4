"""Export a model in other formats, whole or without what no photo needs, and measure what a viewer draws."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, Scene, SceneTransform, View
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.io.files import sweep_killed
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.io.ply import rescaled
from ambiguous_wild.io.splat_arrays import SH_C0, Arrays, finite
from ambiguous_wild.io.splat_files import FORMATS, write_splats
from ambiguous_wild.io.untrusted import read_bytes
from ambiguous_wild.metrics.image import psnr
from ambiguous_wild.viewing.model import (
    Renderer,
    RenderSettings,
    Space,
    ViewedModel,
    gaussians_of,
    moved,
    upright,
)

NEEDED = 0.3  # px: least sum of a Gaussian's blend weights in the training photo that shows it most
FULL_HARMONICS = 15  # coefficients of degree 1 to 3
FEW = 100  # Gaussians; fewer that far out are outliers, and no skybox


@dataclass(frozen=True)
class ExportParts:
    """What is left out of the files, and what is added."""

    clean: bool = False  # leave out Gaussians that no training photo needs
    skybox: bool = True  # write the skybox
    pad_harmonics: bool = False  # write zeros up to degree 3


@dataclass(frozen=True)
class ExportedModel:
    """An exported file. dB are means over the views; None = there was no view to measure on."""

    format: str
    path: Path
    bytes: int
    share: float  # of the size of `source`
    gaussians: int  # number of finite Gaussians, which are written
    psnr_to_model: float | None  # of its renders against the model's, dB; inf = equal pictures
    psnr: float | None  # of its renders against the photos, dB
    lost_db: float | None  # PSNR of the model minus `psnr`
    transform: SceneTransform = (
        UNMOVED  # of the file's coordinates; glTF that is not turned has the user's coordinates
    )
    source: str = "the PLY"  # file with whose size `share` compares


def export(
    model: ViewedModel,
    folder: Path,
    formats: Sequence[str],
    views: Sequence[View] = (),
    *,
    name: str = "point_cloud",
    space: Space | None = None,
    up: str | None = None,
    scene: Scene | None = None,
    parts: ExportParts | None = None,
) -> tuple[list[ExportedModel], list[str]]:
    """Write the formats into a folder, each atomically, read them back and measure them.

    Files have the units of the scene's files if the format can hold them: SPZ's sizes and, for large units,
    SOG's positions cannot. Each file records its `ExportedModel.transform`.

    Args:
        model: the model; its PLY is not changed.
        folder: created if it does not exist.
        formats: names of `io.splat_files.FORMATS`.
        views: views to measure the loss on, usually the test views; none = only sizes.
        name: name of the files, without extension.
        space: of the scene, needed with `up`.
        up: axis of `AXES` that points up in the files (always y in glTF), with the floor at zero; None =
            the scene's coordinates.
        scene: of the model; None: not known.
        parts: which Gaussians are written; None: all.

    Returns:
        The files, and notes on what is in them or left out.

    Raises:
        AwError: unknown format, a model that cannot be read, or nothing in it that is finite.
    """
    for wanted in formats:
        if wanted not in FORMATS:
            raise unknown("format", wanted, FORMATS)
    written, notes = chosen_parts(model.read(), scene, model.render_settings, parts or ExportParts())
    if any(model.render_settings.background):
        colour = ", ".join(f"{255 * value:.0f}" for value in model.render_settings.background)
        notes.append(f"the background is {colour}, which no format holds: set it in the viewer")
    gaussians: Arrays = written
    transform = model.transform
    if not len(finite(gaussians)["means"]):
        raise AwError(f"{model.ply} holds no Gaussian that is finite: there is nothing to export")
    plain = model.ply.stat().st_size
    photos = [read_png_rgb(view.image_path) for view in views]
    before = _renders(model.read(), model.render_settings, views)
    exported = []
    for form in (FORMATS[wanted] for wanted in dict.fromkeys(formats)):
        if up is not None and space is not None:
            transform = upright(model, space, "y" if form.y_up else up)
            gaussians = moved(written, model.transform, transform)
        path = folder / f"{name}{form.suffix}"
        sweep_killed(path)
        units = transform.scale if form.holds_units(transform.scale) else 1.0
        left = replace(transform, scale=transform.scale / units)
        count = write_splats(
            form, path, rescaled(gaussians, 1 / units), left, model.render_settings.antialias
        )
        read_back = form.decode(read_bytes(path), path).gaussians
        there = moved(rescaled(read_back, units), transform, model.transform)
        if model.render_settings.antialias and not form.antialias:
            notes.append(f"{form.name} cannot say that Mip-Splatting's 2D filter draws it, so viewers do not")
        # as a viewer draws it that knows the file alone
        flagged = model.render_settings.antialias and form.antialias
        stranger = RenderSettings(antialias=flagged, background=model.render_settings.background)
        after = _renders(there, stranger, views)
        old, new = _mean(before, photos), _mean(after, photos)
        size = path.stat().st_size
        exported.append(
            ExportedModel(
                format=form.name,
                path=path,
                bytes=size,
                share=size / plain,
                gaussians=count,
                psnr_to_model=_mean(after, before),
                psnr=new,
                lost_db=None if old is None or new is None else old - new,
                transform=UNMOVED if form.y_up and up is None else left,
                source="the PLY" if model.ply.suffix == ".ply" else model.ply.name,
            )
        )
    return exported, notes


def _renders(
    gaussians: Mapping[str, np.ndarray], render_settings: RenderSettings, views: Sequence[View]
) -> list[np.ndarray]:
    if not views:
        return []
    renderer = Renderer(gaussians, render_settings)
    return [renderer(view.camera) for view in views]


def _mean(renders: Sequence[np.ndarray], photos: Sequence[np.ndarray]) -> float | None:
    values = [psnr(render, photo) for render, photo in zip(renders, photos)]
    if not values:
        return None
    return math.inf if math.inf in values else sum(values) / len(values)


def chosen_parts(
    gaussians: dict[str, np.ndarray], scene: Scene | None, settings: RenderSettings, parts: ExportParts
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the Gaussians that are written, and notes on the others.

    Args:
        gaussians: raw parameters in the scene's inner coordinates.
        scene: their scene; None: not known.
        settings: how they are drawn.
        parts: what is asked for.

    Raises:
        AwError: the scene is needed and not known, or nothing is left.
    """
    if scene is None and (parts.clean or not parts.skybox):
        raise AwError("--clean and --no-skybox need the scene of the model: name its folder with --scene")
    keep, notes = np.ones(len(gaussians["means"]), bool), []
    if scene is not None and (far := _skybox(gaussians["means"], scene)).sum() >= FEW:
        what = f"{far.sum():,} of {len(keep):,} Gaussians lie 4 times as far out as the scene (skybox)"
        if parts.skybox:
            notes.append(f"{what}; viewers may sort the others more exactly without: --no-skybox")
        else:
            keep &= ~far
            notes.append(f"{what}: left out")
    if parts.clean and scene is not None:
        needed = largest_weights(gaussians, scene, settings) >= NEEDED
        count = int((keep & ~needed).sum())
        notes.append(f"{count:,} of {len(keep):,} Gaussians that photos look at and none needs: left out")
        keep &= needed
    if not keep.any():
        raise AwError("nothing is left of the model: export it without --clean and --no-skybox")
    chosen = {name: values[keep] for name, values in gaussians.items()}
    if parts.pad_harmonics:
        rest = chosen["sh_rest"]
        zeros = np.zeros((len(rest), FULL_HARMONICS - rest.shape[1], 3), np.float32)
        chosen["sh_rest"] = np.concatenate([rest, zeros], axis=1)
    return chosen, notes


def _skybox(means: np.ndarray, scene: Scene) -> np.ndarray:
    """Tell which Gaussians [N] lie on the sphere on which the skybox is laid out."""
    from ambiguous_wild.splat.effects.skybox import skybox_sphere

    middle, radius = skybox_sphere([view.camera for view in scene.train], scene.points.xyz)
    return np.asarray(np.linalg.norm(means - middle, axis=1) > 0.5 * radius)


def largest_weights(
    gaussians: dict[str, np.ndarray], scene: Scene, settings: RenderSettings
) -> np.ndarray:  # [N] px
    """Return for each Gaussian the largest sum of its blend weights in a training photo; inf outside of all.

    The sum is the gradient of the picture's sum with respect to the Gaussian's colour.
    """
    import torch

    from ambiguous_wild.splat.render import render

    white = {
        **gaussians,
        "sh0": np.ones_like(gaussians["sh0"]),
        "sh_rest": np.zeros_like(gaussians["sh_rest"]),
    }
    model, largest = gaussians_of(white), np.zeros(len(gaussians["means"]), np.float32)
    looked_at = np.zeros(len(largest), bool)
    for view in scene.train:
        drawn = render(model, view.camera, sh_degree=0, antialias=settings.antialias, blur=settings.blur)
        cotangent = torch.zeros_like(drawn.image)
        cotangent[..., 0] = 1.0
        gradient = drawn.backward(cotangent).sh0[:, 0].numpy()
        largest = np.maximum(largest, gradient / SH_C0)
        looked_at |= drawn.visible.numpy()
    return np.where(looked_at, largest, np.inf)
