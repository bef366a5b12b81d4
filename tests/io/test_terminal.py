"""Lines of a terminal: broken between words alone, and bars whose clocks run while nothing is done."""

from __future__ import annotations

import os
import sys
import time

import pytest
from tqdm import tqdm

from ambiguous_wild.io.terminal import clock, display_width, keep_clock_running, line_width, say, wrapped
from tests.command_line import Terminal

LINE = "3 of 30 photos share too few features with two others at once: IMG_0012.jpg, IMG_0017.jpg and 1 more"
COMMAND = "aw bench --method 3dgs,refinesplat --scene my-scene -o runs"


@pytest.mark.parametrize("width", [20, 40, 80])
def test_a_line_is_broken_between_words_and_all_words_stay(width: int) -> None:
    lines = wrapped(LINE, width).splitlines()
    assert len(lines) > 1 and max(map(len, lines)) <= width
    assert " ".join(line.strip() for line in lines) == LINE
    assert all(line.startswith("  ") and not line.startswith("   ") for line in lines[1:])


def test_without_a_terminal_and_where_it_fits_a_line_stays() -> None:
    assert wrapped(LINE, None) == LINE == wrapped(LINE, len(LINE))


def test_further_lines_begin_under_the_last_column() -> None:
    lines = wrapped(f"overlap   WARNING  {LINE}", 60).splitlines()
    assert lines[0].startswith("overlap   WARNING  3 of 30")
    assert all(line.startswith(" " * 19) and line[19] != " " for line in lines[1:])


@pytest.mark.parametrize("text", [f"ready; next: {COMMAND}", f"too few: '{COMMAND}' makes more of them"])
def test_a_command_to_copy_stays_on_one_line(text: str) -> None:
    lines = wrapped(f"{LINE}; {text}", 72).splitlines()
    assert sum(COMMAND in line for line in lines) == 1 and max(map(len, lines)) <= 72
    # where no line has room for it, the terminal breaks it, which copies as one line
    assert any(COMMAND in line for line in wrapped(f"{LINE}; {text}", 40).splitlines())


def test_after_a_command_the_line_may_break() -> None:
    text = "compare them with: aw cost runs, or one folder with: aw table runs/budget-60s; both are quick"
    lines = wrapped(text, 50).splitlines()
    assert max(map(len, lines)) <= 50 and any("aw table runs/budget-60s;" in line for line in lines)


def test_wide_characters_take_two_columns() -> None:
    assert display_width("写真") == 4 and display_width("e\u0301") == 1
    assert max(map(display_width, wrapped("写真 " * 30, 40).splitlines())) <= 40


def test_what_is_said_fits_the_terminal_and_stays_whole_in_a_file(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    say(LINE)
    say("a\x1b[31mb\nc", out=True)
    assert capsys.readouterr() == ("a\\x1b[31mb\\nc\n", f"{LINE}\n") and line_width() is None
    monkeypatch.setattr(sys, "stdout", terminal := Terminal())
    say(LINE, out=True)
    lines = terminal.getvalue().splitlines()
    assert max(map(len, lines)) <= 40 < len(LINE) and line_width() == 40


def test_a_reader_of_progress_that_leaves_does_not_stop_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("stdout", "stderr"):
        read, write = os.pipe()
        os.close(read)
        monkeypatch.setattr(sys, name, os.fdopen(write, "w", buffering=1))
    say(LINE)
    with pytest.raises(BrokenPipeError):
        say(LINE, out=True)


def test_a_clock_runs_while_nothing_is_done_and_ends_with_its_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    nap = time.sleep
    monkeypatch.setattr(time, "sleep", lambda seconds: nap(0.01))
    terminal = Terminal()
    bar = tqdm(total=3, file=terminal, leave=False)
    drawn = terminal.getvalue().count("\r")
    keep_clock_running(bar)
    nap(0.2)
    assert terminal.getvalue().count("\r") > drawn + 2
    bar.close()
    ended = terminal.getvalue()
    nap(0.1)
    assert terminal.getvalue() == ended
    monkeypatch.setattr(sys, "stderr", shown := Terminal())
    with clock("compiling", 95.0):
        nap(0.05)
    assert "compiling [00:00 of about 01:35]" in shown.getvalue()
