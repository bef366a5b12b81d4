"""Files of network weights: where they are searched, and how tensors are read without running code.

torch is imported only when a file is read.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ambiguous_wild.core.errors import AwError

if TYPE_CHECKING:
    from torch import Tensor


CACHE = "~/.cache"
DEFAULT_FOLDER = f"{CACHE}/ambiguous_wild/weights"


def weights_folder() -> Path:
    """Return the folder that AW_WEIGHTS names; `DEFAULT_FOLDER` if the variable is not set."""
    return expanded(os.environ.get("AW_WEIGHTS", "").strip() or DEFAULT_FOLDER, "AW_WEIGHTS")


def expanded(path: str | Path, name: str) -> Path:
    """Replace the ~ of a path; `name` is the variable or option that holds it.

    A cache of a user without a home, as in containers, lies in a temporary folder.

    Raises:
        AwError: the home folder of its user is not known.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        if str(path).startswith(f"{CACHE}/") or str(path) == CACHE:
            user = os.getuid() if hasattr(os, "getuid") else 0
            return Path(tempfile.gettempdir()) / f"ambiguous_wild-home-{user}" / str(path).removeprefix("~/")
        raise AwError(
            f"{name} is {str(path)!r}, but no home folder is known for its '~'; give the full path"
        ) from None


def folder_fault() -> str:
    """Return why `weights_folder` cannot hold weights, and what to do; "" if it can."""
    folder = weights_folder()
    existing = next((place for place in (folder, *folder.parents) if place.exists()), None)
    if existing is None or existing.is_dir():
        return ""
    role = "the folder of weights" if existing == folder else f"which the folder of weights {folder} is in"
    return f"{existing}, {role}, is a file; set AW_WEIGHTS to a folder"


def torch_hub_folder() -> Path:
    """Return the folder of checkpoints that torch downloads: TORCH_HOME/hub/checkpoints or its default."""
    cache = os.environ.get("XDG_CACHE_HOME") or CACHE
    home = os.environ.get("TORCH_HOME")
    folder = expanded(home, "TORCH_HOME") if home else expanded(cache, "XDG_CACHE_HOME") / "torch"
    return folder / "hub" / "checkpoints"


def file_places(name: str) -> list[Path]:
    """Return the folders in which files of the weights of this name are searched, in order."""
    own = weights_folder()
    return [own / name, own, torch_hub_folder()]


def find_file(name: str, files: tuple[str, ...]) -> Path | None:
    """Return the first of these equivalent files that exists in `file_places`."""
    paths = (folder / file for folder in file_places(name) for file in files)
    return next((path for path in paths if path.is_file()), None)


def _fits(path: Path) -> bool:
    """Whether the file fits into memory twice: if so, a file that asked for too much is damaged."""
    try:
        bytearray(2 * path.stat().st_size)
    except MemoryError:
        return False
    return True


def read_tensors(path: Path, advice: str = "download it again") -> dict[str, Tensor]:
    """Read the tensors of a .safetensors file, or of a file of torch with ``weights_only``.

    Args:
        path: file to read.
        advice: what to do about a file that cannot be used; ends the error.

    Raises:
        AwError: the file is damaged, holds anything but a dict of tensors, or a value is not finite.
    """
    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            data = load_file(path)
        else:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # warnings about odd pickles: the error below is enough
                data = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(data, dict) or not all(isinstance(v, torch.Tensor) for v in data.values()):
            raise AwError(f"{path} holds no dictionary of tensors; {advice}")
        tensors = {str(key): value.detach() for key, value in data.items()}
        broken = not_finite(tensors)
    except AwError:
        raise
    except Exception as error:  # torch raises many undocumented types for a damaged file
        short = isinstance(error, MemoryError) or "allocate memory" in str(error)
        if short and not _fits(path):
            raise MemoryError(str(error)) from None
        raise AwError(f"{path} cannot be read as weights ({_reason(path, error)}); {advice}") from None
    if broken is not None:
        raise AwError(f"{path} holds values that are not finite, in tensor {broken}; {advice}")
    return tensors


def not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Return the name of the first tensor with a NaN or an infinite value, if any."""
    import torch

    floats = ((key, value) for key, value in tensors.items() if value.is_floating_point())
    return next((key for key, value in floats if not bool(torch.isfinite(value).all())), None)


def _reason(path: Path, error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if path.suffix == ".safetensors":
        return (str(error).splitlines() or [type(error).__name__])[0]
    # torch would advise to read it without weights_only, which runs what a pickle asks for
    return "damaged, or more than tensors; nothing in it was run"
