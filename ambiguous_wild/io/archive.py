"""Folders as tar archives: packed with a bound, unpacked so that nothing leaves the target."""

from __future__ import annotations

import io
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import IO

from ambiguous_wild.core.errors import AwError

MOST_FILES = 200_000


def pack_folder(folder: Path | str, limit_mb: float) -> bytes:
    """The files below a folder as an uncompressed tar; names that begin with a dot are left out.

    Links are followed: what arrives elsewhere must not depend on what lies there.

    Args:
        folder: what to pack.
        limit_mb: largest sum of the files, MB (10^6 bytes).

    Raises:
        AwError: they are more than that.
    """
    root = Path(folder)
    # A part of a path that begins with a dot is a lock, a cache or half-written.
    paths = [p for p in sorted(root.rglob("*")) if p.is_file() and not _hidden(p.relative_to(root))]
    size_mb = sum(p.stat().st_size for p in paths) / 1e6
    if size_mb > limit_mb:
        raise AwError(
            f"{root} has {size_mb:.0f} MB, more than the {limit_mb:.0f} MB that may be sent: put it on "
            "shared storage, or raise --transfer-limit"
        )
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", dereference=True) as archive:
        for path in paths:
            archive.add(path, path.relative_to(root).as_posix(), recursive=False)
    return buffer.getvalue()


def unpack(
    source: Path | bytes,
    target: Path,
    limit_mb: float,
    *,
    wanted: Callable[[str], bool] = lambda name: True,
) -> list[str]:
    """Write the files of a tar archive (gz, bz2 and xz too) below a folder that exists.

    Args:
        source: the archive's path, or its bytes.
        target: an existing folder; nothing is written outside it and nothing in it is replaced.
        limit_mb: largest sum of all files in the archive, MB; stops what unpacks to far more than it is.
        wanted: which names are written; the others are passed over.

    Returns:
        The names that were written, relative, in the order of the archive.

    Raises:
        AwError: no readable archive; a name that is absolute, holds ``..`` or is there twice; a link or a
            device; more than the limit. What was written before stays: unpack into a temporary folder.
    """
    where = source if isinstance(source, Path) else "the archive"
    try:
        with _opened(source) as archive:
            return _extract(archive, target, limit_mb, wanted, str(where))
    except (tarfile.TarError, EOFError, OSError) as error:
        if isinstance(error, FileNotFoundError):
            raise AwError(f"there is no archive {where}") from None
        raise AwError(f"{where} cannot be unpacked: {error}") from error


def _opened(source: Path | bytes) -> tarfile.TarFile:
    file: IO[bytes] = io.BytesIO(source) if isinstance(source, bytes) else open(source, "rb")  # noqa: SIM115
    try:
        return tarfile.open(fileobj=file, mode="r:*")
    except BaseException:
        file.close()
        raise


def _extract(
    archive: tarfile.TarFile, target: Path, limit_mb: float, wanted: Callable[[str], bool], where: str
) -> list[str]:
    written: list[str] = []
    total = 0
    for count, member in enumerate(archive, start=1):
        name = _inside(member.name, where)
        total += member.size
        if count > MOST_FILES or total > limit_mb * 1e6:
            raise AwError(
                f"{where} unpacks to more than {limit_mb:.0f} MB or {MOST_FILES} files: not unpacked"
            )
        if member.isdir():
            continue
        if not member.isfile():
            raise AwError(f"{where} holds {name!r}, a link or a device: not unpacked")
        if not wanted(name):
            continue
        path = target / name
        path.parent.mkdir(parents=True, exist_ok=True)
        content = archive.extractfile(member)
        if content is None or path.exists():
            raise AwError(f"{where} holds {name!r} twice: not unpacked")
        with content, open(path, "xb") as f:
            shutil.copyfileobj(content, f)
        written.append(name)
    return written


def _inside(name: str, where: str) -> str:
    pure = PurePosixPath(name)
    if pure.is_absolute() or ".." in pure.parts or "\\" in name or "\0" in name:
        raise AwError(f"{where} names a file outside itself: {name!r}: not unpacked")
    return pure.as_posix()


def _hidden(relative: Path) -> bool:
    return any(part.startswith(".") for part in relative.parts)
