"""The log keeps a bounded, even sample of places, and goes on exactly after a resume."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from ambiguous_wild.splat import checkpoint, training_records
from ambiguous_wild.splat.training_records import DensityLog, SampledPositions


def numbered(start: int, count: int) -> torch.Tensor:
    """Positions whose x is their number."""
    return torch.arange(start, start + count, dtype=torch.float32)[:, None].repeat(1, 3)


@given(st.lists(st.integers(0, 70), max_size=12))
def test_what_is_kept_is_every_so_many_th_of_all(sizes):
    most, training_records.MAX_POSITIONS = training_records.MAX_POSITIONS, 16
    try:
        places = SampledPositions()
        for size in sizes:
            places.add(numbered(places.passed, size))
    finally:
        training_records.MAX_POSITIONS = most
    total = sum(sizes)
    assert places.passed == total
    assert len(places.xyz) <= 16
    np.testing.assert_array_equal(places.xyz[:, 0].numpy(), np.arange(0, total, places.stride))


def test_state_goes_on_exactly(tmp_path):
    whole, parts = DensityLog(), DensityLog()
    for k, log in enumerate((whole, parts)):
        log.begin(100)
        log.grew(2, 3, numbered(0, 8))
        log.now.pruned, log.now.count = 1, 40
        if k:
            checkpoint.save(tmp_path / "log", log.state_dict())
            parts = DensityLog()
            parts.load_state_dict(checkpoint.load(tmp_path / "log"))
            log = parts
        log.begin(200)
        log.merge(5, numbered(8, 5))
        log.grew(0, 0, numbered(0, 0))
    assert parts.rounds == whole.rounds and whole.rounds[1].merged == 5
    assert torch.equal(parts.added.xyz, whole.added.xyz) and torch.equal(parts.merged.xyz, whole.merged.xyz)
    assert parts.added.passed == 8 and parts.merged.passed == 5
