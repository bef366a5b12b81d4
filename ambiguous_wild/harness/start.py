"""Start a run from a splat file or a point cloud (PLY), as `aw bench --start` does."""

from __future__ import annotations

import shlex
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.names import plain
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.ply import has_splats, read_point_ply
from ambiguous_wild.io.splat_arrays import SplatFile
from ambiguous_wild.io.splat_files import read_splats

if TYPE_CHECKING:
    from ambiguous_wild.splat.method_hooks import MethodHooks
    from ambiguous_wild.splat.train_config import TrainConfig

_NEAR = 0.05  # of a point's distance to the nearest train camera
# Shares of near points below which a start is refused, and warned of. Models of the scene had 0.59 to 1; with
# errors of 10 % of the depth 0.97, at half and twice the scale 0.02; 75 of 92 models and point clouds of
# other scenes had less than 0.1, as had points at random in the box of the scene (0.05).
_MIN_NEAR, _FEW_NEAR = 0.02, 0.1
_FEW_POINTS = 100  # of a scene; fewer do not say where it lies


@dataclass(frozen=True)
class StartFile:
    """A file, and the hash of its content when the run was planned."""

    path: Path
    sha256: str
    # what it holds, of a file that was read for planning
    count: int = field(default=0, compare=False)
    kind: Literal["splats", "points"] = field(default="points", compare=False)


def recorded_start(record: dict[str, str] | None) -> StartFile | None:
    """Return the file that the key "start" of a run's config.yaml names; None without the key."""
    return StartFile(Path(record["path"]), record["sha256"]) if record else None


def start_file(path: Path) -> StartFile:
    """Check that a run can start from the file, and hash it.

    Raises:
        AwError: the file cannot be read, or is of another kind.
    """
    if path.name == "meta.json":  # its hash is not that of the textures
        export = f"aw export {shlex.quote(str(path))} --format ply -o start"
        raise AwError(f"{path} is an unpacked SOG: give --start the file that '{export}' writes")
    content = _read(path)
    is_splats = isinstance(content, SplatFile)
    count = len(content.gaussians["means"]) if isinstance(content, SplatFile) else len(content[0])
    return StartFile(path.resolve(), sha256_file(path), count, "splats" if is_splats else "points")


def with_start(hooks: MethodHooks, start: StartFile | None, scene: Scene) -> MethodHooks:
    """Return the hooks of a method that starts from the file.

    Raises:
        AwError: the file has changed, or its content does not lie where the scene is.
    """
    if start is None:
        return hooks
    from ambiguous_wild.viewing.model import gaussians_of, moved

    content, transform = _read(start.path), scene.transform
    if sha256_file(start.path) != start.sha256:
        raise AwError(f"{start.path} has changed since the run was planned; bench again")
    if isinstance(content, SplatFile):
        arrays = moved(content.gaussians, content.transform, transform)
        _check_position(start.path, arrays["means"], scene)
        return replace(hooks, user_start=gaussians_of(arrays))
    xyz = (content[0] - transform.centre) * transform.scale
    _check_position(start.path, xyz, scene)
    return replace(hooks, user_start=(xyz, content[1]))


def start_line(start: StartFile, method: str, hooks: MethodHooks, train: TrainConfig, scene: Scene) -> str:
    """Return a line that says how many splats or points of the file a run starts from."""
    from ambiguous_wild.splat.method_hooks import start_rows
    from ambiguous_wild.splat.run_schedule import max_gaussians

    sizes = [(view.camera.height, view.camera.width) for view in scene.train]
    most = max_gaussians(train, hooks.schedule, sizes, hooks.density_config.max_gaussians)
    kept = len(start_rows(start.count, most))
    thin = (
        f", chosen at random: it may have {most:,} Gaussians (--max-gaussians)" if kept < start.count else ""
    )
    of = f"{kept:,} of the {start.count:,} {start.kind} of {start.path.name}"
    return f"{scene.name}: {method} starts from {of}{thin}"


def _read(path: Path) -> SplatFile | tuple[np.ndarray, np.ndarray]:
    """Read the Gaussians of a splat file, or the points [M, 3] and colours [M, 3] of another PLY."""
    if has_splats(path):
        return read_splats(path)
    xyz, rgb = read_point_ply(path)
    if not len(xyz):
        raise AwError(f"{path} holds no point")
    return xyz, rgb


def _check_position(path: Path, xyz: np.ndarray, scene: Scene) -> None:
    """Refuse points [N, 3] that lie far from the scene's points; warn if few of them lie near."""
    from scipy.spatial import cKDTree

    from ambiguous_wild.vision.sparse_surface import subsample_points

    points = scene.points.xyz
    if len(points) < _FEW_POINTS:
        return
    cameras = cKDTree([view.camera.center for view in scene.train])
    shares = [
        float((cKDTree(others).query(some)[0] < _NEAR * cameras.query(some)[0]).mean())
        for some, others in ((subsample_points(xyz), points), (subsample_points(points), xyz))
    ]  # the greater counts: each of the two may cover a part of the scene alone
    if max(shares) < _FEW_NEAR:
        middle = np.median(xyz, axis=0) / scene.transform.scale + scene.transform.centre
        coordinates = ", ".join(f"{c:.4g}" for c in middle)
        message = (
            f"{path} lies around ({coordinates}), and at most {max(shares):.0%} of its points and those of "
            f"{scene.name} lie near each other"
        )
        if max(shares) < _MIN_NEAR:
            raise AwError(f"{message}: give a file of this scene, in its coordinates")
        warnings.warn(plain(f"{message}: is it of another scene?"), stacklevel=2)
