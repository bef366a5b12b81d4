"""The catalogue of public datasets (`public.yaml`), and their download.

A download is resumed after a break, checked by length and hash, and unpacked safely. The server is not
trusted: it may break off, state a wrong length, ignore a request to resume, or serve another file later.
"""

from __future__ import annotations

import contextlib
import os
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from http.client import HTTPException
from pathlib import Path
from typing import Any, TypedDict
from urllib.parse import urlsplit

import msgspec

from ambiguous_wild import __version__
from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.io.archive import extract
from ambiguous_wild.io.files import check_output, folder_lock, is_free, own_json, sha256_file, write_json
from ambiguous_wild.io.plain_yaml import read_mapping

CATALOGUE = Path(__file__).with_name("public.yaml")
RECORD = "downloads.json"  # file beside the archives: name -> record of the first download
TRIES = 5
WAIT_S = 2.0  # before the second try; doubles
STALL_S = 60.0  # without a byte, a connection counts as broken
_CHUNK = 1 << 20
MAX_BYTES = 200_000_000_000


@dataclass(frozen=True)
class PublicData:
    """A public dataset: an archive, or a page that leads to one."""

    name: str
    page: str
    license: str
    note: str
    url: str = ""  # of the archive; empty = there is only a page
    layout: str = ""
    size_mb: str = ""  # as stated; empty = not stated
    sha256: str = ""  # empty = the publisher states none


@cache
def public_data() -> dict[str, PublicData]:
    """Read the catalogue, by name, in the order of the file."""
    data = read_mapping(CATALOGUE)
    rows = [*data["datasets"], *data["pages"]]
    return {row["name"]: PublicData(**{k: str(v) for k, v in row.items()}) for row in rows}


def find_public(name: str, others: Iterable[str] = ()) -> PublicData:
    """Return the dataset of a name.

    Args:
        name: its name.
        others: names that are no downloads, for the message on a misspelt one.

    Raises:
        AwError: there is none, or it has no archive to download.
    """
    catalogue = public_data()
    if name not in catalogue:
        raise unknown("dataset", name, [*others, *catalogue], "'aw fetch' lists them")
    if not catalogue[name].url:
        raise AwError(
            f"{name} has no fixed archive: download it from {catalogue[name].page}, then 'aw import' it"
        )
    return catalogue[name]


class Download(TypedDict):
    """Record of the first download of an archive."""

    url: str
    sha256: str
    bytes: int


@dataclass(frozen=True)
class Fetched:
    """A downloaded archive."""

    archive: Path
    folder: Path  # of the unpacked files
    sha256: str
    first: bool  # it is the first download, whose hash was recorded
    downloaded: int  # bytes downloaded in this call


class _TransferBroken(Exception):
    """The transfer stopped before its end; another try may continue it."""


