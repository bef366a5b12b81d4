"""Processes that a command starts: those of Python, and what a log says at its end."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

_CLONE = str(Path(__file__).parents[2])
_TAIL_BYTES = 8192
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|[\x00-\x08\x0b-\x1f\x7f]")


def python_command(code: str, *words: str) -> list[str]:
    """Command that runs code which may import this package.

    -P: Python would import a `random.py` of the working directory, which may be a folder of photos. Without
    that folder a clone that is not installed would not be found either, so it is added as the last one.
    """
    return [sys.executable, "-P", "-c", f"import sys; sys.path.append({_CLONE!r})\n{code}", *words]


def git_commit(folder: Path) -> str | None:
    """Return the commit of the repository that a folder lies in; None without git, or outside of one."""
    return _git(folder, "rev-parse", "HEAD")


def own_commit() -> str:
    """Return the commit of this package, with "+changes" where its files differ from it; else "".

    Known in a clone, and after an installation from a repository's address.
    """
    clone = Path(_CLONE)
    if (clone / ".git").exists():  # the folder above may be a repository of the user's
        changes = _git(
            clone, "status", "--porcelain", "--untracked-files=no", "--", str(Path(__file__).parents[1])
        )
        return (git_commit(clone) or "") + ("+changes" if changes else "")
    with suppress(importlib.metadata.PackageNotFoundError, ValueError, AttributeError):
        record = importlib.metadata.distribution("ambiguous-wild").read_text("direct_url.json")
        return str(json.loads(record or "{}").get("vcs_info", {}).get("commit_id", ""))
    return ""


def _git(folder: Path, *words: str) -> str | None:
    try:
        done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


@contextmanager
def python_meanwhile(
    code: str, variables: Mapping[str, str] | None = None, finish: bool = False
) -> Iterator[None]:
    """Run code in another process without a word; its errors are ignored.

    Args:
        variables: added to its environment.
        finish: wait for its end where the block ends without an error; else it is killed.
    """
    quiet, env = subprocess.DEVNULL, {**os.environ, **(variables or {})}
    try:
        process = subprocess.Popen(python_command(code), stdin=quiet, stdout=quiet, stderr=quiet, env=env)
    except OSError:
        yield
        return
    try:
        yield
        if finish:
            process.wait()
    finally:
        process.kill()
        process.wait()


def last_lines(log: Path) -> list[str]:
    """Return what the last "$ COMMAND" of a log wrote at its end, without the escapes of a terminal."""
    with open(log, "rb") as f:
        f.seek(max(0, log.stat().st_size - _TAIL_BYTES))
        text = f.read().decode(errors="replace")
    lines = [_ESCAPES.sub("", line).strip() for line in re.split(r"[\r\n]+", text)]
    begun = max((k for k, line in enumerate(lines) if line.startswith("$ ")), default=-1)
    return [line for line in lines[begun + 1 :] if line]
