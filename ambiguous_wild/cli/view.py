"""`aw view`: a page to fly through models; `--live`: watch a training."""

from __future__ import annotations

from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName
from ambiguous_wild.core.errors import AwError

MOST_GAUSSIANS = 150_000


@click.command(name="view")
@click.argument("runs", nargs=-1, type=PathName())
@click.option(
    "-o", "--output", type=PathName(file_okay=False), default=Path("view"), show_default=True,
    help="Folder of the page; with --live, of the run (default then: runs).",
)  # fmt: skip
@click.option("--scene", help="Name of the scene, if the runs have several.")
@click.option(
    "--scene-folder", type=PathName(file_okay=False), help="The scene folder.  [default: as the runs say]"
)
@click.option(
    "--max-gaussians", type=click.IntRange(1), default=MOST_GAUSSIANS, show_default=True,
    help="A larger model is reduced to this number of Gaussians in the page, with a note.",
)  # fmt: skip
@click.option(
    "--plugin",
    "plugins",
    multiple=True,
    type=PathName(),
    help="A Python file that registers your methods; repeatable.",
)
@click.option("--title", help="Title of the page.  [default: the scene's name]")
@click.option(
    "--live",
    type=PathName(file_okay=False),
    metavar="SCENE",
    help="Train on SCENE and watch it in a browser.",
)
@click.option("--method", default="refinesplat", show_default=True, help="With --live: method to train.")
@click.option("--iterations", type=click.IntRange(1), help="With --live: iterations.  [default: 30000]")
@click.option(
    "--max-train-gaussians",
    type=click.IntRange(4),
    help="With --live: largest number of Gaussians.  [default: the method's]",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="With --live: seed.")
@click.option("--threads", type=click.IntRange(1), help="With --live: CPU threads.")
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    show_default=True,
    help="With --live: auto is the GPU if torch and gsplat can use one, else the CPU.",
)
@click.option("--host", default="127.0.0.1", show_default=True, help="With --live: address to listen on.")
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8080,
    show_default=True,
    help="With --live: port; 0 = any free one.",
)
@click.option("--paused", is_flag=True, help="With --live: pause after the first step.")
@click.pass_context
def command(
    ctx: click.Context,
    runs: tuple[Path, ...],
    output: Path,
    scene: str | None,
    scene_folder: Path | None,
    max_gaussians: int,
    plugins: tuple[Path, ...],
    title: str | None,
    live: Path | None,
    method: str,
    iterations: int | None,
    max_train_gaussians: int | None,
    seed: int,
    threads: int | None,
    device: str,
    host: str,
    port: int,
    paused: bool,
) -> None:
    """Write a page that shows the models of RUNS (run folders, or folders of them), all of one scene.

    The page is one file that needs no server and no network. It shows models side by side or under a slider
    with the same camera, the cameras of the photos, masks over photos, and the PSNR of each test view.

    \b
    aw view runs -o view                       then open view/index.html
    aw view --live scene --method 3dgs         watch a training at http://127.0.0.1:8080
    """
    from ambiguous_wild.methods.registry import load_plugin

    for plugin in plugins:
        load_plugin(plugin)
    chosen = ctx.get_parameter_source("output")
    if live is not None:
        if runs:
            raise AwError("--live trains a run of its own: leave RUNS out, or leave --live out")
        from ambiguous_wild.harness.showing.live import watch

        folder = Path("runs") if chosen is click.core.ParameterSource.DEFAULT else output
        watch(
            live, method, folder, iterations=iterations, max_gaussians=max_train_gaussians, seed=seed,
            threads=threads, device=device, host=host, port=port, paused=paused, say=_say,
        )  # fmt: skip
        return
    if not runs:
        raise AwError("no RUNS: give the folder that 'aw bench -o' wrote, or --live SCENE")
    from ambiguous_wild.harness.showing.page import view_runs

    page = view_runs(
        runs,
        output,
        scene=scene,
        scene_folder=scene_folder,
        most_gaussians=max_gaussians,
        title=title,
        say=_say,
    )
    told = f"{page.bytes / 1e6:.1f} MB, of which models {page.models_bytes / 1e6:.1f} MB"
    _say(f"wrote {page.path}: {told}; open it in a browser")


def _say(text: str) -> None:
    click.echo(text, err=True)
