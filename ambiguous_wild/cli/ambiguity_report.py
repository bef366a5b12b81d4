"""`aw ambiguity-report`: how hard a scene's distractors are to tell apart."""

from __future__ import annotations

import json
from pathlib import Path

import click


@click.command("ambiguity-report")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option(
    "-o", "--out", type=click.Path(path_type=Path, file_okay=False), help="Default: SCENE-ambiguity."
)
@click.option(
    "--masks",
    type=click.Path(path_type=Path, file_okay=False),
    help="Your own distractor masks: <stem>.png, white (255) = distractor, black = scene: the inverse of "
    "build-scene's keep masks. Default: the scene's truth.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the bootstrap.")
@click.option("--record/--no-record", default=True, show_default=True, help="Note the scores in scene.json.")
@click.option("--json", "as_json", is_flag=True, help="Print the facts as JSON.")
def command(
    scene: Path, out: Path | None, masks: Path | None, seed: int, record: bool, as_json: bool
) -> None:
    """Measure SCENE: colour ambiguity, semantic ambiguity, occlusion; write a page, a CSV and a picture."""
    from tqdm import tqdm

    from ambiguous_wild.core.errors import AwError
    from ambiguous_wild.harness import ambiguity
    from ambiguous_wild.io.atomic import check_output, write_json
    from ambiguous_wild.io.scene_folder import load_scene, read_scene_json

    loaded = load_scene(scene)
    found = ambiguity.find_masks(loaded, masks)
    folder = out or scene.resolve().parent / f"{scene.resolve().name}-ambiguity"
    if folder.resolve().is_relative_to(scene.resolve()):
        raise AwError(f"{folder} lies inside {scene}, and would change the scene; choose another -o")
    check_output(folder / "index.html" if folder.is_dir() else folder)
    measured = ambiguity.measure(
        loaded, found, lambda v: tqdm(v, unit="photo", desc="measure", disable=as_json or None)
    )
    summary = ambiguity.summarise(loaded, measured, seed)
    ambiguity.write_report(loaded, found, measured, summary, folder)
    # scene.json lists the hashes of the other files, not its own: the scene's identity stays.
    info = read_scene_json(scene) if record else None
    if info is not None:
        source = "truth" if masks is None else "user masks"
        write_json(scene / "scene.json", {**info, "ambiguity": {**summary, "masks": source}})
    if as_json:
        click.echo(json.dumps({**summary, "report": str(folder)}, indent=2))
        return
    for line in ambiguity.describe(summary):
        click.echo(line)
    click.echo(f"wrote {folder / 'index.html'} ({len(measured)} photos)")
