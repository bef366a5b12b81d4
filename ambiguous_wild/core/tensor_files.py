"""Files of tensors, read without running anything that they name; torch is imported when one is read."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ambiguous_wild.core.errors import AwError

if TYPE_CHECKING:
    from torch import Tensor


def read_tensors(path: Path, advice: str = "download it again") -> dict[str, Tensor]:
    """The tensors of a .safetensors file, or of a file of torch, read with ``weights_only``.

    Args:
        path: of the file.
        advice: what to do about a file that cannot be used; ends the error.

    Raises:
        AwError: damaged, a file that holds anything but a dict of tensors, or values that are not finite.
    """
    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            data = load_file(path)
        else:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about odd pickles: the error below says it in one line
                data = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(data, dict) or not all(isinstance(v, torch.Tensor) for v in data.values()):
            raise AwError(f"{path} holds no dictionary of tensors; {advice}")
        tensors = {str(key): value.detach() for key, value in data.items()}
        broken = not_finite(tensors)
    except AwError:
        raise
    except Exception as error:  # torch raises many undocumented types for a damaged file
        raise AwError(f"{path} cannot be read as weights ({_reason(path, error)}); {advice}") from None
    if broken is not None:
        raise AwError(f"{path} holds values that are not finite, in tensor {broken}; {advice}")
    return tensors


def not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Name of the first tensor with a NaN or an infinite value."""
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
