"""What a run ran on, and how much memory it took."""

import sys

import numpy as np
import pytest

from ambiguous_wild.harness.running.cell import environment, installed
from ambiguous_wild.harness.running.training import peak_rss_mb, reset_peak


def test_the_environment_names_what_is_there_and_what_is_not():
    facts = environment("cpu")
    assert facts["packages"]["numpy"] == np.__version__
    assert facts["python"] == ".".join(map(str, sys.version_info[:3]))
    assert facts["cores"] >= 1
    assert installed("no-such-distribution") is None


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can forget a peak")
def test_the_peak_is_that_of_the_run_not_of_the_process():
    block = np.ones(40_000_000)  # 320 MB
    high = peak_rss_mb()
    del block
    reset_peak()
    assert peak_rss_mb() < high - 200
