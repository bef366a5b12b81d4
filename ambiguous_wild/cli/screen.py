"""`aw screen`: check a capture before a scene is built from it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ambiguous_wild.cli.options import PathName

if TYPE_CHECKING:
    from ambiguous_wild.builder.capture_report import CaptureReport

_WORDS = {"ok": ("ok", "green"), "warning": ("WARNING", "red"), "unknown": ("unknown", "yellow")}


@click.command("screen")
@click.argument("raw", type=PathName())
@click.option("--strict", is_flag=True, help="Refuse the capture (exit code 2) if a check fails.")
@click.option("--jobs", type=click.IntRange(min=1), help="Threads; the result does not depend on it.")
@click.option("--json", "as_json", is_flag=True, help="Print the same facts as JSON.")
def command(raw: Path, strict: bool, jobs: int | None, as_json: bool) -> None:
    """Check the photos in RAW before building: exposure, white balance, ISO, focus, focal length, blur,
    near-duplicates, overlap, motion. Nothing is written."""
    import os

    from ambiguous_wild.builder.capture_report import check_capture, refuse_failed
    from ambiguous_wild.builder.progress import Bar

    found = check_capture(raw, jobs=jobs or os.cpu_count() or 1, bar=Bar(not as_json))
    if as_json:
        facts = {
            "capture": str(found.root),
            "photos": found.photos,
            "skipped": found.skipped,
            "checks": [dataclasses.asdict(c) for c in found.checks],
        }
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        _print(found)
    if strict:
        refuse_failed(found)


def _print(found: CaptureReport) -> None:
    width = max(len(c.name) for c in found.checks)
    for check in found.checks:
        word, colour = _WORDS[check.state]
        # File names may hold control characters of the terminal.
        text = "".join(c if c.isprintable() else "?" for c in f"{check.finding}  [{check.basis}]")
        click.echo(f"{check.name:<{width}}  {click.style(f'{word:<7}', fg=colour)}  {text}")
        if check.advice:
            click.echo(f"{'':<{width}}           -> {check.advice}")
    bad = len(found.warnings)
    verdict = "all checks passed" if not bad else f"{bad} of {len(found.checks)} checks failed"
    unknown = sum(c.state == "unknown" for c in found.checks)
    click.echo(f"{found.photos} photos: {verdict}" + (f", {unknown} unknown" if unknown else ""))
