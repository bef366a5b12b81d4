"""Last stage: the scene folder as gsplat, nerfstudio and NerfBaselines read it, with its own account."""

from __future__ import annotations

import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ambiguous_wild.io.atomic import write_json
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.io.scene_folder import SCENE_SCHEMA


@dataclass(frozen=True)
class Parts:
    """Where the finished stages left what the scene is made of."""

    full: Path  # images/, sparse/0, masks/, truth/ at full size
    small: Path | None  # the same downsampled; None at factor 1
    factor: int
    train: list[str]
    test: list[str]
    truth_files: list[Path]  # cameras.json and capture.json of a simulated capture


def package(folder: Path, parts: Parts, account: dict[str, Any], *, link: bool, jobs: int) -> dict[str, Any]:
    """Assemble the scene in `folder`.

    Args:
        folder: does not exist yet; renamed to the scene afterwards.
        parts: see `Parts`.
        account: what scene.json says, without the files.
        link: hard-link from the stages (they are deleted afterwards) instead of copying.
        jobs: threads that hash.

    Returns:
        Facts: number of files and bytes.
    """
    begun = time.perf_counter()
    folder.mkdir()
    small = parts.small or parts.full
    _place(parts.full / "images", folder / "images", link)
    if parts.small is not None:
        _place(small / "images", folder / f"images_{parts.factor}", link)
    _place(parts.full / "sparse" / "0", folder / "sparse" / "0", link)
    if (small / "masks").is_dir():
        # Never for test photos: NerfBaselines would leave those pixels out of the score.
        _place(small / "masks", folder / "masks" / "train", link, set(parts.train))
    for part in ("distractor", "clean"):
        if (small / "truth" / part).is_dir():
            _place(small / "truth" / part, folder / "truth" / part, link)
    for path in parts.truth_files:
        _place_file(path, folder / "truth" / path.name, link=False)
    (folder / "train_list.txt").write_text("".join(f"{n}\n" for n in parts.train), encoding="utf-8")
    (folder / "test_list.txt").write_text("".join(f"{n}\n" for n in parts.test), encoding="utf-8")
    write_json(folder / "nb-info.json", nerfbaselines_info(parts.factor, account["name"]))
    files = list_files(folder, jobs)
    seconds = {**account["seconds"], "package": round(time.perf_counter() - begun, 3)}
    head = {"schema": "ambiguous_wild.scene", "schema_version": SCENE_SCHEMA}
    write_json(folder / "scene.json", {**head, **account, "seconds": seconds, "files": files})
    return {"files": len(files) + 1, "bytes": sum(f["bytes"] for f in files.values())}


def nerfbaselines_info(factor: int, name: str) -> dict[str, Any]:
    """nb-info.json: which folder NerfBaselines loads and how it scores.

    No `id`: NerfBaselines only loads ids that are registered with it.
    """
    return {
        "loader": "colmap",
        "loader_kwargs": {"images_path": "images" if factor == 1 else f"images_{factor}"},
        "scene": name,
        "evaluation_protocol": "default",
        "downscale_factor": factor,
    }


def list_files(folder: Path, jobs: int) -> dict[str, dict[str, Any]]:
    """sha256 and size of every file, by path relative to the folder."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    with ThreadPoolExecutor(jobs) as pool:
        digests = list(pool.map(sha256_file, paths))
    return {
        p.relative_to(folder).as_posix(): {"sha256": d, "bytes": p.stat().st_size}
        for p, d in zip(paths, digests)
    }


def _place(source: Path, target: Path, link: bool, names: set[str] | None = None) -> None:
    for path in sorted(source.iterdir()):
        if names is None or path.name in names:
            _place_file(path, target / path.name, link=link)


def _place_file(source: Path, target: Path, *, link: bool) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if link:
        try:
            os.link(source, target)
            return
        except OSError:  # a file system without hard links
            pass
    shutil.copyfile(source, target)
