"""`aw try`: from photos or a video to a table and a page, each step an ordinary command."""

from __future__ import annotations

import os
import shlex
import time
from pathlib import Path

import click

from ambiguous_wild.cli.options import PathName, prepare_cpu, say, threads_option
from ambiguous_wild.core.errors import AwError, counted
from ambiguous_wild.io.files import own_json

METHODS = ("3dgs", "refinesplat")
IN_3DGS = 1 + 1.2  # an iteration of 3dgs and one of refinesplat, in iterations of 3dgs (docs/refinesplat.md)
# Share of the time after the scene is built; the plan, measuring and the page take the rest.
TRAINING = 0.7
SHORTEST, LONGEST = 300, 30_000  # iterations; shorter runs show no difference of methods
PHOTO_FOLDERS = ("images", "photos", "input", "rgb")  # name no scene: the folder above does
FRAMES = 60  # taken from a video
# 'aw build-scene' on two idle cores with photos of about 1 MP: 11 take 9 to 11 s, 23 take 15 s, 40 take 43 s.
SCENE_S = (3.0, 1.0)  # for any scene; for each photo


@click.command("try")
@click.argument("source", type=PathName(exists=True), metavar="PHOTOS|VIDEO")
@click.option("-o", "--output", type=PathName(file_okay=False), required=True, help="Folder for everything.")
@click.option("--budget", default="5m", show_default=True, help="Time for everything: 90s, 10m, 1.5h.")
@threads_option
@click.pass_context
def command(ctx: click.Context, source: Path, output: Path, budget: str, threads: int | None) -> None:
    """Try it on your photos: check, scene, plan, 3dgs and refinesplat, page, table.

    Each step is a command that is printed first and can be run alone. The time decides how many iterations each
    method trains, at least 300. After an interruption the same command continues.

    \b
    aw try photos/ -o out
    aw try walk.mp4 -o out --budget 15m
    """
    from ambiguous_wild.cli.bench import parse_budget
    from ambiguous_wild.harness.store import known_iterations

    begin, seconds = time.monotonic(), parse_budget(budget)
    photos, scene, runs, plan = (output / name for name in ("photos", "scene", "runs", "plan.json"))
    video = source.is_file()
    if not video:
        photos = source
    say(_announced(source, seconds))
    cores = ["--threads", str(threads)] if threads else []

    def step(*words: str | Path, done: Path | None = None) -> None:
        line = [str(word) for word in words]
        click.echo(f"\n$ aw {shlex.join(line)}", err=True)
        if done is not None and done.exists():
            say(f"done before: {done}")
            return
        try:
            ctx.find_root().command.main(line, prog_name="aw", standalone_mode=False)
        except AwError as error:
            if "--overwrite" not in str(error):
                raise
            raise AwError(
                f"{error} ('aw try' has no such option: give it to the step printed above)"
            ) from None

    if video:
        record = own_json(photos / "capture.json").get("source")
        if record is not None and Path(str(record)).name != source.name:
            raise AwError(f"{photos} holds frames of {record}, not of {source}: choose another -o")
        step("capture", source, "-o", photos, "--frames", str(FRAMES), *cores, done=photos)
    if not (scene / "scene.json").exists():
        step("screen", photos, *cores)
    named = source.resolve()
    if named.name.lower() in PHOTO_FOLDERS and named.parent.name:
        named = named.parent
    step("build-scene", photos, "-o", scene, "--name", named.stem, *cores)
    iterations = known_iterations(runs) or _iterations(scene, seconds - (time.monotonic() - begin), threads)
    length = ["--iterations", str(iterations)]
    step("plan", scene, "--no-probe", "-o", plan, done=plan)
    say(f"renders of your photos appear while it trains: {runs / '*' / '*' / 'seed0' / 'pictures'}")
    step(
        "bench",
        "--method",
        ",".join(METHODS),
        "--scene",
        scene,
        *length,
        "--effects",
        plan,
        "-o",
        runs,
        *cores,
    )
    page = output / "view"
    step("view", runs, "-o", page)
    step("table", runs)
    step("figure", runs, "-o", output / "comparison.png", "--with-masks")
    longer = shlex.join(
        ["aw", "bench", "--method", ",".join(METHODS), "--scene", str(scene), "--budget", "30m"]
    )
    say(
        f"{_minutes(time.monotonic() - begin)}. Look at {page / 'index.html'} and "
        f"{output / 'comparison.png'}. To train longer: {longer} -o longer"
    )
    for run in sorted(runs.glob(f"*/{METHODS[-1]}/seed0")):
        say(
            f"the splat without distractors: {run / 'point_cloud.ply'}; as SPZ, SOG and glTF: aw export {run}"
        )
        if (run / "masks").is_dir():
            say(f"its masks, white = static: {run / 'masks'}")


def _announced(source: Path, seconds: float) -> str:
    """Return how long it will take; refuse a source that is neither photos nor a video."""
    from ambiguous_wild.io.photos import PHOTO_SUFFIXES

    count = FRAMES
    if source.is_dir():
        names = [name for _, _, files in os.walk(source) for name in files]
        count = sum(Path(name).suffix.lower() in PHOTO_SUFFIXES for name in names)
        if not count:
            raise AwError(f"{source} holds no photos: give a folder of photos, or a video")
    scene_s = SCENE_S[0] + SCENE_S[1] * count
    total = max(seconds, scene_s + seconds * (1 - TRAINING))
    return (
        f"{counted(count, 'photo')}: about {_minutes(total)}, of which {_minutes(scene_s)} for the scene, "
        f"unless it was built before"
    )


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def _iterations(scene: Path, seconds: float, threads: int | None) -> int:
    """Print and return how many iterations each method can train in this time on this machine."""
    from ambiguous_wild.harness.timing import expected_s, slowness
    from ambiguous_wild.io.scene_folder import load_scene

    prepare_cpu(threads)
    camera = load_scene(scene, verify=False, check=False).train[0].camera
    pixels = camera.width * camera.height
    one = IN_3DGS * expected_s(1, pixels, pixels) * slowness()
    most = round(TRAINING * seconds / one, -2)
    iterations = int(min(max(most, SHORTEST), LONGEST))
    more = "; that is too few to compare methods: give more --budget" if most < SHORTEST else ""
    say("")
    say(f"{iterations} iterations a method: about {_minutes(iterations * one)} of training here{more}")
    return iterations
