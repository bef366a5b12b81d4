"""`aw explain`: why a pixel of a photo is masked."""

from __future__ import annotations

from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName, prepare_cpu
from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.io.terminal import say


class _Pixel(click.Command):
    """Says in one message what of the photo and the pixel is missing, not one word at a time."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        rest = super().parse_args(ctx, args)
        missing = [name.upper() for name in ("run", "photo", "column", "row") if ctx.params.get(name) is None]
        if missing and not ctx.resilient_parsing:
            raise click.UsageError(
                f"{', '.join(missing)} not given: name a run, a train photo of it, and a pixel from its upper "
                "left, e.g. aw explain runs/scene/refinesplat/seed0 IMG_0012.jpg 120 64; a click in the page of "
                "'aw view' says the same",
                ctx,
            )
        return rest


@click.command("explain", cls=_Pixel)
@click.argument("run", type=PathName(exists=True, file_okay=False), required=False, metavar="RUN")
@click.argument("photo", required=False, metavar="PHOTO")
@click.argument("column", type=click.IntRange(0), required=False, metavar="COLUMN")
@click.argument("row", type=click.IntRange(0), required=False, metavar="ROW")
def command(run: Path, photo: str, column: int, row: int) -> None:
    """Say why the pixel at COLUMN, ROW of a train PHOTO is masked or kept in RUN.

    The masks are those of the trained model; pixels count from the upper left of the photo as it was trained. A
    click on the photo in the page of 'aw view' says the same.

    \b
    aw explain runs/scene/refinesplat/seed0 IMG_0012.jpg 120 64
    """
    from ambiguous_wild.core.scene import find_view
    from ambiguous_wild.harness.evaluate import explained_keep
    from ambiguous_wild.harness.replay import open_run
    from ambiguous_wild.harness.store import read_config

    prepare_cpu(None)
    trainer, method = open_run(run), read_config(run).get("method")
    names = [view.name for view in trainer.data.scene.train]
    view = find_view(trainer.data.scene.train, photo)
    if view is None and find_view(trainer.data.scene.test, photo):
        raise AwError(f"{photo} is a test photo: only train photos have masks")
    if view is None:
        raise unknown("train photo", photo, names)
    index = names.index(view.name)
    step = trainer.make_step(max(trainer.iteration, 1), index, downsampling=1)
    height, width = step.photo.shape[:2]
    if column >= width or row >= height:
        raise AwError(f"{photo} is trained at {width} x {height}: there is no pixel {column}, {row}")
    keep, reasons = explained_keep(trainer, step)
    kept = keep is None or bool(keep[row, column] > 0.5)
    sentence = "" if reasons is None else reasons.at(column, row)
    if keep is None:
        sentence = f"kept: {method} masks nothing in this photo, or had not begun to"
    say(sentence or f"{'kept' if kept else 'masked'} by {method}, which gives no reasons")
    say(f"  {view.name}, column {column}, row {row}")
    if keep is not None:
        for line in trainer.hooks.mask.explain(step, column, row):
            say(f"  {line}")
    if not trainer.done:
        say(f"  {run} is not finished: these are its masks after {trainer.iteration} iterations")
