"""`aw package`: scenes as archives with checksums, Croissant metadata and a data card.

Two packages of the same scenes have the same bytes: files are stored uncompressed, sorted by name, with one
fixed time, and nothing of the machine is written.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import zipfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.core.config import Facts
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.names import check_name, csv_text
from ambiguous_wild.core.scene import SceneInfo
from ambiguous_wild.datasets.privacy import may_show_person, strip_metadata
from ambiguous_wild.datasets.release_facts import (
    PackedFile,
    ReleaseInfo,
    SceneFacts,
    card,
    croissant,
    simulated_license,
    with_simulated,
)
from ambiguous_wild.io.files import (
    atomic_dir,
    check_output,
    check_replaceable,
    own_json,
    sha256_file,
    write_json,
)
from ambiguous_wild.io.scene_folder import load_scene, read_scene_json, without_suffix

FILES = ("scene", "archive", "path", "role", "split", "sha256", "bytes")
PHOTOS = ("scene", "photo", "split", "source", "done", "metadata_removed", "person")
EDITABLE = ("README.md", "croissant.json", "files.csv", "photos.csv")  # a person may have edited them
FIXED = (*EDITABLE, "checksums.sha256", "checksums.md5")
_TIME = (1980, 1, 1, 0, 0, 0)  # the earliest time that zip can hold
NOT_STATED = "not stated"  # the licence in scene.json
_DROPPED = ("seconds", "capture")  # keys of scene.json that differ between two builds of one scene


@dataclass(frozen=True)
class Packed:
    """A finished package."""

    folder: Path
    scenes: tuple[str, ...]
    lacking: tuple[str, ...]  # fields that keep it from release
    bytes: int
    stripped: int  # photos that lost metadata
    people: tuple[str, ...] | None  # photos in which a person may be seen


def package_scenes(
    scenes: Sequence[Path],
    output: Path,
    info: ReleaseInfo,
    *,
    keep_metadata: bool = False,
    look_for_people: bool = True,
    jobs: int = 1,
    progress: bool = False,
) -> Packed:
    """Pack scene folders into `output`, which appears complete or not at all.

    Args:
        scenes: scene folders with scene.json.
        output: the folder to make; an earlier package in it is replaced, unless a person edited its texts.
        info: licence, consent and the rest; of simulated scenes they are known.
        keep_metadata: leave EXIF with places and serial numbers in the photos.
        look_for_people: run the person detectors of `privacy`.
        jobs: threads.
        progress: show bars.

    Raises:
        AwError: a scene is damaged, has no scene.json, or two have one name.
    """
    opened = [_open(Path(path)) for path in scenes]
    names = [name for _, name, _ in opened]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise AwError(f"two scenes are called {twice[0]}: their archives would be one file; rename one")
    captures = {name: own_json(root / "truth" / "capture.json") for root, name, _ in opened}
    info = with_simulated(info, captures)
    check_output(output, outside={f"the scene {name}": root for root, name, _ in opened})
    sums = output / "checksums.sha256"
    lines = sums.read_text(encoding="utf-8", errors="replace").splitlines() if sums.is_file() else []
    listed = {line[66:]: line[:64] for line in lines}
    check_replaceable(output, "package", {*FIXED, *listed} if "croissant.json" in listed else None)
    for name in EDITABLE:
        path = output / name
        if path.is_file() and sha256_file(path) != listed.get(name):
            raise AwError(
                f"{path} is not as this command wrote it and would be replaced: move it elsewhere, or "
                "choose another -o"
            )
    bar = Bar(progress)
    file_rows: list[list[Any]] = []
    photo_rows: list[list[Any]] = []
    packed: list[PackedFile] = []
    stripped = 0
    with atomic_dir(output) as folder:
        for root, name, scene_info in opened:
            detections = _people(root, jobs, bar) if look_for_people else {}
            rows, photos = _pack(root, name, scene_info, folder / f"{name}.zip", keep_metadata, bar)
            file_rows += rows
            for photo in photos:
                stripped += bool(photo[5])
                photo_rows.append([*photo, detections.get(photo[1], "")])
            packed.append(_described(folder / f"{name}.zip", "application/zip"))
        for table, head, rows in (("files.csv", FILES, file_rows), ("photos.csv", PHOTOS, photo_rows)):
            (folder / table).write_text(_csv(head, rows), encoding="utf-8")
            packed.append(_described(folder / table, "text/csv"))
        people = [f"{r[0]}/{r[1]}" for r in photo_rows if r[6]] if look_for_people else None
        facts = [_facts(name, scene_info, captures[name]) for _, name, scene_info in opened]
        data = croissant(info, facts, packed, {"files.csv": FILES, "photos.csv": PHOTOS})
        write_json(folder / "croissant.json", data)
        (folder / "README.md").write_text(card(info, facts, people, stripped, keep_metadata), "utf-8")
        for kind in ("sha256", "md5"):
            every = [*packed, *(_described(folder / n, "") for n in ("croissant.json", "README.md"))]
            text = "".join(f"{getattr(f, kind)}  {f.name}\n" for f in sorted(every, key=lambda f: f.name))
            (folder / f"checksums.{kind}").write_text(text, encoding="utf-8")
    bar.finish()
    size = sum(f.bytes for f in packed)
    return Packed(
        output, tuple(names), tuple(info.lacking), size, stripped, None if people is None else tuple(people)
    )


def _open(root: Path) -> tuple[Path, str, SceneInfo]:
    info = read_scene_json(root)
    if info is None:
        raise AwError(
            f"{root} has no scene.json: import it with 'aw import', or build it with 'aw build-scene'"
        )
    load_scene(root)
    return root, check_name("scene name", str(info.get("name", root.name))), info


def _people(root: Path, jobs: int, bar: Bar) -> dict[str, str]:
    """Run the detectors: photo -> "person", "face" or both, of photos with a detection."""
    views = load_scene(root, verify=False, check=False).views
    bar.start("looking for people", len(views))

    def one(path: Path) -> str:
        detection = may_show_person(path)
        bar.step()
        return detection

    with ThreadPoolExecutor(jobs) as pool:
        detections = list(pool.map(one, [v.image_path for v in views]))
    bar.finish()
    return {v.name: text for v, text in zip(views, detections) if text}


def _pack(
    root: Path, name: str, info: SceneInfo, archive: Path, keep_metadata: bool, bar: Bar
) -> tuple[list[list[Any]], list[list[Any]]]:
    """Write one archive; return its rows of files.csv and of photos.csv."""
    split = {
        line: side
        for side in ("train", "test")
        if (root / f"{side}_list.txt").is_file()
        for line in (root / f"{side}_list.txt").read_text(encoding="utf-8").splitlines()
    }
    stems = {without_suffix(n): n for n in split}
    removed: dict[str, set[str]] = {}
    rows = []
    names = sorted(info["files"])
    bar.start(f"packing {name}", len(names))
    listed = {}
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as target:
        for path in names:
            data = (root / path).read_bytes()
            photo = _photo_of(path, stems)
            role, side = _role(path), split.get(photo or "", "")
            if not keep_metadata and (role == "photo" or path.endswith(".png")):
                data, dropped = strip_metadata(data, str(root / path))
                if dropped and photo is not None:
                    removed.setdefault(photo, set()).update(dropped)
            listed[path] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
            _add(target, f"{name}/{path}", data)
            rows.append([name, archive.name, path, role, side, listed[path]["sha256"], len(data)])
            bar.step()
        kept = {k: v for k, v in info.items() if k not in (*_DROPPED, "files")}
        record = json.dumps({**kept, "files": listed}, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        data = record.encode("utf-8")
        _add(target, f"{name}/scene.json", data)
        rows.append(
            [name, archive.name, "scene.json", "record", "", hashlib.sha256(data).hexdigest(), len(data)]
        )
    bar.finish()
    photo_facts: Any = info.get("photos")
    photos = []
    for photo, side in sorted(split.items()):
        fact = photo_facts.get(photo) if isinstance(photo_facts, dict) else None
        fact = fact if isinstance(fact, dict) else {}
        done = "; ".join(map(str, fact.get("notes") or [])) or "undistorted and stored as PNG where needed"
        dropped_here = ", ".join(sorted(removed.get(photo, ())))
        photos.append([name, photo, side, fact.get("source", ""), done, dropped_here])
    return rows, photos


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    entry = zipfile.ZipInfo(name, _TIME)
    entry.compress_type, entry.create_system, entry.external_attr = zipfile.ZIP_STORED, 3, 0o644 << 16
    archive.writestr(entry, data)


def _photo_of(path: str, stems: dict[str, str]) -> str | None:
    """Return the listed photo that a file under images*/ or masks/train belongs to."""
    parts = PurePosixPath(path).parts
    if len(parts) < 2 or not parts[0].startswith(("images", "masks")):
        return None
    rest = parts[2:] if parts[0] == "masks" else parts[1:]
    return stems.get(without_suffix(str(PurePosixPath(*rest)))) if rest else None


def _role(path: str) -> str:
    top = path.partition("/")[0]
    roles = {"sparse": "model", "masks": "mask", "truth": "truth"}
    if top.startswith("images"):
        return "photo"
    return roles.get(top, "list" if path.endswith(".txt") else "record")


def _facts(name: str, info: SceneInfo, capture: Facts) -> SceneFacts:
    counts, ambiguity = info.get("counts"), info.get("ambiguity")
    license = str(info.get("license", NOT_STATED))
    return {
        "name": name,
        "license": license if license != NOT_STATED else simulated_license(capture) or license,
        "counts": counts if isinstance(counts, dict) else {},
        "factor": info["factor"],
        "ambiguity": ambiguity if isinstance(ambiguity, dict) else None,
    }


def _described(path: Path, kind: str) -> PackedFile:
    sha256, md5, size = hashlib.sha256(), hashlib.md5(usedforsecurity=False), 0
    with open(path, "rb") as f:
        while chunk := f.read(1 << 20):
            sha256.update(chunk)
            md5.update(chunk)
            size += len(chunk)
    return PackedFile(path.name, sha256.hexdigest(), md5.hexdigest(), size, kind)


def _csv(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Write CSV whose cells no spreadsheet takes for formulas."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    for row in rows:
        writer.writerow([_cell(value) for value in row])
    return out.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, int):
        return value
    return csv_text("".join(c if c.isprintable() else " " for c in str(value)))
