"""Functions that torch compiles on a GPU, where one kernel replaces many."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import torch


def compiled(function: Callable[..., Any], what: str) -> Callable[..., Any]:
    """The function, compiled at its first call on a GPU, for tensors of any size.

    torch's compiler needs Triton, which comes with its CUDA builds on Linux. Where it fails, the function
    runs without it and a warning says why.
    """
    versions: list[Callable[..., Any]] = []

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        if not compiles(arguments[0].device):
            return function(*arguments)
        if not versions:
            versions.append(torch.compile(function, fullgraph=True, dynamic=True))
        try:
            return versions[0](*arguments)
        except torch.cuda.OutOfMemoryError:
            raise
        except Exception as error:  # of the compiler: many kinds, none of them the user's
            if versions[0] is function:
                raise
            versions[0] = function
            reason = str(error).strip().split("\n")[0][:200]
            warnings.warn(f"{what} is not compiled and slower for it: {reason}", stacklevel=2)
            return function(*arguments)

    return call


def compiles(device: torch.device) -> bool:
    """Whether functions are compiled for tensors on this device."""
    return device.type == "cuda"
