"""`aw video`: models side by side along one camera path."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from ambiguous_wild.cli.options import PathName


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
@click.option("--seconds", type=click.FloatRange(0.1, 600), default=8.0, show_default=True)
@click.option(
    "--fps", type=click.FloatRange(1, 120), default=24.0, show_default=True, help="Frames per second."
)
@click.option(
    "--width", type=click.IntRange(16, 4096), help="Width of each render, px.  [default: as the photos]"
)
@click.option("--columns", type=click.IntRange(1), help="Renders in a row.  [default: up to three]")
@click.option("--gif", type=PathName(dir_okay=False), help="Also write this GIF of the whole path.")
@click.option("--gif-seconds", type=click.FloatRange(0.5, 30), default=4.0, show_default=True)
@click.option("--gif-width", type=click.IntRange(16, 2048), default=640, show_default=True, help="Width, px.")
@click.option("--scene", help="Name of the scene, if the runs have several.")
@click.option(
    "--scene-folder", type=PathName(file_okay=False), help="The scene folder.  [default: as the runs say]"
)
@click.option(
    "--plugin",
    "plugins",
    multiple=True,
    type=PathName(),
    help="A Python file that registers your methods; repeatable.",
)
@click.option("--threads", type=click.IntRange(1), help="CPU threads.")
def command(
    runs: tuple[Path, ...], output: Path, path: str, plugins: tuple[Path, ...], **options: Any
) -> None:
    """Film the models of RUNS (run folders, or folders of them) side by side along one camera path.

    \b
    aw video runs -o video.mp4
    aw video runs --path orbit --seconds 12 --fps 30 --gif video.gif
    """
    from ambiguous_wild.harness.showing.video import video_runs
    from ambiguous_wild.methods.registry import load_plugin

    for plugin in plugins:
        load_plugin(plugin)

    with _Bar() as bar:
        done = video_runs(runs, output, path=path, **options, say=_say, tick=bar.tick)
    _say(f"wrote {done.path}: {done.frames} frames, {done.seconds:.1f} s, {', '.join(done.labels)}")
    if done.gif is not None:
        _say(f"wrote {done.gif}: {done.gif.stat().st_size / 1e6:.1f} MB")


def _say(text: str) -> None:
    click.echo(text, err=True)


class _Bar:
    """A bar over the frames, where somebody looks."""

    def __init__(self) -> None:
        self.bar: Any = None

    def __enter__(self) -> _Bar:
        return self

    def tick(self, done: int, total: int) -> None:
        from tqdm import tqdm

        if self.bar is None:
            self.bar = tqdm(total=total, unit="frame", disable=not sys.stderr.isatty(), file=sys.stderr)
        self.bar.update(done - self.bar.n)

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()
