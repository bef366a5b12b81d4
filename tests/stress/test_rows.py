"""Every row of the hard cases, named after it. What comes out and how far off it may be is the case's own."""

import pytest

from ambiguous_wild.stress.case import run
from ambiguous_wild.stress.stress_table import CASES
from tests.splat import fake_gsplat


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.key)
def test_row(case):
    outcome = run(case, "cpu")
    assert outcome.failure == ""
    assert outcome.passed, (outcome.error, outcome.tolerance, outcome.why)
    assert outcome.expected


@pytest.mark.gpu
@pytest.mark.parametrize("case", [c for c in CASES if "cuda" in c.devices], ids=lambda case: case.key)
def test_row_on_a_gpu(case):
    outcome = run(case, "cuda")
    assert outcome.failure == ""
    assert outcome.passed, (outcome.error, outcome.tolerance, outcome.why)


@pytest.mark.parametrize("case", [c for c in CASES if "cuda" in c.devices], ids=lambda case: case.key)
def test_row_on_a_gpus_path_around_a_stand_in(case, monkeypatch):
    """All of it but gsplat's own kernels, of which a stand-in in plain torch has the conventions."""
    with fake_gsplat.installed(monkeypatch):
        outcome = run(case, "cpu")
    assert outcome.failure == ""
    assert outcome.passed, (outcome.error, outcome.tolerance, outcome.why)


def test_keys_are_unique_and_rows_1_to_24_have_cases():
    keys = [case.key for case in CASES]
    assert len(set(keys)) == len(keys)
    assert {case.row for case in CASES} == set(range(1, 25))
