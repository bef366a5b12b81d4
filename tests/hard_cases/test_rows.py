"""Every row of the hard cases, named after it. What comes out and how far off it may be is the case's own."""

import re
from pathlib import Path

import pytest

from ambiguous_wild.stress.case import run
from ambiguous_wild.stress.table import CASES
from tests.splat import fake_gsplat

DOCS = Path(__file__).parents[2] / "docs" / "numerics.md"


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.key)
def test_row(case):
    outcome = run(case, "cpu")
    assert outcome.failure == ""
    assert outcome.passed, (outcome.error, outcome.tolerance, outcome.why)
    assert outcome.comes_out


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


def test_the_page_maps_every_row_to_tests_that_exist():
    rows = dict(re.findall(r"^\| (\d+) \|[^|]*\| (.*) \|$", DOCS.read_text(encoding="utf-8"), re.MULTILINE))
    assert sorted(map(int, rows)) == list(range(1, 28))
    root = Path(__file__).parents[2]
    for number, cell in rows.items():
        named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", cell)
        assert named or int(number) <= 24, number
        for path, function in named:
            assert f"def {function}(" in (root / path).read_text(encoding="utf-8"), (number, path, function)
    for case in CASES:
        assert f"`{case.key}`" in DOCS.read_text(encoding="utf-8"), case.key
