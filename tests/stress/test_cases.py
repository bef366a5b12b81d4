"""Every case of `aw stress`; what is expected, and how large an error may be, is the case's own."""

import pytest

from ambiguous_wild.stress.case import run
from ambiguous_wild.stress.stress_table import CASES
from tests.splat import fake_gsplat

every_case = pytest.mark.parametrize("case", CASES, ids=lambda case: case.key)
case_of_a_gpu = pytest.mark.parametrize(
    "case", [c for c in CASES if "cuda" in c.devices], ids=lambda case: case.key
)


def passes(case, device):
    line = run(case, device)
    assert line.passed and line.expected, (line.failure, line.error, line.tolerance, line.why)


@every_case
def test_on_a_cpu(case):
    passes(case, "cpu")


@pytest.mark.gpu
@case_of_a_gpu
def test_on_a_gpu(case):
    passes(case, "cuda")


@case_of_a_gpu
def test_on_the_path_of_a_gpu_around_a_stand_in(case, monkeypatch):
    """All of it but gsplat's own kernels, of which a stand-in in plain torch has the conventions."""
    with fake_gsplat.installed(monkeypatch):
        passes(case, "cpu")


def test_keys_are_unique_and_no_group_is_empty():
    assert len({case.key for case in CASES}) == len(CASES)
    assert {case.group for case in CASES} == set(range(1, 25))
