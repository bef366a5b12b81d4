"""`aw figure`: renders of methods side by side, for a paper."""

from __future__ import annotations

from pathlib import Path

import click

from ambiguous_wild.cli.options import FiniteFloat, PathName, label_option, only_option, say, style_of
from ambiguous_wild.core.errors import AwError, counted

SUFFIXES = {suffix: suffix for suffix in (".pdf", ".png", ".svg")}
NONE = "none"


@click.command(name="figure")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@click.option(
    "-o", "--output", required=True, type=PathName(dir_okay=False), help="PDF, PNG or SVG, by the suffix."
)
@click.option(
    "--photo", "photos", multiple=True, metavar="NAME",
    help="Show this test photo, or this train photo with its masks; repeatable.  [default: where the methods "
    "differ most]",
)  # fmt: skip
@click.option(
    "--crop", "crops", multiple=True, metavar="X,Y,W,H",
    help="Enlarge this part: px of the photo, or shares if none is above 1; none: nothing. Once, or after "
    "each --photo.  [default: where the methods differ most]",
)  # fmt: skip
@click.option(
    "--with-errors", "errors", is_flag=True, help="Also show error maps: |render - photo|, mean over RGB."
)
@click.option(
    "--with-masks", "masks", is_flag=True, help="Also show train photos, with what each method masks in red."
)
@click.option(
    "--inches", "width", type=FiniteFloat(min=1, max=50), metavar="WIDTH",
    help="Width of the figure.  [default: 3.3 for up to two methods, else 7]",
)  # fmt: skip
@only_option
@label_option
def command(
    runs: tuple[Path, ...],
    output: Path,
    photos: tuple[str, ...],
    crops: tuple[str, ...],
    errors: bool,
    masks: bool,
    width: float | None,
    scenes: tuple[str, ...],
    labels: tuple[str, ...],
) -> None:
    """Show test photos and renders of the runs below the folders RUNS side by side, with zooms and PSNR.

    Photos and zooms that are not given are those where the mean squared errors of the methods differ most, in
    either direction; they are printed as options. All methods show the same part. The first seed that all methods
    have is shown.

    \b
    aw figure runs -o figure.pdf
    aw figure runs -o figure.pdf --photo IMG_7.png --crop 120,80,100,75 --with-errors
    aw figure runs -o figure.png --only yard --with-masks --label refinesplat=Ours
    """
    style_of(output, SUFFIXES)
    boxes = [_crop(text) for text in crops]
    from ambiguous_wild.harness.store import read_runs
    from ambiguous_wild.io.files import check_output
    from ambiguous_wild.report.figure_drawing import fitted, write_figure
    from ambiguous_wild.report.figure_rows import in_words, runs_figure

    check_output(output)
    figure = runs_figure(
        read_runs(*runs, labels=labels), scenes=scenes, photos=photos, crops=boxes, errors=errors, masks=masks
    )
    if not photos:
        figure = fitted(figure, width)
    wide, high = write_figure(figure, output, width=width)
    for line in in_words(figure):
        say(line)
    counts = f"{counted(len(figure.rows), 'photo')}, {counted(len(figure.methods), 'method')}"
    say(f"wrote {output}: {counts}, {wide:.2f} x {high:.2f} inches")


def _crop(text: str) -> tuple[float, float, float, float] | None:
    if text == NONE:
        return None
    try:
        x, y, w, h = (FiniteFloat().convert(part, None, None) for part in text.split(","))
    except (ValueError, click.BadParameter):
        raise AwError(
            f"--crop {text!r}: write X,Y,W,H with the upper left corner first, in px of the photo or in shares "
            f"of it, e.g. 120,80,100,75; or {NONE}"
        ) from None
    return x, y, w, h
