"""One error class for everything a user can cause and mend."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_LONGEST = 2000  # characters of a message; ours have below 700


class AwError(Exception):
    """Something the user can mend: one line that says what, where, why, and what to do next.

    The command line prints the message in red without a traceback and exits with code 2.
    """

    exit_code = 2

    def __init__(self, message: object = "") -> None:
        text = str(message)
        # What a damaged file holds may be a word of a megabyte; a message stays one that can be read.
        super().__init__(text if len(text) <= _LONGEST else f"{text[: _LONGEST - 300]} ... {text[-290:]}")


def unknown(kind: str, name: str, choices: Iterable[str], hint: str = "") -> AwError:
    """The error for a name that does not exist: names the nearest one that does.

    Args:
        kind: what is looked up, e.g. ``"method"``.
        name: what the user wrote.
        choices: what there is.
        hint: what to do to see all of them, e.g. ``"'aw methods' lists them"``.
    """
    known = sorted(choices)
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        tail = f"did you mean {near[0]!r}?"
    elif len(known) <= 12:
        tail = "there is: " + ", ".join(known)
    else:
        some = difflib.get_close_matches(name, known, n=3, cutoff=0.0)
        tail = f"the nearest of {len(known)}: {', '.join(some)}"
    return AwError(f"unknown {kind} {name!r}: {tail}" + (f" ({hint})" if hint else ""))


def counted(number: int, noun: str) -> str:
    """``"1 rater"``, ``"3 raters"``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def shortlist(names: Iterable[str], limit: int = 5) -> str:
    """``"a.jpg, b.jpg and 3 more"``: names for a message that must stay one line."""
    listed = [str(n) for n in names]
    if len(listed) <= limit:
        return ", ".join(listed)
    return ", ".join(listed[:limit]) + f" and {len(listed) - limit} more"
