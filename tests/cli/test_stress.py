"""`aw stress`: names, choice, formats, exit codes."""

import json

import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.main import cli
from ambiguous_wild.core import AwError
from ambiguous_wild.stress import table
from ambiguous_wild.stress.case import Measured, case, run


def aw(*words):
    return CliRunner().invoke(cli, ["stress", *words])


def test_the_list_has_every_case_or_those_chosen():
    assert aw("--list").output.split() == [c.key for c in table.CASES]
    chosen = aw("--list", "--only", "24", "--only", "needle").output.split()
    assert chosen
    assert all(key.startswith("24-") or "needle" in key for key in chosen)


def test_an_unknown_case_is_named():
    with pytest.raises(AwError, match="'nedle': no such case"):
        CliRunner().invoke(cli, ["stress", "--only", "nedle"], catch_exceptions=False)


def test_json_holds_what_the_table_shows():
    done = aw("--only", "24", "--json", "--device", "cpu")
    assert done.exit_code == 0, done.output
    rows = json.loads(done.stdout)
    assert [row["key"] for row in rows] == [c.key for c in table.CASES if c.row == 24]
    assert all(row["passed"] and row["error"] <= row["tolerance"] for row in rows)


@pytest.mark.parametrize("error", [2.0, float("nan")])
def test_a_case_that_fails_is_said_and_exits_with_1(monkeypatch, error):
    bad = case(1, "made to fail")(lambda device: Measured(error, 1.0, "by hand", "nothing"))
    monkeypatch.setattr(table, "CASES", (bad,))
    done = aw("--device", "cpu")
    assert done.exit_code == 1
    assert "FAILED" in done.stdout
    assert "0 of 1 passed" in done.output
    assert aw("--device", "cpu", "--json").exit_code == 1
    assert "FAILED" in aw("--device", "cpu", "--format", "markdown").stdout


def test_a_case_that_raises_fails_with_its_reason():
    def measure(device):
        raise AwError("not today")

    outcome = run(case(1, "raises")(measure), "cpu")
    assert not outcome.passed
    assert outcome.failure == "not today"
