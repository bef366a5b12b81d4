"""What a run starts from with `aw bench --start`: a splat file, or a point cloud as PLY."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.ply import has_splats, read_point_ply
from ambiguous_wild.io.splat_files import Splats, read_splats

if TYPE_CHECKING:
    from ambiguous_wild.splat.pace import TrainConfig
    from ambiguous_wild.splat.parts import Parts

_LOOKED_AT = 2000  # points


@dataclass(frozen=True)
class StartFile:
    """A file and what it held when the run was planned."""

    path: Path
    sha256: str


def start_file(path: Path) -> StartFile:
    """The file, if a run can start from it.

    Raises:
        AwError: it cannot be read, or is of another kind.
    """
    _read(path)
    return StartFile(path.resolve(), sha256_file(path))


def started(parts: Parts, start: StartFile | None, scene: Scene) -> Parts:
    """A method that starts from the file.

    Raises:
        AwError: the file has changed, or no camera of the scene sees what it holds.
    """
    if start is None:
        return parts
    import torch

    from ambiguous_wild.splat.gaussians import Gaussians
    from ambiguous_wild.viewing.model import moved

    found, place = _read(start.path), scene.place
    if sha256_file(start.path) != start.sha256:
        raise AwError(f"{start.path} has changed since the run was planned; bench again")
    if isinstance(found, Splats):
        arrays = moved(found.gaussians, found.place, place)
        _refuse_elsewhere(start.path, arrays["means"], scene)
        tensors: dict[str, Any] = {name: torch.from_numpy(np.array(a)) for name, a in arrays.items()}
        return replace(parts, given=Gaussians(**tensors))
    xyz = (found[0] - place.centre) * place.scale
    _refuse_elsewhere(start.path, xyz, scene)
    return replace(parts, given=(xyz, found[1]))


def start_line(start: StartFile, method: str, parts: Parts, train: TrainConfig, scene: Scene) -> str:
    """How much of the file a run starts from."""
    from ambiguous_wild.splat.pace import room
    from ambiguous_wild.splat.parts import thinned

    found = _read(start.path)
    splats = isinstance(found, Splats)
    count = len(found.gaussians["means"]) if isinstance(found, Splats) else len(found[0])
    sizes = [(view.camera.height, view.camera.width) for view in scene.train]
    most = room(train, parts.schedule, sizes, parts.density_config.max_gaussians)
    kept = len(thinned(count, most))
    thin = f", chosen at random: it may hold {most:,} (--max-gaussians)" if kept < count else ""
    of = f"{kept:,} of the {count:,} {'splats' if splats else 'points'} of {start.path.name}"
    return f"{scene.name}: {method} starts from {of}{thin}"


def _read(path: Path) -> Splats | tuple[np.ndarray, np.ndarray]:
    """The Gaussians of a splat file; else the points [M, 3] and colours [M, 3] of a PLY."""
    if has_splats(path):
        return read_splats(path)
    xyz, rgb = read_point_ply(path)
    if not len(xyz):
        raise AwError(f"{path} holds no point")
    return xyz, rgb


def _refuse_elsewhere(path: Path, xyz: np.ndarray, scene: Scene) -> None:
    """Raise AwError where no train camera sees any of the points [N, 3]."""
    looked = xyz[np.random.default_rng(0).permutation(len(xyz))[:_LOOKED_AT]].astype(np.float64)
    for view in scene.train:
        camera = view.camera
        x, y, z = (looked @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]).T
        ahead = np.where(z > 0, z, np.nan)
        u, v = camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy
        if ((u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)).any():
            return
    middle = np.median(looked, axis=0) / scene.place.scale + scene.place.centre
    told = ", ".join(f"{c:.4g}" for c in middle)
    raise AwError(
        f"{path}: no train camera of {scene.name} sees what it holds, around ({told}): give a file in the "
        "coordinates of the scene"
    )
