"""Run an external method as a cell: its program trains and renders, its files are measured like any run's."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import torch

from ambiguous_wild.core import UNMOVED, AwError, Scene, View
from ambiguous_wild.core.machine import allowed_cores
from ambiguous_wild.harness import evaluate
from ambiguous_wild.harness.cell import Cell
from ambiguous_wild.harness.chosen_effects import EXTERNAL_NO_EFFECTS
from ambiguous_wild.harness.meter import Meter, own_s
from ambiguous_wild.harness.result_file import Cost, MaskScores, RunResult
from ambiguous_wild.io.files import atomic_path
from ambiguous_wild.io.images import image_size, read_gray, read_png_rgb
from ambiguous_wild.io.ply import read_splat_ply, splat_count, write_splat_ply
from ambiguous_wild.methods.external_process import LOGS, WORK, Produced, Program, Task
from ambiguous_wild.splat.render import render
from ambiguous_wild.viewing.model import gaussians_of


def run_program(cell: Cell, folder: Path) -> RunResult:
    """Run the method's program, measure its files and return the result as in metrics.json.

    Raises:
        AwError: the program failed, or a picture is missing, no 8-bit PNG, or of another size.
    """
    program = cell.method.program
    if program is None:
        raise AwError(f"{cell.method.name} is no external method")
    check_program(cell)
    (folder / WORK).mkdir(exist_ok=True)
    task = Task(
        scene=cell.scene,
        options=cell.options,
        seed=cell.train.seed,
        iterations=cell.train.iterations,
        budget_s=cell.train.budget_s,
        device=cell.device,
        folder=folder,
        work=folder / WORK,
        logs=folder / LOGS,
    )
    produced, time_cost = _timed(program, task)
    truth = evaluate.load_test_photos(cell.scene)
    draw = _splats(produced, cell.device) if produced.drawn_by_us else partial(_written, produced.renders)
    per_image, missing = evaluate.render_and_measure(
        draw, truth, folder / "renders" / "test", half=cell.protocol == "half", scene=cell.scene
    )
    evaluate.refuse_empty(truth, folder / "renders" / "test")
    return cell.result(
        per_image=per_image,
        missing=missing,
        masks=_masks(cell.scene, produced.masks, folder / "masks"),
        facts=dict(produced.facts)
        | {"no_effects": EXTERNAL_NO_EFFECTS}
        | ({"drawn_by": "ambiguous_wild"} if produced.drawn_by_us else {})
        | ({} if cell.protocol == "full" else {"protocol": cell.protocol}),
        cost=cast(
            Cost, {"device": cell.device, **produced.cost, **time_cost, **_model(cell, produced, folder)}
        ),
    )


def check_program(cell: Cell) -> None:
    """Raise AwError if the method's program is not on this machine."""
    program, method = cell.method.program, cell.method
    if program is not None and (lacking := program.missing(cell.options)):
        raise AwError(
            f"{method.name} needs {method.needs}: there is no program {lacking!r}; install it, or name "
            "another program in a copy of the description (docs/external-methods.md)"
        )


def _timed(program: Program, task: Task) -> tuple[Produced, Cost]:
    """Run the program between two calibrations; return its output and the cost of its time.

    The cost is empty where the program's training ended before this call, or where the calibration kernel
    cannot run: a program needs none of our packages.
    """
    meter, begin, before = Meter(task.device, len(allowed_cores())), time.perf_counter(), own_s()
    try:
        meter.begin(0.0)
    except AwError:
        meter.end()
        return program.run(task), {}
    try:
        produced = program.run(task)
        trained, spent = produced.cost.get("train_s"), time.perf_counter() - begin
        if trained is None or trained > spent:
            return produced, {}
        meter.calibrate(trained)
    finally:
        meter.end()
    return produced, {**meter.cost(trained), "cpu_s": own_s() - before}


def _written(renders: Mapping[str, Path], test: evaluate.TestPhoto) -> torch.Tensor:
    """Return the picture that the program wrote; effects of a program cannot be fitted here."""
    path = renders[test.view.name]
    _check_picture(test.view, path, "render")
    return torch.from_numpy(read_png_rgb(path).astype(np.float32) / 255.0)


def _splats(produced: Produced, device: str) -> evaluate.Draw:
    """Return how our renderer draws the program's splats: on a black background, without colour effects.

    Raises:
        AwError: the file of splats cannot be read.
    """
    assert produced.ply is not None
    gaussians = gaussians_of(read_splat_ply(produced.ply)).to(device)

    @torch.no_grad()
    def draw(test: evaluate.TestPhoto) -> torch.Tensor:
        return render(gaussians, test.view.camera, sh_degree=gaussians.sh_degree).image

    return draw


def _check_picture(view: View, path: Path, what: str) -> None:
    """Raise AwError unless the file is an 8-bit PNG of the view's size."""
    with open(path, "rb") as f:
        head = f.read(25)
    if head[:8] != b"\x89PNG\r\n\x1a\n":
        raise AwError(f"{what} {path} is no PNG: only files without compression loss are measured")
    if head[24] != 8:
        raise AwError(f"{what} {path} has {head[24]} bits per channel; write 8, as every method does")
    width, height = image_size(path)
    if (width, height) != (view.camera.width, view.camera.height):
        raise AwError(
            f"{what} {path} is {width}x{height}, its photo {view.name} {view.camera.width}x"
            f"{view.camera.height}: pictures are not resized, so let the program work at that size "
            "({images}, {factor}) or run with --factor"
        )


def _masks(scene: Scene, masks: Mapping[str, Path], folder: Path) -> MaskScores | None:
    """Copy the keep maps of the train views and score them where the truth is known."""
    if not masks:
        return None

    def keeps() -> Iterator[tuple[View, np.ndarray]]:
        for view in scene.train:
            if view.name in masks:
                _check_picture(view, masks[view.name], "mask")
                yield view, read_gray(masks[view.name]) >= 128

    return evaluate.write_keeps(scene, keeps(), folder)


def _model(cell: Cell, produced: Produced, folder: Path) -> dict[str, float]:
    """Make the splats the run's point_cloud.ply; return their number and the size of the file."""
    if produced.ply is None:
        return {}
    target = folder / "point_cloud.ply"
    with atomic_path(target) as temporary:
        temporary.unlink()
        try:
            if cell.scene.transform != UNMOVED:
                write_splat_ply(temporary, read_splat_ply(produced.ply), cell.scene.transform)
            else:
                os.link(produced.ply, temporary)
        except OSError:  # another file system, or one without hard links
            shutil.copyfile(produced.ply, temporary)
    return {"gaussians": splat_count(target), "model_mb": target.stat().st_size / 1e6}
