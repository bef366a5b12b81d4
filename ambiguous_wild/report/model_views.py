"""Export and film the models of runs, and watch a training, as `aw export`, `aw video`, `aw view --live`."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ambiguous_wild.core import AwError, Camera, Scene
from ambiguous_wild.core.scene import NO_PHOTO
from ambiguous_wild.harness.benchmark import BenchReport, bench
from ambiguous_wild.harness.callbacks import Callbacks, outcome_line, run_name
from ambiguous_wild.harness.chosen_effects import mixed_tests
from ambiguous_wild.harness.evaluate import keep_maps
from ambiguous_wild.harness.trained_models import (
    find_run_models,
    open_scene,
    page_title,
    read_models,
    read_splat_models,
    training_model,
)
from ambiguous_wild.io.files import check_output, refuse_files_there, write_text
from ambiguous_wild.io.page_parts import narrowed
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.io.splat_files import FORMATS
from ambiguous_wild.report.cost_curves import duration
from ambiguous_wild.splat.calibration import prepare_cpu
from ambiguous_wild.viewing.live import LiveView
from ambiguous_wild.viewing.model import ViewedModel, space_of
from ambiguous_wild.viewing.model_export import ExportedModel, ExportParts, export
from ambiguous_wild.viewing.page_file import PAGE, check_page_folder, page_text
from ambiguous_wild.viewing.video import (
    Frame,
    Tick,
    draw_frames,
    from_file,
    orbit,
    through_views,
    write_gif,
    write_mp4,
)

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell, CellReport
    from ambiguous_wild.splat.trainer import Trainer


LOG = logging.getLogger(__name__)
FOLDER = "export"  # in a run folder
FIRST_PAGE_S = 10.0  # of training until the first page of a run that is trained
LONGEST_PAUSE_S = 60.0  # of training between two pages
LEAST_PAUSE = 10.0  # least pause, in times that a page takes
GIF_SECONDS, GIF_FRAMES, GIF_WIDTH = 4.0, 48, 640  # px
GAUSSIANS_WHILE_TRAINING = 60_000  # of a model in such a page, which is to be written within a second or two


def export_runs(
    paths: Sequence[Path],
    formats: Sequence[str],
    output: Path | None = None,
    *,
    loss: bool = True,
    scene_folder: Path | None = None,
    threads: int | None = None,
    overwrite: bool = False,
    up: str | None = None,
    clean: bool = False,
    skybox: bool = True,
    pad_harmonics: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> list[tuple[str, list[ExportedModel]]]:
    """Write the models of runs, and splat files, in other formats.

    Args:
        paths: run folders, folders of runs, or splat files.
        formats: names in `io.splat_files.FORMATS`.
        output: folder for all files, named after the models' labels; None = RUN/export, or beside a file.
        loss: render the test views to measure the loss by rounding; without scene or test views only sizes
            are reported.
        scene_folder: where the scene lies; None = where the runs say.
        threads: threads of the kernels; None = all cores.
        overwrite: replace files of these names in `output`; those in RUN/export are always replaced.
        up: axis of the files that points up, see `model_export.export`; None = the scene's coordinates.
        clean: leave out Gaussians that no training photo needs, see `viewing.model_export`.
        skybox: write the skybox.
        pad_harmonics: write harmonics of degree 3, padded with zeros.
        say: gets a line about each run that is left out, and about parts of models that are.

    Returns:
        (label of the model, its files), in the order of the runs' paths.

    Raises:
        AwError: no run with a model, a file that is none, a folder that cannot be written, or files of these
            names in `output`.
    """
    files, notes = read_splat_models(paths)
    if up is not None and files and scene_folder is None:
        raise AwError(f"{files[0].ply}: --up needs the cameras of its scene: name its folder with --scene")
    runs = [path for path in paths if not path.is_file()]
    trained, more = find_run_models(runs) if runs else ([], [])
    for note in (*notes, *more):
        say(note)
    models = [*(t.model for t in trained), *files]
    homes = [t.run for t in trained] + [model.ply.parent for model in files]
    scenes = [t.scene for t in trained] + [trained[0].scene if trained else ""] * len(files)
    stems = [re.sub(r"(\.compressed)?\.\w+$", "", model.label) for model in files]
    names = _file_names(scenes, [t.model.label for t in trained] + stems)
    folders = [home / FOLDER if output is None else output for home in homes]
    for folder in folders:
        check_output(folder / "file")
    if not overwrite:  # files in RUN/export are replaced anyway
        for folder, name in list(zip(folders, names))[len(trained) if output is None else 0 :]:
            wanted = [name + FORMATS[form].suffix for form in formats if form in FORMATS]
            refuse_files_there(folder, wanted, "--overwrite")
    if loss:
        prepare_cpu(threads, say)
    reports = []
    for number, (model, folder, name) in enumerate(zip(models, folders, names)):
        run = homes[number] if number < len(trained) else None
        scene: Scene | None = None
        try:
            if run is not None:
                scene = open_scene(run, scene_folder)
            elif scene_folder is not None:
                scene = load_scene(scene_folder)
                model = model.within(scene.transform)
        except AwError as error:
            if up is not None or run is None or clean or not skybox:
                raise
            what = "the loss is not measured" if loss else "a skybox is not looked for"
            say(f"{model.label}: {what}: {error}")
        space = None if up is None or scene is None else space_of(scene)
        views = scene.test if scene is not None and loss else ()
        stem = "point_cloud" if output is None and run is not None else name
        parts = ExportParts(clean, skybox, pad_harmonics)
        done, more = export(
            model, folder, formats, views, name=stem, space=space, up=up, scene=scene, parts=parts
        )
        for note in more:
            say(f"{model.label}: {note}")
        reports.append((model.label, done))
    return reports


def _file_names(scenes: Sequence[str], labels: Sequence[str]) -> list[str]:
    """Return a unique file name for each model, from its label and, with several scenes, the scene's name."""
    several = len(set(scenes)) > 1
    taken: dict[str, int] = {}
    names = []
    for scene, label in zip(scenes, labels):
        text = f"{scene}-{label}" if several else label
        name = re.sub(r"[^\w.+@=-]+", "-", text).strip(".-")[:80] or "model"
        taken[name] = taken.get(name, 0) + 1
        names.append(name if taken[name] == 1 else f"{name}-{taken[name]}")
    return names


