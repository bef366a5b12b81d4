"""Draw the pictures of a run into RUN/pictures.

training_<photo>.png  what the method saw of a train view at fixed moments of the run, a row a moment
masks.jpg             train photos with what the trained method masks
density.png           where Gaussians were added and merged, and how many there were
and whatever the method draws itself (RefineSplat: entropies.png)
"""

from __future__ import annotations

import shutil
from pathlib import Path, PurePosixPath

import numpy as np

from ambiguous_wild.harness.pictures import strips
from ambiguous_wild.harness.pictures.density import draw_density
from ambiguous_wild.harness.pictures.mask_sheet import write_contact
from ambiguous_wild.io.images import read_png_rgb, to_uint8, write_png
from ambiguous_wild.io.palette import ramp
from ambiguous_wild.splat.parts import MaskPolicy
from ambiguous_wild.splat.trainer import Trainer

MOMENTS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)  # shares of the run
VIEWS = 3
CELL = 240  # px, width of a picture in a strip
WORST = 0.5  # error that is drawn red: mean over channels of |photo - render|
ROWS = ".moments"  # in the run folder while it trains; hidden, as it is no result


class Recorder:
    """Records a strip of each chosen view whenever the run passes a moment.

    Called after an iteration, with the clock stopped. Rows lie on disk until the end, so that a run that was
    killed and resumed has them all; nothing of it is in the trainer's state.
    """

    def __init__(self, trainer: Trainer, folder: Path) -> None:
        views = trainer.data.scene.train
        chosen = np.linspace(0, len(views) - 1, min(VIEWS, len(views))).round().astype(int)
        self.views = [int(v) for v in np.unique(chosen)]
        self.folder = folder
        self.on = type(trainer.parts.mask).panels is not MaskPolicy.panels  # else there is nothing to see
        self.passed = self._passed(trainer)

    def _passed(self, trainer: Trainer) -> int:
        done = trainer.progress(trainer.iteration)
        return sum(done >= moment for moment in MOMENTS)

    def __call__(self, trainer: Trainer) -> None:
        """Draw if a moment was passed since the last call."""
        passed = self._passed(trainer)
        if not self.on or passed == self.passed:
            return
        self.passed = passed
        for view in self.views:
            write_png(self._row(trainer, view, passed), strip(trainer, view))

    def _row(self, trainer: Trainer, view: int, moment: int) -> Path:
        return self.folder / ROWS / file_stem(trainer, view) / f"{moment}.png"

    def finish(self, trainer: Trainer) -> list[Path]:
        """Put the rows together as pictures/training_<photo>.png; returns what was written."""
        written = []
        for view in self.views:
            paths = [self._row(trainer, view, k) for k in range(1, len(MOMENTS) + 1)]
            rows = [read_png_rgb(path) for path in paths if path.is_file()]
            if rows:
                path = self.folder / "pictures" / f"training_{file_stem(trainer, view)}.png"
                path.parent.mkdir(exist_ok=True)
                write_png(path, strips.stack(rows, 0))
                written.append(path)
        shutil.rmtree(self.folder / ROWS, ignore_errors=True)
        return written


def file_stem(trainer: Trainer, view: int) -> str:
    """A file name for pictures of a train view: photos may lie in folders."""
    return str(PurePosixPath(trainer.data.scene.train[view].name).with_suffix("")).replace("/", "_")


def strip(trainer: Trainer, view: int) -> np.ndarray:
    """Photo, render, error and the method's own panels of a train view as one row, [h, w, 3] uint8."""
    spent = dict(trainer.clock.parts_s)
    step = trainer.make_step(max(trainer.iteration, 1), view, divisor=1)
    panels = trainer.parts.mask.panels(step)
    trainer.clock.parts_s = spent  # looking is no part of training
    photo, render = step.photo.cpu().numpy(), step.rendered.image.detach().cpu().numpy()
    error = np.abs(photo - np.clip(render, 0.0, 1.0)).mean(axis=2)
    share = 100 * trainer.progress(trainer.iteration)
    cells = {
        f"iteration {trainer.iteration} ({share:.0f} %)": to_uint8(photo),
        "render": to_uint8(render),
        f"error, mean {error.mean():.3f}": ramp(error, 0.0, WORST),
    }
    return strips.stack([strips.cell(name, image, CELL) for name, image in (cells | panels).items()], 1)


def draw_all(trainer: Trainer, recorder: Recorder, folder: Path) -> list[Path]:
    """Every picture of a finished run; returns what was written.

    Args:
        trainer: after its last step; masks/ lies in the folder already.
        recorder: that watched it.
        folder: the run folder.
    """
    pictures = folder / "pictures"
    written = recorder.finish(trainer)
    written += trainer.parts.mask.draw(pictures)
    written += draw_density(trainer, pictures / "density.png")
    written += write_contact(trainer.data.scene, folder / "masks", pictures / "masks.jpg")
    return written
