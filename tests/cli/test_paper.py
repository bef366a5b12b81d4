"""The commands of docs/paper.md, and the paper that TeX makes of their files."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.command_line import ROOT, aw
from tests.report.board_runs import own_scene, write_run
from tests.shared import made_once

PAGE = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
COMMANDS, TEX = (
    re.search(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[1]  # type: ignore[index]
    for language in ("bash", "latex")
)
LINES = [shlex.split(line)[1:] for line in COMMANDS.splitlines()]
WRITTEN = {"results.tex", "pairs.tex", "figure.pdf", "statement.tex"}


def compiled(folder: Path) -> str:
    """Make paper.pdf of the page's LaTeX and the files in the folder; return TeX's log."""
    if shutil.which("pdflatex") is None:
        pytest.skip("no pdflatex: apt install texlive-latex-recommended")
    (folder / "paper.tex").write_text(TEX, encoding="utf-8")
    words = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "-no-shell-escape", "paper.tex"]
    for _ in range(2):
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, errors="replace")
        assert done.returncode == 0, done.stdout[-3000:]
    return (folder / "paper.log").read_text(errors="replace")


def test_tables_figure_and_statement_are_made_of_runs(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    def make(root: Path) -> None:
        for scene in (own_scene(root / "yard"), own_scene(root / "porch")):
            for noise, method in enumerate(("refinesplat", "robustsplat", "3dgs"), start=4):
                for seed in (0, 1):
                    write_run(root / "runs", scene, method, seed, noise=4.0 * noise, iterations=30_000)

    shutil.copytree(made_once(tmp_path_factory, "paper", make) / "runs", tmp_path / "runs")
    assert len(LINES) == 6
    for line in LINES:
        if line[0] != "bench":
            done = aw(*line, cwd=tmp_path)
            assert done.returncode == 0, done.stderr
    assert {path.name for path in tmp_path.iterdir()} == WRITTEN | {"runs"}
    for name in WRITTEN - {"figure.pdf"}:
        text = (tmp_path / name).read_text()
        assert str(tmp_path) not in text
        assert "Ours" in text or name == "statement.tex"


@pytest.mark.slow
def test_a_paper_is_made_and_compiled(tmp_path: Path) -> None:
    for name in ("yard", "porch"):
        own_scene(tmp_path / name)
    for line in LINES:
        short = ["--iterations", "20"] if "--method" in line else []  # the study has it then
        done = aw(*line, *short, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    assert "12 finished before" in done.stderr or done.stderr.count("finished before, kept") == 12
    log = compiled(tmp_path)
    assert "Overfull" not in log and "undefined" not in log
    pdf = (tmp_path / "paper.pdf").read_bytes()
    assert b"/Type3" not in pdf and pdf.count(b"/Subtype /Image") + pdf.count(b"/Subtype/Image") >= 8
