"""Pickles of arrays are read, and nothing else of a pickle has an effect."""

from __future__ import annotations

import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.io import array_pickle
from ambiguous_wild.io.array_pickle import read_arrays


def write(path: Path, data: Any, protocol: int = 3) -> Path:
    path.write_bytes(data if isinstance(data, bytes) else pickle.dumps(data, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", [3, 4])
def test_arrays_come_back_with_type_order_and_values(tmp_path: Path, protocol: int) -> None:
    rng = np.random.default_rng(0)
    tree = {
        "net": {
            "kernel": rng.random((3, 4, 2)).astype(np.float32),
            "fortran": np.asfortranarray(rng.random((3, 5))),
            "swapped": rng.random(4).astype(">f4"),
        },
        "counts": np.arange(5, dtype=np.int64),
        "flags": np.array([True, False]),
        "scalar": np.array(2.5),
        "empty": np.zeros((0, 3), np.uint8),
    }
    found = read_arrays(write(tmp_path / "a.pkl", tree, protocol))
    expected = {f"net.{k}": v for k, v in tree.pop("net").items()} | tree
    assert found.keys() == expected.keys()
    for key, array in expected.items():
        assert np.array_equal(found[key], array) and found[key].shape == array.shape, key
        assert found[key].dtype == array.dtype
    assert found["counts"].flags.writeable


class Calls:
    """Pickles as a call."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = (function, args)

    def __reduce__(self) -> Any:
        return self.call


# BUILD on the stand-in for numpy's function, with a second dict: sets attributes
_SETS = b"\x80\x03cnumpy.core.multiarray\n_reconstruct\nN}X\x05\x00\x00\x00_nameX\x01\x00\x00\x00xs\x86b."
_STATE = (
    b"\x80\x03cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R(K\x01%scnumpy\ndtype\n"
    b"X\x02\x00\x00\x00f4\x85R%s\x89C\x04\x00\x00\x00\x00tb."
)


@pytest.mark.parametrize(
    "data",
    [
        Calls(os.system, "touch executed"),
        {"a": {"b": Calls(exec, "open('executed', 'w')")}},
        {"a": Calls(np.load, "x.npy")},
        {"a": np.array([{"x": 1}, None], dtype=object)},
        {"a": np.array(["text"])},
        {"a": np.zeros(2, dtype=[("x", "f4")])},
        {"a": 3},
        [np.zeros(2)],
        OrderedDict(a=np.zeros(2)),
        {1: np.zeros(2)},
        np.float32(3.0),
        b"",
        b"not a pickle",
        _SETS,
        _STATE % (b"K\x02\x85", b""),  # two numbers where there is one
        _STATE % (b"J\xff\xff\xff\xff\x85", b""),  # a side of -1
        _STATE % (b"\x89\x85", b""),  # a bool as side
        b"\x80\x03X\x01\x00\x00\x00xQ.",  # persistent id
        b"\x80\x03cnumpy\nndarray\nK\x02\x85R.",  # an array made by its class
        b"\x80\x03cnumpy\nndarray\n.",
        b"\x80\x03}q\x00X\x01\x00\x00\x00ah\x00s.",  # a dict that holds itself
        b"\x80\x03c" + b"ambiguous_wild.io.array_pickle\nread_arrays\nX\x01\x00\x00\x00x\x85R.",
    ],
)  # fmt: skip
def test_anything_else_is_refused_and_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path / "a.pkl", data)
    with pytest.raises(AwError, match=r"a\.pkl is no pickle of numpy arrays \(.+\)") as error:
        read_arrays(path)
    assert "\n" not in str(error.value)
    assert [p.name for p in tmp_path.iterdir()] == ["a.pkl"]


def test_one_good_state_shows_that_the_damaged_ones_fail_for_their_damage(tmp_path: Path) -> None:
    whole = _STATE % (b"K\x01\x85", b"(K\x03X\x01\x00\x00\x00<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb")
    path = write(tmp_path / "a.pkl", b"\x80\x03}X\x01\x00\x00\x00a" + whole[2:-1] + b"s.")
    assert np.array_equal(read_arrays(path)["a"], np.zeros(1, np.float32))


def test_a_small_file_cannot_grow_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree: dict[str, Any] = {"a": np.zeros(1)}
    for _ in range(40):  # 2 ** 40 arrays in a kilobyte
        tree = {"a": tree, "b": tree}
    with pytest.raises(AwError, match="more than 10000 arrays"):
        read_arrays(write(tmp_path / "a.pkl", tree))


def test_cut_files_are_refused(tmp_path: Path) -> None:
    whole = pickle.dumps({"a": np.arange(100.0)}, protocol=3)
    for length in (1, len(whole) // 2, len(whole) - 1):
        with pytest.raises(AwError, match="no pickle of numpy arrays"):
            read_arrays(write(tmp_path / "a.pkl", whole[:length]))


def test_the_stand_ins_cannot_be_changed() -> None:
    name = array_pickle._Name("_reconstruct")
    with pytest.raises(pickle.UnpicklingError, match="sets the attribute"):
        name._name = "other"
