"""The error that a user can correct, and words for its message: install commands, counts, short lists."""

from __future__ import annotations

import contextlib
import difflib
import errno
import importlib.metadata
import logging
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

_LONGEST = 2000  # characters of a message; ours have fewer than 700
# what to do where a file does not fit on the disk, in the user's share of it, or under the limit of its size
_ROOM = {errno.ENOSPC: "free space", errno.EDQUOT: "free space", errno.EFBIG: "raise ulimit -f"}


def installed(package: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def install_command(extra: str) -> str:
    """Return the pip command that installs an extra: from the running checkout, else by the package's name.

    Args:
        extra: a name under [project.optional-dependencies], e.g. ``"cuda"``.
    """
    root = Path(__file__).resolve().parents[2]
    target = f"-e '{root}[{extra}]'" if (root / "pyproject.toml").is_file() else f"'ambiguous-wild[{extra}]'"
    return f"{sys.executable} -m pip install{_pinned(root)} {target}"


def torch_command(version: str) -> str:
    """Return the commands that replace a CPU build of torch by a CUDA build.

    Both have the same version apart from the part after "+", so pip must remove one before it installs the
    other.

    Args:
        version: the installed torch's, e.g. ``"2.13.0+cpu"``.
    """
    pip, release = f"{sys.executable} -m pip", version.partition("+")[0]
    pinned = _pinned(Path(__file__).resolve().parents[2])
    return f"{pip} uninstall -y torch && {pip} install{pinned} 'torch=={release}'"


def _pinned(root: Path) -> str:
    return f" -c '{root / 'constraints.txt'}'" if (root / "constraints.txt").is_file() else ""


class AwError(Exception):
    """An error that the user can correct. The message is one line: what, where, why, what to do.

    The command line prints it in red without a traceback and exits with code 2.
    """

    exit_code = 2

    def __init__(self, message: object = "") -> None:
        text = str(message)
        # Messages may quote a damaged file, where one word can have a megabyte.
        super().__init__(text if len(text) <= _LONGEST else f"{text[: _LONGEST - 300]} ... {text[-290:]}")


def disk_line(error: OSError, otherwise: str = "") -> str:
    """Return the error of a disk as one line: the file, the reason, and what to do.

    `otherwise` is the advice where there is room.
    """
    advice = _ROOM.get(error.errno or 0, otherwise)
    what = f"; {advice}, or choose another folder" if advice else ""
    return f"{error.filename or 'input or output'}: {error.strerror or error}{what}"


def unknown(kind: str, name: str, choices: Iterable[str], hint: str = "") -> AwError:
    """Return the error for an unknown name; its message suggests the nearest known name.

    Args:
        kind: what is named, e.g. ``"method"``.
        name: as the user wrote it.
        choices: the known names.
        hint: how to list all known names, e.g. ``"'aw methods' lists them"``.
    """
    known = sorted(choices)
    lowered = {choice.casefold(): choice for choice in reversed(known)}
    match = difflib.get_close_matches(name.casefold(), lowered, n=1, cutoff=0.5)
    if match:
        suggestion = f"did you mean {lowered[match[0]]!r}?"
    elif len(known) <= 12:
        suggestion = "there is: " + ", ".join(known) if known else "there is none"
    else:
        nearest = difflib.get_close_matches(name, known, n=3, cutoff=0.0)
        suggestion = f"the nearest of {len(known)}: {', '.join(nearest)}"
    return AwError(f"unknown {kind} {name!r}: {suggestion}" + (f" ({hint})" if hint else ""))


def similar_path(path: Path | str) -> str:
    """Return "; did you mean photos?" where that lies beside a path that does not exist; else ""."""
    given = Path(path)
    try:
        names = sorted(inner.name for inner in given.parent.iterdir() if not inner.name.startswith("."))
    except OSError:
        return ""
    match = [] if given.name in names else difflib.get_close_matches(given.name, names, n=1, cutoff=0.6)
    return f"; did you mean {given.with_name(match[0])}?" if match else ""


@contextlib.contextmanager
def logged_to(handler: logging.Handler) -> Iterator[None]:
    """Send all log messages of this package, of any level, to the handler meanwhile; close it at the end."""
    logger = logging.getLogger("ambiguous_wild")
    logger.setLevel(logging.DEBUG)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()


def counted(number: int, noun: str) -> str:
    """Return the number with its noun: ``"1 rater"``, ``"3 raters"``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def shortlist(names: Iterable[str], limit: int = 5) -> str:
    """Join names for a message of one line: ``"a.jpg, b.jpg and 3 more"``."""
    listed = [str(n) for n in names]
    if len(listed) <= limit:
        return ", ".join(listed)
    return ", ".join(listed[:limit]) + f" and {len(listed) - limit} more"
