"""The catalogue of public datasets (`public.yaml`), and their download.

A download is resumed after a break, checked by length and hash, and unpacked safely.

The server is not trusted: it may break off, lie about the length, ignore a wish to resume, or serve another
file on another day.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from http.client import HTTPException
from pathlib import Path
from typing import Any, TypedDict
from urllib.parse import urlsplit

from ambiguous_wild import __version__
from ambiguous_wild.builder.workspace import build_lock
from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.io.archive import extract
from ambiguous_wild.io.files import check_output, sha256_file, write_json
from ambiguous_wild.io.plain_yaml import read_mapping

CATALOGUE = Path(__file__).with_name("public.yaml")
RECORD = "downloads.json"  # beside the archives: name -> what was downloaded first
TRIES = 5
WAIT_S = 2.0  # before the second try; doubles
STALL_S = 60.0  # without a byte, a connection counts as broken
_CHUNK = 1 << 20
MOST_BYTES = 200_000_000_000


@dataclass(frozen=True)
class PublicData:
    """One archive, or a page that leads to one."""

    name: str
    page: str
    license: str
    note: str
    url: str = ""  # empty: only a page
    layout: str = ""
    size_mb: str = ""  # as stated; empty = not stated
    sha256: str = ""  # empty = the publisher states none


@cache
def public_data() -> dict[str, PublicData]:
    """By name, in the order of the file."""
    data: dict[str, Any] = read_mapping(CATALOGUE)
    rows = [*data["datasets"], *data["pages"]]
    return {row["name"]: PublicData(**{k: str(v) for k, v in row.items()}) for row in rows}


def find_public(name: str) -> PublicData:
    """The dataset of that name.

    Raises:
        AwError: there is none, or it has no archive to download.
    """
    known = public_data()
    if name not in known:
        raise unknown("dataset", name, known, "'aw fetch --list' lists them")
    if not known[name].url:
        raise AwError(
            f"{name} has no fixed archive: download it from {known[name].page}, then 'aw import' it"
        )
    return known[name]


class Download(TypedDict):
    """What the first download of an archive was."""

    url: str
    sha256: str
    bytes: int


@dataclass(frozen=True)
class Fetched:
    """An archive on this disk."""

    archive: Path
    folder: Path | None  # unpacked; None where that was not asked for
    sha256: str
    first: bool  # the hash was recorded now, as none was known
    downloaded: int  # bytes that came over the network in this call


class _Broken(Exception):
    """The transfer stopped before its end; another try may go on."""


def fetch(
    data: PublicData,
    output: Path,
    *,
    unpack: bool = True,
    tries: int = TRIES,
    wait_s: float = WAIT_S,
    tick: Callable[[int, int | None], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> Fetched:
    """Download into `output`/archives and unpack into `output`/NAME.

    A call that was broken off goes on where it stopped. The hash of the first download is kept in
    downloads.json; another file later is refused.

    Args:
        data: of the catalogue.
        output: folder of datasets.
        unpack: also unpack.
        tries: attempts before giving up; what came stays.
        wait_s: seconds before the second attempt, doubled for each further one.
        tick: told bytes so far and in all, None where the server does not say.
        say: told why a try failed.

    Raises:
        AwError: no connection, a file with another hash or length than is known, or a hostile archive.
    """
    if urlsplit(data.url).scheme not in ("http", "https"):
        raise AwError(f"{data.name}: its address {data.url[:80]!r} is neither http nor https")
    folder = output / "archives"
    check_output(folder / "file")
    archive = folder / _file_name(data)
    with build_lock(archive):
        known = _read_record(folder).get(data.name)
        digest = data.sha256 or (known["sha256"] if known is not None else "")
        moved, first = 0, False
        if not archive.is_file():
            moved = _download(data, archive, known, tries, wait_s, tick, say)
        found = sha256_file(archive)
        if digest and found != digest:
            os.replace(archive, archive.with_suffix(archive.suffix + ".refused"))
            where = "the registry" if data.sha256 else f"{folder / RECORD}, from the first download,"
            raise AwError(
                f"{data.name}: {archive.name} has sha256 {found[:16]}..., but {where} states "
                f"{digest[:16]}...: the "
                "server serves another file, or it was changed here; it is kept as .refused, remove "
                "it to try again"
            )
        if known is None:
            first = not data.sha256
            _record(folder, data, archive, found)
        target = output / data.name if unpack else None
        if target is not None and not target.is_dir():
            extract(archive, target)
    return Fetched(archive, target, found, first, moved)


def _file_name(data: PublicData) -> str:
    """The archive's name here: the dataset's, with the ending of the address."""
    base = urlsplit(data.url).path.rpartition("/")[2]
    ending = re.search(r"(\.tar)?\.(zip|gz|bz2|tar|tgz)$", base)
    return data.name + (ending[0] if ending else ".archive")


def _download(
    data: PublicData,
    archive: Path,
    known: Download | None,
    tries: int,
    wait_s: float,
    tick: Callable[[int, int | None], None],
    say: Callable[[str], None],
) -> int:
    """Bytes that came over the network; the archive is complete afterwards."""
    part = archive.with_suffix(archive.suffix + ".part")
    state = archive.with_suffix(archive.suffix + ".part.json")
    moved = 0
    for attempt in range(tries):
        if attempt:
            time.sleep(wait_s * 2 ** (attempt - 1))
        before = part.stat().st_size if part.is_file() else 0
        try:
            _transfer(data, part, state, known, tick)
            moved += part.stat().st_size - before
            os.replace(part, archive)
            state.unlink(missing_ok=True)
            return moved
        except _Broken as error:
            now = part.stat().st_size if part.is_file() else 0
            moved += max(0, now - before)
            reason = str(error)
            say(f"{data.name}: {reason}; {now} bytes are here, try {attempt + 1} of {tries}")
    raise AwError(
        f"{data.name}: {data.url} broke off {tries} times, last: {reason}; what came is kept: run the "
        "same command "
        "again to go on"
    )


def _transfer(
    data: PublicData, part: Path, state: Path, known: Download | None, tick: Callable[[int, int | None], None]
) -> None:
    """One request; appends to `part`.

    Raises:
        _Broken: it ended early, or the connection failed.
        AwError: the server refuses, or announces another file than the known one.
    """
    have = part.stat().st_size if part.is_file() else 0
    tag = _read_state(state) if have else ""
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
            if known is not None and total is not None and total != known["bytes"]:
                raise AwError(
                    f"{data.name}: the server now announces {total} bytes, the first download had "
                    f"{known['bytes']}: "
                    f"it is another file; remove the entry in {RECORD} if you trust it"
                )
            write_json(state, {"etag": "" if etag.startswith("W/") else etag})
            with open(part, "r+b" if start else "wb") as f:
                f.seek(start)
                f.truncate()
                _copy(reply, f, start, total, tick)
    except urllib.error.HTTPError as error:
        if error.code == 416:  # all of it is here, or more than all: start again
            part.unlink(missing_ok=True)
            raise _Broken("the server has no further bytes") from error
        if error.code >= 500 or error.code in (408, 429):
            raise _Broken(f"the server answers {error.code}") from error
        raise AwError(
            f"{data.name}: {data.url} answers {error.code} ({error.reason}); look at "
            f"{data.page or 'its page'}"
        ) from error
    except (urllib.error.URLError, HTTPException, TimeoutError, ConnectionError) as error:
        reason = getattr(error, "reason", None) or error
        raise _Broken(f"no connection ({reason})") from error


def _start_of(reply: Any, have: int) -> int:
    """Where the bytes of the reply begin in the file; 0 where the server sends all of it again."""
    if reply.status != 206:
        return 0
    match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", reply.headers.get("Content-Range") or "")
    if match is None or int(match[1]) != have:
        raise _Broken("the server resumes at another place than asked for")
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
            raise _Broken(f"broken off after {done + len(partial)} bytes") from error
        if not chunk:
            break
        done += len(chunk)
        if done > MOST_BYTES or (total is not None and done > total):
            raise AwError("the server sends more than it announced; do not trust it")
        target.write(chunk)
        tick(done, total)
    if total is not None and done < total:
        raise _Broken(f"broken off after {done} of {total} bytes")


def _read_state(path: Path) -> str:
    """The server's tag of the part that is here; empty where it is unknown."""
    try:
        return str(json.loads(path.read_text(encoding="utf-8")).get("etag", ""))
    except (OSError, ValueError, AttributeError):
        return ""


def _read_record(folder: Path) -> dict[str, Download]:
    path = folder / RECORD
    if not path.is_file():
        return {}
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        return {
            name: Download(url=str(e["url"]), sha256=str(e["sha256"]), bytes=int(e["bytes"]))
            for name, e in known.items()
        }
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise AwError(
            f"{path} is damaged ({error}); restore it, or remove it to record hashes anew"
        ) from error


def _record(folder: Path, data: PublicData, archive: Path, digest: str) -> None:
    entry = Download(url=data.url, sha256=digest, bytes=archive.stat().st_size)
    write_json(folder / RECORD, {**_read_record(folder), data.name: entry})
