"""Rules for names that are printed, written into tables and used in paths."""

from __future__ import annotations

import unicodedata
from pathlib import PurePosixPath

from ambiguous_wild.core.errors import AwError

LONGEST = 100  # bytes of UTF-8; file systems allow 255, and suffixes are added to names
SIGNS = " ._-+=,@()'&#!~"  # beside letters and digits; paths of all systems may hold them


def check_name(kind: str, name: str) -> str:
    """Return the name without surrounding blanks, if it can be printed and be part of a path.

    Args:
        kind: what is named, for the error, e.g. ``"scene name"``.
        name: as the user gave it.

    Raises:
        AwError: empty, longer than 100 bytes, starting with a dot or a minus sign, or holding a character
            other than letters and digits of any language, and `SIGNS`.
    """
    stripped = name.strip()
    size = len(stripped.encode("utf-8", errors="replace"))
    shown = quoted(stripped, 40)
    if not stripped:
        raise AwError(f"the {kind} is empty; give it at least one letter")
    bad = next((c for c in stripped if not _allowed(c)), None)
    if bad is not None:
        signs = " ".join(SIGNS.strip())
        raise AwError(f"{kind} {shown} holds {bad!a}; use letters, digits, blanks and {signs}")
    if stripped[0] in ".-":
        raise AwError(f"{kind} {shown} starts like a hidden file or an option; leave out {stripped[0]!r}")
    if size > LONGEST:
        raise AwError(f"{kind} {shown} has {size} bytes; at most {LONGEST} are allowed")
    return stripped


def name_from(text: str) -> str:
    """Return the text as a name that `check_name` accepts: other characters become "_", the end is cut."""
    name = "".join(c if _allowed(c) else "_" for c in text).lstrip(".- ")
    return name.encode()[:LONGEST].decode(errors="ignore").strip() or "scene"


def _allowed(char: str) -> bool:
    return char in SIGNS or unicodedata.category(char)[0] in "LMN"


def spelling_key(name: str) -> str:
    """Return what is equal for names that differ in case and in whether letters are composed only."""
    return unicodedata.normalize("NFC", name).casefold()


def stays_below(path: str) -> bool:
    """Whether a relative path names something below the folder that it starts from."""
    pure = PurePosixPath(path)
    return not pure.is_absolute() and ".." not in pure.parts and bool(pure.parts)


def is_text(value: str) -> bool:
    """Whether the text can be written as UTF-8: JSON and command lines may hold lone surrogates."""
    return not any("\ud800" <= c <= "\udfff" for c in value)


def ascii_text(text: str) -> str:
    """Return the text as OpenCV's fonts can draw it: without accents, other characters as escapes."""
    letters = (c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
    return "".join(c if " " <= c <= "~" else c.encode("unicode_escape").decode() for c in letters)


def plain(text: str) -> str:
    """Return the text on one line, with control and format characters escaped."""
    return "".join(c.encode("unicode_escape").decode() if _unprintable(c) else c for c in str(text))


def csv_text(text: str) -> str:
    """Return a cell that spreadsheets take for text: a leading formula character gets an apostrophe."""
    text = plain(text) if not str(text).startswith("\t") else "'" + plain(text)
    return "'" + text if text.lstrip()[:1] in ("=", "+", "-", "@") else text


def _unprintable(char: str) -> bool:
    """Whether it is a control, format or surrogate character, or a line or paragraph separator."""
    return unicodedata.category(char) in ("Cc", "Cf", "Cs", "Zl", "Zp")


def quoted(value: object, longest: int = 60) -> str:
    """Return a value of an untrusted file for a message: in ASCII, at most `longest` characters."""
    try:
        text = ascii(value)
    except ValueError:  # a whole number of thousands of digits
        text = "a huge number"
    return text if len(text) <= longest else text[: longest - 3] + "..."
