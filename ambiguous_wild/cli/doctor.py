"""`aw doctor`: missing dependencies and the commands that install them."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING

import click

from ambiguous_wild.core.errors import AwError

if TYPE_CHECKING:
    from ambiguous_wild.cli.checks import Check


@click.command(name="doctor")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def command(as_json: bool) -> None:
    """Check this machine: packages, CPU, GPU, kernels, weights; with a command to install what is missing.

    Exit code 0 if the core works (optional parts may be missing), else 2.
    """
    from ambiguous_wild.cli.checks import all_checks

    checks = all_checks()
    broken = [c for c in checks if c.group == "core" and not c.ok]
    if as_json:
        facts = {"ok": not broken, "checks": [dataclasses.asdict(c) for c in checks]}
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        for group in ("core", "optional"):
            _print_group(group, [c for c in checks if c.group == group])
    if broken:
        names = ", ".join(c.name for c in broken)
        raise AwError(f"the core does not work on this machine: {names}; first run: {broken[0].fix}")
    if not as_json:
        missing = sum(c.group == "optional" and not c.ok for c in checks)
        click.echo(
            f"\nthe core works; {missing} optional parts are missing" if missing else "\nall parts work"
        )


def _print_group(group: str, checks: list[Check]) -> None:
    if not checks:
        return
    click.secho(("" if group == "core" else "\n") + group, bold=True)
    width = max(len(c.name) for c in checks)
    for c in checks:
        click.echo(f"  {_mark(c)} {c.name.ljust(width)}  {c.detail}")
        if not c.ok and c.fix:
            click.echo(f"    {' ' * width}  → {c.fix}")


def _mark(check: Check) -> str:
    if check.ok:
        return click.style("✓", fg="green")
    return click.style("✗", fg="red" if check.group == "core" else "yellow")
