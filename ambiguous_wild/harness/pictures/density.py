"""density.png: how many Gaussians there were, and where they were added and merged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import Camera
from ambiguous_wild.io.atomic import atomic_path
from ambiguous_wild.io.images import to_uint8
from ambiguous_wild.io.palette import ADDED, MERGED, NEUTRAL, plot_colour
from ambiguous_wild.splat.trainer import Trainer

SHOWN = 20_000  # points of a kind in a picture


def draw_density(trainer: Trainer, path: Path) -> list[Path]:
    """Write the picture; returns what was written: nothing where density control never did anything."""
    log = trainer.density.log
    if not log.rounds:
        return []
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 4.6), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    counts, top, view = figure.subplots(1, 3, width_ratios=[1.0, 1.1, 1.4])
    _counts(counts, trainer)
    _top_view(top, trainer)
    _in_a_view(view, trainer)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, metadata={"Software": None})
    return [path]


def _counts(axes: Any, trainer: Trainer) -> None:
    rounds, rows = trainer.density.log.rounds, trainer.timeline.rows
    steps = np.array([0] + [r["iteration"] for r in rows] + [r.iteration for r in rounds])
    count = np.array([trainer.pace.start] + [r["gaussians"] for r in rows] + [r.count for r in rounds])
    order = np.argsort(steps, kind="stable")
    axes.plot(steps[order], count[order], color="k", lw=1.5)
    merges = [r for r in rounds if r.merged]
    if merges:
        at, after = [r.iteration for r in merges], [r.count for r in merges]
        gone = sum(r.merged for r in merges)
        label = f"{len(merges)} merges, {gone:,} Gaussians fewer"
        axes.plot(at, after, "v", ms=7, color=plot_colour(MERGED), label=label)
    axes.set_title(
        f"{sum(r.cloned for r in rounds):,} cloned, {sum(r.split for r in rounds):,} split, "
        f"{sum(r.pruned for r in rounds):,} pruned",
        fontsize=10,
    )
    axes.set_xlabel("iteration")
    axes.set_ylabel("Gaussians")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.25)
    if merges:
        axes.legend(fontsize=8, loc="lower right")


def _kinds(trainer: Trainer) -> list[tuple[str, np.ndarray, str, tuple[int, int, int], float]]:
    """(caption, positions, marker, colour, size) of what is drawn over the scene."""
    log = trainer.density.log
    return [
        (f"added: {log.added.passed:,}", log.added.xyz.numpy(), ".", ADDED, 3.0),
        (f"merged: {log.merged.passed:,}", log.merged.xyz.numpy(), "x", MERGED, 5.0),
    ]


def _top_view(axes: Any, trainer: Trainer) -> None:
    """From above, where above is the mean of the cameras' own."""
    poses = np.stack([camera.cam_from_world for camera in trainer.data.cameras])
    up = -poses[:, 1, :3].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    right = poses[:, 0, :3].mean(axis=0)
    right -= up * (right @ up)
    if np.linalg.norm(right) < 1e-6:  # cameras all around: any direction will do
        right = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    right /= np.linalg.norm(right)
    plane = np.stack([right, np.cross(up, right)])
    everything = _thin(trainer.gaussians.means.detach().cpu().numpy()) @ plane.T
    centres = np.stack([camera.center for camera in trainer.data.cameras]) @ plane.T
    axes.scatter(everything[:, 0], everything[:, 1], 0.5, color=plot_colour(NEUTRAL), alpha=0.4, lw=0)
    for _, xyz, marker, colour, size in _kinds(trainer):
        if len(xyz):
            flat = xyz @ plane.T
            axes.scatter(
                flat[:, 0], flat[:, 1], size, marker=marker, color=plot_colour(colour), lw=0.5, alpha=0.6
            )
    axes.scatter(centres[:, 0], centres[:, 1], 14, marker="^", color="k", label="cameras")
    # a few strays must not shrink the scene to a dot
    low = np.minimum(np.quantile(everything, 0.1, axis=0), centres.min(axis=0))
    high = np.maximum(np.quantile(everything, 0.9, axis=0), centres.max(axis=0))
    margin = 0.12 * float((high - low).max())
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title("from above; grey: all Gaussians, triangles: cameras", fontsize=10)


def _in_a_view(axes: Any, trainer: Trainer) -> None:
    index = len(trainer.data.cameras) // 2
    camera, photo = trainer.data.cameras[index], to_uint8(trainer.data.photos[index].cpu().numpy())
    faded = (0.35 * photo + 0.65 * 255).astype(np.uint8)
    axes.imshow(faded, extent=(0, camera.width, camera.height, 0))
    for caption, xyz, marker, colour, size in _kinds(trainer):
        uv = _seen(xyz, camera)
        axes.scatter(*uv.T, size, marker=marker, color=plot_colour(colour), lw=0.5, alpha=0.7, label=caption)
    axes.set_xlim(0, camera.width)
    axes.set_ylim(camera.height, 0)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.legend(fontsize=8, loc="lower right", markerscale=3.0)
    axes.set_title(f"in {trainer.data.scene.train[index].name} (through walls)", fontsize=10)


def _seen(xyz: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels [n, 2] of the positions in front of the camera and inside its picture."""
    local = xyz @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    local = local[local[:, 2] > 1e-6]
    u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
    v = camera.fy * local[:, 1] / local[:, 2] + camera.cy
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return np.stack([u[inside], v[inside]], axis=1)


def _thin(rows: np.ndarray) -> np.ndarray:
    return rows[:: max(len(rows) // SHOWN, 1)]
