"""A contact sheet of masks: train photos with what is masked, for judging captures without truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ambiguous_wild.core import Scene, View
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.harness.pictures import strips
from ambiguous_wild.harness.running.regions import true_distractor
from ambiguous_wild.io.images import read_gray, read_png_rgb
from ambiguous_wild.io.palette import MASKED, tint

MOST, COLUMNS, WIDTH = 20, 5, 320  # photos; in a row; px of each


def write_contact(
    scene: Scene, masks: Path, path: Path, *, names: Sequence[str] = (), most: int = MOST
) -> list[Path]:
    """Write a JPEG of train photos, the masked region tinted, each with its masked share.

    Args:
        scene: whose train photos.
        masks: RUN/masks: keep maps by the photo's name, white = keep.
        path: JPEG to write.
        names: photos to show; empty: up to `most`, evenly chosen among those with a mask.
        most: photos at most.

    Returns:
        What was written: nothing where the method masks nothing.

    Raises:
        AwError: a name that is no train photo.
    """
    by_name = {view.name: view for view in scene.train}
    for name in names:
        if name not in by_name:
            raise unknown("train photo", name, by_name)
    views = [by_name[name] for name in names] or list(scene.train)
    views = [view for view in views if _mask(masks, view).is_file()]
    if not views:
        return []
    chosen = np.unique(np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int))
    cells = [_tinted(scene, views[i], masks) for i in chosen]
    columns = min(COLUMNS, len(cells))
    rows = [strips.stack(cells[k : k + columns], 1) for k in range(0, len(cells), columns)]
    path.parent.mkdir(parents=True, exist_ok=True)
    strips.write_jpeg(path, strips.stack(rows, 0))
    return [path]


def _mask(folder: Path, view: View) -> Path:
    return folder / Path(view.name).with_suffix(".png")


def _tinted(scene: Scene, view: View, masks: Path) -> np.ndarray:
    photo, masked = read_png_rgb(view.image_path), read_gray(_mask(masks, view)) < 128
    caption = f"{view.name}: {100 * masked.mean():.0f} % masked"
    truth = true_distractor(scene, view)
    if truth is not None:
        caption += f", {100 * truth.mean():.0f} % true"
    return strips.cell(caption, tint(photo, masked, MASKED), WIDTH)
