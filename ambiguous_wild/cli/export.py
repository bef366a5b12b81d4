"""`aw export`: models in smaller file formats."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ambiguous_wild.cli.options import PathName

if TYPE_CHECKING:
    from ambiguous_wild.viewing.export import Exported

FORMATS = ("compressed-ply", "spz", "sog", "gltf")


@click.command(name="export")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@click.option(
    "--format", "formats", multiple=True, type=click.Choice(FORMATS), default=FORMATS, show_default="all",
    help="Repeatable.",
)  # fmt: skip
@click.option(
    "-o", "--output", type=PathName(file_okay=False),
    help="Folder for the files, as LABEL.spz and so on.  [default: RUN/export]",
)  # fmt: skip
@click.option(
    "--loss/--no-loss", default=True, show_default=True, help="Render the test views to measure the loss."
)
@click.option(
    "--scene-folder", type=PathName(file_okay=False), help="The scene folder.  [default: as the runs say]"
)
@click.option(
    "--plugin",
    "plugins",
    multiple=True,
    type=PathName(),
    help="A Python file that registers your methods; repeatable.",
)
@click.option("--threads", type=click.IntRange(1), help="CPU threads.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
def command(
    runs: tuple[Path, ...],
    formats: tuple[str, ...],
    output: Path | None,
    loss: bool,
    scene_folder: Path | None,
    plugins: tuple[Path, ...],
    threads: int | None,
    as_json: bool,
) -> None:
    """Write the models of RUNS (run folders, or folders of them) as compressed PLY, SPZ, SOG and glTF.

    Prints the size of each file and the loss from its rounding: PSNR against the renders of the model, and dB
    lost against the test photos. The plain point_cloud.ply stays.

    \b
    aw export runs
    aw export runs/courtyard/refinesplat/seed0 --format spz -o models
    """
    from ambiguous_wild.harness.showing.export import export_runs
    from ambiguous_wild.methods.registry import load_plugin

    for plugin in plugins:
        load_plugin(plugin)

    reports = export_runs(
        runs, formats, output, loss=loss, scene_folder=scene_folder, threads=threads, say=_say
    )
    if as_json:
        rows = [
            {k: _plain(v) for k, v in {"label": label, **dataclasses.asdict(e)}.items()}
            for label, files in reports
            for e in files
        ]
        click.echo(json.dumps(rows, indent=2, ensure_ascii=False))
        return
    for label, files in reports:
        click.echo(f"{label}: {files[0].gaussians:,} Gaussians")
        for e in files:
            click.echo(f"  {_line(e)}")


def _say(text: str) -> None:
    click.echo(text, err=True)


def _plain(value: object) -> object:
    if isinstance(value, Path):
        return str(value)
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _line(e: Exported) -> str:
    told = f"{e.format:<14} {e.bytes / 1e6:8.2f} MB  {100 * e.share:5.1f} % of the PLY"
    if e.psnr_to_model is not None and e.lost_db is not None:
        same = "renders the same" if math.isinf(e.psnr_to_model) else f"{e.psnr_to_model:.1f} dB to the model"
        told += f"  {same}, {e.lost_db:+.3f} dB lost"
    return f"{told}  {e.path}"
