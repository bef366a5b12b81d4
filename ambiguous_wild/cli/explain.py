"""`aw explain`: why a pixel of a photo is masked."""

from __future__ import annotations

from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName, prepare_cpu, say
from ambiguous_wild.core.errors import AwError, unknown


@click.command("explain")
@click.argument("run", type=PathName(exists=True, file_okay=False))
@click.argument("photo")
@click.argument("column", type=click.IntRange(0))
@click.argument("row", type=click.IntRange(0))
def command(run: Path, photo: str, column: int, row: int) -> None:
    """Say why the pixel at COLUMN, ROW of a train PHOTO is masked or kept in RUN.

    The masks are those of the trained model; pixels count from the upper left of the photo as it was trained.

    \b
    aw explain runs/scene/refinesplat/seed0 IMG_0012.jpg 120 64
    """
    from ambiguous_wild.core.scene import find_view
    from ambiguous_wild.harness.replay import open_run

    prepare_cpu(None)
    trainer = open_run(run)
    names = [view.name for view in trainer.data.scene.train]
    view = find_view(trainer.data.scene.train, photo)
    if view is None:
        raise unknown("train photo", photo, names)
    index = names.index(view.name)
    step = trainer.make_step(max(trainer.iteration, 1), index, downsampling=1)
    height, width = step.photo.shape[:2]
    if column >= width or row >= height:
        raise AwError(f"{photo} is trained at {width} x {height}: there is no pixel {column}, {row}")
    if not trainer.done:
        say(f"{run} is not finished: these are its masks after {trainer.iteration} iterations")
    policy, own = trainer.hooks.mask, trainer.data.user_keep[index]
    predicted = policy.predict(step)
    keep = trainer.combine_user_keep(step, predicted)
    kept = keep is None or bool(keep[row, column] > 0.5)
    say(f"{view.name}, column {column}, row {row}: {'kept' if kept else 'masked'}")
    if own is not None and not bool(own[row, column] > 0.5):
        say("  the capture's own mask leaves it out")
    if predicted is None:
        say("  the method masks nothing in this photo, or had not begun to")
    else:
        for line in policy.explain(step, column, row) or ["the method gives no reasons"]:
            say(f"  {line}")
