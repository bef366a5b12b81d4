"""Simulated captures of suites: whether one is whole, and whether it is the one that everybody has.

A capture is identified by its pixels and cameras, not by the bytes of its files, which depend on the
encoders. Other versions of what computes the pixels may change them: then the hash is not the listed one.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core.config import Facts, config_hash
from ambiguous_wild.core.errors import AwError, counted, shortlist
from ambiguous_wild.core.machine import usable_cores
from ambiguous_wild.datasets.suites import Suite, simulated_suites
from ambiguous_wild.io.files import own_json, sha256_array, sha256_file
from ambiguous_wild.io.images import pillow
from ambiguous_wild.io.plain_yaml import read_mapping
from ambiguous_wild.io.untrusted import read_json

LISTED = Path(__file__).with_suffix(".yaml")
CAPTURES = "captures"  # folder of them, in that of a suite
RECORD = Path("truth") / "capture.json"
CAMERAS = Path("truth") / "cameras.json"
TRUTH = ("distractor", "instances", "shadow", "objects", "clean")
IMAGES = ("train", "test", *(f"truth/{part}" for part in TRUTH))
SUFFIXES = (".jpg", ".png")
DIGITS = 9  # of the cameras' numbers


@dataclass(frozen=True)
class CheckedCapture:
    """A whole simulated capture."""

    name: str
    sha256: str  # see `capture_hash`
    listed: str  # its hash in the list; empty: the list has none
    spec: Facts  # what it was simulated from
    version: str  # of this package, with which it was made

    @property
    def differs(self) -> bool:
        """Whether the list has another hash."""
        return self.listed not in ("", self.sha256)


@cache
def listed_hashes() -> dict[str, dict[str, str]]:
    """Read the list: width of the photos, px -> name -> `capture_hash`."""
    return read_mapping(LISTED)


def capture_hash(capture: Path) -> str:
    """Return the sha256 over names, sizes and decoded pixels of all images, and the rounded cameras.

    Images of `IMAGES` count, in the order of their names; previews and depth maps do not.

    Raises:
        AwError: an image or the cameras cannot be read.
    """
    paths = sorted(
        (path for part in IMAGES for path in (capture / part).glob("*") if path.suffix in SUFFIXES),
        key=lambda path: path.relative_to(capture).as_posix(),
    )
    with ThreadPoolExecutor(usable_cores()) as pool:
        pixels = list(pool.map(_pixels_hash, paths))
    images = [[path.relative_to(capture).as_posix(), digest] for path, digest in zip(paths, pixels)]
    return config_hash({"images": images, "cameras": _rounded(read_json(capture / CAMERAS))})


def _pixels_hash(path: Path) -> str:
    """Return the sha256 of the size and the decoded pixels of an image."""
    try:
        with pillow().open(path) as image:
            return sha256_array(np.asarray(image))
    except (OSError, ValueError, SyntaxError) as error:
        raise AwError(f"{path} cannot be read ({error}): remove its capture, and make it again") from None


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_rounded(inner) for inner in value]
    return round(value, DIGITS) + 0.0 if isinstance(value, float) else value  # -0.0 becomes 0.0


def check_capture(capture: Path, name: str, suite: Suite) -> CheckedCapture:
    """Check that a folder holds the whole capture `name` of a simulated suite, and hash it.

    Raises:
        AwError: it is no simulated capture, one of other settings, or damaged.
    """
    made, record = suite.simulated, own_json(capture / RECORD)
    spec, files, version = record.get("spec"), record.get("files"), record.get("version")
    if made is None or not isinstance(spec, dict) or not isinstance(files, dict):
        raise AwError(
            f"{capture} exists and is no whole capture of 'aw simulate': move it away, then "
            f"'aw fetch {suite.name}' makes {name} there"
        )
    asked = {"preset": name, "seed": made.seed, "width": made.width}
    there = {"preset": record.get("preset"), "seed": record.get("seed"), "width": spec.get("width")}
    if other := [f"{key} {there[key]}, not {value}" for key, value in asked.items() if there[key] != value]:
        raise AwError(
            f"{capture} holds another capture than {suite.name} has ({', '.join(other)}): move it away, then "
            f"'aw fetch {suite.name}' makes the right one"
        )
    paths = {n: capture / n for n in files}
    wrong = [n for n, path in paths.items() if not path.is_file() or sha256_file(path) != files[n]]
    if wrong:
        raise AwError(
            f"{capture} is damaged ({counted(len(wrong), 'file')} absent or changed: {shortlist(wrong, 3)}): "
            f"remove it, then 'aw fetch {suite.name}' makes it again"
        )
    by = version.get("ambiguous_wild") if isinstance(version, dict) else None
    listed = listed_hashes().get(str(made.width), {}).get(name, "")
    return CheckedCapture(name, capture_hash(capture), listed, spec, str(by))


def list_lines(checked: Sequence[CheckedCapture]) -> list[str]:
    """Return the lines on captures that are not the listed ones, or that the list lacks."""
    lines = []
    if other := [capture.name for capture in checked if capture.differs]:
        made_by = shortlist(sorted({capture.version for capture in checked if capture.differs}))
        lines.append(
            f"warning: {shortlist(other, 20)}: pixels or cameras differ from the listed ones, so results are "
            "not comparable with the board; likely another version of numpy, OpenCV, scikit-image, Pillow or "
            f"ambiguous-wild ({made_by}), or another processor"
        )
    if unknown := [capture.name for capture in checked if not capture.listed]:
        lines.append(f"no hash is listed for {shortlist(unknown, 20)}: whether all have the same is unknown")
    return lines


@dataclass(frozen=True)
class VerifiedCaptures:
    """The captures of a suite's folder."""

    suite: Suite
    checked: tuple[CheckedCapture, ...]
    absent: tuple[str, ...]
    damaged: tuple[str, ...]  # a line each

    @property
    def width(self) -> str:
        """The key of the suite's captures in the list."""
        return str(self.suite.simulated.width) if self.suite.simulated else ""


def suite_of_captures(folder: Path) -> Suite | None:
    """Return the simulated suite whose captures lie in a folder, by their width; None without any.

    Of suites with the same captures it is the one with most scenes.
    """
    widths = {_width(record) for record in sorted((folder / CAPTURES).glob(f"*/{RECORD.as_posix()}"))}
    fitting = [s for s in simulated_suites().values() if s.simulated and s.simulated.width in widths]
    return max(fitting, key=lambda suite: len(suite.scenes), default=None)


def _width(record: Path) -> Any:
    spec = own_json(record).get("spec")
    width = spec.get("width") if isinstance(spec, dict) else None
    return width if isinstance(width, int) else None


def verify_captures(folder: Path, suite: Suite) -> VerifiedCaptures:
    """Check every capture of a suite that lies in its folder, which holds captures/."""
    checked, absent, damaged = [], [], []
    for name in suite.scenes:
        capture = folder / CAPTURES / name
        if not capture.exists():
            absent.append(name)
            continue
        try:
            checked.append(check_capture(capture, name, suite))
        except AwError as error:
            damaged.append(str(error))
    return VerifiedCaptures(suite, tuple(checked), tuple(absent), tuple(damaged))
