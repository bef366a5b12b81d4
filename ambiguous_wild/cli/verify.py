"""`aw verify`: check a package."""

from __future__ import annotations

import json
from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName


@click.command("verify")
@click.argument("package", type=PathName())
@click.option(
    "--scratch", type=PathName(file_okay=False), help="Folder to unpack in.  [default: the system's]"
)
@click.option("--json", "as_json", is_flag=True, help="Print the same facts as JSON.")
def command(package: Path, scratch: Path | None, as_json: bool) -> None:
    """Check PACKAGE, a folder of 'aw package' or one of its archives: every checksum, table and scene.

    Nothing is trusted: hostile archives are refused.
    """
    from ambiguous_wild.datasets.release.verify import verify

    found = verify(package, scratch=scratch)
    if as_json:
        facts = {"scenes": found.scenes, "files": found.files, "warnings": found.warnings}
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
        return
    for warning in found.warnings:
        click.echo(f"warning: {warning}")
    click.echo(f"{package} is whole: {len(found.scenes)} scenes, {found.files} files")
