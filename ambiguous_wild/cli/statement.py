"""`aw statement`: the paragraph on reproducibility of a paper."""

from __future__ import annotations

from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName, style_of

SUFFIXES = {".txt": "text", ".md": "markdown", ".tex": "latex", "": "text"}


@click.command(name="statement")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@click.option("-o", "--output", type=PathName(dir_okay=False), help="Write to this file: .txt, .md or .tex.")
def command(runs: tuple[Path, ...], output: Path | None) -> None:
    """Write what a paper says of the runs below the folders RUNS: code, machine, data, seeds and commands.

    Where runs differ, it says which have what. The commands name scenes and files without folders.

    \b
    aw statement runs
    aw statement runs -o reproducibility.tex
    """
    from ambiguous_wild.core.errors import counted
    from ambiguous_wild.io.files import write_text
    from ambiguous_wild.report.reproducibility import statement, to_latex, to_markdown, to_text

    style = style_of(output, SUFFIXES)
    said = statement(runs)
    text = {"text": to_text, "markdown": to_markdown, "latex": to_latex}[style](said)
    if output is None:
        click.echo(text, nl=False)
    else:
        write_text(output, text)
        click.echo(f"wrote {output}: {counted(len(said.commands), 'command')}", err=True)
