"""Exact snapshots of a run: nested dicts of tensors and plain values in one safetensors file.

safetensors holds no code, so a checkpoint from a stranger cannot run any. Plain values travel as JSON in
the file's metadata; Python's floats and big integers survive it exactly.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import State
from ambiguous_wild.io.files import atomic_path

FORMAT = "ambiguous_wild/1"
_TENSOR = "@tensor"  # stands in the plain tree where a tensor was


def save(path: Path | str, tree: State) -> None:
    """Write a nested dict of tensors, arrays, numbers, strings, lists and None, atomically.

    Raises:
        TypeError: a value is of another type.
    """
    tensors: dict[str, torch.Tensor] = {}
    plain = _split(tree, "", tensors)
    _separate(tensors)
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"format": FORMAT, "plain": json.dumps(plain)})


def load(path: Path | str) -> State:
    """Read what `save` wrote, with tensors on the CPU.

    Raises:
        AwError: the file is no checkpoint of this version, or is damaged.
    """
    try:
        with safe_open(str(path), framework="pt", device="cpu") as f:
            metadata = f.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise AwError(
                    f"{path} is no checkpoint of this version (format {metadata.get('format')!r}, "
                    f"expected {FORMAT!r}); train again with --overwrite always"
                )
            tensors = {key: f.get_tensor(key) for key in f.keys()}  # noqa: SIM118 - not a dict
        return _join(json.loads(metadata["plain"]), "", tensors)
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise AwError(
            f"cannot read checkpoint {path}: {error}; delete it or train with --overwrite always"
        ) from None


def _split(value: Any, key: str, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(value, Mapping):
        for name in value:
            if not isinstance(name, str) or "/" in name:
                raise TypeError(
                    f"checkpoint keys are strings without '/', got {name!r} under {key!r}: write str(...) "
                    "in the state_dict() that gives it"
                )
        return {name: _split(item, f"{key}/{name}", tensors) for name, item in value.items()}
    if isinstance(value, np.ndarray):
        value = torch.from_numpy(np.ascontiguousarray(value))
    if isinstance(value, torch.Tensor):
        tensors[key] = value.detach().to("cpu").contiguous()
        return _TENSOR
    if isinstance(value, (list, tuple)):
        return [_split(item, f"{key}/{i}", tensors) for i, item in enumerate(value)]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"cannot store {type(value).__name__} at {key!r} in a checkpoint")


def _separate(tensors: dict[str, torch.Tensor]) -> None:
    """Copy tensors that share memory with one before them, which safetensors refuses."""
    taken: dict[int, list[tuple[int, int]]] = {}  # ranges of addresses by storage
    for key, tensor in tensors.items():
        start, end = tensor.data_ptr(), tensor.data_ptr() + tensor.nbytes
        ranges = taken.setdefault(tensor.untyped_storage().data_ptr(), [])
        if any(start < other_end and other_start < end for other_start, other_end in ranges):
            tensors[key] = tensor.clone()
        else:
            ranges.append((start, end))


def _join(plain: Any, key: str, tensors: dict[str, torch.Tensor]) -> Any:
    if plain == _TENSOR:
        return tensors[key]
    if isinstance(plain, dict):
        return {name: _join(item, f"{key}/{name}", tensors) for name, item in plain.items()}
    if isinstance(plain, list):
        return [_join(item, f"{key}/{i}", tensors) for i, item in enumerate(plain)]
    return plain
