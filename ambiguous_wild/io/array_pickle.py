"""Read pickles of nested dicts of numpy arrays without running anything that they name.

A pickle may call any function of Python. This reader never imports what a pickle asks for: the three names by
which numpy arrays are pickled stand for objects of this module, which check sizes and types and build the
array; every other name is refused.
"""

from __future__ import annotations

import io
import itertools
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core.errors import AwError

_DTYPES = {"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1"}
_MOST = 10_000  # arrays and dicts
_NAMES = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),  # numpy 1
    ("numpy._core.multiarray", "_reconstruct"),  # numpy 2
}


class _Name:
    """One of the admitted names. No attribute can be set on it: BUILD would reach `__setattr__`."""

    __slots__ = ("_name",)
    _name: str

    def __init__(self, name: str) -> None:
        object.__setattr__(self, "_name", name)

    def __setattr__(self, key: str, value: object) -> None:
        raise pickle.UnpicklingError(f"sets the attribute {key!r}")

    def __call__(self, *args: Any) -> Any:
        if self._name == "_reconstruct":
            return _Array()
        if self._name == "dtype":
            return _Dtype(*args[:1])
        raise pickle.UnpicklingError(f"calls {self._name}")


class _Dtype:
    """Stands for a numpy.dtype; numbers only."""

    __slots__ = ("code", "order")

    def __init__(self, code: Any = None) -> None:
        if code not in _DTYPES:
            raise pickle.UnpicklingError(f"holds an array of type {str(code)[:40]!r}, not of numbers")
        self.code, self.order = str(code), "<"

    def __setstate__(self, state: Any) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        if order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("holds a type without byte order")
        self.order = "<" if order == "=" else order


class _Array:
    """Stands for an array until its state arrives."""

    __slots__ = ("array",)

    def __setstate__(self, state: Any) -> None:
        if not (isinstance(state, tuple) and len(state) == 5):
            raise pickle.UnpicklingError("holds an array without its five parts")
        _, shape, dtype, fortran, data = state
        if not isinstance(dtype, _Dtype) or not isinstance(data, bytes):
            raise pickle.UnpicklingError("holds an array of objects")
        if not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
            raise pickle.UnpicklingError("holds an array without a shape")
        values = np.frombuffer(data, np.dtype(dtype.order + dtype.code))
        self.array = values.reshape(shape, order="F" if fortran else "C")


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _NAMES:
            raise pickle.UnpicklingError(f"asks for {module}.{name}"[:120])
        return _Name(name)

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("refers to data outside of it")


def read_arrays(path: Path | str) -> dict[str, np.ndarray]:
    """The arrays of a pickled nested dict, by their keys joined with dots.

    Raises:
        AwError: damaged, or anything but dicts of arrays of numbers; nothing of it was run.
    """
    try:
        tree = _Reader(io.BytesIO(Path(path).read_bytes())).load()
        found = dict(_flatten(tree, "", itertools.count()))
    # a damaged pickle raises many types, MemoryError and RecursionError among them
    except Exception as error:
        line = (str(error).splitlines() or [type(error).__name__])[0]
        raise AwError(
            f"{path} is no pickle of numpy arrays ({line}); nothing of it was run: delete it"
        ) from None
    return found


def _flatten(tree: Any, prefix: str, visits: Iterator[int]) -> Iterator[tuple[str, np.ndarray]]:
    # a dict may hold another many times over, or itself
    if next(visits) > _MOST:
        raise pickle.UnpicklingError(f"holds more than {_MOST} arrays")
    if isinstance(tree, _Array) and hasattr(tree, "array"):
        yield prefix, np.array(tree.array)  # own memory, writeable
        return
    if type(tree) is not dict or not all(type(key) is str for key in tree):
        raise pickle.UnpicklingError(f"holds a {type(tree).__name__.strip('_')} that is no dict of arrays")
    for key, value in tree.items():
        yield from _flatten(value, f"{prefix}.{key}" if prefix else key, visits)
