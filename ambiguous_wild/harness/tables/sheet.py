"""One picture that compares runs: test renders beside the photo, and what each method masks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.harness.running.store import Runs, read_config
from ambiguous_wild.io.atomic import atomic_path
from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.metrics.image import psnr

GAP, BAR = 6, 22  # px between cells; height of a caption
TINT = np.array([255, 30, 30], np.float32)  # of what is masked, sRGB


@dataclass(frozen=True)
class Panel:
    """A picture and what stands above it."""

    caption: str
    image: np.ndarray  # [H, W, 3] uint8


def write_sheet(runs: Runs, path: Path, *, scene: str | None = None, views: int = 3) -> int:
    """Write the sheet of one scene: a column a method (first seed), `views` test and train rows.

    Args:
        runs: what `read_runs` found.
        path: PNG to write, or JPG by its ending.
        scene: its name; None where the runs are of one scene only.
        views: rows of each kind.

    Returns:
        The number of methods shown.

    Raises:
        AwError: several scenes and none named, no finished run, the scene folder has moved, or a
            run lacks its renders.
    """
    finished = runs.runs[runs.runs["status"] == "ok"]
    names = sorted(finished["scene"].unique())
    if scene is None and len(names) > 1:
        raise AwError(f"runs of {len(names)} scenes: name one with --scene ({', '.join(names)})")
    chosen = finished if scene is None else finished[finished["scene"] == scene]
    if chosen.empty:
        raise AwError("no finished run to show; 'aw table' lists what is there")
    first = chosen.sort_values("seed").drop_duplicates("method").sort_values("method")
    folders = {str(row.method): Path(str(row.folder)) for row in first.itertuples()}
    source = _scene_of(next(iter(folders.values())))
    rows = [_test_row(view, folders) for view in _spread(source.test, views)]
    rows += [_train_row(view, folders) for view in _spread(source.train, views)]
    _write(path, _stack(rows))
    return len(folders)


def _write(path: Path, image: np.ndarray) -> None:  # [H, W, 3] uint8
    if path.suffix.lower() != ".jpg":
        write_png(path, image)
        return
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(image[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 92])
    if not done:  # a side above 65500 px
        raise AwError(f"{path}: {list(image.shape[:2])} px are too many for a JPG; write a .png")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())


def _scene_of(folder: Path) -> Scene:
    settings = read_config(folder).get("scene")
    where = settings.get("path") if isinstance(settings, dict) else None
    if not isinstance(settings, dict) or not isinstance(where, str):
        raise AwError(f"{folder} has no config.yaml that names its scene: restore it from where it was made")
    if not Path(where).is_dir():
        raise AwError(f"{folder} was trained on {where}, which is not there any more: move the scene back")
    # The run may have used another factor than the scene's own.
    return load_scene(where, factor=settings.get("factor"), verify=False)


def _spread(views: tuple[View, ...], count: int) -> list[View]:
    if not views:
        return []
    index = np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int))
    return [views[i] for i in index]


def _test_row(view: View, folders: dict[str, Path]) -> list[Panel]:
    photo = read_png_rgb(view.image_path)
    cells = [Panel(f"test photo {view.name}", photo)]
    for method, folder in folders.items():
        path = folder / "renders" / "test" / Path(view.name).with_suffix(".png")
        if not path.is_file():
            raise AwError(
                f"the run {folder} lacks its render {path.relative_to(folder)}: restore it, or make the run "
                "again with 'aw bench --overwrite always'"
            )
        render = read_png_rgb(path)
        cells.append(Panel(f"{method}  {psnr(render, photo):.2f} dB", render))
    return cells


def _train_row(view: View, folders: dict[str, Path]) -> list[Panel]:
    photo = read_png_rgb(view.image_path)
    cells = [Panel(f"train photo {view.name}", photo)]
    for method, folder in folders.items():
        path = folder / "masks" / Path(view.name).with_suffix(".png")
        if not path.is_file():
            cells.append(Panel(f"{method}  masks nothing", photo))
            continue
        masked = read_gray(path) < 128
        shown = photo.astype(np.float32)
        shown[masked] = 0.45 * shown[masked] + 0.55 * TINT
        cells.append(Panel(f"{method}  masks {100 * masked.mean():.0f} %", shown.astype(np.uint8)))
    return cells


def _stack(rows: list[list[Panel]]) -> np.ndarray:
    width = max(cell.image.shape[1] for row in rows for cell in row)
    lines = []
    for row in rows:
        height = max(cell.image.shape[0] for cell in row)
        lines.append(np.hstack([_framed(cell, width, height) for cell in row]))
    return np.vstack(lines)


def _framed(cell: Panel, width: int, height: int) -> np.ndarray:
    frame = np.full((height + BAR + GAP, width + GAP, 3), 255, np.uint8)
    frame[BAR : BAR + cell.image.shape[0], : cell.image.shape[1]] = cell.image
    # The field's names are ASCII; anything else would be drawn as question marks.
    text = cell.caption.encode("ascii", "replace").decode()
    cv2.putText(frame, text, (2, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (20, 20, 20), 1, cv2.LINE_AA)
    return frame
