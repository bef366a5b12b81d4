"""`aw ambiguity-report`: similarity of a scene's distractors to the scene."""

from __future__ import annotations

import json
from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName, json_option
from ambiguous_wild.io.terminal import say


@click.command("ambiguity-report")
@click.argument("scene", type=PathName())
@click.option("-o", "--output", type=PathName(), help="Folder for the report.  [default: SCENE-ambiguity]")
@click.option(
    "--distractor-masks",
    "masks",
    metavar="truth|scene|run|FOLDER",
    help="Exact masks, those of the scene, those of --run, or a folder of <stem>.png, white = distractor.  "
    "[default: the first available]",
)
@click.option(
    "--keep-masks", type=PathName(), help="Folder of <stem>.png instead, white = keep, black = distractor."
)
@click.option(
    "--background",
    type=click.Choice(["clean", "run", "none"]),
    help="Background that distractors are compared with: clean photos, the renders of --run, or none.  "
    "[default: the first available]",
)
@click.option(
    "--run",
    type=PathName(file_okay=False),
    help="A trained run of this scene, for its renders and masks.",
)
@click.option(
    "--features",
    default="labhog",
    show_default=True,
    help="Features of the semantic score: labhog, dinov2-small, ... (docs/foundation-models.md).",
)
@click.option(
    "--objects",
    type=PathName(file_okay=False),
    help="Folder of masks of the static objects to compare with, <stem>.png, white = object.  "
    "[default: statues, cars and pictures of a simulated capture, else every static segment]",
)
@click.option("--record/--no-record", default=True, show_default=True, help="Save the scores in scene.json.")
@json_option
def command(
    scene: Path,
    output: Path | None,
    masks: str | None,
    keep_masks: Path | None,
    background: str | None,
    run: Path | None,
    features: str,
    objects: Path | None,
    record: bool,
    as_json: bool,
) -> None:
    """Measure how similar the distractors of SCENE are to it, in colour and semantically, and their coverage.

    Writes an HTML page, a CSV and an image.
    """
    from tqdm import tqdm

    from ambiguous_wild.core.errors import AwError, counted
    from ambiguous_wild.io.files import check_output, write_json
    from ambiguous_wild.io.scene_folder import load_scene, read_scene_json
    from ambiguous_wild.report import ambiguity_measure, ambiguity_page, ambiguity_sources, ambiguity_summary

    loaded = load_scene(scene)
    if run is not None:
        ambiguity_sources.check_run(loaded, run)
    if masks is not None and keep_masks is not None:
        raise AwError("--distractor-masks and --keep-masks exclude each other: give one of them")
    chosen = masks if keep_masks is None else str(keep_masks)
    found = ambiguity_sources.find_masks(loaded, chosen, run, keep=keep_masks is not None)
    behind = ambiguity_sources.find_background(loaded, background, run, found)
    folder = output or scene.resolve().parent / f"{scene.resolve().name}-ambiguity"
    if folder.resolve().is_relative_to(scene.resolve()):
        raise AwError(f"{folder} is inside {scene} and would change the scene; choose another -o")
    check_output(folder / "index.html" if folder.is_dir() else folder)
    ambiguity_page.check_folder(folder)
    measured = ambiguity_measure.measure(
        loaded,
        found,
        behind,
        features=features,
        objects=objects,
        progress=lambda v: tqdm(v, unit="photo", desc="measure", disable=as_json or None),
    )
    facts = ambiguity_summary.summarise(measured)
    ambiguity_page.write_report(measured, facts, folder)
    # scene.json is not part of the scene's identity, which is a hash of the other files.
    info = read_scene_json(scene) if record else None
    if info is not None:
        write_json(scene / "scene.json", {**info, "ambiguity": facts})
    if as_json:
        click.echo(json.dumps({**facts, "report": str(folder)}, indent=2))
        return
    say(f"{loaded.name}: {facts['class']}{ambiguity_summary.doubts(facts)}", out=True)
    for line in ambiguity_summary.describe(facts):
        say(line, out=True)
    saved = ", scores saved in scene.json" if info is not None else ""
    say(f"wrote {folder / 'index.html'} ({counted(len(measured.photos), 'photo')}){saved}", out=True)
