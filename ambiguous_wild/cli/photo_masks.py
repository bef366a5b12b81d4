"""`aw masks`: masks of photos or of a run for other tools, and photos without their distractors."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from ambiguous_wild.cli.options import (
    PathName,
    own_step,
    prepare_cpu,
    say,
    scene_name,
    threads_option,
    threads_words,
)
from ambiguous_wild.core.errors import AwError, counted
from ambiguous_wild.io.mask_files import MASK_STYLES

WORK = "-work"  # added to the name of -o: the folder of the scene and the run


@click.command("masks")
@click.argument("source", type=PathName(exists=True), metavar="PHOTOS|RUN")
@click.option("-o", "--output", type=PathName(), required=True, help="Folder of the masks to make.")
@click.option(
    "--for", "tool", type=click.Choice(list(MASK_STYLES)),
    help="Names and colours that this tool reads.  [default: the photo's name with .png, white = static]",
)  # fmt: skip
@click.option(
    "--inpaint", type=PathName(), metavar="FOLDER",
    help="Also write the photos with the model's render in place of the distractors.",
)  # fmt: skip
@click.option("--budget", default="10m", show_default=True, help="Time for PHOTOS: 90s, 10m, 1.5h.")
@threads_option
@click.pass_context
def command(
    ctx: click.Context,
    source: Path,
    output: Path,
    tool: str | None,
    inpaint: Path | None,
    budget: str,
    threads: int | None,
) -> None:
    """Write a mask of every photo, at its full size and along its edges.

    PHOTOS: a scene is built of all of them, refinesplat is trained, and its masks are written; each step is a
    command that is printed first. OUTPUT-work keeps scene and run: until the masks exist, the same command
    continues; others, of another tool or inpainted, are made of OUTPUT-work/runs. RUN: the masks of a finished run.

    \b
    aw masks photos/ -o masks
    aw masks photos/ -o masks --for realityscan --inpaint clean
    aw masks runs/scene/refinesplat/seed0 -o masks --for colmap
    """
    from ambiguous_wild.harness.store import run_folders
    from ambiguous_wild.io.files import check_output

    for place in (output, *([inpaint] if inpaint else [])):
        if place.resolve() == Path.cwd():
            raise AwError(f"{place} is the folder you are in, which would be replaced: name a new one")
        check_output(place, new=True)
    if (source / "scene.json").is_file():
        raise AwError(
            f"{source} is a scene: give its photos, or a run: aw bench --method refinesplat --scene "
            f"{shlex.quote(str(source))}"
        )
    if source.is_file() or next(run_folders(source), None) is None:
        source = _trained(ctx, source, output, tool, inpaint, budget, threads)
        words = ["--for", tool] if tool else []
        words += ["--inpaint", str(inpaint)] if inpaint else []
        own_step(ctx, "masks", source, "-o", output, *words, *threads_words(threads))
        return
    from ambiguous_wild.cli.run_progress import ticking
    from ambiguous_wild.report.full_size_masks import write_full_size_masks

    if inpaint:
        prepare_cpu(threads)
    with ticking(desc="masks", unit="photo") as tick:
        done = write_full_size_masks(source, output, tool=tool, inpaint=inpaint, tick=tick)
    for line in done.lines():
        click.echo(line)
    colour = "white" if done.style.left_out else "black"
    click.echo(f"wrote {counted(done.masks, 'mask')} to {output}, {colour} = distractor; {done.style.use}")
    if inpaint:
        copied = f" and copied {done.copied} in which nothing is masked" if done.copied else ""
        click.echo(f"wrote {counted(done.inpainted, 'inpainted photo')}{copied} to {inpaint}")


def _trained(
    ctx: click.Context,
    photos: Path,
    output: Path,
    tool: str | None,
    inpaint: Path | None,
    budget: str,
    threads: int | None,
) -> Path:
    """Build a scene of all photos, train refinesplat on it, and return the run."""
    from ambiguous_wild.cli.bench import parse_budget
    from ambiguous_wild.cli.try_all import train_within
    from ambiguous_wild.core.machine import usable_cores
    from ambiguous_wild.harness.store import run_folders
    from ambiguous_wild.report.full_size_masks import check_before_training

    seconds = parse_budget(budget)
    work = output.with_name(output.name + WORK)
    check_before_training(photos, work, output, tool=tool, inpaint=inpaint, jobs=threads or usable_cores())
    scene, runs, plan = work / "scene", work / "runs", work / "plan.json"
    own_step(
        ctx,
        "build-scene",
        photos,
        "-o",
        scene,
        "--no-test",
        "--name",
        scene_name(photos),
        *threads_words(threads),
    )
    if not plan.exists():
        own_step(ctx, "plan", scene, "--no-probe", "-o", plan)
    train_within("refinesplat", scene, runs, plan, work / "view", seconds, threads)
    own_step(ctx, "view", runs, "-o", work / "view")
    say(f"scene and run stay in {work}")
    return next(run_folders(runs))
