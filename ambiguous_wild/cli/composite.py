"""`aw composite`: add distractors with exact masks to a scene of real photos, or to plain photos."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from ambiguous_wild.cli.options import PathName


@click.command("composite")
@click.argument("source", type=PathName())
@click.option("-o", "--output", required=True, type=PathName(), help="Scene or capture folder to make.")
@click.option("--cutouts", type=PathName(), help="Folder of PNG files with alpha as the mask.")
@click.option("--patches", is_flag=True, help="Fill the shapes with pieces of the photos.")
@click.option("--coverage", type=float, default=0.15, show_default=True, help="Mean covered share of photos.")
@click.option(
    "--presence",
    type=float,
    default=0.8,
    show_default=True,
    help="Share of the train photos that show each distractor; of plain photos: any distractor.",
)
@click.option(
    "--pose",
    type=click.Choice(["standing", "lying"]),
    default="standing",
    show_default=True,
    help="Upright; or lying at any angle, for photos from above. Scenes only.",
)
@click.option(
    "--shadow",
    type=float,
    default=0.0,
    show_default=True,
    help="Darkness of the shadows: 0 none, 1 black. Scenes only.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print the facts as JSON.")
@click.pass_context
def command(
    context: click.Context,
    source: Path,
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
    """Add distractors to the train photos of SOURCE, in each photo at other places. Test photos do not change.

    SOURCE is a scene: the output is a scene, with the poses of the clean photos. Or it is a folder of at least six
    plain photos: the output is a capture for 'aw build-scene', every sixth photo for test, so that structure from
    motion sees the distractors.

    --patches without --cutouts draws rounded shapes.
    """
    from tqdm import tqdm

    from ambiguous_wild.core.config import from_plain
    from ambiguous_wild.core.errors import AwError
    from ambiguous_wild.io.atomic import check_output, sweep_siblings
    from ambiguous_wild.io.lock import folder_lock
    from ambiguous_wild.simulate.composite.composite_photos import composite_photos, is_photo_folder
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

    plain = is_photo_folder(source)
    given = [n for n in ("pose", "shadow") if context.get_parameter_source(n) is not ParameterSource.DEFAULT]
    if plain and given:
        raise AwError(
            f"--{given[0]} needs the depths of a scene, and {source} holds plain photos; leave it out, "
            "or give a scene from 'aw build-scene'"
        )

    def bar(items):
        return tqdm(items, unit="photo", desc="composite", disable=as_json or None)

    check_output(output)
    with folder_lock(output, "aw composite"):
        sweep_siblings(output)  # left by a killed call
        make: Any = composite_photos if plain else composite
        facts = make(source, output, config, cutouts, bar)
    if as_json:
        click.echo(json.dumps({k: v for k, v in facts.items() if k != "photos"}, indent=2))
        return
    share, train = facts["occlusion"], facts["photos"]
    shares = (
        f"{100 * share['min']:.0f} to {100 * share['max']:.0f} % (mean {100 * share['mean']:.1f} %) of each"
    )
    place = shlex.quote(str(output))
    if plain:
        changed = sum(bool(photo["distractors"]) for photo in train.values())
        click.echo(
            f"wrote: {output}: {len(train)} train photos, {changed} of them with distractors; distractors cover {shares}; "
            f"{facts['source']['photos'] - len(train)} test photos"
        )
        click.echo(f"next: aw build-scene {place} -o SCENE")
        return
    click.echo(
        f"wrote: {output}: {len(train)} train photos, {len(facts['cutouts'])} distractors cover {shares}"
    )
    click.echo(f"next: aw bench --method refinesplat --scene {place} -o runs")
