"""CSV that spreadsheets take for text, and that reads back as what was written."""

from __future__ import annotations

import csv
import hashlib
import math
import re
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.tables import plain_formats
from ambiguous_wild.harness.tables.plain_formats import shortest

FORMULA = ("=", "+", "-", "@")
LARGEST = 200_000_000  # bytes
LONGEST = 200  # characters of a name
HIDDEN = ("Cc", "Cf", "Cs", "Zl", "Zp")  # Unicode categories of invisible characters
CsvValue = str | int | float | None


def guard(text: str) -> str:
    """The text with an apostrophe in front where a spreadsheet would calculate it.

    A text that begins with an apostrophe gets one too, so that `unguard` knows ours from its own.
    """
    begins = text.lstrip()[:1]
    return "'" + text if begins in FORMULA or text[:1] in ("'", "\t", "\r", "\n") else text


def unguard(cell: str) -> str:
    """What `guard` was given."""
    return cell[1:] if cell.startswith("'") else cell


def number(value: float | None) -> str:
    """Shortest digits that read back as the same number; empty where it is missing."""
    if value is None or math.isnan(value):
        return ""
    return str(value) if isinstance(value, int) else shortest(value)


def board_csv(head: Sequence[str], rows: Iterable[Sequence[CsvValue]]) -> str:
    """Text is guarded, numbers stay numbers, None is an empty cell."""
    return plain_formats.to_csv(head, rows, text=guard, number=shortest)


def read_csv(path: Path, required: Sequence[str]) -> tuple[list[str], list[dict[str, str]]]:
    """(columns, rows) of a file that `board_csv` wrote; cells as they stand, see `unguard` and `to_number`.

    Raises:
        AwError: unreadable, malformed, or without a column that must be there.
    """
    try:
        if path.stat().st_size > LARGEST:
            raise AwError(f"{path} is larger than {LARGEST // 1_000_000} MB: no file of a leaderboard")
        with open(path, newline="", encoding="utf-8") as f:
            lines = list(csv.reader(f, strict=True))
    except UnicodeDecodeError:
        raise AwError(f"{path} is no text in UTF-8: restore it from your version control") from None
    except csv.Error as error:
        raise AwError(f"{path} is malformed CSV ({error}): restore it from your version control") from None
    except OSError as error:
        raise AwError(f"cannot read {path}: {error.strerror}") from None
    head = lines[0] if lines else []
    lacking = [c for c in required if c not in head]
    if lacking or len(set(head)) != len(head):
        what = f"lacks the column {lacking[0]!r}" if lacking else "names a column twice"
        raise AwError(f"{path} {what}: it is no file of a leaderboard, or was changed by hand; restore it")
    for at, line in enumerate(lines[1:], 2):
        if len(line) != len(head):
            raise AwError(f"{path} row {at} has {len(line)} cells, not {len(head)}: restore the file")
    return head, [dict(zip(head, line)) for line in lines[1:]]


def to_count(text: str, where: str) -> int:
    """The whole number from 0 on of a cell.

    Raises:
        AwError: it holds none, or one of more than 18 digits.
    """
    if not (text.isascii() and text.isdigit()) or len(text) > 18:
        raise AwError(f"{where} {text[:40]!a} is no count; restore the file")
    return int(text)


def to_number(cell: str, where: str) -> float:
    """The number in a cell; NaN for an empty one.

    Raises:
        AwError: it is no number.
    """
    if not cell:
        return math.nan
    if not re.fullmatch(r"-?(inf|\d+(\.\d+)?([eE][+-]?\d+)?)", cell):
        raise AwError(f"{where}: {cell[:40]!a} is no number; restore the file")
    return float(cell)


def check_text(kind: str, text: str) -> str:
    """The text, where it is fit to stand in a table: others' names may hold anything that can be printed.

    Raises:
        AwError: empty, too long, or with control characters or text-direction marks.
    """
    hidden = next((c for c in text if unicodedata.category(c) in HIDDEN), None)
    if not text.strip() or len(text) > LONGEST or hidden is not None:
        shown = text if len(text) <= 40 else text[:37] + "..."
        why = "is empty" if not text.strip() else f"holds {hidden!a}" if hidden else "is too long"
        raise AwError(f"the {kind} {shown!a} {why}; give it 1 to {LONGEST} characters that can be printed")
    return text


def slug(text: str) -> str:
    """A file name for any text: lower case, digits and '-', and never a path."""
    ascii_text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9]+", "-", ascii_text).strip("-")[:48].strip("-")


def unique_slug(*texts: str) -> str:
    """A file name of its own for every tuple of texts."""
    digest = hashlib.sha256("\0".join(texts).encode("utf-8", "surrogatepass")).hexdigest()[:8]
    return "-".join(filter(None, (slug(texts[0]), digest)))
