"""`aw import`, `fetch`, `export-scene`, `package` and `verify`: datasets in other layouts, releases."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.cli.options import (
    PathName,
    json_option,
    license_option,
    name_option,
    seed_option,
    threads_option,
)
from ambiguous_wild.core.errors import AwError, counted, shortlist
from ambiguous_wild.core.machine import usable_cores
from ambiguous_wild.io.terminal import say

if TYPE_CHECKING:
    from ambiguous_wild.datasets.capture_hashes import VerifiedCaptures
    from ambiguous_wild.datasets.suites import Suite
    from ambiguous_wild.datasets.write import ImportRecord

KINDS = (
    "on-the-go", "robustnerf", "photo-tourism", "drone", "dualsplat", "nerfbaselines", "nerfstudio",
    "instant-ngp", "blender", "realityscan", "metashape", "polycam", "record3d", "colmap",
)  # fmt: skip


@click.command("import")
@click.argument("source", type=PathName())
@click.option("-o", "--output", required=True, type=PathName(), help="Scene folder to make.")
@click.option("--as", "kind", type=click.Choice(KINDS), help="Layout of SOURCE.  [default: recognised]")
@click.option("--model", default="", help="Name of one of several COLMAP models.  [default: most photos]")
@click.option("--factor", type=int, help="Downsampling.  [default: as in the papers]")
@name_option
@license_option
@click.option("--dataset", default="", help="Name of the dataset in tables.  [default: the layout's]")
@click.option(
    "--drop-test-only-points",
    is_flag=True,
    help="Drop points that only test photos see: they leak clean geometry. Published code keeps them.",
)
@click.option("--motion", is_flag=True, help="Match the photos to find what moves, for masks (motion.npz).")
@click.option(
    "--no-masks", "masks", is_flag=True, flag_value=False, default=True,
    help="Leave out keep masks: those that the layout names, masks/ beside the photos, the photos' alpha.",
)  # fmt: skip
@threads_option
@seed_option("Seed of matching and of random points.")
@click.option("--overwrite", is_flag=True, help="Replace a scene imported from other files or settings.")
@json_option
def import_command(
    source: Path,
    output: Path,
    name: str | None,
    threads: int | None,
    overwrite: bool,
    as_json: bool,
    **settings: Any,  # fields of `ImportSettings`
) -> None:
    """Import the scene in SOURCE: NeRF On-the-go, RobustNeRF, Photo Tourism, Drone Imagery, DualSplat,
    NerfBaselines, nerfstudio, instant-ngp, Blender, or COLMAP with images.

    Photos are linked unless they must be undistorted or reduced. Split, factor and test protocol are those
    of the dataset's papers; 'aw bench' follows them without an option.
    """
    from ambiguous_wild.datasets.write import ImportSettings, import_scene

    done = import_scene(
        source,
        output,
        ImportSettings(**settings, name=name or ""),
        overwrite=overwrite,
        jobs=threads,
        progress=not as_json,
    )
    info = done.info
    if as_json:
        facts = {k: v for k, v in info.items() if k not in ("files", "photos", "inputs")}
        extra = {"scene": str(done.scene), "why": done.why, "up_to_date": done.up_to_date}
        click.echo(json.dumps({**extra, **facts}, indent=2, ensure_ascii=False))
        return
    if done.up_to_date:
        say(f"{output} is up to date", out=True)
    for line in summary(info, done.why):
        say(line, out=True)
    say(f"next: aw bench --method refinesplat --scene {shlex.quote(str(output))} -o runs", out=True)


def summary(info: ImportRecord, why: str) -> list[str]:
    """Return lines on what was recognised, counted and decided."""
    counts, imported = info["counts"], info["imported"]
    protocol = info.get("evaluation", {}).get("protocol", "full")
    measured = {"full": "whole test photos", "half": "right halves of test photos"}[protocol]
    return [
        f"layout {imported['layout']} ({why}), factor {info['factor']}, measured on {measured}",
        f"{counts['train']} training and {counts['test']} test photos, {counted(counts['cameras'], 'camera')}, "
        f"{counts['points']} points, {counts['points_seen_in_test_only']} of them seen in test photos only",
        *(f"note: {note}" for note in imported["notes"]),
        *(f"warning: {warning}" for warning in info["warnings"]),
    ]


@click.command("fetch")
@click.argument("name", required=False)
@click.option(
    "-o", "--output", type=PathName(), default=Path("datasets"), show_default=True, help="Folder of datasets."
)
@json_option
def fetch_command(name: str | None, output: Path, as_json: bool) -> None:
    """Download the dataset NAME and unpack it; without NAME, list the datasets: licence, size, page.

    A suite of simulated captures (aw-sim) is not downloaded but simulated, into OUTPUT/NAME/captures.

    An interrupted call continues. The hash of the first download is stored in
    OUTPUT/archives/downloads.json; later downloads must match it.
    """
    from ambiguous_wild.datasets.fetch import find_public, public_data
    from ambiguous_wild.datasets.suites import simulated_suites

    suites = simulated_suites()
    if name is None:
        if as_json:
            rows = [*map(asdict, public_data().values()), *map(asdict, suites.values())]
            click.echo(json.dumps(rows, indent=2, ensure_ascii=False))
            return
        for suite in suites.values():
            say(
                f"{suite.name:<29}  simulated here, nothing is downloaded, licence: {suite.license}", out=True
            )
            say(
                f"{'':<29}  {counted(len(suite.scenes), 'capture')} with exact truth; docs/datasets.md",
                out=True,
            )
        for data in public_data().values():
            size = f"{data.size_mb} MB" if data.size_mb else "size not stated"
            how = f"layout {data.layout}, {size}" if data.url else "from its page only"
            say(f"{data.name:<29}  {how}, licence: {data.license}", out=True)
            say(f"{'':<29}  {data.note}; {data.page}", out=True)
        return
    from ambiguous_wild.cli.run_progress import ticking
    from ambiguous_wild.datasets.fetch import fetch

    if name in suites:
        _simulate(suites[name], output, as_json)
        return
    data = find_public(name, suites)
    say(f"{data.name}: licence: {data.license} ({data.page})")
    with ticking(desc=name, unit="B", unit_scale=True, disable=True if as_json else None) as tick:
        done = fetch(data, output, tick=tick, say=say)
    if as_json:
        facts = {"archive": str(done.archive), "folder": str(done.folder)}
        click.echo(json.dumps({**facts, "sha256": done.sha256, "first": done.first}, indent=2))
        return
    state = "recorded now, nothing to compare with" if done.first else "as recorded before"
    say(f"{done.archive}: sha256 {done.sha256[:16]}... ({state})", out=True)
    say(
        f"unpacked into {done.folder}; next: aw import {shlex.quote(str(done.folder))}/SCENE -o SCENE",
        out=True,
    )


def _simulate(suite: Suite, output: Path, as_json: bool) -> None:
    from ambiguous_wild.datasets.capture_hashes import CAPTURES
    from ambiguous_wild.report.simulated_suite import make_captures

    root = output / suite.dataset
    captures = make_captures(suite, root, progress=not as_json, say=say)
    if as_json:
        hashes = {capture.name: capture.sha256 for capture in captures}
        click.echo(json.dumps({"folder": str(root), "sha256": hashes}, indent=2))
        return
    scene = "" if output == Path("datasets") else f" --scene {shlex.quote(str(root))}"
    say(f"{root / CAPTURES}: {counted(len(captures), 'capture')}; look at NAME/truth/sheet.jpg", out=True)
    say(f"next: aw bench --suite {suite.name}{scene} -o runs", out=True)


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
@click.option(
    "--masks", "run", type=PathName(), metavar="RUN", help="The masks of this run, not the scene's own."
)
@json_option
def export_scene_command(
    scene: Path, form: str, output: Path, copy: bool, run: Path | None, as_json: bool
) -> None:
    """Write SCENE in another tool's layout: photos at their training size, cameras, split, points, masks."""
    from ambiguous_wild.datasets.export import export_scene

    masks = None
    if run is not None:
        from ambiguous_wild.report.full_size_masks import masks_of_run

        _, _, masks = masks_of_run(run, scene)
    done = export_scene(scene, form, output, copy=copy, masks=masks)
    if as_json:
        facts = {"folder": str(done.folder), "layout": form, "train": done.train, "test": done.test}
        click.echo(json.dumps({**facts, "left_out": list(done.left_out)}, indent=2))
        return
    lost = f"; the layout holds no {', no '.join(done.left_out)}" if done.left_out else ""
    say(f"wrote {output}: {done.train} training and {done.test} test photos as {form}{lost}", out=True)


