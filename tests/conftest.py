"""What needs a GPU is skipped elsewhere, with the reason."""

from __future__ import annotations

import pytest


def pytest_collection_modifyitems(items):
    wanted = [item for item in items if item.get_closest_marker("gpu")]
    if not wanted:
        return
    from ambiguous_wild.splat.cuda_ready import look, why_not

    lack = why_not(look())
    if lack is not None:
        skip = pytest.mark.skip(reason=f"no GPU to test on: {lack.what}")
        for item in wanted:
            item.add_marker(skip)
