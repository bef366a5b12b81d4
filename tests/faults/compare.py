"""Compare the outputs of two runs of a command, and check that files are complete."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import yaml

from ambiguous_wild.core.config import to_plain
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.io.ply import read_splat_ply
from ambiguous_wild.io.scene_folder import read_scene_json, verify_files
from ambiguous_wild.splat import checkpoint

# What a clock or the machine's load decides; everything else must be the same to the byte.
_CLOCK = {
    "seconds", "train_s", "setup_s", "elapsed_s", "parts_s", "ms_per_iteration", "ms_parts", "fps",
    "fps_low", "fps_high", "peak_rss_mb", "wall_s", "taken_s", "written", "created", "cpu_s", "reference_s",
    "timing", "meter", "first_pass_s",
    "cores",  # that the process may use: whoever shares the machine may change it between two starts
}  # fmt: skip
_MACHINE = {"env.json", "log.txt"}  # say when and on what a run was made


def without_clock(value: Any) -> Any:
    """Plain data without keys for times."""
    if isinstance(value, dict):
        kept = {k: v for k, v in value.items() if k not in _CLOCK and not str(k).startswith("ms_")}
        return {k: without_clock(v) for k, v in kept.items()}
    if isinstance(value, list):
        return [without_clock(v) for v in value]
    return value


def fingerprint(path: Path) -> str:
    """sha256 of a file's content without times."""
    if path.suffix == ".json":
        data = without_clock(json.loads(path.read_text(encoding="utf-8")))
        return _digest([json.dumps(data).encode()])
    if path.name == "timeline.csv":
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))
        return _digest([json.dumps(without_clock(rows)).encode()])
    if path.suffix == ".safetensors":
        return _digest(_leaves(without_clock(checkpoint.load(path))))
    return _digest([path.read_bytes()])


def _leaves(tree: Any) -> Iterable[bytes]:
    if isinstance(tree, dict):
        for name in sorted(tree):
            yield name.encode()
            yield from _leaves(tree[name])
    elif isinstance(tree, list | tuple):
        yield f"{len(tree)}".encode()
        for value in tree:
            yield from _leaves(value)
    elif hasattr(tree, "numpy"):
        array = tree.numpy()
        yield f"{array.dtype}{array.shape}".encode()
        yield array.tobytes()
    else:
        yield json.dumps(to_plain(tree)).encode()


def _digest(parts: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()


def state(folder: Path) -> dict[str, str]:
    """Fingerprint of every file below `folder`, including hidden leftovers of a kill."""
    return {
        path.relative_to(folder).as_posix(): fingerprint(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in _MACHINE
    }


def _scene(path: Path) -> None:
    info = read_scene_json(path.parent)
    if info is not None:
        verify_files(path.parent, info)


def _json(path: Path) -> None:
    json.loads(path.read_text(encoding="utf-8"))


def _yaml(path: Path) -> None:
    if not isinstance(yaml.safe_load(path.read_text(encoding="utf-8")), dict):
        raise ValueError("no mapping")


def _csv(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    lengths = {len(row) for row in csv.reader(io.StringIO(text), strict=True)}
    if len(lengths) != 1 or not text.endswith("\n"):
        raise ValueError("lines of different lengths")


def _html(path: Path) -> None:
    if not path.read_text(encoding="utf-8").rstrip().endswith("</html>"):
        raise ValueError("has no end")


_WHOLE: dict[str, Callable[[Path], Any]] = {
    "scene.json": _scene,
    ".json": _json,
    ".yaml": _yaml,
    ".csv": _csv,
    ".html": _html,
    ".png": read_png_rgb,
    ".jpg": read_png_rgb,
    ".ply": read_splat_ply,
    ".safetensors": checkpoint.load,
}


def half_written(folder: Path) -> list[str]:
    """Incomplete files with final names; hidden ones are temporary."""
    wrong = []
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder)
        if not path.is_file() or any(part.startswith(".") for part in inside.parts):
            continue
        check = _WHOLE.get(path.name) or _WHOLE.get(path.suffix)
        try:
            if check is not None:
                check(path)
            elif path.stat().st_size == 0:
                raise ValueError("empty")
        except Exception as error:  # whatever a reader says of it, the file is not whole
            wrong.append(f"{inside.as_posix()}: {error}")
    return wrong
