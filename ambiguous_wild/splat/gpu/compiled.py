"""Functions that torch compiles on a GPU, where one kernel replaces many; eager where it cannot."""

from __future__ import annotations

import types
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


class Compiled:
    """A function as torch compiles it on CUDA, or the function itself where torch cannot.

    Each combination of arguments that are no tensors (with a keep map or without, inside or outside) is
    compiled once, for pictures of any size: height and width are symbols from the start.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        what: str = "the loss",
        backend: str | Callable[..., Any] = "inductor",
    ) -> None:
        """
        Args:
            function: of tensors [H, W, ...] or [N, ...] and constants.
            what: its name in the warning.
            backend: of torch.compile.
        """
        self.function, self.what, self.backend = function, what, backend
        self.compiled: dict[tuple[Any, ...], Callable[..., Any]] = {}
        self.broken: set[tuple[Any, ...]] = set()

    def __call__(self, *arguments: Any) -> Any:
        kind = tuple(Tensor if isinstance(a, Tensor) else a for a in arguments)
        if kind in self.broken or not compiles(arguments[0].device):
            return self.function(*arguments)
        # other strides would be another version
        tensors = [a.contiguous() for a in arguments if isinstance(a, Tensor)]
        try:
            if kind not in self.compiled:
                self.compiled[kind] = torch.compile(
                    self._of_tensors(kind), fullgraph=True, backend=self.backend
                )
                for tensor in tensors:
                    torch._dynamo.maybe_mark_dynamic(tensor, list(range(min(tensor.dim(), 2))))
            return self.compiled[kind](*tensors)
        except torch.cuda.OutOfMemoryError:
            raise
        except Exception as error:  # of the compiler: many kinds, none of them the user's
            self.broken.add(kind)
            reason = str(error).strip().split("\n")[0][:200]
            warnings.warn(f"{self.what} is not compiled and slower for it: {reason}", stacklevel=3)
            return self.function(*arguments)

    def _of_tensors(self, kind: tuple[Any, ...]) -> Callable[..., Any]:
        """The function of its tensors alone, everything else a constant."""

        def call(*tensors: Tensor) -> Any:
            given = iter(tensors)
            return self.function(*[next(given) if a is Tensor else a for a in kind])

        # versions are counted by code object, and the compiler gives up on one that has several
        return types.FunctionType(call.__code__.replace(), call.__globals__, closure=call.__closure__)


def compiles(device: torch.device) -> bool:
    return device.type == "cuda"
