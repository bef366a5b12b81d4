"""The hidden work folder of a build: one folder a stage, complete or absent, so a kill costs one stage.

The name of a stage's folder holds a key: the hash of its inputs, its settings, the code's version and the
keys of the stages it reads. A changed setting changes the keys of later stages only. The stage's record holds
the key too, so that a folder under the name of another is made anew.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from ambiguous_wild import __version__
from ambiguous_wild.core.errors import AwError, installed
from ambiguous_wild.io.files import atomic_dir, own_json, write_json

BUILDER = 26  # raised when a stage gives another result for the same input
_LIBRARIES = ("pycolmap", "OpenImageIO", "opencv-contrib-python-headless", "pillow", "numpy")
_RESULT = "stage.json"
_MIN_FREE = 2**20  # bytes; with less, a stage that fails is taken to fail for lack of space
Facts = TypeVar("Facts", bound=Mapping[str, object])  # a record of `records.py`


@cache
def versions() -> dict[str, str]:
    """Return the versions that the result depends on, by name; a library under another name is absent."""
    version_of = {name: version for name in _LIBRARIES if (version := installed(name)) is not None}
    return {"ambiguous_wild": __version__, "builder": str(BUILDER), **version_of}


def content_key(*parts: Any) -> str:
    """sha256 of the parts as canonical JSON, 64 hex digits."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("utf-8", errors="surrogateescape")).hexdigest()


@dataclass(frozen=True)
class StageResult(Generic[Facts]):
    """A finished stage: its files, its record and its time."""

    name: str
    key: str
    folder: Path
    facts: Facts
    seconds: float
    reused: bool  # an earlier call had finished it


class Workspace:
    """Runs stages inside one folder and remembers the finished ones."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.results: list[StageResult[Any]] = []
        root.mkdir(parents=True, exist_ok=True)
        for leftover in root.glob(".*.tmp-*"):  # a stage that was killed
            shutil.rmtree(leftover, ignore_errors=True)

    def run(self, name: str, inputs: Any, work: Callable[[Path], Facts]) -> StageResult[Facts]:
        """Run `work(folder)` unless its result exists.

        Args:
            name: of the stage; part of its folder's name.
            inputs: plain data that determines the result: settings, hashes, keys of earlier stages.
            work: fills the folder and returns a record for stage.json.

        Raises:
            OSError: the disk is full.
        """
        key = content_key(name, inputs)
        folder = self.root / f"{name}-{key[:16]}"
        reused = own_json(folder / _RESULT).get("key") == key
        if not reused:
            started = time.perf_counter()
            with atomic_dir(folder) as temporary:
                try:
                    facts = work(temporary)
                except AwError as error:  # COLMAP does not say why it ended, and its log is on the same disk
                    if shutil.disk_usage(temporary).free >= _MIN_FREE:
                        raise
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder)) from error
                spent = round(time.perf_counter() - started, 3)
                write_json(temporary / _RESULT, {"key": key, "facts": facts, "seconds": spent})
        stored = json.loads((folder / _RESULT).read_text(encoding="utf-8"))
        result: StageResult[Facts] = StageResult(
            name, key, folder, stored["facts"], stored["seconds"], reused
        )
        self.results.append(result)
        return result

    def seconds(self) -> dict[str, float]:
        """Return the time of each stage; a stage with several results gets their sum."""
        seconds_of: dict[str, float] = {}
        for result in {result.key: result for result in self.results}.values():
            seconds_of[result.name] = round(seconds_of.get(result.name, 0.0) + result.seconds, 3)
        return seconds_of

    def forget(self, result: StageResult[Any]) -> None:
        """Delete one stage's folder, so that it runs again."""
        self.results.remove(result)
        shutil.rmtree(result.folder, ignore_errors=True)

    def remove(self) -> None:
        """Delete the work folder and everything in it."""
        shutil.rmtree(self.root, ignore_errors=True)