def fetch(
    data: PublicData,
    output: Path,
    *,
    tries: int = TRIES,
    wait_s: float = WAIT_S,
    tick: Callable[[int, int | None], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> Fetched:
    """Download into `output`/archives and unpack into `output`/NAME.

    An interrupted call continues where it stopped. The hash of the first download is kept in downloads.json;
    another file later is refused.

    Args:
        data: dataset of the catalogue.
        output: folder of datasets.
        tries: attempts before giving up; the downloaded part is kept.
        wait_s: seconds before the second attempt, doubled for each further one.
        tick: called with bytes so far and in total, None if the server does not state it.
        say: called with the reason why a try failed.

    Raises:
        AwError: no connection, another hash or length than recorded, or a hostile archive.
    """
    if urlsplit(data.url).scheme not in ("http", "https"):
        raise AwError(f"{data.name}: its address {data.url[:80]!r} is neither http nor https")
    folder = output / "archives"
    check_output(folder / "file")
    archive = folder / _file_name(data)
    with folder_lock(archive, "aw fetch"):
        prior = _read_record(folder).get(data.name)
        digest = data.sha256 or (prior["sha256"] if prior is not None else "")
        moved, first = 0, False
        if not archive.is_file():
            moved = _download(data, archive, prior, tries, wait_s, tick, say)
        actual = sha256_file(archive)
        if digest and actual != digest:
            os.replace(archive, archive.with_suffix(archive.suffix + ".refused"))
            where = "the registry" if data.sha256 else f"{folder / RECORD}, from the first download,"
            raise AwError(
                f"{data.name}: {archive.name} has sha256 {actual[:16]}..., but {where} states "
                f"{digest[:16]}...: the server serves another file, or it was changed here; it is kept as "
                ".refused, remove it to try again"
            )
        if prior is None:
            first = not data.sha256
            _record(folder, data, archive, actual)
        target = output / data.name
        if not target.is_dir() or is_free(target):
            extract(archive, target)
    return Fetched(archive, target, actual, first, moved)


def _file_name(data: PublicData) -> str:
    """Return the archive's file name: the dataset's name with the extension of the address."""
    base = urlsplit(data.url).path.rpartition("/")[2]
    ending = re.search(r"(\.tar)?\.(zip|gz|bz2|tar|tgz)$", base)
    return data.name + (ending[0] if ending else ".archive")


def _download(
    data: PublicData,
    archive: Path,
    prior: Download | None,
    tries: int,
    wait_s: float,
    tick: Callable[[int, int | None], None],
    say: Callable[[str], None],
) -> int:
    """Complete the archive, and return the number of bytes downloaded."""
    part = archive.with_suffix(archive.suffix + ".part")
    state = archive.with_suffix(archive.suffix + ".part.json")
    moved = 0
    for attempt in range(tries):
        if attempt:
            time.sleep(wait_s * 2 ** (attempt - 1))
        before = part.stat().st_size if part.is_file() else 0
        try:
            _transfer(data, part, state, prior, tick)
            moved += part.stat().st_size - before
            os.replace(part, archive)
            state.unlink(missing_ok=True)
            return moved
        except _TransferBroken as error:
            now = part.stat().st_size if part.is_file() else 0
            moved += max(0, now - before)
            reason = str(error)
            say(f"{data.name}: {reason}; {now} bytes downloaded so far, try {attempt + 1} of {tries}")
    raise AwError(
        f"{data.name}: {data.url} broke off {tries} times, last: {reason}; what came is kept: run the same "
        "command again to go on"
    )


def _transfer(
    data: PublicData, part: Path, state: Path, prior: Download | None, tick: Callable[[int, int | None], None]
) -> None:
    """Make one request, and append its bytes to `part`.

    Raises:
        _TransferBroken: it ended early, or the connection failed.
        AwError: the server refuses, or announces another file than the first download.
    """
    have = part.stat().st_size if part.is_file() else 0
    tag = str(own_json(state).get("etag", "")) if have else ""
    request = urllib.request.Request(data.url, headers={"User-Agent": f"ambiguous-wild/{__version__}"})
    request.add_header("Accept-Encoding", "identity")
    if have:
        request.add_header("Range", f"bytes={have}-")
        if tag:
            request.add_header("If-Range", tag)
    try:
        with contextlib.closing(urllib.request.urlopen(request, timeout=STALL_S)) as reply:
            start = _start_of(reply, have)
            length = reply.headers.get("Content-Length")
            total = start + int(length) if length and length.isdigit() else None
            etag = reply.headers.get("ETag") or ""
            if prior is not None and total is not None and total != prior["bytes"]:
                raise AwError(
                    f"{data.name}: the server now announces {total} bytes, the first download had "
                    f"{prior['bytes']}: it is another file; remove the entry in {RECORD} if you trust it"
                )
            write_json(state, {"etag": "" if etag.startswith("W/") else etag})
            with open(part, "r+b" if start else "wb") as f:
                f.seek(start)
                f.truncate()
                _copy(reply, f, start, total, tick)
    except urllib.error.HTTPError as error:
        if error.code == 416:  # the part has all bytes or too many: start again
            part.unlink(missing_ok=True)
            raise _TransferBroken("the server has no further bytes") from error
        if error.code >= 500 or error.code in (408, 429):
            raise _TransferBroken(f"the server answers {error.code}") from error
        raise AwError(
            f"{data.name}: {data.url} answers {error.code} ({error.reason}); look at "
            f"{data.page or 'its page'}"
        ) from error
    except (urllib.error.URLError, HTTPException, TimeoutError, ConnectionError) as error:
        reason = getattr(error, "reason", None) or error
        raise _TransferBroken(f"no connection ({reason})") from error


def _start_of(reply: Any, have: int) -> int:
    """Return where the bytes of the reply begin in the file; 0 if the server sends all of it again."""
    if reply.status != 206:
        return 0
    match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", reply.headers.get("Content-Range") or "")
    if match is None or int(match[1]) != have:
        raise _TransferBroken("the server resumes at another place than asked for")
    return have


def _copy(
    reply: Any, target: Any, done: int, total: int | None, tick: Callable[[int, int | None], None]
) -> None:
    while True:
        try:
            chunk = reply.read(_CHUNK)
        except (HTTPException, TimeoutError, ConnectionError) as error:
            partial = getattr(error, "partial", b"")
            target.write(partial)
            raise _TransferBroken(f"broken off after {done + len(partial)} bytes") from error
        if not chunk:
            break
        done += len(chunk)
        if done > MAX_BYTES or (total is not None and done > total):
            raise AwError("the server sends more than it announced; do not trust it")
        target.write(chunk)
        tick(done, total)
    if total is not None and done < total:
        raise _TransferBroken(f"broken off after {done} of {total} bytes")


def _read_record(folder: Path) -> dict[str, Download]:
    path = folder / RECORD
    if not path.is_file():
        return {}
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, Download])
    except (msgspec.DecodeError, ValueError) as error:
        raise AwError(
            f"{path} is damaged ({error}); restore it, or remove it to record hashes anew"
        ) from error


def _record(folder: Path, data: PublicData, archive: Path, digest: str) -> None:
    entry = Download(url=data.url, sha256=digest, bytes=archive.stat().st_size)
    write_json(folder / RECORD, {**_read_record(folder), data.name: entry})
