"""`aw capture` takes photos from a video, a folder or a camera; `aw screen` checks them."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ambiguous_wild.cli.options import FiniteFloat, PathName, json_option, threads_option
from ambiguous_wild.core.errors import AwError, counted, similar_path
from ambiguous_wild.core.machine import usable_cores
from ambiguous_wild.io.terminal import say

if TYPE_CHECKING:
    from ambiguous_wild.builder.checks import CaptureReport

BROKEN_BELOW = 0.9  # of the frames in a video's header, which is often wrong by a few


@click.command("capture")
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True)
@click.option("-o", "--output", required=True, type=PathName(), help="Folder of photos to make.")
@click.option(
    "--frames",
    type=click.IntRange(3, 5000),
    default=60,
    show_default=True,
    help="Photos to take from each video or a camera; a short video gives all its frames.",
)
@click.option(
    "--every",
    type=FiniteFloat(0.05, 3600),
    default=1.0,
    show_default=True,
    help="Seconds between photos of a camera.",
)
@threads_option
@json_option
def capture_command(
    sources: tuple[str, ...], output: Path, frames: int, every: float, threads: int | None, as_json: bool
) -> None:
    """Take photos from SOURCE: a video (sharp, evenly spaced frames), a folder of photos, videos or folders
    (copies with EXIF), several of these (a folder each), or 'camera' ('camera:1' is the second one)."""

    from ambiguous_wild.builder import capture_photos
    from ambiguous_wild.builder.progress import Bar

    wanted = "give a video, a folder of photos, or 'camera'"
    if not all(source.strip() for source in sources):
        raise AwError(f"SOURCE is empty: {wanted}")
    bar = Bar(not as_json)
    paths = [Path(source) for source in sources]
    absent = next((source for source in sources if not Path(source).exists()), None)
    if absent is None:
        jobs = threads or usable_cores()
        facts = capture_photos.photos_from(paths, output, frames=frames, jobs=jobs, bar=bar)
    elif len(sources) == 1 and (camera := re.fullmatch(r"camera(?::(\d{1,3}))?", absent)):
        facts = capture_photos.photos_from_camera(
            int(camera[1] or 0), output, frames=frames, every_s=every, bar=bar
        )
    elif absent.startswith("camera"):
        raise AwError(f"unknown camera {absent!r}: write 'camera' or 'camera:1', and nothing beside it")
    else:
        raise AwError(f"{absent} does not exist: {wanted}{similar_path(absent)}")
    videos = facts.get("videos", [])
    if "frames_read" in facts:
        counts = facts["frames_read"], facts["frames_announced"]
        videos = [{"source": sources[0], "frames_read": counts[0], "frames_announced": counts[1]}]
    for video in videos:
        total, announced = video["frames_read"], video["frames_announced"]
        if total < frames:
            name = video["source"]
            say(f"{name} has {total} frames: took all of them, fewer than --frames {frames}")
        if announced and total < BROKEN_BELOW * announced:
            say(
                f"warning: {video['source']} announces {announced} frames, {total} could be read: it may be cut "
                "short or damaged"
            )
    if as_json:
        click.echo(json.dumps({**facts, "capture": str(output)}, indent=2, ensure_ascii=False))
        return
    left = facts["left_out"]
    if left:
        names = ", ".join(f"{x['source']} ({x['why']})" for x in left[:3]) + (" ..." if len(left) > 3 else "")
        say(f"left out: {names}", out=True)
    say(f"{len(facts['photos'])} photos in {output}; next: aw screen {shlex.quote(str(output))}", out=True)


_WORDS = {"ok": ("ok", "green"), "warning": ("WARNING", "red"), "unknown": ("unknown", "yellow")}


@click.command("screen")
@click.argument("raw", type=PathName(), nargs=-1, required=True)
@click.option("-o", "--output", type=PathName(dir_okay=False), help="Picture of which photos overlap, a PNG.")
@click.option("--strict", is_flag=True, help="Refuse the capture (exit code 2) at a warning.")
@threads_option
@json_option
def screen_command(
    raw: tuple[Path, ...], output: Path | None, strict: bool, threads: int | None, as_json: bool
) -> None:
    """Check the photos in RAW before building: exposure, white balance, ISO, focus, focal length, blur,
    near-duplicates, overlap, motion. Nothing is written but the picture of -o."""

    from ambiguous_wild.builder.checks import check_capture, refuse_failed
    from ambiguous_wild.builder.map_drawing import check_target, write_map
    from ambiguous_wild.builder.progress import Bar

    if output is not None:
        check_target(output, raw)
    report = check_capture(raw, jobs=threads or usable_cores(), bar=Bar(not as_json))
    if output is not None:
        write_map(report.overlap_map(), output)
    if as_json:
        facts = {
            "capture": str(report.root),
            "photos": report.photos,
            "skipped": report.skipped,
            "checks": [dataclasses.asdict(c) for c in report.checks],
        }
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        _print(report)
    if strict:
        refuse_failed(report)


def _print(report: CaptureReport) -> None:
    width = max(len(c.name) for c in report.checks)
    for check in report.checks:
        word, colour = _WORDS[check.state]
        line = f"{check.name:<{width}}  {word:<7}  {check.finding} [{check.basis}]"
        say(line, out=True, fg=colour, only=word)
        if check.advice:
            say(f"{'':<{width}}           -> {check.advice}", out=True)
    count = Counter(check.state for check in report.checks)
    verdict = f"{count['ok']} of {len(report.checks)} checks passed"
    verdict += f", {counted(count['warning'], 'warning')}" if count["warning"] else ""
    verdict += f", {count['unknown']} unknown" if count["unknown"] else ""
    say(f"{report.photos} photos: {verdict}", out=True)
