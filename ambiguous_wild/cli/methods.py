"""`aw methods`: the available methods and their requirements."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path

import click

from ambiguous_wild.cli.paths import PathName


@click.command(name="methods")
@click.option("--plugin", "plugins", multiple=True, type=PathName(),
              help="A Python file that registers your methods; repeatable.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the list as JSON.")
def command(plugins: tuple[Path, ...], as_json: bool) -> None:
    """List the methods: name, summary, paper, requirements beyond the core."""
    from ambiguous_wild.methods.registry import all_methods, load_plugin

    for plugin in plugins:
        load_plugin(plugin)
    entries = [entry for _, entry in sorted(all_methods().items())]
    if as_json:
        rows = [{"name": e.name, "summary": e.summary, "paper": e.paper, "needs": e.needs} for e in entries]
        click.echo(json.dumps(rows, indent=2, ensure_ascii=False))
        return
    width = max(len(e.name) for e in entries)
    for entry in entries:
        lines = [entry.summary]
        lines += [f"paper: {entry.paper}"] if entry.paper else []
        lines += [f"needs: {entry.needs or 'nothing beyond the core'}"]
        for i, line in enumerate(lines):
            name = click.style(entry.name.ljust(width), bold=True) if i == 0 else " " * width
            click.echo(
                textwrap.fill(line, 100, initial_indent=f"{name}  ", subsequent_indent=" " * (width + 2))
            )
    click.echo(f"\n{len(entries)} methods; 'aw bench --method NAME --scene SCENE' runs one")
