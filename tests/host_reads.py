"""Proof without a GPU that a step leaves the host alone: torch's `meta` device, and a watch on transfers.

On `meta` whatever needs a value on the host raises by itself: `.item()`, `float(...)`, `bool(...)`,
`nonzero`, boolean indexing, `bincount`, `.cpu()`. What it lets pass is the other direction, a tensor made of
host data, for which a GPU's host waits as well: `no_transfers` raises there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from ambiguous_wild.splat import backend

READ = "(?i)meta|host"  # what torch, and `no_transfers`, say of a step that does not leave it alone

_PLAIN = (str, bytes, int, float, bool, type(None), type, np.ndarray, np.generic, FunctionType, MethodType,
          ModuleType, BuiltinFunctionType, torch.dtype, torch.Generator)  # fmt: skip


def on_accelerator(monkeypatch: pytest.MonkeyPatch, yes: bool = True) -> None:
    monkeypatch.setattr(backend, "accelerated", lambda _: yes)


def moved(thing: Any, device: str = "meta", done: dict[int, Any] | None = None) -> Any:
    """`thing` with all its tensors on `device`, in place where it can be; what is shared stays shared."""
    done = {} if done is None else done
    if isinstance(thing, _PLAIN):
        return thing
    if isinstance(thing, torch.device):
        return torch.device(device)
    if id(thing) in done:
        return done[id(thing)][0]

    def known(result: Any) -> Any:
        done[id(thing)] = (result, thing)  # the thing too: as long as it lives, its id is its own
        return result

    def of(part: Any) -> Any:
        return moved(part, device, done)

    if isinstance(thing, torch.nn.Parameter):
        return known(torch.nn.Parameter(thing.detach().to(device), requires_grad=thing.requires_grad))
    if isinstance(thing, torch.Tensor):
        return known(thing.detach().to(device))
    if isinstance(thing, (tuple, frozenset, set)):
        return known(type(thing)(of(part) for part in thing))
    known(thing)
    if isinstance(thing, dict):
        parts = [(of(key), of(value)) for key, value in thing.items()]
        thing.clear()
        thing.update(parts)
    elif isinstance(thing, list):
        thing[:] = [of(part) for part in thing]
    elif hasattr(thing, "__dict__"):
        for name, value in list(vars(thing).items()):
            thing.__dict__[name] = of(value)  # frozen dataclasses too
    return thing


class _Watch(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        given = [t for t in tree_leaves((args, kwargs or {})) if isinstance(t, torch.Tensor)]
        made = [t for t in tree_leaves(out) if isinstance(t, torch.Tensor)]
        hosts = [t for t in given if t.device.type == "cpu"]
        if hosts and any(t.device.type == "meta" for t in given + made):
            raise AssertionError(f"{func}: {[tuple(t.shape) for t in hosts]} come from the host in a step")
        return out


@contextmanager
def no_transfers() -> Iterator[None]:
    """Inside, making a tensor on `meta` of what lies on the host raises."""

    def watched(make: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            out = make(*args, **kwargs)
            if out.device.type == "meta" and not isinstance(args[0], torch.Tensor):
                raise AssertionError(f"{make.__name__} of host data in a step")
            return out

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name in ("tensor", "as_tensor", "asarray"):
            patch.setattr(torch, name, watched(getattr(torch, name)))
        new_tensor = torch.Tensor.new_tensor

        def of_self(self: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
            if self.device.type == "meta":
                raise AssertionError("new_tensor of host data in a step")
            return new_tensor(self, *args, **kwargs)

        patch.setattr(torch.Tensor, "new_tensor", of_self)
        with _Watch():
            yield
