"""Versions that the result depends on: ours and those of the libraries."""

from __future__ import annotations

from functools import cache
from importlib import metadata

from ambiguous_wild import __version__

BUILDER = 11  # raised when a stage gives another result for the same input
_LIBRARIES = ("pycolmap", "OpenImageIO", "opencv-contrib-python-headless", "pillow", "numpy")


@cache
def versions() -> dict[str, str]:
    """Name -> version; a library that is installed under another name is left out."""
    found = {"ambiguous_wild": __version__, "builder": str(BUILDER)}
    for name in _LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
