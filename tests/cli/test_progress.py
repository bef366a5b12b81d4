"""What a person at a terminal sees while a run is made, and what is left of it."""

from __future__ import annotations

import contextlib
import re
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from ambiguous_wild.cli import main, run_progress
from tests.command_line import Terminal, aw
from tests.tiny_scene import write_tiny_scene

LENGTH = 30


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    scene = write_tiny_scene(tmp_path / "wall")
    out = tmp_path / "runs"
    return ["bench", "--method", "3dgs", "--scene", str(scene), "-o", str(out), "--iterations", str(LENGTH)]


def seen(words: list[str], monkeypatch: pytest.MonkeyPatch) -> Terminal:
    terminal = Terminal()
    monkeypatch.setattr(sys, "argv", ["aw", *words])
    monkeypatch.setattr(sys, "stderr", terminal)
    with contextlib.suppress(SystemExit):
        main.main()
    return terminal


def test_a_bar_says_what_is_done_and_goes(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    shown = seen([*words, "--effects", "dense"], monkeypatch)
    phases = ["finding start points: ", "training: ", r"measuring \d+ test views: 100%", "drawing masks"]
    assert re.search(".*".join(phases), shown.getvalue(), re.DOTALL)
    assert "|" not in shown.left() and "PSNR" in shown.left()


def test_set_up_has_a_clock_of_its_own_and_the_end_of_a_budget_is_known(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = seen([*words, "--effects", "none"], monkeypatch).getvalue()
    begun = shown.index("training: ")
    assert "setting up: [00:00]" in shown[:begun] and "%" not in shown[:begun]
    assert re.search(r"training: +0%\|.*\| 0/30it \[00:00<\?, \d+ ms/it, 400 Gaussians", shown)
    budget = [*words[: words.index("--iterations")], "--budget", "1s", "--seed", "1", "--effects", "none"]
    shown = seen(budget, monkeypatch).getvalue()
    assert "setting up: [00:00, then 00:01 of training]" in shown
    assert re.search(r"training: .*/100% \[00:00, 00:0[01] left, \d+ ms/it", shown) and "?" not in shown


STOPPING = "stopping: the model is measured and saved, Ctrl-C again to quit"


@pytest.mark.parametrize("terminal", [True, False])
def test_ctrl_c_is_answered_at_once_and_leaves_no_bar(
    words: list[str], monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    monkeypatch.setattr(Terminal, "isatty", lambda self: terminal)
    tick = run_progress.ProgressBar.tick

    def pressing(self, trainer):
        tick(self, trainer)
        if trainer.iteration == 12:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(run_progress.ProgressBar, "tick", pressing)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        shown = seen([*words, "--effects", "none"], monkeypatch)
    finally:
        signal.signal(signal.SIGINT, before)
    text = shown.getvalue()
    assert text.index(STOPPING) < text.index("stopped after 12 iterations of 30")
    assert shown.left().splitlines().count(f"    {STOPPING}") == 1  # a line that stays
    assert "|" not in shown.left() and "measuring" not in text


def test_quiet_verbose_and_the_log_of_a_run(words: list[str], tmp_path: Path) -> None:
    effects = ["--effects", "none"]
    quiet = aw("--quiet", *words, *effects)
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")
    log = (tmp_path / "runs/wall/3dgs/seed0/log.txt").read_text()
    for expected in (
        "3dgs on wall, seed 0, configuration",
        "training",
        "test PSNR",
        "measuring",
        " dB over ",
    ):
        assert re.search(rf"^\d{{4}}-\d\d-\d\d \d\d:\d\d:\d\d .*{expected}", log, re.MULTILINE), expected
    told = aw(*words, *effects, "--seed", "1", "-v").stderr
    assert "test PSNR" in told and told.count("measuring") == 1
    plain = aw(*words, *effects, "--seed", "2").stderr
    phases = r"-> .*\n    setting up\n    training\n    measuring \d+ test views\n    drawing "
    assert re.search(phases, plain)
    wrong = aw("table", tmp_path / "none", "-q")
    assert wrong.returncode == 2 and wrong.stderr.startswith("error: no folder of runs")
    assert "exclude each other" in aw("-q", "-v", "doctor").stderr


@pytest.mark.parametrize(
    ("scenes", "tabulated", "end"),
    [
        (("yard",), False, "compare them with: aw table runs, look at them with: aw view runs"),
        (("yard", "hall"), False, "look at them scene by scene with: aw view runs/hall"),
        (("yard", "hall"), True, "the same command prints these tables again, look at them scene by scene"),
    ],
)
def test_the_end_names_commands_that_work(capsys, scenes, tabulated, end):
    runs = [SimpleNamespace(folder=Path("/elsewhere/runs", scene, "3dgs/seed0")) for scene in scenes]
    report = SimpleNamespace(
        failed=[], runs=runs, folders=(Path("runs"),), output=Path("runs"), outcomes={"trained": len(runs)}
    )
    run_progress.finish(report, as_json=False, tabulated=tabulated)
    assert end in " ".join(capsys.readouterr().err.split())
