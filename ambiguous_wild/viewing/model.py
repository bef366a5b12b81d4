"""A trained model for viewing: how it is drawn, its scene's axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ambiguous_wild.core import AwError, Camera, Scene, SceneTransform
from ambiguous_wild.core.scene import without_outliers
from ambiguous_wild.io.images import to_uint8
from ambiguous_wild.io.ply import read_splat_ply, read_transform, splat_count, stated_up
from ambiguous_wild.io.splat_arrays import Arrays, SplatFile
from ambiguous_wild.io.splat_files import read_splats

if TYPE_CHECKING:
    from ambiguous_wild.splat.gaussians import Gaussians
    from ambiguous_wild.splat.rendered import Rendered

AXES = {
    sign + axis: (-1.0 if sign else 1.0) * row for sign in ("", "-") for axis, row in zip("xyz", np.eye(3))
}
_FLOOR = 0.02  # share of the Gaussians around the middle that lie below the floor


@dataclass(frozen=True)
class Space:
    """Up, middle and size of a scene, in world units."""

    up: np.ndarray  # [3] unit vector
    middle: np.ndarray  # [3] point that the cameras look at
    distance: float  # mean distance of the cameras from the middle
    extent: float  # radius of the camera positions, see `Scene.extent`


def space_of(scene: Scene) -> Space:
    """Find up as the mean of the photos' up, and the middle at the median depth of the photos' points."""
    views = without_outliers(scene.train or scene.views)
    poses = np.array([v.camera.cam_from_world for v in views])
    up = -poses[:, 1, :3].mean(axis=0)
    size = np.linalg.norm(up)
    up = up / size if size > 1e-6 else -poses[0, 1, :3]
    centers = np.array([v.camera.center for v in views])
    depths = np.array([_median_depth(v.camera, scene.points.xyz) for v in views])
    finite = np.isfinite(depths)
    depths = np.where(finite, depths, np.median(depths[finite]) if finite.any() else scene.extent)
    middle = (centers + poses[:, 2, :3] * depths[:, None]).mean(axis=0)
    distance = float(np.linalg.norm(centers - middle, axis=1).mean())
    return Space(up=up, middle=middle, distance=max(distance, 1e-6), extent=scene.extent)


def _median_depth(camera: Camera, points: np.ndarray) -> float:
    """Return the median depth of points within 45 degrees of the view's axis; NaN without points."""
    if not len(points):
        return np.nan
    seen = camera.to_camera(points)
    ahead = (seen[:, 2] > 0) & (np.linalg.norm(seen[:, :2], axis=1) < seen[:, 2])
    return float(np.median(seen[ahead, 2])) if ahead.any() else np.nan


@dataclass(frozen=True)
class RenderSettings:
    """How a method draws its Gaussians."""

    sh_degree: int = 3
    antialias: bool = False  # Mip-Splatting's 2D filter
    blur: float = 0.3  # px^2 added to both variances of a splat
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ViewedModel:
    """One method's model of a scene."""

    label: str  # unique among the models that are shown together
    ply: Path
    render_settings: RenderSettings = field(default_factory=RenderSettings)
    psnr: Mapping[str, float] = field(default_factory=dict)  # dB by name of the test view
    # keep maps of train views: a folder of PNGs (white = keep), or [H, W] bool by name of the view (1 = keep)
    masks: Path | Mapping[str, np.ndarray] | None = None
    reasons: Path | None = None  # reasons.json of the run: why regions are masked or kept
    retrain: str = ""  # command that trains it longer with the corrections.json of the page
    reference: bool = False  # trained with exact masks or clean photos, so it does not compete
    splats: SplatFile | None = field(
        default=None, repr=False, compare=False
    )  # content of `ply` if it is a splat file, or a model that is still trained, and not a run's

    def read(self) -> dict[str, np.ndarray]:
        """Read the Gaussians, in the coordinates of `transform`.

        Raises:
            AwError: no splat PLY.
        """
        return read_splat_ply(self.ply) if self.splats is None else self.splats.gaussians

    @property
    def transform(self) -> SceneTransform:
        """Place of the scene in whose coordinates `read` returns Gaussians."""
        return read_transform(self.ply) if self.splats is None else self.splats.transform

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return splat_count(self.ply) if self.splats is None else len(self.splats.gaussians["means"])

    def within(self, transform: SceneTransform) -> ViewedModel:
        """Move the model of a splat file to a scene's inner coordinates; a run's model has them already."""
        if self.splats is None:
            return self
        arrays = moved(self.splats.gaussians, self.splats.transform, transform)
        return replace(self, splats=replace(self.splats, gaussians=dict(arrays), transform=transform))


