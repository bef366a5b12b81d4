"""Commands that install optional dependencies, for this installation."""

from __future__ import annotations

import sys
from pathlib import Path


def install_command(extra: str) -> str:
    """The pip command for the extra, from the checkout that is running, else by the package's name.

    Args:
        extra: a name under [project.optional-dependencies], e.g. ``"cuda"``.
    """
    root = Path(__file__).resolve().parents[2]
    target = f"-e '{root}[{extra}]'" if (root / "pyproject.toml").is_file() else f"'ambiguous-wild[{extra}]'"
    return f"{sys.executable} -m pip install{_pinned(root)} {target}"


def torch_command(version: str) -> str:
    """The commands that replace a CPU build of torch by a CUDA build.

    Both have the same version apart from the part after "+", so pip must remove one before it installs the
    other.

    Args:
        version: of torch, e.g. ``"2.13.0+cpu"``.
    """
    pip, release = f"{sys.executable} -m pip", version.partition("+")[0]
    pinned = _pinned(Path(__file__).resolve().parents[2])
    return f"{pip} uninstall -y torch && {pip} install{pinned} 'torch=={release}'"


def _pinned(root: Path) -> str:
    return f" -c '{root / 'constraints.txt'}'" if (root / "constraints.txt").is_file() else ""
