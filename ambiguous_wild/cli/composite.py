"""`aw composite`: add distractors with exact masks to a scene of real photos."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import click

from ambiguous_wild.cli.paths import PathName


@click.command("composite")
@click.argument("scene", type=PathName())
@click.option("-o", "--output", required=True, type=PathName(), help="Scene folder to make.")
@click.option("--cutouts", type=PathName(), help="Folder of PNG files with alpha as the mask.")
@click.option("--patches", is_flag=True, help="Fill the shapes with the scene's own texture.")
@click.option("--coverage", type=float, default=0.15, show_default=True, help="Mean covered share of photos.")
@click.option(
    "--presence",
    type=float,
    default=0.8,
    show_default=True,
    help="Share of the train photos that show each distractor.",
)
@click.option(
    "--pose",
    type=click.Choice(["standing", "lying"]),
    default="standing",
    show_default=True,
    help="Upright; or lying at any angle, for photos from above.",
)
@click.option(
    "--shadow", type=float, default=0.0, show_default=True, help="Darkness of the shadows: 0 none, 1 black."
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print the facts as JSON.")
def command(
    scene: Path,
    output: Path,
    cutouts: Path | None,
    patches: bool,
    coverage: float,
    presence: float,
    pose: str,
    shadow: float,
    seed: int,
    as_json: bool,
) -> None:
    """Add distractors to the train photos of SCENE, in each photo at other places. Test photos do not change.

    --patches without --cutouts draws rounded shapes.
    """
    from tqdm import tqdm

    from ambiguous_wild.core.config import from_plain
    from ambiguous_wild.io.atomic import check_output, sweep_siblings
    from ambiguous_wild.io.lock import folder_lock
    from ambiguous_wild.simulate.composite.composite_scene import composite
    from ambiguous_wild.simulate.composite.placement import CompositeConfig

    config = from_plain(
        CompositeConfig,
        {
            "coverage": coverage,
            "presence": presence,
            "pose": pose,
            "shadow": shadow,
            "patches": patches,
            "seed": seed,
        },
    )

    def bar(views):
        return tqdm(views, unit="photo", desc="composite", disable=as_json or None)

    check_output(output)
    with folder_lock(output, "aw composite"):
        sweep_siblings(output)  # left by a killed call
        facts = composite(scene, output, config, cutouts, bar)
    if as_json:
        click.echo(json.dumps({k: v for k, v in facts.items() if k != "photos"}, indent=2))
        return
    share = facts["occlusion"]
    click.echo(
        f"wrote: {output}: {len(facts['photos'])} train photos, {len(facts['cutouts'])} distractors cover "
        f"{100 * share['min']:.0f} to {100 * share['max']:.0f} % (mean {100 * share['mean']:.1f} %) of each"
    )
    click.echo(f"next: aw bench --method refinesplat --scene {shlex.quote(str(output))} -o runs")