def file_model(path: Path) -> tuple[ViewedModel, str]:
    """Read the model of a splat file of any tool, to be drawn as plain 3DGS; also return a note, or "".

    Raises:
        AwError: see `read_splats`.
    """
    splats = read_splats(path)
    notes = []
    if splats.left_out:
        notes.append(f"{splats.left_out:,} Gaussians with values that are not finite left out")
    if path.suffix.lower() == ".ply" and (axis := stated_up(path)):
        notes.append(f"its header says that {axis} is up; here -y is: --up and --scene turn it")
    model = ViewedModel(path.name, path, RenderSettings(antialias=splats.antialias), splats=splats)
    return model, f"{path}: {'; '.join(notes)}" if notes else ""


def moved(gaussians: Arrays, of: SceneTransform, to: SceneTransform) -> Arrays:
    """Convert Gaussians from one transform to another."""
    if of == to:
        return gaussians
    factor, shift = to.scale / of.scale, to.rotation @ np.subtract(of.centre, to.centre) * to.scale
    rotation = to.rotation @ of.rotation.T
    placed = {**gaussians, "means": (factor * gaussians["means"] @ rotation.T + shift).astype(np.float32)}
    placed["log_scales"] = (gaussians["log_scales"] + np.log(factor)).astype(np.float32)
    if of.quat != to.quat:
        placed["quats"] = _rotated_quats(gaussians["quats"], rotation)
        placed["sh_rest"] = _rotated_harmonics(gaussians["sh_rest"], rotation)
    return placed


def _rotated_quats(quats: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return (quats.astype(np.float64) @ left.T).astype(np.float32)


def _rotated_harmonics(rest: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Rotate harmonics [N, K, 3]: each degree is mixed within itself, so colours rotate with the model."""
    from ambiguous_wild.splat.cpu.project import basis

    degree = round((rest.shape[1] + 1) ** 0.5) - 1
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis_rotated, basis_now = np.empty((2, rest.shape[1], len(directions)))
    for values, seen in ((basis_rotated, directions), (basis_now, directions @ rotation)):
        getattr(basis, "py_func", basis)(*seen.T, degree, values)  # for all directions at once
    rotated = rest.astype(np.float64)
    for k in range(1, degree + 1):
        of = slice(k * k - 1, (k + 1) ** 2 - 1)
        mixing = np.linalg.lstsq(basis_rotated[of].T, basis_now[of].T, rcond=None)[0]
        rotated[:, of] = np.einsum("jk,nkc->njc", mixing, rotated[:, of])
    return rotated.astype(np.float32)


def gaussians_of(arrays: Arrays) -> Gaussians:
    """Return raw parameters as float32 tensors on the CPU."""
    import torch

    from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians

    return Gaussians(**{name: torch.from_numpy(np.array(arrays[name], np.float32)) for name in PARAMETERS})  # type: ignore[arg-type]


class Renderer:
    """Renders one model on the CPU, with the kernels it was trained with."""

    def __init__(self, gaussians: Arrays, render_settings: RenderSettings) -> None:
        """
        Args:
            gaussians: raw parameters of at least one Gaussian.
            render_settings: how they are drawn.

        Raises:
            AwError: there is no Gaussian.
        """
        if not len(gaussians["means"]):
            raise AwError("the model has no Gaussian: there is nothing to draw")
        self._gaussians = gaussians_of(gaussians)
        self._render_settings = render_settings

    def __call__(self, camera: Camera) -> np.ndarray:  # [H, W, 3] uint8
        """Render the picture that a camera sees, as a run writes it to PNG."""
        return to_uint8(self.frame(camera).image.numpy())

    def frame(self, camera: Camera) -> Rendered:
        """Render picture, alpha and depth of a camera."""
        import torch

        from ambiguous_wild.splat.render import render

        settings = self._render_settings
        with torch.no_grad():
            return render(
                self._gaussians,
                camera,
                sh_degree=min(settings.sh_degree, self._gaussians.sh_degree),
                background=settings.background,
                antialias=settings.antialias,
                blur=settings.blur,
            )


def upright(model: ViewedModel, space: Space, axis: str) -> SceneTransform:
    """Return a transform in which an axis of `AXES` points up and the floor below the middle is at zero.

    Args:
        model: model in the coordinates of `space`.
        space: up, middle and size of its scene.
        axis: axis of the file that is to point up.
    """
    from scipy.spatial.transform import Rotation

    gaussians, transform = model.read(), model.transform
    near = np.linalg.norm(gaussians["means"] - space.middle, axis=1) < 1.5 * space.distance
    near &= gaussians["opacity_logits"] > 0
    heights = gaussians["means"][near] @ space.up
    floor = float(np.quantile(heights, _FLOOR)) if len(heights) else 0.0
    foot = space.middle + (floor - space.middle @ space.up) * space.up
    x, y, z = (transform.rotation.T @ foot / transform.scale + transform.centre).tolist()
    turn, _ = Rotation.align_vectors([AXES[axis]], [transform.rotation.T @ space.up])
    a, b, c, d = turn.as_quat().tolist()
    return SceneTransform((x, y, z), transform.scale, (d, a, b, c))
