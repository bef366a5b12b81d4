"""`aw stress`: numerical stress tests, and the replay of a training that met a NaN."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from ambiguous_wild.cli.options import (
    PathName,
    choose_device,
    device_option,
    json_option,
    prepare_cpu,
    style_of,
)
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.terminal import say

SUFFIXES = {".txt": "text", ".md": "markdown", ".json": "json", "": "text"}  # of -o


@click.command("stress")
@click.option(
    "--only", multiple=True, metavar="CASE", help="Only this case: number or part of its name; repeatable."
)
@click.option(
    "--method",
    "methods",
    multiple=True,
    metavar="NAME",
    help="Instead of the cases: check this method, such as FILE.py:RECIPE, in a short training; repeatable.",
)
@click.option("--list", "listing", is_flag=True, help="Only print the names of the cases.")
@device_option("auto: the CPU, and the GPU if there is one.")
@json_option
@click.option("-o", "--output", type=PathName(dir_okay=False), help="Write to this file: .txt, .md or .json.")
@click.option(
    "--replay",
    "run",
    type=PathName(file_okay=False),
    help="Run folder whose training met a NaN or infinite value: repeat the training up to it.",
)
def command(
    only: tuple[str, ...],
    methods: tuple[str, ...],
    listing: bool,
    device: str,
    as_json: bool,
    output: Path | None,
    run: Path | None,
) -> None:
    """Run numerical stress tests: the error of each case against float64, and the allowed error.

    \b
    aw stress                     every case
    aw stress --only 4 --only needle
    aw stress --method my.py:trimmed    its bits when it is repeated, and when it is stopped and resumed
    aw stress --replay runs/scene/3dgs/seed0

    Exits with code 1 if a case fails or a replay differs. docs/numerics.md explains the tolerances.
    """
    if run is not None:
        _replay(run)
        return
    from ambiguous_wild.stress import stress_table

    if methods:
        from ambiguous_wild.methods.registry import get_method
        from ambiguous_wild.stress.method_cases import case_of

        if only or device == "cuda":
            raise AwError("--method is checked on the CPU, alone: leave out --only and --device cuda")
        cases, device = [case_of(get_method(name)) for name in methods], "cpu"
    else:
        cases = stress_table.chosen(only)
    if listing:
        click.echo("\n".join(c.key for c in cases))
        return
    devices = _devices(device)
    style = "json" if as_json else style_of(output, SUFFIXES)
    live = style == "text" and output is None
    if live:
        click.echo(stress_table.HEADER)
    outcomes = stress_table.run_all(
        cases, devices, (lambda o: click.echo(stress_table.to_line(o))) if live else None
    )
    if style == "json":
        text = json.dumps([o.plain() for o in outcomes], indent=2, allow_nan=False) + "\n"
    elif style == "markdown":
        from ambiguous_wild.report.plain_formats import to_markdown
        from ambiguous_wild.report.table_layout import text_table

        text = to_markdown(
            [text_table("", stress_table.HEAD, map(stress_table.row, outcomes), words=stress_table.WORDS)]
        )
    else:
        text = "\n".join([stress_table.HEADER, *map(stress_table.to_line, outcomes)]) + "\n"
    if output is not None:
        from ambiguous_wild.io.files import write_text

        write_text(output, text)
    elif not live:
        click.echo(text, nl=False)
    failed = sum(not o.passed for o in outcomes)
    say(f"{len(outcomes) - failed} of {len(outcomes)} passed on {' and '.join(devices)}")
    if failed:
        sys.exit(1)


def _devices(wanted: str) -> list[str]:

    usable = choose_device(wanted)  # its error names what is missing for a GPU
    devices = ["cuda"] if wanted == "cuda" else ["cpu"] if usable == "cpu" else ["cpu", "cuda"]
    if "cpu" in devices:
        prepare_cpu(None)
    return devices


def _replay(run: Path) -> None:
    from ambiguous_wild.harness.replay import replay_run

    prepare_cpu(None)
    result = replay_run(run)
    say(f"reported: {result.reported}", out=True)
    say(
        f"replayed from iteration {result.started_at}: {result.reproduced or 'all values are finite'}",
        out=True,
    )
    if not result.matches:
        say("the replay differs from the report: check the version, the machine and the plugins")
        sys.exit(1)
