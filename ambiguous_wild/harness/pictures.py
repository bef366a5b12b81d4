"""Draw the pictures of a run into RUN/pictures.

training_<photo>.png  photo, render, error and masks of a train view, a row for each moment of the run; rows
                      appear while it trains
masks.jpg             train photos with the masks of the trained method
density.png           where Gaussians were added and merged, and their number over time

A method may draw more pictures (RefineSplat: entropies.png).
"""

from __future__ import annotations

import shutil
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ambiguous_wild.core import Camera
from ambiguous_wild.harness import sheets
from ambiguous_wild.io.files import atomic_path
from ambiguous_wild.io.images import read_png_rgb, to_uint8, write_png
from ambiguous_wild.io.palette import ADDED, MERGED, NEUTRAL, plot_colour, ramp
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.vision.sparse_surface import in_map, inside

MOMENTS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)  # shares of the run
VIEWS = 3
CELL = 240  # px, width of a picture in a row
WORST = 0.5  # error that is drawn red: mean over channels of |photo - render|
ROWS = ".moments"  # folder of finished rows while the run trains; hidden, because it is no result
SHOWN = 20_000  # most points of a kind in a picture


class TrainingPictures:
    """Draw a row of pictures of each chosen view whenever the run passes a moment.

    It is called after every iteration, with the clock stopped. Rows are kept on disk, too, until the end, so
    that a run that was killed and resumed has all of them; the trainer's state holds none.
    """

    def __init__(self, trainer: Trainer, folder: Path) -> None:
        self.folder = folder
        self.passed = self._passed(trainer)
        self.rows: dict[int, dict[int, np.ndarray]] = {}  # view -> its rows by moment
        for view in sheets.evenly_spaced(range(len(trainer.data.scene.train)), VIEWS):
            paths = {k: self._row(trainer, view, k) for k in range(1, self.passed + 1)}
            self.rows[view] = {k: read_png_rgb(path) for k, path in paths.items() if path.is_file()}

    def _passed(self, trainer: Trainer) -> int:
        done = trainer.progress(trainer.iteration)
        return sum(done >= moment for moment in MOMENTS)

    def __call__(self, trainer: Trainer) -> None:
        """Draw the rows if a moment was passed since the last call."""
        before, self.passed = self.passed, self._passed(trainer)
        if self.passed in (0, before):  # a rollback may lead to before the first moment
            return
        for view, rows in self.rows.items():
            row = rows[self.passed] = picture_row(trainer, view)
            write_png(self._row(trainer, view, self.passed), row, compressed=False)
        self._join(trainer, compressed=False)

    def _row(self, trainer: Trainer, view: int, moment: int) -> Path:
        return self.folder / ROWS / file_stem(trainer, view) / f"{moment}.png"

    def finish(self, trainer: Trainer) -> list[Path]:
        """Join the rows for the last time and remove them; return the paths written."""
        written = self._join(trainer)
        shutil.rmtree(self.folder / ROWS, ignore_errors=True)
        return written

    def _join(self, trainer: Trainer, compressed: bool = True) -> list[Path]:
        written = []
        for view, rows in self.rows.items():
            if rows:
                path = self.folder / "pictures" / f"training_{file_stem(trainer, view)}.png"
                path.parent.mkdir(exist_ok=True)
                write_png(path, sheets.stack([*rows.values()], 0), compressed)
                written.append(path)
        return written


def file_stem(trainer: Trainer, view: int) -> str:
    """Return a file name for pictures of a train view, whose photo may be in a folder."""
    return str(PurePosixPath(trainer.data.scene.train[view].name).with_suffix("")).replace("/", "_")


def picture_row(trainer: Trainer, view: int) -> np.ndarray:
    """Draw photo, render, error and the method's panels of a train view as one row, [h, w, 3] uint8."""
    spent = dict(trainer.clock.parts_s)
    step = trainer.make_step(max(trainer.iteration, 1), view, downsampling=1)
    panels = trainer.hooks.mask.panels(step)
    trainer.clock.parts_s = spent  # drawing is not part of the training time
    photo, render = step.photo.cpu().numpy(), step.rendered.image.detach().cpu().numpy()
    error = np.abs(photo - np.clip(render, 0.0, 1.0)).mean(axis=2)
    share = 100 * trainer.progress(trainer.iteration)
    cells = {
        f"iteration {trainer.iteration} ({share:.0f} %)": to_uint8(photo),
        "render": to_uint8(render),
        f"error, mean {error.mean():.3f}": ramp(error, 0.0, WORST),
    }
    return sheets.stack([sheets.cell(name, image, CELL) for name, image in (cells | panels).items()], 1)


def draw_all(trainer: Trainer, recorder: TrainingPictures, folder: Path) -> list[Path]:
    """Draw every picture of a finished run; return the paths written.

    Args:
        trainer: the trainer after its last step.
        recorder: the recorder of this training.
        folder: the run folder, which has masks/ already.
    """
    pictures = folder / "pictures"
    written = recorder.finish(trainer)
    written += trainer.hooks.mask.draw(pictures)
    written += draw_density(trainer, pictures / "density.png")
    written += sheets.write_contact(trainer.data.scene, folder / "masks", pictures / "masks.jpg")
    return written


def draw_density(trainer: Trainer, path: Path) -> list[Path]:
    """Draw the work of density control; return the path written, or nothing if it never ran."""
    log = trainer.density.log
    if not log.rounds:
        return []
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 4.6), layout="constrained", dpi=110)
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
    count = np.array(
        [trainer.run_schedule.start] + [r["gaussians"] for r in rows] + [r.count for r in rounds]
    )
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
    """Return (caption, positions, marker, colour, size) of the points to draw: added and merged Gaussians."""
    log = trainer.density.log
    return [
        (f"added: {log.added.passed:,}", log.added.xyz.numpy(), ".", ADDED, 3.0),
        (f"merged: {log.merged.passed:,}", log.merged.xyz.numpy(), "x", MERGED, 5.0),
    ]


def _top_view(axes: Any, trainer: Trainer) -> None:
    """Draw the scene from above, along the mean up direction of the cameras."""
    poses = np.stack([camera.cam_from_world for camera in trainer.data.cameras])
    up = -poses[:, 1, :3].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    right = poses[:, 0, :3].mean(axis=0)
    right -= up * (right @ up)
    if np.linalg.norm(right) < 1e-6:  # cameras all around: any direction will do
        right = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    right /= np.linalg.norm(right)
    plane = np.stack([right, np.cross(up, right)])
    means = trainer.gaussians.means.detach().cpu().numpy()
    everything = means[:: max(len(means) // SHOWN, 1)] @ plane.T
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
        uv = _pixels_in_view(xyz, camera)
        axes.scatter(*uv.T, size, marker=marker, color=plot_colour(colour), lw=0.5, alpha=0.7, label=caption)
    axes.set_xlim(0, camera.width)
    axes.set_ylim(camera.height, 0)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.legend(fontsize=8, loc="lower right", markerscale=3.0)
    axes.set_title(f"in {trainer.data.scene.train[index].name} (through walls)", fontsize=10)


def _pixels_in_view(xyz: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the pixels [n, 2] of the positions in front of the camera and inside its picture."""
    shape = (camera.height, camera.width)
    x, y = in_map(camera, camera.to_camera(xyz), shape)
    return np.stack([x, y], axis=1)[inside(x, y, shape)] + 0.5
