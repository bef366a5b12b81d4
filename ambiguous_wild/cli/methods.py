"""`aw methods`: list the methods, show one of them in full, or compare their parts."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.cli.options import json_option, plugin_option
from ambiguous_wild.io.terminal import line_width, say

if TYPE_CHECKING:
    from ambiguous_wild.methods.entry import MethodEntry

WIDTH = 100  # of a line, at most


@click.command(name="methods")
@click.argument("names", nargs=-1, metavar="[NAME]...")
@click.option("--table", is_flag=True, help="Table of the parts of each method: masks, density, ...")
@plugin_option
@json_option
def command(names: tuple[str, ...], table: bool, as_json: bool) -> None:
    """List the methods: name, summary, paper, extra requirements.

    With NAME: differences from the published code and why, features in the publication and here, options with
    their defaults, and ablations.
    """
    from ambiguous_wild.methods.registry import all_methods, get_method

    entries = [get_method(name) for name in names] or [entry for _, entry in sorted(all_methods().items())]
    if table:
        _table(entries, as_json)
    elif names:
        _in_full(entries, as_json)
    else:
        _list(entries, as_json)


def _list(entries: Sequence[MethodEntry], as_json: bool) -> None:
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
            click.echo(_filled(line, head=f"{name}  ", margin=" " * (width + 2)))
    click.echo()
    say(
        f"{len(entries)} methods; 'aw methods NAME' shows one in full, 'aw methods --table' their parts",
        out=True,
    )


def _filled(text: str, head: str, margin: str) -> str:
    """Return the text behind its head, in lines that fit the terminal."""
    width = min(line_width() or WIDTH, WIDTH)
    return textwrap.fill(text, width, initial_indent=head, subsequent_indent=margin)


def _table(entries: Sequence[MethodEntry], as_json: bool) -> None:
    from ambiguous_wild.methods.describe import COLUMNS, table_row

    rows = [table_row(entry) for entry in entries]
    if as_json:
        click.echo(json.dumps([dict(zip(COLUMNS, row)) for row in rows], indent=2, ensure_ascii=False))
        return
    widths = [max(len(row[i]) for row in (COLUMNS, *rows)) for i in range(len(COLUMNS))]
    for row in (COLUMNS, *rows):
        line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip()
        click.echo(click.style(line, bold=row is COLUMNS))
    click.echo()
    say("- as in 3DGS, or none; CPU: a statistic is needed that gsplat does not offer", out=True)


def _in_full(entries: Sequence[MethodEntry], as_json: bool) -> None:
    from ambiguous_wild.methods.describe import details

    described = [details(entry) for entry in entries]
    if as_json:
        click.echo(json.dumps(described, indent=2, ensure_ascii=False))
        return
    for number, one in enumerate(described):
        click.echo("\n" * bool(number), nl=False)
        _show(one)


def _show(one: dict[str, Any]) -> None:
    click.echo(click.style(one["name"], bold=True) + "\n")
    paragraphs = (one["about"] or one["summary"]).split("\n\n")
    click.echo("\n\n".join(_filled(" ".join(text.split()), "", "") for text in paragraphs))
    click.echo()
    facts = {
        "paper": f"{one['paper']}, \\cite{{{one['cite']}}}" if one["cite"] else one["paper"],
        "needs": one["needs"] or "nothing beyond the core",
        **one["parts"],
        "published with": one["published_with"],
        "runs with": ", ".join(f"{k}={v}" for k, v in one["runs_with"].items()),
        "trainings": "2, the second with the final masks" if one["passes"] > 1 else "",
        "recipe": one["recipe"],
    }
    width = max(map(len, facts))
    for key, value in facts.items():
        if value:
            head = f"{key.ljust(width)}  "
            click.echo(_filled(value, head=head, margin=" " * len(head)))
    if one["options"]:
        click.echo(click.style("\noptions", bold=True) + f" (--set {one['name']}.KEY=VALUE)")
        keys = max(len(o["key"]) + len(o["default"]) + 1 for o in one["options"])
        keys = min(keys, 44)
        for option in one["options"]:
            head = f"  {option['key']}={option['default']}".ljust(keys + 4)
            indent = " " * (keys + 4)
            click.echo(_filled(option["comment"], head=head, margin=indent)
                       if option["comment"] else head.rstrip())  # fmt: skip
    if one["ablations"]:
        click.echo(click.style("\nablations", bold=True) + f" (aw ablate --method {one['name']})")
        for group in one["ablations"]:
            click.echo(_filled(f"{group['name']}: {group['title']} ({', '.join(group['variants'])})",
                               head="  ", margin="    "))  # fmt: skip
