"""`aw rescore`: add metrics that were missing when runs ended."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName
from ambiguous_wild.core.errors import AwError


@click.command(name="rescore")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@click.option(
    "--scene",
    type=PathName(file_okay=False),
    help="Scene folder, if it was moved.  [default: as each run says]",
)
@click.option("--json", "as_json", is_flag=True, help="Print what became of every run as JSON.")
def command(runs: tuple[Path, ...], scene: Path | None, as_json: bool) -> None:
    """Add metrics that were missing when the runs below RUNS ended, e.g. LPIPS before its weights were there.

    Nothing is trained: the saved renders are compared with the scene's test photos. First every number of a
    result is computed again; a run whose renders, photos or settings were changed is refused. metrics.json
    records what was added, and by which version.

    \b
    aw rescore runs
    aw table runs
    """
    from ambiguous_wild.harness.rescore import rescore

    found = rescore(runs, scene=scene)
    if as_json:
        click.echo(json.dumps([dataclasses.asdict(r) | {"run": str(r.run)} for r in found], indent=2))
    else:
        for r in found:
            what = r.error or (f"added {', '.join(r.added)}" if r.added else "nothing to add")
            still = f"; still missing: {', '.join(r.missing)}" if r.missing and not r.error else ""
            click.echo(f"{r.run}: {what}{still}")
    counts = Counter(r.outcome for r in found)
    click.echo(", ".join(f"{n} {outcome}" for outcome, n in counts.items()), err=True)
    refused = [r for r in found if r.outcome == "refused"]
    if refused:
        raise AwError(f"{len(refused)} of {len(found)} runs refused: {refused[0].error}")
