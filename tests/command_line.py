"""`aw` as it is typed, without a process of its own: importing torch takes longer than most commands."""

from __future__ import annotations

import contextlib
import io
import sys
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from ambiguous_wild.cli import main
from ambiguous_wild.harness import measures
from ambiguous_wild.methods import registry

ROOT = Path(__file__).parents[1]


class Terminal(io.StringIO):
    """Text that is written to a terminal."""

    def isatty(self) -> bool:
        return True

    def left(self) -> str:
        """What still stands there: after a carriage return a line is written over."""
        lines = []
        for line in self.getvalue().split("\n"):
            shown = ""
            for piece in line.split("\r"):
                shown = piece + shown[len(piece) :]
            lines.append(shown.rstrip())
        return "\n".join(lines)


def aw(*words: object, cwd: Path = ROOT, columns: int | None = None) -> CompletedProcess[str]:
    """What `aw WORDS` prints and its exit code. Plugins of an earlier call are forgotten.

    `columns`: those of the terminal to which it prints; None: it prints to files.
    """
    line = ["aw", *map(str, words)]
    out, err = (io.StringIO() if columns is None else Terminal() for _ in range(2))
    with pytest.MonkeyPatch.context() as patch:
        if columns is not None:
            patch.setenv("COLUMNS", str(columns))
        patch.setattr(sys, "argv", line)
        patch.setattr(registry, "registered", {})
        patch.setattr(measures, "own_metrics", {})
        patch.chdir(cwd)
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                main.main()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return CompletedProcess(line, code, out.getvalue(), err.getvalue())
