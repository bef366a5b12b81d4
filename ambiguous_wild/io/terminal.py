"""Lines for a terminal: how wide they may be, where they are broken, and bars whose clocks run."""

from __future__ import annotations

import re
import shutil
import sys
import threading
import time
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.core.names import plain

if TYPE_CHECKING:
    from tqdm import tqdm

# A command is copied as one line: in quotes, and after a colon up to the next comma or semicolon.
_WHOLE = re.compile(
    r"'(?:aw|pip|git|python3?|sudo|export) [^']*'"
    r"|(?:(?<=: )|^ *)(?:\$ )?(?:aw|pip|git|\S*python3?) (?:(?![,;] ).)+"
)
_HELD = "\0"  # a blank at which no line is broken


def display_width(text: str) -> int:
    """Return the width in columns of a terminal: wide characters take two, combining ones none."""
    wide = sum(unicodedata.east_asian_width(c) in "WF" for c in text)
    return len(text) + wide - sum(unicodedata.combining(c) > 0 for c in text)


def line_width(err: bool = False) -> int | None:
    """Return the columns of standard output or standard error; None: no terminal, lines are not broken."""
    return shutil.get_terminal_size().columns if (sys.stderr if err else sys.stdout).isatty() else None


def wrapped(text: str, width: int | None) -> str:
    """Return a line broken between words, never inside of one, nor inside of a command that a user may copy.

    Args:
        text: one line; its own indentation is kept. Further lines begin under its last column, where columns
            are parted by two blanks or more, else two columns further right.
        width: columns of a line; None leaves the text as it is.
    """
    if width is None or display_width(text) <= width:
        return text
    held = _WHOLE.sub(lambda command: command[0].replace(" ", _HELD), text)
    begin = len(held) - len(held.lstrip(" "))
    columns = [
        end for m in re.finditer(r"\S {2,}", held) if (end := display_width(held[: m.end()])) <= width // 2
    ]
    lines, margin = [" " * begin], " " * (columns[-1] if columns else begin + 2)
    blanks = ""  # between the last word and the next; columns are aligned by several
    for word in re.split(r"( +)", held[begin:]):
        if not word.strip(" "):
            blanks = word
            continue
        # a command that fits no line is left where it is: the terminal breaks it, and copies it as one line
        fits_below = _HELD not in word or display_width(margin + word) <= width
        if display_width(lines[-1] + blanks + word) > width and lines[-1].strip() and fits_below:
            lines.append(margin + word)
        else:
            lines[-1] += blanks + word
    return "\n".join(lines).replace(_HELD, " ")


def say(text: str, *, out: bool = False, fg: str = "", only: str = "") -> None:
    """Print a line, broken between words at the width of the terminal.

    Args:
        text: one line; control characters, as names of files may hold them, are escaped.
        out: print it on stdout, as the result of a command, not on stderr.
        fg: colour of the line.
        only: the word that is coloured, if it is not the line.
    """
    line = wrapped(plain(text), line_width(not out))
    if fg:
        line = line.replace(only, click.style(only, fg=fg), 1) if only else click.style(line, fg=fg)
    bars = getattr(sys.modules.get("tqdm"), "tqdm", None)
    # a bar on the line is cleared, and drawn again below
    cleared = nullcontext() if bars is None else bars.external_write_mode()
    # if nobody reads how a command goes on (`aw bench 2>&1 | head`), it goes on
    with nullcontext() if out else suppress(BrokenPipeError), cleared:
        click.echo(line, err=not out)


def keep_clock_running(bar: tqdm[Any]) -> None:
    """Redraw a bar each second until it is closed, however long a step takes."""

    def redraw() -> None:
        while not bar.disable:
            time.sleep(1.0)
            with bar.get_lock():  # `close` sets `disable` before it clears the line with this lock
                if not bar.disable:
                    bar.refresh(nolock=True)

    if not bar.disable:
        threading.Thread(target=redraw, daemon=True).start()


@contextmanager
def clock(what: str, expected_s: float) -> Iterator[None]:
    """Show a running clock beside the expected seconds meanwhile, if standard error is a terminal."""
    from tqdm import tqdm

    form = f"{{desc}} [{{elapsed}} of about {tqdm.format_interval(expected_s)}]"
    with tqdm(
        desc=what, bar_format=form, disable=not sys.stderr.isatty(), leave=False, file=sys.stderr
    ) as bar:
        keep_clock_running(bar)
        yield
