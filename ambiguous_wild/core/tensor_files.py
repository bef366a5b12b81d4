"""Files of tensors, read without running anything that they name; torch is imported when one is read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ambiguous_wild.core.errors import AwError

if TYPE_CHECKING:
    from torch import Tensor


def read_tensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a .safetensors file, or of a file of torch, read with ``weights_only``.

    Raises:
        AwError: damaged, or a file that holds anything but a dict of tensors.
    """
    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return dict(load_file(path))
        data = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many undocumented types for a damaged file
        line = (str(error).splitlines() or [type(error).__name__])[0]
        raise AwError(f"{path} cannot be read as weights ({line}); download it again") from None
    if not isinstance(data, dict) or not all(isinstance(v, torch.Tensor) for v in data.values()):
        raise AwError(f"{path} holds no dictionary of tensors; download it again")
    return {str(key): value.detach() for key, value in data.items()}
