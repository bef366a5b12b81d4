"""`aw explain`: why a pixel of a photo is masked."""

from __future__ import annotations

from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName, say


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
    from ambiguous_wild.cli.options import prepare_cpu
    from ambiguous_wild.core.errors import AwError, unknown
    from ambiguous_wild.harness.replay import open_run
    from ambiguous_wild.splat.parts import MaskPolicy

    prepare_cpu(None)
    trainer = open_run(run)
    names = [view.name for view in trainer.data.scene.train]
    found = [k for k, name in enumerate(names) if photo in (name, Path(name).stem)]
    if not found:
        raise unknown("train photo", photo, names)
    step = trainer.make_step(trainer.iteration, found[0], divisor=1)
    height, width = step.photo.shape[:2]
    if column >= width or row >= height:
        raise AwError(f"{photo} is trained at {width} x {height}: there is no pixel {column}, {row}")
    policy = trainer.parts.mask
    if type(policy).predict is MaskPolicy.predict and type(policy).keep is MaskPolicy.keep:
        raise AwError(f"{run} is of a method without masks: it keeps every pixel")
    keep = policy.predict(step)
    kept = keep is None or bool(keep[row, column] > 0.5)
    say(f"{photo}, column {column}, row {row}: {'kept' if kept else 'masked'}")
    for line in policy.explain(step, column, row):
        say(f"  {line}")
