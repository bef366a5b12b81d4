"""`aw fetch`: download a public dataset."""

from __future__ import annotations

import json
import shlex
import sys
from dataclasses import asdict
from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName
from ambiguous_wild.core.errors import AwError


@click.command("fetch")
@click.argument("name", required=False)
@click.option(
    "-o", "--output", type=PathName(), default=Path("datasets"), show_default=True, help="Folder of datasets."
)
@click.option("--list", "listing", is_flag=True, help="List what can be fetched: licence, size, page.")
@click.option("--unpack/--no-unpack", default=True, show_default=True, help="Unpack the archive.")
@click.option("--json", "as_json", is_flag=True, help="Print the same facts as JSON.")
def command(name: str | None, output: Path, listing: bool, unpack: bool, as_json: bool) -> None:
    """Download the dataset NAME and unpack it. An interrupted download continues.

    The hash of the first download is stored in OUTPUT/archives/downloads.json; later downloads must match it.
    """
    from ambiguous_wild.datasets.catalogue import find_public, public_data

    if listing:
        if as_json:
            click.echo(json.dumps([asdict(d) for d in public_data().values()], indent=2, ensure_ascii=False))
            return
        for data in public_data().values():
            size = f"{data.size_mb} MB" if data.size_mb else "size not stated"
            how = f"layout {data.layout}, {size}" if data.url else "from its page only"
            click.echo(f"{data.name:<30} {how}, licence: {data.license}\n{'':<30} {data.note}; {data.page}")
        return
    if name is None:
        raise AwError("which dataset? 'aw fetch --list' lists them")
    from tqdm import tqdm

    from ambiguous_wild.datasets.fetch import fetch

    data = find_public(name)
    click.echo(f"{data.name}: licence: {data.license} ({data.page})", err=True)
    bar = tqdm(desc=name, unit="B", unit_scale=True, file=sys.stderr, disable=True if as_json else None)

    def tick(done: int, total: int | None) -> None:
        bar.total = total
        bar.update(done - bar.n)

    with bar:
        done = fetch(data, output, unpack=unpack, tick=tick, say=lambda text: click.echo(text, err=True))
    if as_json:
        facts = {"archive": str(done.archive), "folder": str(done.folder) if done.folder else None}
        click.echo(json.dumps({**facts, "sha256": done.sha256, "first": done.first}, indent=2))
        return
    known = "recorded now, nothing to compare with" if done.first else "as known"
    click.echo(f"{done.archive}: sha256 {done.sha256[:16]}... ({known})")
    if done.folder is not None:
        click.echo(
            f"unpacked into {done.folder}; next: aw import {shlex.quote(str(done.folder))}/SCENE -o SCENE"
        )
