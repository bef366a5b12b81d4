"""`aw verify`: check a package, or one archive of it, from an untrusted source."""

from __future__ import annotations

import csv
import re
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.datasets.package import FILES, FIXED
from ambiguous_wild.datasets.release_facts import NOT_FOR_RELEASE, VERSION
from ambiguous_wild.io.archive import extract
from ambiguous_wild.io.files import list_names, sha256_file
from ambiguous_wild.io.images import image_size
from ambiguous_wild.io.scene_folder import load_scene, read_scene_json, verify_files
from ambiguous_wild.io.untrusted import read_json, read_text


@dataclass
class VerifiedPackage:
    """Scenes and files that were checked."""

    scenes: list[str] = field(default_factory=list)
    files: int = 0
    warnings: list[str] = field(default_factory=list)  # why a whole package is not ready for release


def verify(path: Path) -> VerifiedPackage:
    """Check checksums, tables, metadata and every scene of a package folder, or one scene's archive.

    Archives are unpacked into a temporary folder, which is removed.

    Raises:
        AwError: the first error, with its file.
    """
    if path.is_file():
        verified = VerifiedPackage()
        _scene(path, None, verified)
        return verified
    if not path.is_dir():
        raise AwError(f"there is no package {path}")
    absent = [name for name in FIXED if not (path / name).is_file()]
    if absent:
        raise AwError(f"{path} is no complete package: {shortlist(absent)} absent; copy it again")
    sums = _checksums(path / "checksums.sha256")
    extra = sorted(set(list_names(path)) - set(sums) - {"checksums.sha256", "checksums.md5"})
    if extra:
        raise AwError(
            f"{path} holds files that its checksums do not list: {shortlist(extra)}; do not trust it"
        )
    for name, digest in sums.items():
        file = path / name
        if not file.is_file() or file.is_symlink():
            raise AwError(f"{file} is absent or a link; copy the package again")
        if sha256_file(file) != digest:
            raise AwError(f"{file} differs from checksums.sha256: it is damaged or changed; copy it again")
    _check_md5(path)
    _check_croissant(path, sums)
    rows = _rows(path / "files.csv")
    verified = VerifiedPackage()
    for name in sorted(sums):
        if name.endswith(".zip"):
            _scene(path / name, {r["path"]: r for r in rows if r["archive"] == name}, verified)
    if not verified.scenes:
        raise AwError(f"{path} holds no scene")
    if NOT_FOR_RELEASE in (path / "README.md").read_text(encoding="utf-8"):
        verified.warnings.append("licence, consent or other fields are not stated: not for release")
    return verified


def _checksums(path: Path, digits: int = 64) -> dict[str, str]:
    found = {}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        match = re.fullmatch(rf"([0-9a-f]{{{digits}}})  ([^/\\\x00-\x1f]+)", line)
        if match is None or match[2].startswith(".") or match[2] in found:
            raise AwError(
                f"{path}, line {number}, is no checksum of a file beside it; do not trust the package"
            )
        found[match[2]] = match[1]
    return found


def _check_md5(path: Path) -> None:
    import hashlib

    for name, digest in _checksums(path / "checksums.md5", 32).items():
        with open(path / name, "rb") as f:
            if hashlib.file_digest(f, lambda: hashlib.md5(usedforsecurity=False)).hexdigest() != digest:
                raise AwError(f"{path / name} has another md5 than checksums.md5 records")


def _check_croissant(path: Path, sums: dict[str, str]) -> None:
    where = path / "croissant.json"
    data = read_json(where)
    if not isinstance(data, dict) or data.get("conformsTo") != VERSION:
        raise AwError(f"{where} is not in Croissant 1.1")
    listed = {}
    entries = data.get("distribution")
    for entry in entries if isinstance(entries, list) else []:
        if isinstance(entry, dict) and entry.get("@type") == "cr:FileObject":
            listed[str(entry.get("contentUrl"))] = entry.get("sha256")
    wanted = {n: d for n, d in sums.items() if n.endswith((".zip", ".csv"))}
    if listed != wanted:
        odd = sorted(str(n) for n in set(listed) ^ set(wanted)) or sorted(
            n for n in wanted if listed[n] != wanted[n]
        )
        raise AwError(f"{where} and checksums.sha256 contradict each other: {shortlist(odd)}")


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        reader = csv.DictReader(read_text(path).splitlines(), strict=True)
        rows = list(reader)
    except csv.Error as error:
        raise AwError(f"{path} is malformed: {error}") from error
    if tuple(reader.fieldnames or ()) != FILES or any(None in r or None in r.values() for r in rows):
        raise AwError(f"{path} does not have the columns {', '.join(FILES)}")
    return rows


def _scene(archive: Path, rows: dict[str, dict[str, str]] | None, found: VerifiedPackage) -> None:
    with tempfile.TemporaryDirectory(prefix="aw-verify-") as temporary:
        folder = Path(temporary) / "scene"
        extract(archive, folder)
        tops = sorted(p.name for p in folder.iterdir())
        if len(tops) != 1 or not (folder / tops[0] / "scene.json").is_file():
            raise AwError(f"{archive} does not hold one scene: {shortlist(tops) or 'nothing'}")
        if tops[0] != archive.stem and rows is not None:
            raise AwError(f"{archive} holds the scene {tops[0]!r}, not {archive.stem!r}")
        root = folder / tops[0]
        names = list_names(root)
        try:
            info = read_scene_json(root)
            if info is None:
                raise AwError(f"{archive} has no scene.json")
            extra = sorted(set(names) - set(info["files"]) - {"scene.json"})
            if extra:
                raise AwError(f"{archive} holds files that scene.json does not list: {shortlist(extra)}")
            verify_files(root, info)
            scene = load_scene(root, verify=False)
            for view in scene.views:
                image_size(view.image_path)
        except AwError as error:
            # The error names the archive, because the temporary folder is gone afterwards.
            raise AwError(str(error).replace(str(folder), str(archive))) from error
        if rows is not None:
            hashes = {n: sha256_file(root / n) for n in names}
            odd = sorted({*rows, *names} - {n for n in names if n in rows and rows[n]["sha256"] == hashes[n]})
            if odd:
                raise AwError(f"{archive} and files.csv contradict each other: {shortlist(odd)}")
        found.scenes.append(scene.name)
        found.files += len(names)