@dataclass(frozen=True)
class Video:
    """The video that was written."""

    path: Path
    gif: Path | None
    frames: int
    seconds: float
    labels: tuple[str, ...]


def video_runs(
    paths: Sequence[Path],
    output: Path,
    *,
    path: str | Path = "test",
    seconds: float = 8.0,
    fps: float = 24.0,
    width: int | None = None,
    columns: int | None = None,
    gif: Path | None = None,
    scene_folder: Path | None = None,
    labels: Sequence[str] = (),
    threads: int | None = None,
    say: Callable[[str], None] = lambda text: None,
    tick: Tick = lambda done, total: None,
) -> Video:
    """Film the models of runs side by side along one camera path.

    Args:
        paths: run folders, or folders of runs, all of one scene.
        output: the .mp4 file.
        path: "test" (through the test cameras), "orbit", or a file of a viewer.
        seconds, fps: length and frames per second.
        width: width of each method's picture, px; None = that of the photos.
        columns: number of pictures in a row.
        gif: path of an animation, the video played faster so that it lasts `GIF_SECONDS`; None = none.
        scene_folder: where the scene lies; None = where the runs say.
        labels: names and order of methods, see `labels.shown_names`.
        threads: threads of the kernels; None = all cores.
        say: gets notes about the models.
        tick: called with (frames done, frames).

    Raises:
        AwError: no run with a model, several scenes, no scene, no camera path, or no place for the file.
    """
    if output.suffix.lower() != ".mp4":
        raise AwError(f"-o {output}: give a name that ends in .mp4")
    if gif is not None and gif.suffix.lower() != ".gif":
        raise AwError(f"--gif {gif}: give a name that ends in .gif")
    frames = round(seconds * fps)
    if frames < 2:
        raise AwError(f"{seconds:g} seconds at {fps:g} frames per second are fewer than two frames")
    shown = read_models(paths, scene_folder=scene_folder, labels=labels)
    for wanted in (output, *([gif] if gif else [])):
        check_output(wanted)
    for note in shown.notes:
        say(note)
    cameras = _cameras(shown.scene, path, frames, width)
    prepare_cpu(threads, say)
    labels = tuple(model.label for model in shown.models)
    say(f"drawing {frames} frames of {'; '.join(labels)}")
    begin = time.perf_counter()
    kept: list[Frame] = []
    chosen = {round(k * (frames - 1) / (GIF_FRAMES - 1)) for k in range(GIF_FRAMES)}

    def watched() -> Iterator[Frame]:
        for number, frame in enumerate(draw_frames(shown.models, cameras, columns=columns, tick=tick)):
            if gif is not None and number in chosen:
                kept.append(narrowed(frame, GIF_WIDTH))
            yield frame
            if number == 2:  # two are written, and most of what only the first frames take is over
                spent = time.perf_counter() - begin
                say(f"about {duration(spent * frames / 2)}; a smaller --width or --fps is faster")

    written = write_mp4(output, watched(), fps)
    if gif is not None:
        write_gif(gif, kept, len(kept) / GIF_SECONDS)
    return Video(output, gif, written, written / fps, labels)


def _cameras(scene: Scene, path: str | Path, frames: int, width: int | None) -> list[Camera]:
    lens = (scene.test or scene.views)[0].camera
    wide = lens.width if width is None else width
    size = (wide, max(2, round(lens.height * wide / lens.width)))
    if path == "orbit" or (path == "test" and scene.views[0].image_path == NO_PHOTO):
        return orbit(scene, frames, size)
    if path == "test":
        return through_views(scene, frames, size)
    return from_file(Path(path), scene, frames, size)


