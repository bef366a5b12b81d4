"""`aw view`, `aw video` and `aw export`: show models to people, and write them for other programs."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.cli.options import (
    Count,
    FiniteFloat,
    Format,
    PathName,
    device_option,
    json_option,
    label_option,
    plugin_option,
    scene_folder_option,
    seed_option,
    threads_option,
)
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.splat_files import FORMATS
from ambiguous_wild.io.terminal import say

if TYPE_CHECKING:
    from ambiguous_wild.viewing.model_export import ExportedModel

MAX_GAUSSIANS = 150_000
THIS_MACHINE = "127.0.0.1"
NO_FORMAT = {  # what people ask for -> what to do instead
    "splat": "it has no harmonics and no scale of the scene; viewers that read .splat also read PLY or SPZ, so "
    "write --format spz",
}
UPS = ("x", "y", "z", "-x", "-y", "-z")


class HostPort(click.ParamType):
    """An address to listen on: (host, port) of "[HOST:]PORT"."""

    name = "[HOST:]PORT"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, int]:
        if isinstance(value, tuple):
            return value
        host, colon, port = str(value).rpartition(":")
        if not re.fullmatch(r"\d{1,5}", port) or int(port) > 65535 or (colon and not host):
            self.fail(f"{value!r} is no port from 0 to 65535, nor HOST:PORT.", param, ctx)
        return host.strip("[]") or THIS_MACHINE, int(port)


@click.command(name="view")
@click.argument("runs", nargs=-1, type=PathName())
@click.option(
    "-o", "--output", type=PathName(file_okay=False),
    help="Folder of the page; with --live, of the run.  [default: view; with --live, runs]",
)  # fmt: skip
@scene_folder_option
@label_option
@click.option(
    "--max-gaussians", type=click.IntRange(4),
    help="Largest number of Gaussians of a model in the page; a larger model is reduced, with a note. With "
    f"--live: in the training.  [default: {MAX_GAUSSIANS}; with --live, the method's]",
)  # fmt: skip
@plugin_option
@click.option("--title", help="Title of the page.  [default: the scene's name]")
@click.option(
    "--live",
    type=PathName(file_okay=False),
    metavar="SCENE",
    help="Train on SCENE and watch it in a browser.",
)
@click.option("--method", default="refinesplat", show_default=True, help="With --live: method to train.")
@click.option("--iterations", type=Count(1), help="With --live: iterations.  [default: as aw bench]")
@seed_option("With --live: seed.")
@threads_option
@device_option("With --live: auto is the GPU if torch and gsplat can use one, else the CPU.")
@click.option(
    "--port", type=HostPort(), default="8080", show_default=True,
    help=f"With --live: where to listen. HOST is {THIS_MACHINE} (this machine alone), PORT 0 any free one.",
)  # fmt: skip
def view_command(
    runs: tuple[Path, ...],
    output: Path | None,
    scene_folder: Path | None,
    labels: tuple[str, ...],
    max_gaussians: int | None,
    title: str | None,
    live: Path | None,
    method: str,
    port: tuple[str, int],
    **training: Any,  # the other arguments of `watch`, by their names
) -> None:
    """Write a page that shows the models of RUNS (run folders, folders of them, or splat files of any tool: PLY,
    compressed PLY, SPZ, SOG, glTF), all of one scene.

    The page is one file that needs no server and no network. It shows models side by side or under a slider
    with the same camera, the cameras of the photos, masks over photos, and the PSNR of each test view.

    \b
    aw view runs -o view                       then open view/index.html
    aw view stranger.ply --scene scene         without --scene: seen from a circle around it
    aw view --live scene --method 3dgs         watch a training at http://127.0.0.1:8080
    """

    if live is not None:
        if runs:
            raise AwError("--live trains a run of its own: leave RUNS out, or leave --live out")
        from ambiguous_wild.report.model_views import watch

        watch(
            live,
            method,
            output or Path("runs"),
            max_gaussians=max_gaussians,
            host=port[0],
            port=port[1],
            say=say,
            **training,
        )
        return
    if not runs:
        raise AwError("no RUNS: give the folder that 'aw bench -o' wrote, or --live SCENE")
    from ambiguous_wild.harness.trained_models import view_runs

    page = view_runs(
        runs,
        output or Path("view"),
        scene_folder=scene_folder,
        most_gaussians=max_gaussians or MAX_GAUSSIANS,
        title=title,
        labels=labels,
        say=say,
    )
    size = f"{page.bytes / 1e6:.1f} MB, of which models {page.models_bytes / 1e6:.1f} MB"
    say(f"wrote {page.path}: {size}; open it in a browser")


@click.command(name="video")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@click.option(
    "-o",
    "--output",
    type=PathName(dir_okay=False),
    default=Path("video.mp4"),
    show_default=True,
    help="mp4 file (VP9).",
)
@click.option(
    "--path", "path", default="test", show_default=True, metavar="test|orbit|FILE",
    help="Along the test cameras, around the scene, or FILE saved by 'aw view', nerfstudio or a 3DGS viewer.",
)  # fmt: skip
@click.option("--seconds", type=FiniteFloat(0.1, 600), default=8.0, show_default=True)
@click.option("--fps", type=FiniteFloat(1, 120), default=24.0, show_default=True, help="Frames per second.")
@click.option(
    "--width", type=click.IntRange(16, 4096), help="Width of each render, px.  [default: as the photos]"
)
@click.option("--columns", type=click.IntRange(1), help="Renders in a row.  [default: up to three]")
@click.option(
    "--gif",
    type=PathName(dir_okay=False),
    help="Also write this GIF, 640 px wide: the whole path in four seconds.",
)
@scene_folder_option
@label_option
@plugin_option
@threads_option
def video_command(runs: tuple[Path, ...], output: Path, path: str, **options: Any) -> None:
    """Film the models of RUNS (run folders, folders of them, or splat files) side by side along one camera path.

    \b
    aw video runs -o video.mp4
    aw video runs --path orbit --seconds 12 --fps 30 --gif video.gif
    """
    from ambiguous_wild.cli.run_progress import ticking
    from ambiguous_wild.report.model_views import video_runs

    # the end of a time limit is an interruption, which keeps the frames
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with ticking(unit="frame") as tick:
            done = video_runs(runs, output, path=path, **options, say=say, tick=tick)
    finally:
        signal.signal(signal.SIGTERM, before)
    say(f"wrote {done.path}: {done.frames} frames, {done.seconds:.1f} s, {'; '.join(done.labels)}")
    if done.gif is not None:
        say(f"wrote {done.gif}: {done.gif.stat().st_size / 1e6:.1f} MB")


@click.command(name="export")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@click.option(
    "--format", "formats", multiple=True, type=Format(list(FORMATS), unsupported=NO_FORMAT), default=[name for name in FORMATS if name != "ply"],
    show_default="all but ply", help="Repeatable.",
)  # fmt: skip
@click.option(
    "-o", "--output", type=PathName(file_okay=False),
    help="Folder for the files, as LABEL.spz and so on.  [default: export/ in the run, or beside the file]",
)  # fmt: skip
@click.option(
    "--up", type=click.Choice(UPS),
    help="Turn the files so that this axis points up, with the floor at zero below the middle of the scene; "
    "always y in glTF.  [default: the scene's coordinates]",
)  # fmt: skip
@click.option("--clean", is_flag=True, help="Leave out Gaussians that no training photo needs (floaters).")
@click.option(
    "--no-skybox", "skybox", is_flag=True, flag_value=False, default=True, help="Leave out the skybox."
)
@click.option(
    "--pad-harmonics", is_flag=True, help="Write harmonics of degree 3, padded by zeros: Unity, SIBR."
)
@click.option("--overwrite", is_flag=True, help="Replace existing files of the same names.")
@click.option(
    "--loss/--no-loss", default=True, show_default=True, help="Render the test views to measure the loss."
)
@scene_folder_option
@plugin_option
@threads_option
@json_option
def export_command(
    runs: tuple[Path, ...],
    formats: tuple[str, ...],
    output: Path | None,
    as_json: bool,
    **options: Any,  # the other arguments of `export_runs`, by their names
) -> None:
    """Write the models of RUNS (run folders, folders of them, or splat files of any tool: PLY, compressed
    PLY, SPZ, SOG, glTF) as compressed PLY, SPZ, SOG, glTF and PLY.

    Prints the size of each file and the loss by rounding: PSNR against the renders of the model, and dB lost
    against the test photos. The plain point_cloud.ply is not changed.

    \b
    aw export runs
    aw export runs/courtyard/refinesplat/seed0 --format spz -o models
    aw export runs --up z --format ply
    aw export stranger.spz --format ply
    """
    from ambiguous_wild.harness.result_file import encoded
    from ambiguous_wild.report.model_views import export_runs

    reports = export_runs(runs, formats, output, say=say, **options)
    if as_json:
        rows = [{"label": label, **dataclasses.asdict(e)} for label, files in reports for e in files]
        click.echo(json.dumps(encoded(rows), indent=2, ensure_ascii=False, default=str))
        return
    for label, files in reports:
        say(f"{label}: {files[0].gaussians:,} Gaussians", out=True)
        if transforms := [
            f"{e.format}: {_transform(e)}" for e in files if e.transform != type(e.transform)()
        ]:
            say(f"  for the scene's coordinates (each file says so too): {'; '.join(transforms)}", out=True)
        for e in files:
            say(f"  {_line(e)}", out=True)


def _transform(e: ExportedModel) -> str:
    x, y, z = e.transform.centre
    smaller = "" if e.transform.scale == 1 else f"divide by {e.transform.scale:g}, then "
    w, *axis = e.transform.quat
    back = (
        ""
        if w == 1
        else f"turn by the quaternion ({', '.join(f'{v:.6g}' for v in (w, *(-v for v in axis)))}), "
    )
    return f"{smaller}{back}add ({x:.15g}, {y:.15g}, {z:.15g})"


def _line(e: ExportedModel) -> str:
    text = f"{e.format:<14} {e.bytes / 1e6:8.2f} MB  {100 * e.share:5.1f} % of {e.source}"
    if e.psnr_to_model is not None and e.lost_db is not None:
        same = "renders the same" if math.isinf(e.psnr_to_model) else f"{e.psnr_to_model:.1f} dB to the model"
        text += f"  {same}, {e.lost_db:+.3f} dB lost"
    return f"{text}  {e.path}"
