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


def aw(*words: object, cwd: Path = ROOT) -> CompletedProcess[str]:
    """What `aw WORDS` prints and its exit code. Plugins of an earlier call are forgotten."""
    line = ["aw", *map(str, words)]
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
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
