"""Unpack untrusted archives: plain files below one folder, or nothing.

Refused with the member's name: paths out of the folder, links, devices, encrypted and sparse members, two
members of one name, and archive bombs. Sizes are counted while writing, never taken from headers.
"""

from __future__ import annotations

import bz2
import gzip
import io
import os
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.names import quoted, spelling_key
from ambiguous_wild.io.files import atomic_dir, is_free

_CHUNK = 1 << 20
_HEADER = 4 << 20  # bytes that all headers of one tar member may have
_ZIP_METHODS = (
    zipfile.ZIP_STORED,
    zipfile.ZIP_DEFLATED,
    zipfile.ZIP_BZIP2,
)  # other methods allocate as much as a header says
_LONGEST = 255  # bytes of a name that file systems can hold
_DEEPEST = 32  # levels of folders


@dataclass(frozen=True)
class Limits:
    """Greatest size of an unpacked archive."""

    files: int = 200_000
    bytes: int = 50_000_000_000
    ratio: float = 200.0  # unpacked to packed; photos and models stay under 20
    free: int = 64 << 20  # bytes below which the ratio is not checked: text compresses well


def extract(archive: Path | str, target: Path | str, limits: Limits | None = None) -> list[str]:
    """Unpack a .zip, .tar, .tar.gz or .tar.bz2 (known by content) into a new folder.

    The folder appears complete or not at all. Permissions, owners and times are not kept.

    Args:
        archive: the file.
        target: the folder to make; must not exist, or be empty.
        limits: see `Limits`.

    Returns:
        Names of the files, relative to the target, sorted.

    Raises:
        AwError: another format, damaged, or refused; the message names the member.
    """
    source, out = Path(archive), Path(target)
    if not is_free(out):
        raise AwError(f"{out} exists; nothing is overwritten: choose another folder or remove it")
    with atomic_dir(out) as folder:
        return sorted(unpack(source, folder, limits))


def unpack(
    source: Path | bytes,
    folder: Path,
    limits: Limits | None = None,
    *,
    wanted: Callable[[str], bool] = lambda name: True,
) -> list[str]:
    """Unpack as `extract` into an existing folder, which the caller removes after an error.

    Args:
        source: the archive's path, or its bytes.
        folder: nothing is written outside it, and nothing in it is replaced.
        limits: see `Limits`; skipped files count too.
        wanted: tells which names to write; the others are skipped.

    Returns:
        The names of the written files, relative, in the order of the archive.

    Raises:
        AwError: as `extract`.
    """
    name = source if isinstance(source, Path) else Path("the archive")
    try:
        packed = source.stat().st_size if isinstance(source, Path) else len(source)
        target = _UnpackFolder(name, packed, limits or Limits(), folder, wanted)
        opened = open(source, "rb") if isinstance(source, Path) else io.BytesIO(source)  # noqa: SIM115
        with opened as raw, _named_errors(name):
            # `is_zipfile` takes a tar for the zip that it ends with.
            members = _zip_members if raw.read(4) in (b"PK\3\4", b"PK\5\6") else _tar_members
            raw.seek(0)
            for member, data in members(raw, name):
                target.add(member, data)
    except OSError as error:
        raise AwError(f"cannot unpack {name}: {error.strerror or error}") from error
    return target.wrote


def pack_folder(folder: Path | str, limit_mb: float) -> bytes:
    """Pack the files below a folder into an uncompressed tar, except names that begin with a dot.

    Links are followed, because the receiver may not have their targets.

    Args:
        folder: what to pack.
        limit_mb: greatest total size, MB (10^6 bytes).

    Raises:
        AwError: the files are larger.
    """
    root = Path(folder)
    paths = []
    for at, folders, files in os.walk(root, followlinks=True):
        real = Path(at).resolve()
        # Names that begin with a dot are locks, caches and unfinished files; a link may lead back up.
        folders[:] = [n for n in folders if n[0] != "." and not real.is_relative_to(Path(at, n).resolve())]
        paths += [Path(at, n) for n in files if n[0] != "." and Path(at, n).is_file()]
    paths.sort()
    size_mb = sum(p.stat().st_size for p in paths) / 1e6
    if size_mb > limit_mb:
        raise AwError(
            f"{root} has {size_mb:.0f} MB, more than the {limit_mb:.0f} MB that may be sent: put it on "
            "shared storage, or raise --set engine.transfer_limit=MB"
        )
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", dereference=True) as archive:
        for path in paths:
            archive.add(path, path.relative_to(root).as_posix(), recursive=False)
    return buffer.getvalue()


@contextmanager
def _named_errors(source: Path) -> Iterator[None]:
    """Turn the errors that the standard library raises for damaged archives into AwError."""
    try:
        yield
    except (zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, ValueError, IndexError) as error:
        raise AwError(f"{source} is a damaged or cut archive ({error}); download it again") from error
    except (NotImplementedError, RuntimeError, KeyError) as error:
        raise AwError(f"{source} holds an unsupported member ({error}); unpack it by hand") from error
    except OSError as error:
        if error.errno is not None:
            raise
        raise AwError(f"{source} is a damaged or cut archive ({error}); download it again") from error


