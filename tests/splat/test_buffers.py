"""The pool of arrays lends memory again when nobody can see it any more, and never before."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from ambiguous_wild.splat.cpu.buffers import BufferPool

Take = Callable[[BufferPool], np.ndarray]
TAKES: dict[str, Take] = {
    "take": lambda pool: pool.take("a", (6, 4)),
    "take_rows": lambda pool: pool.take_rows("a", (6, 4))[0],
}
# what a caller may keep of an array instead of the array
KEPT: dict[str, Callable[[np.ndarray], Any]] = {
    "the array": lambda array: array,
    "a row": lambda array: array[2],
    "a view of a view": lambda array: array.T[1:][:, 2:],
    "another type": lambda array: array.view(np.uint8),
    "a flat view": lambda array: array.reshape(-1),
    "a subclass": lambda array: array.view(np.matrix),
    "a tensor": torch.from_numpy,
    "a row of a tensor": lambda array: torch.from_numpy(array)[3],
    "an array of a tensor": lambda array: torch.from_numpy(array[1:]).detach().numpy()[2:],
    "a memoryview": memoryview,
}


def place(array: np.ndarray) -> int:
    """Address of the first byte."""
    return int(array.__array_interface__["data"][0])


@pytest.mark.parametrize("take", TAKES.values(), ids=TAKES)
@pytest.mark.parametrize("keep", KEPT.values(), ids=KEPT)
def test_what_is_held_is_not_handed_out_again(take: Take, keep: Callable[[np.ndarray], Any]) -> None:
    pool = BufferPool()
    first = take(pool)
    first[:] = 1.0
    at = place(first)
    kept = keep(first)
    del first
    second = take(pool)
    second[:] = 2.0
    assert place(second) != at
    assert (np.asarray(kept).view(np.float32) == 1.0).all()
    del kept
    assert place(take(pool)) == at


@pytest.mark.parametrize("take", TAKES.values(), ids=TAKES)
def test_ownership_does_not_depend_on_reference_counts(take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    # CPython 3.14 does not count a local that the interpreter borrows, so that a count is one lower there.
    count = sys.getrefcount
    # one of the two is the parameter of this function
    monkeypatch.setattr(sys, "getrefcount", lambda thing: count(thing) - 2)
    pool = BufferPool()
    first = take(pool)
    assert place(first) != place(take(pool))


def test_the_same_memory_serves_needs_of_about_its_size() -> None:
    pool = BufferPool()
    first = pool.take("a", (1000, 4), slack=0.25)
    at = place(first)
    assert at % 64 == 0
    del first
    assert place(pool.take("a", (1200, 4))) == at
    assert place(pool.take("a", (4, 1000), np.int32)) == at
    assert place(pool.take("a", (4000,))) == at
    larger = pool.take("a", (9000, 4))
    assert larger.shape == (9000, 4) and larger.flags.writeable and larger.flags.c_contiguous
    del larger
    # a block much too large is no good for a small need
    large = place(pool.take("a", (9000, 4)))
    assert place(pool.take("a", (10,))) != large


def test_rows_come_back_with_the_mask_of_what_was_written() -> None:
    pool = BufferPool()
    rows, dirty = pool.take_rows("a", (5, 2))
    assert not rows.any() and not dirty.any()
    rows[3], dirty[3] = 7.0, True
    del rows, dirty
    rows, dirty = pool.take_rows("a", (5, 2))
    assert dirty.tolist() == [False, False, False, True, False]
    assert (rows[3] == 7.0).all() and not rows[~dirty].any()


def test_only_so_many_are_remembered_and_nothing_that_is_held_is_lost() -> None:
    pool = BufferPool(keep=2)
    held = [pool.take("a", (50,)) for _ in range(5)]
    for number, array in enumerate(held):
        array[:] = number
    assert [float(array[0]) for array in held] == [0, 1, 2, 3, 4]
    assert len(pool._blocks["a"]) == 2
    pool.clear()
    fresh = pool.take("a", (50,))
    fresh[:] = -1.0
    assert [float(array[0]) for array in held] == [0, 1, 2, 3, 4]


def test_nothing_at_all_can_be_asked_for() -> None:
    pool = BufferPool()
    assert pool.take("a", (0, 4)).shape == (0, 4)
    assert pool.take_rows("a", (0, 15, 3))[0].shape == (0, 15, 3)
