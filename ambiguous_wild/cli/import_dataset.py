"""`aw import`: a scene of a public dataset as a scene folder."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import click

from ambiguous_wild.cli.options import PathName

KINDS = (
    "on-the-go", "robustnerf", "photo-tourism", "drone", "dualsplat", "nerfbaselines", "nerfstudio",
    "instant-ngp", "blender", "colmap",
)  # fmt: skip


@click.command("import")
@click.argument("source", type=PathName())
@click.option("-o", "--output", required=True, type=PathName(), help="Scene folder to make.")
@click.option("--as", "kind", type=click.Choice(KINDS), help="Layout of SOURCE.  [default: recognised]")
@click.option("--factor", type=int, help="Downsampling.  [default: as in the papers]")
@click.option("--name", default="", help="Name of the scene.  [default: the output folder's]")
@click.option("--license", "license_", default="", help="Licence of the photos, recorded in scene.json.")
@click.option("--dataset", default="", help="Name of the dataset in tables.  [default: the layout's]")
@click.option(
    "--drop-test-only-points",
    is_flag=True,
    help="Drop points that only test photos see: they leak clean geometry. Published code keeps them.",
)
@click.option("--motion", is_flag=True, help="Match the photos to find what moves, for masks (motion.npz).")
@click.option("--jobs", type=click.IntRange(min=1), help="Threads; the result does not depend on it.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Seed of matching and of random points.",
)
@click.option("--overwrite", is_flag=True, help="Replace a scene imported from other files or settings.")
@click.option("--json", "as_json", is_flag=True, help="Print the same facts as JSON.")
def command(
    source: Path,
    output: Path,
    kind: str | None,
    factor: int | None,
    name: str,
    license_: str,
    dataset: str,
    drop_test_only_points: bool,
    motion: bool,
    jobs: int | None,
    seed: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Import the scene in SOURCE: NeRF On-the-go, RobustNeRF, Photo Tourism, Drone Imagery, DualSplat,
    NerfBaselines, nerfstudio, instant-ngp, Blender, or COLMAP with images.

    Photos are linked unless they must be undistorted or reduced. Split, factor and test protocol are those
    of the dataset's papers; 'aw bench' follows them without an option.
    """
    from ambiguous_wild.datasets.write import ImportSettings, import_scene

    settings = ImportSettings(kind, factor, name, license_, dataset, drop_test_only_points, seed, motion)
    done = import_scene(source, output, settings, overwrite=overwrite, jobs=jobs, progress=not as_json)
    info = done.info
    if as_json:
        facts = {k: v for k, v in info.items() if k not in ("files", "photos", "inputs")}
        extra = {"scene": str(done.scene), "why": done.why, "up_to_date": done.up_to_date}
        click.echo(json.dumps({**extra, **facts}, indent=2, ensure_ascii=False))
        return
    if done.up_to_date:
        click.echo(f"{output} is up to date")
    for line in summary(info, done.why):
        click.echo(line)
    click.echo(f"next: aw bench --method refinesplat --scene {shlex.quote(str(output))} -o runs")


def summary(info: dict[str, Any], why: str) -> list[str]:
    """What was recognised, counted and decided."""
    counts, imported = info["counts"], info["imported"]
    protocol = info.get("evaluation", {}).get("protocol", "full")
    measured = {"full": "whole test photos", "half": "right halves of test photos"}[protocol]
    return [
        f"layout {imported['layout']} ({why}), factor {info['factor']}, measured on {measured}",
        f"{counts['train']} training and {counts['test']} test photos, {counts['cameras']} cameras, "
        f"{counts['points']} points, {counts['points_seen_in_test_only']} of them seen in test photos only",
        *(f"note: {note}" for note in imported["notes"]),
        *(f"warning: {warning}" for warning in info["warnings"]),
    ]
