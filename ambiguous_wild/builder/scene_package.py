"""Last stage: the scene folder, laid out for gsplat, nerfstudio and NerfBaselines, and its scene.json."""

from __future__ import annotations

import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.builder.records import KeyedRecord, PackageResult, SceneRecord
from ambiguous_wild.builder.resample import TRUTH_PARTS
from ambiguous_wild.core.scene import FileEntry
from ambiguous_wild.io.files import sha256_file, write_json
from ambiguous_wild.io.scene_folder import SCENE_SCHEMA


@dataclass(frozen=True)
class SceneParts:
    """Files of the finished stages that the scene consists of."""

    resampled: Path  # images/, sparse/0, with a factor images_FACTOR/, masks/, truth/
    factor: int
    train: list[str]
    test: list[str]
    truth_files: list[Path]  # cameras.json and capture.json of a simulated capture
    motion: Path  # file of the motion points
    map: Path  # picture of the cameras from above
    masked: list[str]  # test photos with a mask or alpha of their own


def package(folder: Path, parts: SceneParts, record: KeyedRecord, *, link: bool, jobs: int) -> PackageResult:
    """Assemble the scene in `folder`.

    Args:
        folder: must not exist yet; the caller renames it to the scene.
        parts: files of the finished stages.
        record: scene.json without its files.
        link: hard-link the stages' files, which are deleted afterwards, instead of copying them.
        jobs: threads that hash.
    """
    begun = time.perf_counter()
    folder.mkdir()
    copies = (f"images_{parts.factor}",) if parts.factor > 1 else ()
    truth = (f"truth/{part}" for part in TRUTH_PARTS)
    for name in ("images", *copies, "sparse/0", *truth):
        if (parts.resampled / name).is_dir():
            _add_folder(parts.resampled / name, folder / name, link)
    masks = parts.resampled / "masks"
    if masks.is_dir():
        # Two folders, not masks/NAME.png: from there NerfBaselines would leave pixels out of its scores.
        _add_folder(masks, folder / "masks" / "train", link, set(parts.train))
        _add_folder(masks, folder / "masks" / "test", link, set(parts.masked))  # for psnr_valid alone
    for path in parts.truth_files:
        _add_file(path, folder / "truth" / path.name, link=False)
    for path in (parts.motion, parts.map):
        _add_file(path, folder / path.name, link=link)
    (folder / "train_list.txt").write_text("".join(f"{n}\n" for n in parts.train), encoding="utf-8")
    (folder / "test_list.txt").write_text("".join(f"{n}\n" for n in parts.test), encoding="utf-8")
    half = record.get("evaluation", {}).get("protocol") == "half"
    write_json(folder / "nb-info.json", nerfbaselines_info(parts.factor, record["name"], half=half))
    files = list_files(folder, jobs)
    scene: SceneRecord = {
        "schema": "ambiguous_wild.scene",
        "schema_version": SCENE_SCHEMA,
        **record,
        "files": files,
    }
    scene["seconds"] = {**record["seconds"], "package": round(time.perf_counter() - begun, 3)}
    write_json(folder / "scene.json", scene)
    return {"files": len(files) + 1, "bytes": sum(f["bytes"] for f in files.values())}


def nerfbaselines_info(factor: int, name: str, *, half: bool) -> dict[str, object]:
    """Return nb-info.json: the folder that NerfBaselines loads, and its evaluation protocol.

    `half`: the right half of each test photo is measured.

    No `id`: NerfBaselines only loads ids that are registered with it.
    """
    return {
        "loader": "colmap",
        "loader_kwargs": {"images_path": "images" if factor == 1 else f"images_{factor}"},
        "scene": name,
        "evaluation_protocol": "nerfw" if half else "default",
        "downscale_factor": factor,
    }


def list_files(folder: Path, jobs: int) -> dict[str, FileEntry]:
    """Return sha256 and size of every file, by path relative to the folder."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    with ThreadPoolExecutor(jobs) as pool:
        digests = list(pool.map(sha256_file, paths))
    return {
        p.relative_to(folder).as_posix(): {"sha256": d, "bytes": p.stat().st_size}
        for p, d in zip(paths, digests)
    }


def _add_folder(source: Path, target: Path, link: bool, names: set[str] | None = None) -> None:
    for path in sorted(source.iterdir()):
        if names is None or path.name in names:
            _add_file(path, target / path.name, link=link)


def _add_file(source: Path, target: Path, *, link: bool) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if link:
        try:
            os.link(source, target)
            return
        except OSError:  # a file system without hard links
            pass
    shutil.copyfile(source, target)
