"""A contact sheet of a simulated capture: photos, their exact masks and clean versions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.harness.pictures import strips
from ambiguous_wild.io.images import read_gray, read_png_rgb
from ambiguous_wild.io.palette import ADDED, MASKED, tint

NAME = "sheet.jpg"
COLUMNS, WIDTH = 4, 320  # photos in a row, px of each


def write_capture_sheet(raw: Path, path: Path | None = None) -> Path:
    """Write a JPEG of eight train photos, two with their truth, and four test photos.

    Args:
        raw: a capture of `aw simulate`.
        path: JPEG to write; None: ``RAW/truth/sheet.jpg``, where no builder takes it for a photo.

    Returns:
        What was written.

    Raises:
        AwError: a photo of the capture is missing.
    """
    facts = json.loads((raw / "truth" / "capture.json").read_text(encoding="utf-8"))
    train = sorted(facts["photos"])
    test = sorted(p.name for p in (raw / "test").iterdir())
    chosen = _spread(train, 2 * COLUMNS)
    cells = [_cell(f"{_caption(name, facts)}", read_png_rgb(raw / "train" / name)) for name in chosen]
    for name in _spread(train, 2):
        cells += _truth(raw, name)
    cells += [_cell(f"test {name}", read_png_rgb(raw / "test" / name)) for name in _spread(test, COLUMNS)]
    rows = [strips.stack(cells[k : k + COLUMNS], 1) for k in range(0, len(cells), COLUMNS)]
    target = raw / "truth" / NAME if path is None else path
    strips.write_jpeg(target, strips.stack(rows, 0))
    return target


def _spread(names: list[str], count: int) -> list[str]:
    index = np.unique(np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int))
    return [names[i] for i in index]


def _caption(name: str, facts: dict[str, Any]) -> str:
    photo = facts["photos"][name]
    words = [f"{Path(name).stem} {100 * photo['occlusion']:.0f} %"]
    for drawn in photo.get("effects", {}).values():
        words += [f"{key} {value:.2g}" for key, value in drawn.items() if isinstance(value, float)]
    return ", ".join(words)


def _truth(raw: Path, name: str) -> list[np.ndarray]:
    stem = Path(name).stem
    mask = read_gray(raw / "truth" / "distractor" / f"{stem}.png") >= 128
    shown = tint(read_png_rgb(raw / "train" / name), mask, MASKED)
    shadow = raw / "truth" / "shadow" / f"{stem}.png"
    if shadow.is_file():
        shown = tint(shown, read_gray(shadow) >= 128, ADDED)
    return [
        _cell(f"{stem} mask, shadow" if shadow.is_file() else f"{stem} mask", shown),
        _cell(f"{stem} clean", read_png_rgb(raw / "truth" / "clean" / f"{stem}.png")),
    ]


def _cell(caption: str, image: np.ndarray) -> np.ndarray:
    return strips.cell(caption, image, WIDTH)
