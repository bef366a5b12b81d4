"""Keep copies of test renders, photos and masks beside the CSV files, so that the page needs no run folder.

Kind "test": the render of a test view, or its photo. Kind "train": a train photo, or the mask that a method
predicts for it. Kind "exact": the exact mask of a train photo. Masks are transparent where a pixel is kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.harness.trained_models import MASKS
from ambiguous_wild.io.files import atomic_path, sha256_file, write_text
from ambiguous_wild.io.images import read_gray, read_png_rgb
from ambiguous_wild.io.page_parts import jpeg_bytes
from ambiguous_wild.report.board import (
    CsvValue,
    Entry,
    board_csv,
    measured,
    number,
    read_csv,
    slug,
    to_count,
    to_number,
    unguard,
    unique_slug,
)
from ambiguous_wild.report.board_verify import RENDERS, VerifiedRun

INDEX = "index.csv"
OLD = (  # columns of an index of earlier versions, which kept no masks: every picture is of kind "test"
    "dataset", "scene", "image", "method", "setting", "options", "seed", "psnr", "file", "sha256", "row_hash",
)  # fmt: skip
COLUMNS = (*OLD[:-1], "kind", "row_hash")
TEST, TRAIN, EXACT = KINDS = ("test", "train", "exact")
SIDE = 1600  # px of the longer side, at most
QUALITY = 90  # of the JPEG
PREDICTED_RGBA, EXACT_RGBA = (255, 40, 40, 140), (0, 200, 255, 140)
Row = dict[str, str]  # by column; method is empty for photos and exact masks


@dataclass(frozen=True)
class _PictureSubject:
    """What a picture shows; see the kinds above."""

    dataset: str
    scene: str
    image: str
    method: str = ""
    setting: str = ""
    options: str = ""
    kind: str = TEST

    @property
    def file(self) -> str:
        name = unique_slug(self.method, self.setting, self.options) if self.method else "photo"
        mask = self.kind == EXACT or (self.kind == TRAIN and bool(self.method))
        name = "exact" if self.kind == EXACT else name
        parts = (slug(self.dataset), unique_slug(self.scene), unique_slug(self.image))
        # a train photo may have the same name as a test photo
        parts = parts if self.kind == TEST else (*parts[:2], f"train-{parts[2]}")
        return "/".join((*parts, f"{name}.{'png' if mask else 'jpg'}"))


def folder_of(board: Path) -> Path:
    """Return the folder of the pictures."""
    return measured(board) / "images"


def read_index(board: Path) -> list[Row]:
    """Read what the pictures of a board show; empty if there are none.

    Raises:
        AwError: the index is damaged, or names a wrong file.
    """
    path = folder_of(board) / INDEX
    if not path.is_file():
        return []
    rows = [
        {"kind": TEST} | {k: unguard(v) for k, v in row.items() if k in COLUMNS}
        for row in read_csv(path, OLD)[1]
    ]
    for at, row in enumerate(rows, 2):
        if row["kind"] not in KINDS:
            raise AwError(f"{path} row {at}: kind is none of {', '.join(KINDS)}; restore the index")
        if row["file"] != _place(row).file:
            raise AwError(f"{path} row {at} names the file of another picture: restore the index")
        if row.pop("row_hash") != _row_hash(row, f"{path} row {at}"):
            raise AwError(
                f"{path} row {at} was changed by hand, its cells do not match its row_hash: "
                "restore the file from your version control"
            )
        if row["seed"]:
            to_count(row["seed"], f"{path} row {at}: seed")
    return rows


def keep(board: Path, runs: Iterable[VerifiedRun], count: int) -> int:
    """Keep pictures of runs: for each method and scene those of the lowest seed.

    Args:
        board: folder of the board.
        runs: the verified runs.
        count: number of test images, and of train photos with masks, for each scene, evenly spaced by name.

    Returns:
        The number of pictures written.
    """
    index = {_place(row): row for row in read_index(board)}
    before = dict(index)
    written = 0
    for run in sorted(runs, key=lambda r: (r.entry.key, str(r.run))) if count else ():
        for name in chosen(run.names, count):
            written += _keep_one(board, run, name, index)
        written += _keep_masks(board, run, count, index)
    if index != before:
        _write_index(board, index.values())
    return written


def drop(board: Path, runs: Iterable[Entry]) -> None:
    """Remove the pictures of all other runs, and photos that have no render any more."""
    cells = {(*e.key[:-1], str(e.seed)) for e in runs}
    index = read_index(board)
    keys = ("dataset", "scene", "method", "setting", "options", "seed")
    renders = [row for row in index if row["method"] and tuple(row[k] for k in keys) in cells]
    shown = {_view(row) for row in renders}
    left = [row for row in index if row in renders or (not row["method"] and _view(row) in shown)]
    if left == index:
        return
    _write_index(board, left)
    files = {row["file"] for row in left}
    for row in index:
        if row["file"] not in files:
            (folder_of(board) / row["file"]).unlink(missing_ok=True)


def _view(row: Row) -> tuple[str, str, str, bool]:
    """Return the test view or train photo of a picture."""
    return row["dataset"], row["scene"], row["image"], row["kind"] == TEST


def _write_index(board: Path, index: Iterable[Row]) -> None:
    rows: list[list[CsvValue]] = []
    for row in sorted(index, key=lambda r: r["file"]):
        seed = int(row["seed"]) if row["seed"] else None
        psnr = to_number(row["psnr"], "psnr")
        texts = (*(row[k] for k in COLUMNS[:6]), seed, psnr, row["file"], row["sha256"], row["kind"])
        rows.append([*texts, _row_hash(row, "psnr")])
    write_text(folder_of(board) / INDEX, board_csv(COLUMNS, rows))


def _row_hash(row: Row, where: str) -> str:
    """Return the sha256 over the other cells of a row."""
    psnr = number(to_number(row["psnr"], where))
    columns = OLD[:-1] if row["kind"] == TEST else COLUMNS[:-1]  # rows of earlier versions keep their hash
    return config_hash([psnr if k == "psnr" else row[k] for k in columns])


def chosen(names: tuple[str, ...], count: int) -> list[str]:
    """Return `count` of the names, evenly spaced."""
    at = (
        np.linspace(0, len(names) - 1, min(count, len(names)) + 2)[1:-1]
        if len(names) > count
        else range(len(names))
    )
    return [names[round(float(i))] for i in at]


def _keep_one(board: Path, run: VerifiedRun, name: str, index: dict[_PictureSubject, Row]) -> int:
    e = run.entry
    place = _PictureSubject(e.dataset, e.scene, name, e.method, e.setting, e.options)
    if _has_lower_seed(index.get(place), e.seed):
        return 0
    written = 0
    if run.scene is not None:
        photo = _PictureSubject(e.dataset, e.scene, name)
        path = next(v.image_path for v in run.scene.test if v.name == name)
        written += _write(board, photo, _jpeg(path), "", math.nan, index)
    render = (run.run / RENDERS / name).with_suffix(".png")
    return written + _write(board, place, _jpeg(render), str(e.seed), run.psnr[name], index)


def _has_lower_seed(row: Row | None, seed: int) -> bool:
    return row is not None and bool(row["seed"]) and int(row["seed"]) < seed


def _keep_masks(board: Path, run: VerifiedRun, count: int, index: dict[_PictureSubject, Row]) -> int:
    """Keep train photos, the run's masks of them, and the exact masks if there are any."""
    e, scene = run.entry, run.scene
    if scene is None:
        return 0
    masks = {v.name: (run.run / MASKS / v.name).with_suffix(".png") for v in scene.train}
    written = 0
    for name in chosen(tuple(sorted(n for n, path in masks.items() if path.is_file())), count):
        view = next(v for v in scene.train if v.name == name)
        place = _PictureSubject(e.dataset, e.scene, name, e.method, e.setting, e.options, TRAIN)
        if _has_lower_seed(index.get(place), e.seed):
            continue
        photo = _jpeg(view.image_path)
        written += _write(
            board, _PictureSubject(e.dataset, e.scene, name, kind=TRAIN), photo, "", math.nan, index
        )
        size = (view.camera.width, view.camera.height)
        exact = scene.root / "truth" / "distractor" / Path(name).with_suffix(".png")
        if exact.is_file():
            drawn = _overlay(read_gray(exact) >= 128, size, EXACT_RGBA)
            written += _write(
                board, _PictureSubject(e.dataset, e.scene, name, kind=EXACT), drawn, "", math.nan, index
            )
        drawn = _overlay(read_gray(masks[name]) < 128, size, PREDICTED_RGBA)
        written += _write(board, place, drawn, str(e.seed), math.nan, index)
    return written


