"""Keep copies of test renders, photos and masks beside the CSV files, so that the page needs no run folder.

Kind "test": the render of a test view, or its photo. Kind "train": a train photo, or the mask that a method
predicts for it. Kind "exact": the exact mask of a train photo. Masks are transparent where a pixel is kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.harness.result_file import render_path
from ambiguous_wild.harness.trained_models import MASKS
from ambiguous_wild.io.files import sha256_file, write_bytes, write_text
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
from ambiguous_wild.report.board_verify import VerifiedRun

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
class PictureSubject:
    """What a picture shows; see the kinds above."""

    dataset: str
    scene: str
    image: str
    method: str = ""
    setting: str = ""
    options: str = ""
    kind: str = TEST

    @property
    def photo(self) -> PictureSubject:
        """The test or train photo itself."""
        return PictureSubject(self.dataset, self.scene, self.image, kind=self.kind)

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
        if row["file"] != _subject(row).file:
            raise AwError(f"{path} row {at} names the file of another picture: restore the index")
        if row.pop("row_hash") != _row_hash(row, f"{path} row {at}"):
            raise AwError(
                f"{path} row {at} was changed by hand, its cells do not match its row_hash: "
                "restore the file from your version control"
            )
        if row["seed"]:
            to_count(row["seed"], f"{path} row {at}: seed")
    return rows


def keep(board: Path, runs: Iterable[VerifiedRun], count: int) -> None:
    """Keep pictures of runs: for each method and scene those of the lowest seed.

    Args:
        board: folder of the board.
        runs: the verified runs.
        count: number of test images, and of train photos with masks, for each scene, evenly spaced by name.
    """
    pictures = BoardPictures(board)
    before = dict(pictures.rows)
    for run in sorted(runs, key=lambda r: (r.entry.key, str(r.run))) if count else ():
        pictures.add(run, count)
    if pictures.rows != before:
        write_index(board, pictures.rows.values())


class BoardPictures:
    """The pictures of a board, and the rows of their index by what they show."""

    def __init__(self, board: Path) -> None:
        self.folder = folder_of(board)
        self.rows = {_subject(row): row for row in read_index(board)}

    def add(self, run: VerifiedRun, count: int) -> None:
        """Keep renders of a run with their photos; then train photos, its masks, and exact masks if any."""
        e, scene = run.entry, run.scene
        own = PictureSubject(e.dataset, e.scene, "", e.method, e.setting, e.options)
        for name in chosen(run.names, count):
            render = replace(own, image=name)
            if self._has_lower_seed(render, e.seed):
                continue
            if scene is not None:
                path = next(v.image_path for v in scene.test if v.name == name)
                self.write(render.photo, _jpeg(path))
            self.write(render, _jpeg(render_path(run.run, name)), e.seed, run.psnr[name])
        if scene is None:
            return
        views = {v.name: v for v in scene.train}
        masks = {n: path for n in views if (path := (run.run / MASKS / n).with_suffix(".png")).is_file()}
        for name in chosen(tuple(sorted(masks)), count):
            view, mask = views[name], replace(own, image=name, kind=TRAIN)
            if self._has_lower_seed(mask, e.seed):
                continue
            self.write(mask.photo, _jpeg(view.image_path))
            size = (view.camera.width, view.camera.height)
            exact = scene.truth_file("distractor", view)
            if exact.is_file():
                drawn = _overlay(read_gray(exact) >= 128, size, EXACT_RGBA)
                self.write(replace(mask.photo, kind=EXACT), drawn)
            self.write(mask, _overlay(read_gray(masks[name]) < 128, size, PREDICTED_RGBA), e.seed)

    def _has_lower_seed(self, subject: PictureSubject, seed: int) -> bool:
        kept = self.rows.get(subject, {}).get("seed", "")
        return bool(kept) and int(kept) < seed

    def write(
        self, subject: PictureSubject, data: bytes, seed: int | None = None, psnr: float = math.nan
    ) -> None:
        """Write a picture and its row; the index is not written."""
        path = self.folder / subject.file
        if not path.is_file() or path.read_bytes() != data:
            write_bytes(path, [data])
        numbers = {
            "seed": "" if seed is None else str(seed),
            "psnr": "" if math.isnan(psnr) else repr(float(psnr)),
        }
        self.rows[subject] = vars(subject) | numbers | {"file": subject.file, "sha256": sha256_file(path)}


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
    write_index(board, left)
    files = {row["file"] for row in left}
    for row in index:
        if row["file"] not in files:
            (folder_of(board) / row["file"]).unlink(missing_ok=True)


def _view(row: Row) -> tuple[str, str, str, bool]:
    """Return the test view or train photo of a picture."""
    return row["dataset"], row["scene"], row["image"], row["kind"] == TEST


def write_index(board: Path, index: Iterable[Row]) -> None:
    """Write the rows in the order of their files."""
    rows: list[list[CsvValue]] = []
    for row in sorted(index, key=lambda r: r["file"]):
        seed, psnr = int(row["seed"]) if row["seed"] else None, to_number(row["psnr"], "psnr")
        cells = row | {"seed": seed, "psnr": psnr, "row_hash": _row_hash(row, "psnr")}
        rows.append([cells[k] for k in COLUMNS])
    write_text(folder_of(board) / INDEX, board_csv(COLUMNS, rows))


def _row_hash(row: Row, where: str) -> str:
    """Return the sha256 over the other cells of a row."""
    psnr = number(to_number(row["psnr"], where))
    columns = OLD[:-1] if row["kind"] == TEST else COLUMNS[:-1]  # rows of earlier versions keep their hash
    return config_hash([psnr if k == "psnr" else row[k] for k in columns])


def chosen(names: tuple[str, ...], count: int) -> list[str]:
    """Return `count` of the names, evenly spaced."""
    if len(names) <= count:
        return list(names)
    return [names[round(float(i))] for i in np.linspace(0, len(names) - 1, count + 2)[1:-1]]


def _subject(row: Row) -> PictureSubject:
    return PictureSubject(**{k: row[k] for k in vars(PictureSubject("", "", ""))})


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
