"""The exact command that brings an optional part, for this installation."""

from __future__ import annotations

import sys
from pathlib import Path


def install_command(extra: str) -> str:
    """The pip command for the extra: from the checkout the package runs from, else by the package's name.

    Args:
        extra: a name under [project.optional-dependencies], e.g. ``"cuda"``.
    """
    root = Path(__file__).resolve().parents[2]
    target = f"-e '{root}[{extra}]'" if (root / "pyproject.toml").is_file() else f"'ambiguous-wild[{extra}]'"
    pinned = f" -c '{root / 'constraints.txt'}'" if (root / "constraints.txt").is_file() else ""
    return f"{sys.executable} -m pip install{pinned} {target}"
