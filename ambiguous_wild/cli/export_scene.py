"""`aw export-scene`: a scene in the layout of another tool."""

from __future__ import annotations

import json
from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName


@click.command("export-scene")
@click.argument("scene", type=PathName())
@click.option(
    "--as",
    "form",
    required=True,
    type=click.Choice(["nerfstudio", "nerfbaselines", "colmap", "on-the-go"]),
    help="The layout to write.",
)
@click.option("-o", "--output", required=True, type=PathName(), help="Folder to make.")
@click.option("--copy", is_flag=True, help="Copy photos instead of linking them.")
@click.option("--json", "as_json", is_flag=True, help="Print the same facts as JSON.")
def command(scene: Path, form: str, output: Path, copy: bool, as_json: bool) -> None:
    """Write SCENE in another tool's layout: photos at their training size, cameras, split, points, masks."""
    from ambiguous_wild.datasets.export import export_scene

    done = export_scene(scene, form, output, copy=copy)
    if as_json:
        facts = {"folder": str(done.folder), "layout": form, "train": done.train, "test": done.test}
        click.echo(json.dumps({**facts, "left_out": list(done.left_out)}, indent=2))
        return
    lost = f"; the layout holds no {', no '.join(done.left_out)}" if done.left_out else ""
    click.echo(f"wrote {output}: {done.train} training and {done.test} test photos as {form}{lost}")
