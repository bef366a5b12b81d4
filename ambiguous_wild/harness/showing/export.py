"""What `aw export` does, as a call."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from ambiguous_wild.core import AwError, View
from ambiguous_wild.harness.showing.read import find_models, open_scene
from ambiguous_wild.io.atomic import check_output
from ambiguous_wild.splat.cpu.warmup import prepare_cpu
from ambiguous_wild.viewing.export import Exported, export

FOLDER = "export"  # in a run folder


def export_runs(
    paths: Sequence[Path],
    formats: Sequence[str],
    output: Path | None = None,
    *,
    loss: bool = True,
    scene_folder: Path | None = None,
    threads: int | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> list[tuple[str, list[Exported]]]:
    """Write the models of runs in other formats.

    Args:
        paths: run folders, or folders of runs.
        formats: of `viewing.export.FORMATS`.
        output: folder for all files, named after the models' labels; None = RUN/export.
        loss: render the test views to measure what rounding costs. Without scene or test views only sizes
            are reported.
        scene_folder: where the scene lies; None = where the runs say.
        threads: of the kernels; None = all.
        say: told what is left out, and why.

    Returns:
        (label of the model, its files), in the order of the runs' paths.

    Raises:
        AwError: no run with a model, or a folder that cannot be written.
    """
    found, notes = find_models(paths)
    for note in notes:
        say(note)
    names = _file_names([f.scene for f in found], [f.model.label for f in found])
    for f in found:
        check_output((f.run / FOLDER if output is None else output) / "file")
    if loss:
        prepare_cpu(threads, say)
    reports = []
    for f, name in zip(found, names):
        views: tuple[View, ...] = ()
        if loss:
            try:
                views = open_scene(f.run, scene_folder).test
            except AwError as error:
                say(f"{f.model.label}: loss not measured: {error}")
        folder, stem = (f.run / FOLDER, "point_cloud") if output is None else (output, name)
        reports.append((f.model.label, export(f.model, folder, formats, views, name=stem)))
    return reports


def _file_names(scenes: Sequence[str], labels: Sequence[str]) -> list[str]:
    """A file name for each model: letters, digits and a few signs of its label, after its scene's name where
    there are several scenes, made unique by a number."""
    several = len(set(scenes)) > 1
    taken: dict[str, int] = {}
    names = []
    for scene, label in zip(scenes, labels):
        text = f"{scene}-{label}" if several else label
        name = re.sub(r"[^\w.+@=-]+", "-", text).strip(".-")[:80] or "model"
        taken[name] = taken.get(name, 0) + 1
        names.append(name if taken[name] == 1 else f"{name}-{taken[name]}")
    return names
