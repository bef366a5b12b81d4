"""`aw try`: from photos or a video to a splat, its masks and a page, each step an ordinary command."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ambiguous_wild.cli.options import (
    PathName,
    command_line,
    own_step,
    prepare_cpu,
    print_command,
    say,
    scene_name,
    threads_option,
    threads_words,
)
from ambiguous_wild.cli.study_file import Recorded
from ambiguous_wild.core.errors import AwError, counted
from ambiguous_wild.io.files import check_output, own_json

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell
    from ambiguous_wild.report.model_views import GrowingPage
    from ambiguous_wild.splat.trainer import Trainer

FRAMES = 60  # taken from a video
# 'aw screen' and 'aw build-scene' on two idle cores: seconds for any scene, and for each photo
SCENE_S = (3.0, 1.2)
# set-up, pages, measuring and masks: seconds for each method, and for each photo
AROUND_S = (14.0, 1.2)
SHORTEST_S = 30.0  # of training, for each method
# Time of an iteration under a budget over one of 3dgs at full size: masks cost time, the smaller photos at the
# start save some. Five captures at 'aw try --budget 2m' had 1.0 to 1.5, of which masks have since saved a sixth.
REFINESPLAT_TIME = 1.1
FULL_GROWTH, LEAST_GROWTH = 10_000, 0.3  # iterations of a run with one Gaussian a pixel; least share of it
GOOD, SHARP = 3000, 10_000  # iterations from which most of a scene is clear, and fine texture is


@click.command("try")
@click.argument("source", type=PathName(exists=True), metavar="PHOTOS|VIDEO")
@click.option("-o", "--output", type=PathName(file_okay=False), required=True, help="Folder for everything.")
@click.option("--budget", default="5m", show_default=True, help="Time for everything: 90s, 10m, 1.5h.")
@click.option(
    "--method", "methods", default="refinesplat", show_default=True,
    help="Method to train; 3dgs,refinesplat trains both in the same time and compares them.",
)  # fmt: skip
@threads_option
@click.pass_context
def command(
    ctx: click.Context, source: Path, output: Path, budget: str, methods: str, threads: int | None
) -> None:
    """Try it on your photos: check, scene, training, a page that grows while it trains.

    Each step is a command that is printed first and can be run alone. The page is written soon after the training
    begins, and again as the model gets better. Ctrl-C ends the training; the same command continues it, also
    with a larger --budget.

    \b
    aw try photos/ -o out
    aw try walk.mp4 -o out --budget 15m
    """
    from ambiguous_wild.cli.bench import parse_budget
    from ambiguous_wild.harness.benchmark import find_methods

    begin, seconds = time.monotonic(), parse_budget(budget)
    find_methods([methods], (), {}, 1)  # a misspelt name is refused before the scene is built
    check_output(output / "scene", outside={"the photos": source})
    photos, scene, runs, plan = (output / name for name in ("photos", "scene", "runs", "plan.json"))
    video = source.is_file()
    if not video:
        photos = source
    say(_announced(source, scene, seconds))
    cores = threads_words(threads)

    def step(*words: str | Path, done: Path | None = None) -> None:
        if done is not None and done.exists():
            print_command(*words)
            say(f"done before: {done}")
            return
        own_step(ctx, *words)

    if video:
        record = own_json(photos / "capture.json").get("source")
        if record is not None and Path(str(record)).name != source.name:
            raise AwError(f"{photos} holds frames of {record}, not of {source}: choose another -o")
        step("capture", source, "-o", photos, "--frames", str(FRAMES), *cores, done=photos)
    if not (scene / "scene.json").exists():
        step("screen", photos, *cores)
    step("build-scene", photos, "-o", scene, "--name", scene_name(source), *cores)
    step("plan", scene, "--no-probe", "-o", plan, done=plan)
    several = train_within(methods, scene, runs, plan, output / "view", seconds, threads) > 1
    step("view", runs, "-o", output / "view")
    if several:
        step("table", runs)
        step("figure", runs, "-o", output / "comparison.png", "--with-masks")
    from ambiguous_wild.harness.result_file import RESULT, read_result
    from ambiguous_wild.harness.trained_models import next_steps, read_models

    say("")
    say(f"{_minutes(time.monotonic() - begin)}. What you have now, and what you can do with it:")
    say(f"  page for any browser: {output / 'view' / 'index.html'}")
    shown = read_models([runs])
    for line in next_steps(shown, on_page=False):
        say(f"  {line.replace('`', '')}")
    iterations = min(read_result(run / RESULT)["cost"]["iterations"] for run in shown.runs)
    if iterations < SHARP:
        longer = f"{command_line(budget=None)} --budget {_enough(seconds, iterations)}"
        say(
            f"{_rounded(iterations)} iterations: {_grade(iterations)}. A sharp splat, by training it on: {longer}"
        )


def train_within(
    methods: str,
    scene: Path,
    runs: Path,
    plan: Path,
    page: Path,
    seconds: float,
    threads: int | None,
) -> int:
    """Train methods in equal shares of a budget for everything, and write a page on the way.

    What was trained before goes on if the budget is larger than it was. The same budget gives the same length,
    because the time to build the scene is that of scene.json.

    Returns:
        number of methods.

    Raises:
        AwError: a run failed.
    """
    from ambiguous_wild.harness.benchmark import bench, split_methods
    from ambiguous_wild.harness.timing import expected_s, slowness
    from ambiguous_wild.io.scene_folder import load_scene
    from ambiguous_wild.report.model_views import GrowingPage

    prepare_cpu(threads)
    opened = load_scene(scene, verify=False, check=False)
    names = split_methods(methods)
    built_s = sum(own_json(scene / "scene.json").get("seconds", {}).values())
    left_s = seconds - built_s - AROUND_S[1] * len(opened.views)
    budget_s = float(round(max(left_s / len(names) - AROUND_S[0], SHORTEST_S)))
    camera = opened.train[0].camera
    pixels = camera.width * camera.height
    one_s = REFINESPLAT_TIME * expected_s(1, pixels, pixels // 2)  # on the reference machine
    # More Gaussians than so short a run can train cost iterations: monstree in 100 s had 21.09 dB with 103 000
    # in 1531 iterations, and 21.56 dB with 60 000 in 2190.
    most = 1000 * round(1e-3 * pixels * min(max(budget_s / one_s / FULL_GROWTH, LEAST_GROWTH), 1.0))
    here_s = REFINESPLAT_TIME * expected_s(1, pixels, most) * slowness()
    say("")
    say(_budget_line(budget_s, budget_s / here_s, len(names)))
    words = ["--method", methods, "--scene", str(scene), "--budget", f"{budget_s:g}s"]
    words += ["--max-gaussians", str(most), "--effects", str(plan), "--overwrite", "longer", "-o", str(runs)]
    print_command("bench", *words)
    growing = GrowingPage(page, runs)
    try:
        report = bench(
            names,
            scene,
            output=runs,
            budgets_s=[budget_s],
            train={"max_gaussians": most},
            plan=plan,
            overwrite="longer",
            threads=threads,
            callbacks=_ProgressAndPage(growing, words),
        )
    except KeyboardInterrupt:
        if growing.end():
            say(f"the page shows the model as it is now: {page / 'index.html'}")
        raise
    if report.failed:
        growing.end()
        raise AwError(report.failed[0].error)
    return len(names)


class _ProgressAndPage(Recorded):
    """Also writes the page that grows while a run trains."""

    def __init__(self, page: GrowingPage, words: list[str]) -> None:
        """`words`: of the 'aw bench' that makes the runs."""
        from ambiguous_wild.cli.bench import command as bench_command

        ctx = bench_command.make_context("bench", words)
        super().__init__(ctx, ctx.params, None, page.runs)
        self.page, self.shown = page, False

    def started(self, cell: Cell, folder: Path) -> None:
        super().started(cell, folder)
        self.page.begin(cell.method.name)

    def tick(self, trainer: Trainer) -> None:
        super().tick(trainer)
        if self.page.tick(trainer) and not self.shown:
            self.shown = True
            say(f"    look at it while it trains: {self.page.folder / 'index.html'}")


def _announced(source: Path, scene: Path, seconds: float) -> str:
    """Return how long it will take; refuse a source that is neither photos nor a video."""
    from ambiguous_wild.io.photos import PHOTO_SUFFIXES

    count = FRAMES
    if source.suffix.lower() in PHOTO_SUFFIXES and source.is_file():
        raise AwError(f"{source} is one photo: give a folder of photos, or a video")
    if source.is_dir():
        names = [name for _, _, files in os.walk(source) for name in files]
        count = sum(Path(name).suffix.lower() in PHOTO_SUFFIXES for name in names)
        if not count:
            raise AwError(f"{source} holds no photos: give a folder of photos, or a video")
    scene_s = 0.0 if (scene / "scene.json").exists() else SCENE_S[0] + SCENE_S[1] * count
    least = scene_s + SHORTEST_S + AROUND_S[0] + AROUND_S[1] * count
    built = f", of which {_minutes(scene_s)} for the scene" if scene_s else ""
    short = f"; --budget {_minutes(seconds)} is too short" if least > seconds else ""
    return f"{counted(count, 'photo')}: about {_minutes(max(seconds, least))}{built}{short}"


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def _budget_line(budget_s: float, iterations: float, methods: int) -> str:
    """Return what a budget buys on this machine, and which one would give a sharp splat."""
    each = " for each method" if methods > 1 else ""
    text = (
        f"{_minutes(budget_s)} of training{each}: about {_rounded(iterations)} iterations here, which give "
    )
    if iterations >= SHARP:
        return f"{text}{_grade(iterations)}"
    return f"{text}{_grade(iterations)}; --budget {_enough(methods * budget_s, iterations)} gives a sharp one"


def _grade(iterations: float) -> str:
    return "a sharp splat" if iterations >= SHARP else "a soft splat" if iterations >= GOOD else "a sketch"


def _enough(seconds: float, iterations: float) -> str:
    """Return the budget for a sharp splat, where `seconds` give this number of iterations."""
    return f"{5 * math.ceil((SHARP / iterations * seconds / 60 + 1) / 5)}m"


def _rounded(count: float) -> str:
    return f"{round(count, -2 if count >= 1000 else -1):,.0f}"
