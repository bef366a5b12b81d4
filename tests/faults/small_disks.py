"""Disks that are full or read-only, for those who may mount; elsewhere tests that ask for one are skipped."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


def mount(*words: str) -> None:
    """Run mount; skip the test where that is not allowed."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("mounting a small disk needs root")
    done = subprocess.run(["mount", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"this machine mounts nothing: {done.stderr.strip()}")


@contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[Path]:
    """A file system of that size at `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    mount("-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder))
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)


def grow(folder: Path, kilobytes: int) -> None:
    """Make room on a small disk."""
    mount("-o", f"remount,size={kilobytes}k", str(folder))


def read_only(folder: Path) -> None:
    """No more writing on a small disk; for root, too, whom rights do not stop."""
    mount("-o", "remount,ro", str(folder))


def writable(folder: Path) -> None:
    mount("-o", "remount,rw", str(folder))