class _UnpackFolder:
    """The folder that one archive is unpacked into; counts its files and bytes."""

    def __init__(
        self, archive: Path, packed: int, limits: Limits, folder: Path, wanted: Callable[[str], bool]
    ) -> None:
        self.archive, self.packed, self.folder, self.wanted = archive, packed, folder, wanted
        self.files, self.left = limits.files, min(limits.bytes, max(limits.free, int(limits.ratio * packed)))
        self.most = self.left
        self.wrote: list[str] = []
        self.names: dict[str, str] = {}  # normalised, case-folded -> as given

    def add(self, name: str, data: IO[bytes] | None) -> None:
        """Write a member, checked to stay below the folder; without data it is a folder.

        A member that is not wanted is read all the same, since its size counts.
        """
        path = PurePosixPath(name)
        # A backslash or a colon leads out of the folder on Windows.
        if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name:
            raise _refused(self.archive, name, "a path that leads out of the folder")
        if not name.isprintable() or len(path.parts) > _DEEPEST:
            raise _refused(self.archive, name, "an invalid file name")
        if any(len(part.encode("utf-8", errors="surrogateescape")) > _LONGEST for part in path.parts):
            raise _refused(self.archive, name, "a name that is too long")
        if data is None:
            (self.folder / path).mkdir(parents=True, exist_ok=True)
            return
        if not path.parts:
            raise _refused(self.archive, name, "a file without a name")
        if len(self.names) >= self.files:
            raise AwError(f"{self.archive} holds more than {self.files} files; unpack a part of it")
        # Some file systems take two such names for one file, and one would overwrite the other.
        key = spelling_key(str(path))
        if key in self.names:
            raise AwError(
                f"{self.archive} holds {quoted(name)} and {quoted(self.names[key])}, the same file; "
                "pack it again"
            )
        self.names[key] = name
        if self.wanted(str(path)):
            (self.folder / path).parent.mkdir(parents=True, exist_ok=True)
            with open(self.folder / path, "xb") as f:
                self._copy(data, f.write)
            self.wrote.append(str(path))
        else:
            self._copy(data, len)

    def _copy(self, data: IO[bytes], write: Callable[[bytes], int]) -> None:
        while chunk := data.read(_CHUNK):
            self.left -= len(chunk)
            if self.left < 0:
                raise AwError(
                    f"{self.archive} unpacks to more than {self.most / 1e6:.0f} MB from "
                    f"{self.packed / 1e6:.2f} MB: that may be an archive bomb; unpack it by hand if "
                    "you trust it"
                )
            write(chunk)


def _zip_members(raw: IO[bytes], source: Path) -> Iterator[tuple[str, IO[bytes] | None]]:
    """Yield names and contents of a zip; None for a folder."""
    with zipfile.ZipFile(raw) as archive:
        for member in archive.infolist():
            mode = member.external_attr >> 16
            if stat.S_IFMT(mode) and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise _refused(source, member.filename, "a link or device")
            if member.flag_bits & 0x1:
                raise NotImplementedError(f"{quoted(member.filename)} is encrypted")
            if member.compress_type not in _ZIP_METHODS:
                raise NotImplementedError(f"{quoted(member.filename)} uses an unsupported compression method")
            if member.is_dir():
                yield member.filename, None
            else:
                with archive.open(member) as data:
                    yield member.filename, data


def _tar_members(raw: IO[bytes], source: Path) -> Iterator[tuple[str, IO[bytes] | None]]:
    """Yield names and contents of a tar, with our own checks: tarfile's data filter renames and repairs."""
    head = raw.read(6)
    raw.seek(0)
    stream = raw
    if head.startswith(b"\x1f\x8b"):
        stream = gzip.GzipFile(fileobj=raw)  # type: ignore[assignment]
    elif head.startswith(b"BZh"):
        stream = bz2.BZ2File(raw)
    elif head.startswith(b"\xfd7zXZ"):
        raise AwError(
            f"{source} is compressed with xz, which is not supported; unpack it by hand, or use .tar.gz"
        )
    gate = _Gate(source, stream)
    with tarfile.open(fileobj=gate, mode="r|") as archive:  # type: ignore[call-overload]
        while True:
            gate.allowed = _HEADER
            member = archive.next()
            archive.members.clear()  # tarfile keeps every header it has read
            if member is None:
                return
            if member.isdir():
                yield member.name, None
                continue
            if not member.isreg() or member.issparse():
                raise _refused(source, member.name, "a link, device or sparse file")
            gate.allowed = member.size + _CHUNK
            yield member.name, archive.extractfile(member)


class _Gate:
    """Limits how much one step reads, against headers that unpack to gigabytes."""

    def __init__(self, source: Path, stream: IO[bytes]) -> None:
        self.source, self.stream, self.allowed = source, stream, _HEADER

    def read(self, size: int) -> bytes:
        data = self.stream.read(size)
        self.allowed -= len(data)
        if self.allowed < 0:
            raise AwError(f"{self.source} has a header of more than {_HEADER >> 20} MB: damaged, or a bomb")
        return data


def _refused(archive: Path, name: str, what: str) -> AwError:
    return AwError(f"{archive} is not unpacked: its member {quoted(name)} is {what}; do not trust it")
