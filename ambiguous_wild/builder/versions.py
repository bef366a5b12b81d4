"""What decided the result besides the photos: our version and those of the libraries that compute."""

from __future__ import annotations

from functools import cache
from importlib import metadata

from ambiguous_wild import __version__

BUILDER = 5  # raised when a stage computes something else from the same input
_LIBRARIES = ("pycolmap", "OpenImageIO", "opencv-contrib-python-headless", "numpy")


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
