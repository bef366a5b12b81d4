"""`aw stress`: names, choice, formats, exit codes."""

import json

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.stress import stress_table
from ambiguous_wild.stress.case import CaseResult, case, run
from tests.command_line import aw


def stress(*words):
    return aw("stress", *words)


def test_the_list_has_every_case_or_those_chosen():
    assert stress("--list").stdout.split() == [c.key for c in stress_table.CASES]
    chosen = stress("--list", "--only", "24", "--only", "needle").stdout.split()
    assert chosen and all(key.startswith("24-") or "needle" in key for key in chosen)


def test_json_holds_what_the_table_shows():
    done = stress("--only", "24", "--json", "--device", "cpu")
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [row["key"] for row in rows] == [c.key for c in stress_table.CASES if c.group == 24]
    assert all(row["passed"] and row["error"] <= row["tolerance"] for row in rows)


@pytest.mark.parametrize("error", [2.0, float("nan")])
def test_a_case_that_fails_is_said_and_exits_with_1(monkeypatch, tmp_path, error):
    bad = case(1, "made to fail")(lambda device: CaseResult(error, 1.0, "by hand", "nothing"))
    monkeypatch.setattr(stress_table, "CASES", (bad,))
    done = stress("--device", "cpu")
    assert done.returncode == 1 and "FAILED" in done.stdout and "0 of 1 passed" in done.stderr
    assert stress("--device", "cpu", "--json").returncode == 1
    for name in ("out.md", "out.txt", "out.json"):
        stress("--device", "cpu", "-o", str(tmp_path / name))
    assert "FAILED" in (tmp_path / "out.md").read_text() and "FAILED" in (tmp_path / "out.txt").read_text()
    assert not json.loads((tmp_path / "out.json").read_text())[0]["passed"]


FAULTY = """
import torch
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks

class Mean(MaskPolicy):
    mean = None

    def keep(self, step):
        error = (step.rendered.image - step.photo).abs().mean(dim=2)
        self.mean = error.mean() if self.mean is None else 0.9 * self.mean + 0.1 * error.mean()
        return (error < 2 * self.mean).float()

class Lost(Mean):
    def predict(self, step):
        return None

class Learns(Mean):
    def state_dict(self):
        return {"mean": self.mean}

    def load_state_dict(self, state):
        self.mean = state["mean"]

class Unseeded(MaskPolicy):
    def keep(self, step):
        return torch.rand(step.photo.shape[:2])

class Brighter(MaskPolicy):
    def setup(self, data):
        data.photos[3].mul_(1.01)

class Breaks(MaskPolicy):
    def keep(self, step):
        raise IndexError("list index\\nout of range")

class Turns(DensityControl):
    turns = 0

    def before_step(self, step, gradients):
        self.turns += 1
        if self.turns % 50 == 7:
            gradients.means.zero_()
        return gradients

def lost(): return MethodHooks(mask=Lost())
def learns(): return MethodHooks(mask=Learns())
def unseeded(): return MethodHooks(mask=Unseeded())
def brighter(): return MethodHooks(mask=Brighter())
def breaks(): return MethodHooks(mask=Breaks())
def turns(): return MethodHooks(density=Turns)
"""


@pytest.mark.parametrize(
    ("recipe", "line"),
    [
        ("lost", "differs in gaussians, optimiser; not restored: Lost.mean: return it from state_dict()"),
        ("turns", "differs in gaussians, optimiser; not restored: Turns.turns: return it from state_dict()"),
        ("learns", "predict(step) or panels(step) changes mask"),
        ("unseeded", "two trainings of one seed differ in gaussians"),
        ("brighter", "it changes data.photos in place"),
        ("breaks", "IndexError: list index out of range (faulty.py, line 35)"),
    ],
)
def test_a_faulty_method_is_found_with_its_remedy(tmp_path, recipe, line):
    (tmp_path / "faulty.py").write_text(FAULTY)
    done = stress("--method", f"{tmp_path / 'faulty.py'}:{recipe}")
    assert done.returncode == 1 and "0 of 1 passed on cpu" in done.stderr
    assert line in done.stdout and len(done.stdout.splitlines()) == 3


def test_a_case_that_raises_fails_with_its_reason():
    def measure(device):
        raise AwError("not today")

    outcome = run(case(1, "raises")(measure), "cpu")
    assert not outcome.passed and outcome.failure == "not today"
