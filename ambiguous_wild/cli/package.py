"""`aw package`: scenes for release."""

from __future__ import annotations

import json
import os
import shlex
from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName
from ambiguous_wild.core.errors import AwError, shortlist


@click.command("package")
@click.argument("scenes", nargs=-1, type=PathName())
@click.option("-o", "--output", type=PathName(), help="Folder to make.")
@click.option(
    "--info",
    "info_file",
    type=PathName(dir_okay=False),
    help="YAML file with licence, consent, creators; see --template.",
)
@click.option("--template", type=PathName(dir_okay=False), help="Write an empty --info file and stop.")
@click.option("--keep-metadata", is_flag=True, help="Leave EXIF (places, serial numbers) in the photos.")
@click.option(
    "--people/--no-people",
    default=True,
    show_default=True,
    help="List photos in which a detector sees a person; it misses most people.",
)
@click.option("--jobs", type=click.IntRange(min=1), help="Threads; the result does not depend on it.")
@click.option("--json", "as_json", is_flag=True, help="Print the same facts as JSON.")
def command(
    scenes: tuple[Path, ...],
    output: Path | None,
    info_file: Path | None,
    template: Path | None,
    keep_metadata: bool,
    people: bool,
    jobs: int | None,
    as_json: bool,
) -> None:
    """Pack SCENES for release: one zip per scene, croissant.json, a data card, checksums.

    \b
    aw package --template release.yaml          fill it in
    aw package scene1 scene2 --info release.yaml -o package
    aw verify package

    The same scenes give the same bytes. Without licence and consent the package says "not for release".
    """
    from ambiguous_wild.datasets.release.info import TEMPLATE, ReleaseInfo, read_release_info

    if template is not None:
        if template.exists():
            raise AwError(f"{template} exists; nothing is overwritten: choose another name")
        from ambiguous_wild.io.atomic import write_text

        write_text(template, TEMPLATE)
        click.echo(f"wrote {template}: fill it in, then pass it with --info")
        return
    if not scenes or output is None:
        raise AwError("give at least one scene folder and -o DIR; 'aw package --help' shows examples")
    from ambiguous_wild.datasets.release.package import package_scenes

    info = read_release_info(info_file) if info_file else ReleaseInfo()
    done = package_scenes(
        scenes,
        output,
        info,
        keep_metadata=keep_metadata,
        look_for_people=people,
        jobs=jobs or os.cpu_count() or 1,
        progress=not as_json,
    )
    if as_json:
        facts = {
            "package": str(done.folder),
            "scenes": done.scenes,
            "bytes": done.bytes,
            "lacking": done.lacking,
        }
        click.echo(json.dumps({**facts, "metadata_removed": done.stripped, "people": done.people}, indent=2))
        return
    size = f"{done.bytes / 1e6:.1f} MB"
    click.echo(
        f"wrote {output}: {len(done.scenes)} scenes, {size}, metadata taken out of {done.stripped} photos"
    )
    if done.people is not None:
        click.echo(f"a person may be seen in {len(done.people)} photos: {shortlist(done.people) or 'none'}")
    click.echo("look for faces and number plates in every photo before release: the detectors miss most")
    if done.lacking:
        click.echo(f"NOT FOR RELEASE: not stated: {', '.join(done.lacking)} (--info FILE)")
    click.echo(f"check it: aw verify {shlex.quote(str(output))}")
