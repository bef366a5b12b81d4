"""Read files of other programs: with a limit of their size, and errors of one line for whatever is wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.files import unique_keys


def read_bytes(path: Path | str, most: int = 1 << 33) -> bytes:
    """Read a file of another program.

    Raises:
        AwError: it cannot be read, or has more than `most` bytes.
    """
    path = Path(path)
    try:
        if path.stat().st_size > most:
            raise AwError(f"{path} is larger than {most / 1e6:.0f} MB, the limit for such files")
        return path.read_bytes()
    except OSError as error:
        raise AwError(f"cannot read {path}: {error.strerror or error}") from None


def read_text(path: Path | str, most: int = 100_000_000) -> str:
    """Read a text of another program in UTF-8, with or without byte order mark.

    Raises:
        AwError: as `read_bytes`, or another encoding.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise AwError(f"cannot read {path}: it is not UTF-8 text; export it again") from None


def read_json(path: Path | str) -> Any:
    """Read a JSON file of another program; no key may stand twice in an object.

    Raises:
        AwError: as `read_text`, or it does not parse.
    """
    try:
        return json.loads(read_text(path), object_pairs_hook=unique_keys)
    except (ValueError, RecursionError) as error:
        raise AwError(f"{path} is no JSON ({error}); copy it again") from None
