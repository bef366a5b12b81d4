"""`aw audit`: find errors in tables of results."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName


@click.command("audit")
@click.argument("tables", nargs=-1, type=PathName())
@click.option(
    "--format",
    "style",
    type=click.Choice(["text", "markdown", "csv", "json"]),
    default="text",
    show_default=True,
)
@click.option("-o", "--output", type=PathName(dir_okay=False), help="Write to this file.")
@click.option("--strict", is_flag=True, help="Exit with code 1 if anything is found.")
def command(tables: tuple[Path, ...], style: str, output: Path | None, strict: bool) -> None:
    """Check TABLES (CSV, or folders of them; default: the paper's tables, which come with the package).

    Finds suspiciously equal numbers, contradictions between tables, swapped numbers, means that do not match
    their values, implausible SSIM and LPIPS, and wrong ranks. The correct values are not known, so a finding
    is a question to the authors of the table.
    """
    from ambiguous_wild.io.files import write_text
    from ambiguous_wild.report.audit import audit, csv_of, markdown_of, text_of
    from ambiguous_wild.report.audit_numbers import REPORTED, read_tables

    numbers = read_tables(tables or (REPORTED,))
    findings = audit(numbers)
    if style == "json":
        text = json.dumps([dataclasses.asdict(f) for f in findings], indent=2, ensure_ascii=False) + "\n"
    else:
        text = {"text": text_of, "markdown": markdown_of, "csv": csv_of}[style](findings)
    if output is not None:
        write_text(output, text)
    else:
        click.echo(text, nl=style == "text" and bool(findings))
    count = len({n.table for n in numbers})
    click.echo(f"{len(findings)} findings in {len(numbers)} numbers of {count} tables", err=True)
    if strict and findings:
        sys.exit(1)