def _write(
    board: Path,
    place: _PictureSubject,
    data: bytes,
    seed: str,
    psnr: float,
    index: dict[_PictureSubject, Row],
) -> int:
    path = folder_of(board) / place.file
    fresh = not path.is_file() or path.read_bytes() != data
    if fresh:
        with atomic_path(path) as temporary:
            temporary.write_bytes(data)
    shown = "" if math.isnan(psnr) else repr(float(psnr))
    texts = (place.dataset, place.scene, place.image, place.method, place.setting, place.options)
    index[place] = dict(zip(COLUMNS, (*texts, seed, shown, place.file, sha256_file(path), place.kind)))
    return int(fresh)


def _place(row: Row) -> _PictureSubject:
    dataset, scene, image, method, setting, options = (row[k] for k in COLUMNS[:6])
    return _PictureSubject(dataset, scene, image, method, setting, options, row["kind"])


def _overlay(
    shown: np.ndarray,  # [H, W] bool
    size: tuple[int, int],  # px of the photo, width and height
    colour: tuple[int, int, int, int],
) -> bytes:
    """Return a PNG with the photo's aspect ratio: the colour where shown, transparent elsewhere."""
    scale = min(1.0, SIDE / max(size))
    size = (max(round(size[0] * scale), 1), max(round(size[1] * scale), 1))
    shown = cv2.resize(shown.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    red, green, blue, alpha = colour
    image = np.zeros((*shown.shape, 4), np.uint8)
    image[shown] = (blue, green, red, alpha)
    return bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1])


def _jpeg(path: Path) -> bytes:
    image = read_png_rgb(path)
    scale = SIDE / max(image.shape[:2])
    if scale < 1:  # never enlarged: the browser does that
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return jpeg_bytes(image, QUALITY, full_colour=True)