@click.command("package")
@click.argument("scenes", nargs=-1, type=PathName())
@click.option("-o", "--output", type=PathName(), help="Folder to make.")
@click.option(
    "--info",
    "info_file",
    type=PathName(dir_okay=False),
    help="YAML file with licence, consent, creators. Without SCENES an empty one is written, to fill in.",
)
@click.option("--keep-metadata", is_flag=True, help="Keep EXIF (places, serial numbers) in the photos.")
@click.option(
    "--people/--no-people",
    default=True,
    show_default=True,
    help="List photos in which a detector sees a person; it misses most people.",
)
@threads_option
@json_option
def package_command(
    scenes: tuple[Path, ...],
    output: Path | None,
    info_file: Path | None,
    keep_metadata: bool,
    people: bool,
    threads: int | None,
    as_json: bool,
) -> None:
    """Pack SCENES for release: one zip per scene, croissant.json, a data card, checksums.

    \b
    aw package --info release.yaml              writes it: fill it in
    aw package scene1 scene2 --info release.yaml -o package
    aw verify package

    The same scenes give the same bytes. Without licence and consent the package says "not for release".
    """
    from ambiguous_wild.datasets.release_facts import TEMPLATE, ReleaseInfo, read_release_info

    if info_file is not None and not scenes:
        if output is not None:
            raise AwError("-o without a scene: name the scene folders to pack")
        if info_file.exists():
            raise AwError(
                f"{info_file} exists; nothing is overwritten: name the scene folders to pack, and -o"
            )
        from ambiguous_wild.io.files import write_text

        write_text(info_file, TEMPLATE)
        say(f"wrote {info_file}: fill it in, then name scenes with it", out=True)
        return
    if not scenes or output is None:
        raise AwError("give at least one scene folder and -o DIR; 'aw package --help' shows examples")
    from ambiguous_wild.datasets.package import package_scenes

    info = read_release_info(info_file) if info_file else ReleaseInfo()
    done = package_scenes(
        scenes,
        output,
        info,
        keep_metadata=keep_metadata,
        look_for_people=people,
        jobs=threads or usable_cores(),
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
    say(
        f"wrote {output}: {counted(len(done.scenes), 'scene')}, {size}, metadata taken out of "
        f"{counted(done.stripped, 'photo')}",
        out=True,
    )
    if done.people is not None:
        say(
            f"a person may be seen in {counted(len(done.people), 'photo')}: {shortlist(done.people) or 'none'}",
            out=True,
        )
    say("look for faces and number plates in every photo before release: the detectors miss most", out=True)
    if done.lacking:
        say(f"NOT FOR RELEASE: not stated: {', '.join(done.lacking)} (--info FILE)", out=True)
    say(f"check it: aw verify {shlex.quote(str(output))}", out=True)


@click.command("verify")
@click.argument("package", type=PathName())
@json_option
def verify_command(package: Path, as_json: bool) -> None:
    """Check PACKAGE, a folder of 'aw package' or one of its archives: every checksum, table and scene; or the
    captures of a simulated suite (datasets/aw-sim), against the hashes that everybody should get.

    Nothing is trusted: hostile archives are refused. TMPDIR is the folder to unpack in.
    """
    from ambiguous_wild.datasets.capture_hashes import suite_of_captures, verify_captures

    suite = suite_of_captures(package)
    if suite is not None:
        _print_captures(package, verify_captures(package, suite), as_json)
        return
    from ambiguous_wild.datasets.package_check import verify

    verified = verify(package)
    if as_json:
        facts = {"scenes": verified.scenes, "files": verified.files, "warnings": verified.warnings}
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
        return
    for warning in verified.warnings:
        say(f"warning: {warning}", out=True)
    say(
        f"{package} is whole: {counted(len(verified.scenes), 'scene')}, {counted(verified.files, 'file')}",
        out=True,
    )


def _print_captures(folder: Path, found: VerifiedCaptures, as_json: bool) -> None:
    """Print what is known of the captures of a suite.

    Raises:
        AwError: one is damaged.
    """
    from ambiguous_wild.datasets.capture_hashes import list_lines

    lines = list_lines(found.checked)
    if as_json:
        hashes = {capture.name: capture.sha256 for capture in found.checked}
        facts = {"absent": found.absent, "damaged": found.damaged, "warnings": lines}
        click.echo(json.dumps({"listed": {found.width: hashes}, **facts}, indent=2, ensure_ascii=False))
    else:
        for line in lines:
            say(line, out=True)
        if found.absent:
            say(f"absent: {shortlist(found.absent, 20)}; 'aw fetch {found.suite.name}' makes them", out=True)
        same = sum(capture.sha256 == capture.listed for capture in found.checked)
        say(
            f"{folder}: {counted(len(found.checked), 'capture')} of {found.suite.name} whole, {same} as listed",
            out=True,
        )
    if found.damaged:
        raise AwError(
            f"{counted(len(found.damaged), 'capture')} of {folder} cannot be used: {found.damaged[0]}"
        )
