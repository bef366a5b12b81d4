"""Where compiled kernels are kept: one folder per state of the kernels' source.

Numba's own cache compares a kernel's file alone, so that a change in a function it calls, in another file,
would go unnoticed. Here the folder's name is a hash over all of them.
"""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
from pathlib import Path


def kernel_cache() -> Path:
    """The user's own NUMBA_CACHE_DIR first, then the home cache, then a private temporary folder."""
    explicit = os.environ.get("NUMBA_CACHE_DIR")
    if explicit:
        return Path(explicit)
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    name = f"kernels-{digest.hexdigest()[:12]}"
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ambiguous_wild"
    try:
        base.mkdir(parents=True, exist_ok=True)
        writable = os.access(base, os.W_OK)
    except OSError:
        writable = False
    return base / name if writable else _private_temporary() / name


def _private_temporary() -> Path:
    """A temporary folder of this user alone: compiled code is loaded from it."""
    user = os.getuid() if hasattr(os, "getuid") else None  # Windows: its temporary folder is the user's own
    folder = Path(tempfile.gettempdir()) / f"ambiguous_wild-{'user' if user is None else user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return Path(tempfile.mkdtemp(prefix="ambiguous_wild-"))
    mine = user is None or (status.st_uid == user and not status.st_mode & 0o022)
    mine = mine and stat.S_ISDIR(status.st_mode)
    return folder if mine else Path(tempfile.mkdtemp(prefix="ambiguous_wild-"))