class ShowInView(Callbacks):
    """Callbacks that show every step of a run in a live view."""

    def __init__(self, view: LiveView, say: Callable[[str], None] = lambda text: None) -> None:
        self.view, self._say = view, say

    def say(self, text: str) -> None:
        self._say(text)

    def started(self, cell: Cell, folder: Path) -> None:
        self._say(f"{run_name(cell)} -> {folder}")

    def tick(self, trainer: Trainer) -> None:
        self.view.tick(trainer)

    def ended(self, cell: Cell, report: CellReport) -> None:
        line = f"{run_name(cell)}: {outcome_line(report)}"
        self.view.end(line)
        self._say(line)


class GrowingPage:
    """Writes the page of `aw view` while runs are trained: soon after the first step, then more rarely."""

    def __init__(self, folder: Path, runs: Path) -> None:
        """
        Args:
            folder: where index.html is written.
            runs: folder of the runs; finished ones are shown beside the one that is trained.
        """
        check_page_folder(folder)
        self.folder, self.runs = folder, runs
        self._trainer: Trainer | None = None
        self._label = self._next_label = ""
        self._cost_s = 0.0  # of the last page

    def begin(self, label: str) -> None:
        """Call it before each run; `label` is the run's name on the page."""
        self._next_label = label
        self._ended: list[ViewedModel] = []
        with suppress(AwError):  # no run has ended yet
            self._ended = [t.model for t in find_run_models([self.runs])[0] if t.model.label != label]

    def tick(self, trainer: Trainer) -> bool:
        """Write the page if one is due, after an iteration with the clock stopped; return whether it was."""
        now = trainer.clock.now()
        if trainer is not self._trainer:
            self._trainer, self._label, self._due = trainer, self._next_label, now + FIRST_PAGE_S
        if now < self._due or trainer.done:
            return False
        pause_s = max(min(max(now, FIRST_PAGE_S), LONGEST_PAUSE_S), LEAST_PAUSE * self._cost_s)
        self._due = now + pause_s
        try:
            self._write(_state(trainer), pause_s + self._cost_s)
        except (AwError, OSError) as error:  # no reason to end a training
            LOG.warning("the page could not be written: %s", error)
            return False
        return True

    def end(self) -> bool:
        """Write the page of a run that was stopped; return whether there is one."""
        if self._trainer is None:
            return False
        self._write(f"stopped: {_state(self._trainer)}; the same command continues")
        return True

    def _write(self, state: str, reload_s: float = 0.0) -> None:
        assert self._trainer is not None
        begin, scene = time.monotonic(), self._trainer.data.scene
        masks = {view.name: keep for view, keep in keep_maps(self._trainer)}
        models = [*self._ended, training_model(self._trainer, self._label, masks)]
        text, _ = page_text(
            scene,
            models,
            title=page_title(scene),
            mixed=mixed_tests(scene),
            most_gaussians=GAUSSIANS_WHILE_TRAINING,
            training=state,
            reload_s=reload_s,
        )
        write_text(self.folder / PAGE, text)
        self._cost_s = time.monotonic() - begin


def _state(trainer: Trainer) -> str:
    seconds, budget = trainer.clock.now(), trainer.config.budget_s
    of = f"{budget:.0f} s" if budget is not None else f"{trainer.config.iterations} iterations"
    return f"{trainer.iteration:,} iterations in {seconds:.0f} s of training, of {of}"


def watch(
    scene: Path,
    method: str,
    output: Path,
    *,
    iterations: int | None = None,
    max_gaussians: int | None = None,
    seed: int = 0,
    threads: int | None = None,
    device: str = "auto",
    host: str = "127.0.0.1",
    port: int = 8080,
    say: Callable[[str], None] = lambda text: None,
    view: LiveView | None = None,
) -> BenchReport:
    """Train a method on a scene and show it in a browser.

    Args:
        scene: folder of the scene.
        method: as `aw bench --method`.
        output: folder of the run, as `aw bench -o`; a stopped run is resumed.
        iterations, max_gaussians, seed, threads, device: as in `bench`.
        host, port: address of the page.
        say: gets the address and the outcome.
        view: a view to use instead of a new one; it is not closed.

    Raises:
        AwError: viser is missing, the port is taken, or the run failed.
    """
    shown = LiveView(host, port) if view is None else view
    try:
        say(f"watch it at http://{host}:{shown.port}")
        report = bench(
            method,
            scene,
            output=output,
            seeds=(seed,),
            iterations=iterations,
            train={} if max_gaussians is None else {"max_gaussians": max_gaussians},
            threads=threads,
            device=device,  # type: ignore[arg-type]
            jobs=1,
            callbacks=ShowInView(shown, say),
        )
    finally:
        if view is None:
            shown.stop()
    if report.failed:
        raise AwError(report.failed[0].error)
    return report
