"""`aw simulate`: captures with exact truth; `aw composite`: distractors added to real photos."""

from __future__ import annotations

import functools
import json
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from ambiguous_wild.cli.options import FiniteFloat, PathName, json_option, seed_option
from ambiguous_wild.core.errors import AwError, counted
from ambiguous_wild.io.terminal import say

if TYPE_CHECKING:
    from ambiguous_wild.simulate.spec import CaptureSpec
    from ambiguous_wild.simulate.truth_records import PhotoTruth, Summary


@click.command("simulate")
@click.argument("name", metavar="NAME|SPEC.yaml", required=False)
@click.option(
    "--like",
    type=PathName(),
    metavar="SCENE",
    help="Simulate a capture that calls for the same effects as this scene, instead of NAME.",
)
@click.option("-o", "--output", type=PathName(file_okay=False), help="Folder to write.")
@seed_option("Seed of world, walk, distractors.")
@click.option("--views", type=int, help="Number of train photos; test photos in proportion.")
@click.option("--width", type=int, help="Width of a photo in px; keeps the aspect ratio.")
@click.option("--depth", is_flag=True, help="Also write depth maps of the static scene.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier capture in this folder.")
@click.option("--print-spec", is_flag=True, help="Print the spec as YAML, and stop.")
@json_option
def simulate_command(
    name: str | None,
    like: Path | None,
    output: Path | None,
    seed: int,
    views: int | None,
    width: int | None,
    depth: bool,
    overwrite: bool,
    print_spec: bool,
    as_json: bool,
) -> None:
    """Simulate a capture: photos with distractors, clean test photos, and the exact truth.

    NAME is a preset; without it, they are listed. SPEC.yaml describes world, walk, distractors and effects
    (docs/simulation.md). Missing keys are as in the preset courtyard; if distractors is missing, there are none.
    """
    from ambiguous_wild.simulate.presets import PRESETS, preset, resized
    from ambiguous_wild.simulate.spec_file import dump_spec, is_spec_file, plain_spec, read_spec

    if name is None and like is None:
        if output is not None or print_spec:
            raise AwError(f"name a capture: {', '.join(PRESETS)} ('aw simulate' describes them)")
        _print_list(PRESETS.values(), as_json)
        return
    if name is not None and like is not None:
        raise AwError("NAME and --like exclude each other: a capture is made from one of them")
    twin = None
    if like is not None:
        from ambiguous_wild.io.scene_folder import load_scene
        from ambiguous_wild.report.twin import measure_likeness, spec_like

        twin = spec_like(measure_likeness(load_scene(like)), width, seed, views)
        spec, called = twin.spec, f"--like {shlex.quote(str(like))}"
    else:
        called = str(name)
        spec = resized(read_spec(called) if is_spec_file(called) else preset(called), views, width)
    lines = twin.lines if twin else ()
    if print_spec:
        if twin:
            lines = (
                *lines,
                f"then: aw simulate SPEC.yaml --seed {seed} -o raw; build-scene with --factor {twin.factor}",
            )
        click.echo("".join(f"# {line}\n" for line in lines) + dump_spec(spec), nl=False)
        return
    if output is None:
        raise AwError(f"the output folder is missing: aw simulate {called} -o raw")
    for line in lines:
        say(line, out=not as_json)

    from tqdm import tqdm

    from ambiguous_wild.io.files import check_output, folder_lock, sweep_siblings
    from ambiguous_wild.simulate.capture_writer import simulate

    bar = functools.partial(tqdm, unit="photo", desc=f"simulate {spec.name}", disable=as_json or None)
    check_output(output)
    with folder_lock(output, f"aw simulate {called}"):
        sweep_siblings(output)  # left by a killed call
        facts = simulate(spec, output, seed, depth, overwrite, bar)
        if not (facts["reused"] and (output / "truth" / "sheet.jpg").is_file()):
            from ambiguous_wild.harness.sheets import write_capture_sheet

            write_capture_sheet(output)
    outside = _outside(spec, facts["photos"])
    if outside:
        say(
            f"warning: in {outside} of {spec.train_views} train photos the share of distractors is outside "
            f"occlusion [{spec.occlusion[0]:g}, {spec.occlusion[1]:g}]; change their size, distance or number"
        )
    for name in _never_seen(spec, facts["photos"]):
        say(
            f"warning: no train photo shows the distractor {name!a}; change its waypoints, laps or distance, or "
            "raise its size"
        )
    if as_json:
        click.echo(json.dumps({k: v for k, v in facts.items() if k not in ("files", "photos")}, indent=2))
        return
    state = "already there, unchanged" if facts["reused"] else "wrote"
    things = counted(len(spec.distractors), "distractor")
    cover = "covers" if len(spec.distractors) == 1 else "cover"
    if spec.fixed:
        things = f"{things} and a {spec.fixed}" if spec.distractors else f"a {spec.fixed}"
        cover = "cover" if spec.distractors else "covers"
    covered = f"{things} {cover} {_range(facts['occlusion'])} of a train photo"
    say(
        f"{state}: {output}: {spec.train_views} train and {spec.test_views} test photos of "
        f"{spec.width}x{spec.height}; {covered if spec.distractors or spec.fixed else 'no distractors'}",
        out=True,
    )
    effects = list(plain_spec(spec)["effects"])
    if effects:
        say(f"effects: {', '.join(effects)}", out=True)
    say(f"look at: {output / 'truth' / 'sheet.jpg'}", out=True)
    scene = output.parent / f"{output.name}-scene"
    factor = f" --factor {twin.factor}" if twin else ""
    say(f"next: aw build-scene {shlex.quote(str(output))} -o {shlex.quote(str(scene))}{factor}", out=True)


