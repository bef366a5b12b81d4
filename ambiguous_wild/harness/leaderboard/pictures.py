"""Small copies of test renders and photos, kept beside the CSVs so that the page needs no run folder."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.harness.leaderboard.board import measured
from ambiguous_wild.harness.leaderboard.entry import Entry
from ambiguous_wild.harness.leaderboard.sheet import (
    CsvValue,
    number,
    read_csv,
    slug,
    to_count,
    to_csv,
    to_number,
    unguard,
    unique_slug,
)
from ambiguous_wild.harness.leaderboard.verify import RENDERS, Verified
from ambiguous_wild.io.atomic import atomic_path, write_text
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.io.images import read_png_rgb

INDEX = "index.csv"
COLUMNS = (
    "dataset", "scene", "image", "method", "setting", "options", "seed", "psnr", "file", "sha256", "row_hash",
)  # fmt: skip
SIDE = 640  # px of the longer side, at most
QUALITY = 88  # of the JPEG
Row = dict[str, str]  # by column; method is empty for the photo


@dataclass(frozen=True)
class _Place:
    """What a picture shows: a method's render of a test view, or its photo."""

    dataset: str
    scene: str
    image: str
    method: str = ""
    setting: str = ""
    options: str = ""

    @property
    def file(self) -> str:
        name = unique_slug(self.method, self.setting, self.options) if self.method else "photo"
        return "/".join((slug(self.dataset), unique_slug(self.scene), unique_slug(self.image), f"{name}.jpg"))


def folder_of(board: Path) -> Path:
    """Where the pictures lie."""
    return measured(board) / "images"


def read_index(board: Path) -> list[Row]:
    """What the pictures of a board show; empty where there is none.

    Raises:
        AwError: the index is damaged, or names a file elsewhere.
    """
    path = folder_of(board) / INDEX
    if not path.is_file():
        return []
    rows = [{k: unguard(v) for k, v in row.items()} for row in read_csv(path, COLUMNS)[1]]
    for at, row in enumerate(rows, 2):
        if row["file"] != _place(row).file:
            raise AwError(f"{path} row {at} names a file that is not its own: restore the index")
        if row.pop("row_hash") != _row_hash(row, f"{path} row {at}"):
            raise AwError(
                f"{path} row {at} was changed by hand, its cells do not hash to its row_hash: "
                "restore the file from your version control"
            )
        if row["seed"]:
            to_count(row["seed"], f"{path} row {at}: seed")
    return rows


def keep(board: Path, runs: Iterable[Verified], count: int) -> int:
    """Keep pictures of these runs: per method and scene those of the lowest seed.

    Args:
        board: its folder.
        runs: that were verified.
        count: test images a scene, evenly over their names; 0 keeps none.

    Returns:
        How many pictures were written.
    """
    index = {_place(row): row for row in read_index(board)}
    before = dict(index)
    written = 0
    for run in sorted(runs, key=lambda r: (r.entry.key, str(r.run))) if count else ():
        for name in chosen(run.names, count):
            written += _keep_one(board, run, name, index)
    if index != before:
        _write_index(board, index.values())
    return written


def drop(board: Path, runs: Iterable[Entry]) -> None:
    """Remove the pictures of runs that are not among these, and photos without any render left."""
    cells = {(*e.key[:-1], str(e.seed)) for e in runs}
    index = read_index(board)
    keys = ("dataset", "scene", "method", "setting", "options", "seed")
    renders = [row for row in index if row["method"] and tuple(row[k] for k in keys) in cells]
    shown = {(row["dataset"], row["scene"], row["image"]) for row in renders}
    left = [
        row
        for row in index
        if row in renders or (not row["method"] and (row["dataset"], row["scene"], row["image"]) in shown)
    ]
    if left == index:
        return
    _write_index(board, left)
    files = {row["file"] for row in left}
    for row in index:
        if row["file"] not in files:
            (folder_of(board) / row["file"]).unlink(missing_ok=True)


def _write_index(board: Path, index: Iterable[Row]) -> None:
    rows: list[list[CsvValue]] = []
    for row in sorted(index, key=lambda r: r["file"]):
        seed = int(row["seed"]) if row["seed"] else None
        psnr = to_number(row["psnr"], "psnr")
        texts = (*(row[k] for k in COLUMNS[:6]), seed, psnr, row["file"], row["sha256"])
        rows.append([*texts, _row_hash(row, "psnr")])
    write_text(folder_of(board) / INDEX, to_csv(COLUMNS, rows))


def _row_hash(row: Row, where: str) -> str:
    """sha256 over the other cells of a row."""
    psnr = number(to_number(row["psnr"], where))
    return config_hash([psnr if k == "psnr" else row[k] for k in COLUMNS[:-1]])


def chosen(names: tuple[str, ...], count: int) -> list[str]:
    """`count` names, evenly spread."""
    at = (
        np.linspace(0, len(names) - 1, min(count, len(names)) + 2)[1:-1]
        if len(names) > count
        else range(len(names))
    )
    return [names[round(float(i))] for i in at]


def _keep_one(board: Path, run: Verified, name: str, index: dict[_Place, Row]) -> int:
    e = run.entry
    place = _Place(e.dataset, e.scene, name, e.method, e.setting, e.options)
    known = index.get(place)
    if known is not None and known["seed"] and int(known["seed"]) < e.seed:
        return 0
    written = 0
    if run.scene is not None:
        photo = _Place(e.dataset, e.scene, name)
        path = next(v.image_path for v in run.scene.test if v.name == name)
        written += _write(board, photo, path, "", math.nan, index)
    render = (run.run / RENDERS / name).with_suffix(".png")
    return written + _write(board, place, render, str(e.seed), run.psnr[name], index)


def _write(board: Path, place: _Place, source: Path, seed: str, psnr: float, index: dict[_Place, Row]) -> int:
    path, data = folder_of(board) / place.file, _jpeg(read_png_rgb(source))
    fresh = not path.is_file() or path.read_bytes() != data
    if fresh:
        with atomic_path(path) as temporary:
            temporary.write_bytes(data)
    shown = "" if math.isnan(psnr) else repr(float(psnr))
    texts = (place.dataset, place.scene, place.image, place.method, place.setting, place.options)
    index[place] = dict(zip(COLUMNS, (*texts, seed, shown, place.file, sha256_file(path))))
    return int(fresh)


def _place(row: Row) -> _Place:
    return _Place(*(row[k] for k in COLUMNS[:6]))


def _jpeg(image: np.ndarray) -> bytes:
    scale = SIDE / max(image.shape[:2])
    if scale < 1:  # never enlarged: the browser does that
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    flags = [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(image[:, :, ::-1]), flags)
    if not done:
        raise AwError(f"OpenCV could not write a picture of {image.shape[1]}x{image.shape[0]} as JPEG")
    return data.tobytes()
