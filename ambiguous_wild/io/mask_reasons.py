"""reasons.json of a run: why the regions of its train photos are masked or kept, one sentence each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambiguous_wild.io.files import own_json, write_json
from ambiguous_wild.io.page_parts import data_uri, png_of

FILE = "reasons.json"  # in the run's folder
WIDTH = 320  # px, largest width of a written map
_MAX_REGIONS = 255
_MAX_SENTENCE = 300  # characters


@dataclass(frozen=True)
class MaskReasons:
    """Why the pixels of one photo are masked or kept."""

    regions: np.ndarray  # [H, W] uint8, number of the sentence, from 1; 0 = no reason is known
    sentences: tuple[str, ...]  # each begins with "kept: " or "masked: "

    def at(self, column: int, row: int) -> str:
        """Return the sentence of a pixel, "" where no reason is known."""
        number = int(self.regions[row, column])
        return self.sentences[number - 1] if number else ""


def reasons_of(regions: np.ndarray, sentences: Sequence[str]) -> MaskReasons:
    """Join regions with the same sentence; of more than 255, those with the smallest areas are dropped.

    Args:
        regions: [H, W] integers, index of the sentence; negative = none.
        sentences: sentences of the regions; a sentence may occur several times.
    """
    distinct = list(dict.fromkeys(sentences))
    places = {sentence: number for number, sentence in enumerate(distinct)}
    index = np.array([*(places[sentence] for sentence in sentences), -1])[np.maximum(regions, -1)]
    areas = np.bincount(index[index >= 0], minlength=len(distinct))
    largest = np.sort(np.argsort(-areas, kind="stable")[:_MAX_REGIONS])
    largest = largest[areas[largest] > 0]
    numbers = np.zeros(len(distinct) + 1, np.uint8)
    numbers[largest] = np.arange(1, len(largest) + 1)
    return MaskReasons(numbers[index], tuple(distinct[k] for k in largest))


def regions_uri(regions: np.ndarray, width: int) -> str:
    """Return a data: address of a map [H, W] uint8 as PNG of at most `width` px, without mixing pixels."""
    import cv2

    if regions.shape[1] > width:
        height = max(1, round(regions.shape[0] * width / regions.shape[1]))
        regions = cv2.resize(regions, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    # a fifth of the time, and 30 % less than OpenCV's default, for such maps
    options = [cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    return data_uri("png", bytes(cv2.imencode(".png", regions, options)[1]))


def write_reasons(path: Path, photos: Mapping[str, MaskReasons]) -> None:
    """Write the reasons of photos, by their names in the scene; without any, an older file is removed."""
    if not photos:
        path.unlink(missing_ok=True)
        return
    rows = {
        name: {"regions": regions_uri(reasons.regions, WIDTH), "sentences": reasons.sentences}
        for name, reasons in photos.items()
    }
    write_json(path, {"schema": 1, "photos": rows})


def read_reasons(path: Path) -> dict[str, MaskReasons]:
    """Read name -> reasons; what is absent or damaged is left out, because a run may come from a stranger."""
    photos = own_json(path).get("photos")
    read = {name: _read(row) for name, row in photos.items()} if isinstance(photos, dict) else {}
    return {name: reasons for name, reasons in read.items() if reasons is not None}


def _read(row: object) -> MaskReasons | None:
    uri, sentences = (row.get("regions"), row.get("sentences")) if isinstance(row, dict) else (None, None)
    regions = png_of(uri, WIDTH, 100 * WIDTH)
    if regions is None or not isinstance(sentences, list) or regions.max(initial=0) > len(sentences):
        return None
    return MaskReasons(regions, tuple(str(sentence)[:_MAX_SENTENCE] for sentence in sentences))
