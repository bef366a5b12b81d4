"""Runs one external command: without a shell, with a log and a time limit; ends all its processes."""

from __future__ import annotations

import json
import os
import platform
import re
import shlex
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.io.atomic import write_json

GRACE_S = 10.0  # between SIGTERM and SIGKILL
_RECORD = ".running.json"  # of a running command, beside its log
_TAIL_BYTES, _TAIL_LINES = 8192, 4
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|[\x00-\x08\x0b-\x1f\x7f]")


def run_logged(
    what: str,
    command: Sequence[str],
    *,
    log: Path,
    cwd: Path,
    environment: Mapping[str, str],
    timeout_s: float | None,
) -> float:
    """Run a command to its end; its output goes to `log`, which is added to.

    Args:
        what: for errors, e.g. ``"train of gsplat-mcmc"``.
        command: program and arguments, unchanged: no shell reads them.
        log: of stdout and stderr.
        cwd: where it runs.
        environment: variables on top of ours.
        timeout_s: it is ended after that; None = never.

    Returns:
        Wall seconds.

    Raises:
        AwError: no such program, a non-zero exit code (with the last lines of the log), or too late.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    record = log.with_suffix(_RECORD)
    begin = time.perf_counter()
    with open(log, "ab") as out:
        out.write(f"$ {shlex.join(command)}\n".encode())
        out.flush()
        try:
            # A session of its own, so that what the program starts ends with it.
            process = subprocess.Popen(
                list(command), cwd=cwd, env={**os.environ, **environment}, stdin=subprocess.DEVNULL,
                stdout=out, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise AwError(
                f"{what} cannot start {command[0]!r} in {cwd}: {error.strerror or error}; "
                "check cwd, prefix and the command"
            ) from None
        try:
            write_json(record, {"group": process.pid, "host": platform.node(), "start": _start(process.pid)})
            code = process.wait(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            raise AwError(f"{what} took longer than {timeout_s:.0f} s and was ended; {_tail(log)}") from None
        finally:
            _end_group(process.pid, process)
            record.unlink(missing_ok=True)
    if code != 0:
        reason = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        raise AwError(f"{what} {reason}; {_tail(log)}")
    return time.perf_counter() - begin


def _tail(log: Path) -> str:
    """ "last lines of LOG: ...": one line, without the escapes of a terminal."""
    with open(log, "rb") as f:
        f.seek(max(0, log.stat().st_size - _TAIL_BYTES))
        text = f.read().decode(errors="replace")
    lines = [_ESCAPES.sub("", line).strip() for line in re.split(r"[\r\n]+", text)]
    lines = [line for line in lines if line and not line.startswith("$ ")]
    return f"last lines of {log}: " + (" | ".join(lines[-_TAIL_LINES:]) or "(it wrote nothing)")


def _end_group(group: int, process: subprocess.Popen[bytes] | None = None) -> None:
    """End every process of the group: SIGTERM first, then SIGKILL."""
    for sign, patience in ((signal.SIGTERM, GRACE_S), (signal.SIGKILL, GRACE_S)):
        try:
            os.killpg(group, sign)
        except (ProcessLookupError, PermissionError):
            break
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline:
            if process is not None:
                process.poll()
            if not _alive(group):
                break
            time.sleep(0.05)
    if process is not None:
        process.wait()


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except (ProcessLookupError, PermissionError):
        return False
    # A leader that has ended but was not waited for (a zombie) does not count.
    stat = _stat(group)
    return stat is None or stat[0] != "Z"


def end_left_over(logs: Path) -> None:
    """End processes that a killed run left behind for these logs: two would overwrite each other's files."""
    for record in sorted(logs.glob(f"*{_RECORD}")):
        _end_recorded(record)


def _end_recorded(record: Path) -> None:
    try:
        left = json.loads(record.read_text(encoding="utf-8"))
        group, host, start = int(left["group"]), left["host"], left["start"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return
    # Process ids are reused: the start time tells whether it is still the same process.
    if host == platform.node() and start is not None and start == _start(group):
        _end_group(group)
    record.unlink(missing_ok=True)


def _start(pid: int) -> str | None:
    """Start time of the process in the kernel's units; None if unknown."""
    stat = _stat(pid)
    return None if stat is None else stat[19]


def _stat(pid: int) -> list[str] | None:
    """Fields of /proc/PID/stat from the state on; None without such a process or system."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