def _range(share: Summary) -> str:
    return f"{100 * share['min']:.0f} to {100 * share['max']:.0f} % (mean {100 * share['mean']:.1f} %)"


def _outside(spec: CaptureSpec, photos: dict[str, PhotoTruth]) -> int:
    """Count the train photos whose share of distractors is clearly outside ``spec.occlusion``."""
    low, high = spec.occlusion
    if not spec.distractors or all(d.path != "elsewhere" for d in spec.distractors):
        return 0  # the place of a walker is given, not chosen
    slack = 0.02 + 0.1 * (high - low)  # because layouts were chosen by a small preview
    shares = [sum(d["occlusion"] for d in photo["distractors"]) for photo in photos.values()]
    return sum(not low - slack <= share <= high + slack for share in shares)


def _never_seen(spec: CaptureSpec, photos: dict[str, PhotoTruth]) -> list[str]:
    """Return the names of distractors with a presence above 0 that no train photo shows."""
    seen = {d["distractor"] for photo in photos.values() for d in photo["distractors"] if d["occlusion"] > 0}
    return [d.name for d in spec.distractors if d.name not in seen and d.presence > 0]


def _print_list(specs: Iterable[CaptureSpec], as_json: bool) -> None:
    rows = [
        (s.name, f"{s.train_views}+{s.test_views}", f"{s.width}x{s.height}", s.designed.ambiguity, s.summary)
        for s in specs
    ]
    if as_json:
        keys = ("name", "views", "size", "designed", "summary")
        click.echo(json.dumps([dict(zip(keys, row)) for row in rows], indent=2))
        return
    for name, count, size, ambiguity, summary in rows:
        say(f"{name:18s} {count:>6s}  {size:9s} {ambiguity:9s} {summary}", out=True)


@click.command("composite")
@click.argument("source", type=PathName())
@click.option("-o", "--output", required=True, type=PathName(), help="Scene or capture folder to make.")
@click.option("--cutouts", type=PathName(), help="Folder of PNG files with alpha as the mask.")
@click.option("--patches", is_flag=True, help="Fill the shapes with pieces of the photos.")
@click.option(
    "--coverage",
    type=FiniteFloat(),
    default=0.15,
    show_default=True,
    help="Mean covered share of a train photo.",
)
@click.option(
    "--presence",
    type=FiniteFloat(),
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
    type=FiniteFloat(),
    default=0.0,
    show_default=True,
    help="Darkness of the shadows: 0 none, 1 black. Scenes only.",
)
@click.option(
    "--path",
    is_flag=True,
    help="Let distractors cross the picture from photo to photo, in the order of the names. Plain photos only.",
)
@click.option(
    "--fixed",
    type=click.Choice(["bonnet", "stamp"]),
    help="Fixed to the camera: the same in all photos, test photos too. Plain photos only.",
)
@seed_option("Seed of where distractors stand.")
@json_option
@click.pass_context
def composite_command(
    context: click.Context,
    source: Path,
    output: Path,
    cutouts: Path | None,
    as_json: bool,
    **settings: Any,  # fields of `CompositeConfig`
) -> None:
    """Add distractors to the train photos of SOURCE, at other places in each photo. Test photos do not change.

    From a scene it makes a scene with the poses of the clean photos. From a folder of at least six plain photos
    it makes a capture for 'aw build-scene', with every sixth photo for testing, so that structure from motion sees
    the distractors.

    --patches without --cutouts draws rounded shapes.
    """
    from tqdm import tqdm

    from ambiguous_wild.core.config import from_plain
    from ambiguous_wild.io.files import check_output, folder_lock, sweep_siblings
    from ambiguous_wild.simulate.composite_photos import composite_photos, is_photo_folder
    from ambiguous_wild.simulate.composite_scene import composite
    from ambiguous_wild.simulate.placement import CompositeConfig

    config = from_plain(CompositeConfig, settings)
    plain = is_photo_folder(source)
    given = [n for n in ("pose", "shadow") if context.get_parameter_source(n) is not ParameterSource.DEFAULT]
    if plain and given:
        raise AwError(
            f"--{given[0]} needs the depths of a scene, and {source} holds plain photos; leave it out, "
            "or give a scene from 'aw build-scene'"
        )

    bar = functools.partial(tqdm, unit="photo", desc="composite", disable=as_json or None)
    check_output(output)
    with folder_lock(output, "aw composite"):
        sweep_siblings(output)  # left by a killed call
        make: Any = composite_photos if plain else composite
        facts = make(source, output, config, cutouts, bar)
    if as_json:
        click.echo(json.dumps({k: v for k, v in facts.items() if k != "photos"}, indent=2))
        return
    train, shares = facts["photos"], f"{_range(facts['occlusion'])} of each"
    place = shlex.quote(str(output))
    if plain:
        changed = sum(bool(photo["distractors"]) for photo in train.values())
        fixed = f", a {config.fixed} in all photos" if config.fixed else ""
        say(
            f"wrote: {output}: {len(train)} train photos, {changed} of them with distractors{fixed}; distractors cover "
            f"{shares}; {facts['source']['photos'] - len(train)} test photos",
            out=True,
        )
        say(f"next: aw build-scene {place} -o SCENE", out=True)
        return
    say(
        f"wrote: {output}: {len(train)} train photos, {len(facts['cutouts'])} distractors cover {shares}",
        out=True,
    )
    say(f"next: aw bench --method refinesplat --scene {place} -o runs", out=True)
