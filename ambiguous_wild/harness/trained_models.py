"""Find the trained models of finished runs with their scene, and show them on the page of `aw view`."""

from __future__ import annotations

import html
import shlex
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.config import from_plain
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.harness.cell import scene_identity
from ambiguous_wild.harness.chosen_effects import mixed_tests
from ambiguous_wild.harness.labels import shown_names
from ambiguous_wild.harness.result_file import (
    CONFIG,
    FAILED,
    MODEL,
    RESULT,
    STOPPED,
    RunResult,
    check_model,
    metrics_of,
    read_result,
)
from ambiguous_wild.harness.store import ReadConfig, config_section, find_runs, read_config
from ambiguous_wild.io.files import write_text
from ambiguous_wild.io.mask_reasons import FILE as REASONS
from ambiguous_wild.io.ply import splat_count
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.io.splat_arrays import SplatFile
from ambiguous_wild.methods.graft import split_graft
from ambiguous_wild.methods.references import is_reference
from ambiguous_wild.methods.registry import get_method, knows_truth
from ambiguous_wild.viewing.model import RenderSettings, ViewedModel, file_model
from ambiguous_wild.viewing.page_file import MAX_GAUSSIANS, PAGE, Page, check_page_folder, page_text
from ambiguous_wild.viewing.video import scene_around

if TYPE_CHECKING:
    from ambiguous_wild.splat.trainer import Trainer

MASKS = "masks"


@dataclass(frozen=True)
class TrainedModel:
    """A finished run with its model."""

    run: Path
    scene: str  # name
    scene_hash: str
    model: ViewedModel
    half: bool  # measured on the right half of each test photo
    note: str = ""  # how it is drawn, where that may differ from training


@dataclass(frozen=True)
class SceneModels:
    """Models of one scene."""

    scene: Scene
    models: tuple[ViewedModel, ...]
    notes: tuple[str, ...]  # which runs are not shown, and why; the meaning of numbers
    mixed: str = ""  # why test photos may hold distractors, see `mixed_tests`
    runs: tuple[Path, ...] = ()  # folders of the models that are runs


def read_models(
    paths: Sequence[Path],
    *,
    scene_folder: Path | None = None,
    labels: Sequence[str] = (),
) -> SceneModels:
    """Read the models of the runs below some folders and of splat files, and their scene.

    Args:
        paths: run folders, folders of runs, or splat files.
        scene_folder: where the scene lies; None = where the runs say. For splat files alone, None gives a
            scene without photos.
        labels: names and order of methods, see `labels.shown_names`.

    Raises:
        AwError: no run, no model in any, runs of several scenes, a wrong label, or a scene that was moved.
    """
    files, notes = read_splat_models(paths)
    folders = [path for path in paths if not path.is_file()]
    if files and not folders:
        shown_names(labels, ())  # files have no method
        opened = scene_around(files[0]) if scene_folder is None else load_scene(scene_folder)
        if scene_folder is None:
            notes.append(f"no --scene: the cameras are on a circle around {files[0].ply.name}, y down")
        return SceneModels(opened, tuple(model.within(opened.transform) for model in files), tuple(notes))
    trained, more = find_run_models(folders if files else paths, labels)
    notes += more
    names = sorted({t.scene for t in trained})
    if len(names) > 1:
        one = trained[0].run.parent.parent
        raise AwError(
            f"these runs are of {len(names)} scenes ({shortlist(names)}): give those of one, e.g. {one}"
        )
    if len({t.scene_hash for t in trained}) > 1:
        runs = shortlist(sorted(str(t.run) for t in trained), 3)
        raise AwError(f"scene {names[0]!r} differs between these runs: {runs}; name them one by one")
    if any(t.half for t in trained):
        notes.append("PSNR of runs with --protocol half is that of the right half of each test photo")
    opened = open_scene(trained[0].run, scene_folder)
    models = (*(t.model for t in trained), *(model.within(opened.transform) for model in files))
    return SceneModels(opened, models, tuple(notes), mixed_tests(opened), tuple(t.run for t in trained))


def read_splat_models(paths: Sequence[Path]) -> tuple[list[ViewedModel], list[str]]:
    """Read the models of the splat files among the paths, with unique labels, and notes on them.

    Raises:
        AwError: a file is no splat file.
    """
    read = [file_model(path) for path in dict.fromkeys(paths) if path.is_file()]
    count = Counter(model.label for model, _ in read)
    models = [replace(m, label=str(m.ply)) if count[m.label] > 1 else m for m, _ in read]
    return models, [note for _, note in read if note]


def find_run_models(
    paths: Sequence[Path], labels: Sequence[str] = ()
) -> tuple[list[TrainedModel], list[str]]:
    """Find the finished runs that have a model, in the order of their paths; write a line on each other run.

    `labels` name and order the methods, see `labels.shown_names`. The models' labels distinguish runs of the
    same method by seed, then by folder.

    Raises:
        AwError: no such folder, one without a run, or no run with a model in any of them.
    """
    trained: list[TrainedModel] = []
    notes: list[str] = []
    for run in find_runs(paths):
        try:
            trained.append(_read_model(run))
        except AwError as error:
            notes.append(f"not shown: {error}")
            continue
        if trained[-1].note:
            notes.append(trained[-1].note)
    if not trained:
        raise AwError(f"no finished run with a {MODEL} below {shortlist(map(str, paths))} ({notes[0]})")
    if labels:
        shown = shown_names(labels, [t.model.label for t in trained])
        trained.sort(key=lambda t: list(shown).index(t.model.label))
        trained = [replace(t, model=replace(t.model, label=shown[t.model.label])) for t in trained]
    return _with_labels(trained), notes


Opened = dict[tuple[Path, int | None], tuple[Scene, str]]  # folder and factor -> scene and its identity


def open_scene(run: Path, folder: Path | None = None, *, opened: Opened | None = None) -> Scene:
    """Open the scene of a run, with the photos it was trained on; its files are compared with their hashes.

    Args:
        run: the run's folder.
        folder: where the scene lies; None = where the run says, else beside a folder that the run is in.
        opened: verified scenes of earlier calls, which are not opened again. Who gives it measures runs, so
            the scene is asked what it is asked before training.

    Raises:
        AwError: the scene is absent, damaged, in another state than the run used, or refused by a check.
    """
    config = read_config(run).get("scene")
    if not isinstance(config, dict):
        raise AwError(f"{run} has no {CONFIG} that names its scene: restore it, or run 'aw bench' again")
    path = Path(str(config.get("path"))) if folder is None else folder
    if folder is None and not path.is_dir():  # the folder that holds scene and runs was moved or copied
        beside = (parent / path.name for parent in run.resolve().parents)
        path = next((place for place in beside if (place / "sparse").is_dir()), path)
    if not path.is_dir():
        raise AwError(
            f"the scene of {run} is not at {path}, nor beside its runs: move the scene back "
            "('aw view', 'aw video', 'aw export' and 'aw rescore' take its folder: --scene)"
        )
    factor = config.get("factor")
    key, measured = (path, factor if isinstance(factor, int) else None), opened is not None
    opened = {} if opened is None else opened
    if key not in opened:
        scene = load_scene(path, factor=key[1], check=measured)
        opened[key] = scene, scene_identity(scene)
    scene, identity = opened[key]
    if identity != (before := str(config.get("sha256"))):
        raise AwError(
            f"{run} was measured on another state of {path}: hash {before[:12]}, now {identity[:12]}; "
            "restore the scene, run again on this one, or name the right one with --scene "
            "('aw view', 'aw video', 'aw export', 'aw rescore' and 'aw leaderboard add' take it)"
        )
    return scene


def finished_result(run: Path) -> RunResult:
    """Read the result of a run that ended well.

    Raises:
        AwError: it failed, or has not ended.
    """
    for path in (run / RESULT, run / FAILED):
        if path.is_file():
            result = read_result(path)
            if result["status"] != "ok":
                raise AwError(f"{run} failed: {result['error']}")
            return result
    stopped = run / STOPPED / MODEL
    shown = f"; its model is {stopped}" if stopped.is_file() else ""
    raise AwError(f"{run} is not finished: the command that began it continues it{shown}")


def _read_model(run: Path) -> TrainedModel:
    result = finished_result(run)
    ply = run / MODEL
    if not ply.is_file():
        raise AwError(f"{run} has no {MODEL}: an external program may keep its model elsewhere")
    splat_count(ply)
    check_model(run, result)
    config = read_config(run)
    look, note = read_render_settings(config)
    psnr = {row["name"]: metrics_of(row).get("psnr") for row in result["per_image"]}
    model = ViewedModel(
        label=result["method"],
        ply=ply,
        render_settings=look,
        psnr={name: float(value) for name, value in psnr.items() if value is not None},
        masks=run / MASKS if any((run / MASKS).rglob("*.png")) else None,  # empty where nothing is masked
        reasons=run / REASONS if (run / REASONS).is_file() else None,
        retrain=_retrain_command(run, result),
        reference=knows_truth(result["method"]),
    )
    half = config.get("protocol") == "half"
    return TrainedModel(run, result["scene"], result["scene_hash"], model, half, note)


def _retrain_command(run: Path, result: RunResult) -> str:
    """Return the command that trains a run half as long again with corrected masks; "" if none is recorded.

    Its paths are seen from the current folder if they are below, else from the one that holds scene and runs.
    """
    try:
        words = shlex.split(str(result.get("reproduce", "")))
    except ValueError:
        return ""
    cost, runs = result["cost"], _folder_of_runs(run)
    iterations = cost.get("iterations")
    if words[:2] != ["aw", "bench"] or not iterations or "passes" in cost:  # two passes cannot go on
        return ""
    options = [
        (option, str(_from_here(Path(value), runs)) if value.startswith("/") else value)
        for option, value in zip(words[2::2], words[3::2])
        if option not in ("--device", "--iterations", "--budget")
    ]
    options += [("-o", str(_from_here(runs, runs))), ("--iterations", str(round(1.5 * iterations)))]
    options += [("--overwrite", "longer"), ("--corrections", "corrections.json")]
    return shlex.join(["aw", "bench", *(word for pair in options for word in pair)])


def _folder_of_runs(run: Path) -> Path:
    """Return the folder that holds SCENE/METHOD/SEED, else the root folder: a run may be moved anywhere."""
    return Path(*run.resolve().parts[:-3] or run.resolve().parts[:1])


def _from_here(path: Path, runs: Path) -> Path:
    """Return the path from the current folder, else from the one above `runs`, else its name alone."""
    for base in (Path.cwd(), runs.parent):
        if path.is_relative_to(base):
            return path.relative_to(base)
    return Path(path.name)


def next_steps(shown: SceneModels, *, on_page: bool = True) -> list[str]:
    """Return where masks and splat files of runs lie, and commands for them.

    `on_page`: folders of this machine are not named.
    """
    steps: list[str] = []
    for run, model in zip(shown.runs, shown.models):
        runs = _folder_of_runs(run)
        if on_page:
            place, root = str(_from_here(run.resolve(), runs)), str(_from_here(runs, runs))
        else:
            place, root = str(run), str(run.parents[2])
        if model.masks is not None:
            steps.append(f"masks of {model.label}, white = static: `{place}/{MASKS}`")
            full = shlex.join(["aw", "masks", place, "-o", "masks"])
            steps.append(f"masks of the photos at full size, for other tools: `{full}`")
        export = shlex.join(["aw", "export", place])
        steps.append(f"splat file of {model.label}: `{place}/{MODEL}`; as SPZ, SOG and glTF: `{export}`")
        if run == shown.runs[-1]:
            steps.append(f"table of the runs: `{shlex.join(['aw', 'table', root])}`")
    return steps


def page_title(scene: Scene) -> str:
    """Return the scene's name; where it is only "scene", the name of the folder that holds it."""
    return scene.root.resolve().parent.name if scene.name == "scene" else scene.name


def read_render_settings(config: ReadConfig) -> tuple[RenderSettings, str]:
    """Return how the run's method draws, with the run's options and effects; and a note, or "".

    An unknown method is drawn as plain 3DGS. The run may come from a stranger: no file that its name refers
    to is imported.

    Raises:
        AwError: effects or background are damaged.
    """
    name, source = str(config.get("method", "")), str(config.get("source", ""))
    if not name:
        return RenderSettings(), "a run without its config.yaml is drawn as plain 3DGS: restore the file"
    options = config_section(config, "options")
    try:
        if is_reference(name):
            raise AwError(f"{name} is a file")
        host, rest = split_graft(name)
        # Masks, also those of a folder, density control and regulariser do not change how a model is drawn.
        as_host = rest != "" and "effects=" not in rest and not get_method(host).source_hash
        entry = get_method(host if as_host else name)
        if as_host:
            source, options = "", config_section(options, "host")
        if entry.program is not None:
            return RenderSettings(), ""
    except AwError:
        advice = "if it is a method of yours, add --plugin FILE.py:RECIPE"
        return RenderSettings(), f"{name} is an unknown method and drawn as plain 3DGS: {advice}"
    if entry.source_hash != source:
        return RenderSettings(), f"{name} has changed since the run, so it is drawn as plain 3DGS"
    note = ""
    try:
        hooks = entry.build(from_plain(type(entry.options()), options, "options"))
    except AwError as error:  # an option of another version
        hooks, note = entry.build(entry.options()), f"{name} is drawn with its present defaults: {error}"
    effects = config.get("effects") or ()
    behind = config_section(config, "scene").get("background", hooks.background)
    try:
        antialias = hooks.antialias or "antialias" in effects
        red, green, blue = map(float, behind)
    except (TypeError, ValueError):
        values = f"effects {str(effects)[:40]!a}, background {str(behind)[:40]!a}"
        raise AwError(f"{CONFIG} of a run of {name} is damaged ({values}): restore it") from None
    return RenderSettings(hooks.sh_degree, antialias, hooks.blur, (red, green, blue)), note


def _with_labels(trained: list[TrainedModel]) -> list[TrainedModel]:
    """Make labels unique among the models of a scene: by seed where that is needed, then by folder."""
    labels = [t.model.label for t in trained]
    for names in ([f"{t.model.label}, {t.run.name}" for t in trained], [str(t.run) for t in trained]):
        count = Counter((t.scene, label) for t, label in zip(trained, labels))
        labels = [
            name if count[t.scene, label] > 1 else label for t, label, name in zip(trained, labels, names)
        ]
    return [replace(t, model=replace(t.model, label=label)) for t, label in zip(trained, labels)]


def view_runs(
    paths: Sequence[Path],
    output: Path,
    *,
    scene_folder: Path | None = None,
    most_gaussians: int = MAX_GAUSSIANS,
    title: str | None = None,
    labels: Sequence[str] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Page:
    """Write OUTPUT/index.html with the models of runs.

    Args:
        paths: run folders, or folders of runs, all of one scene.
        output: folder of the page.
        scene_folder: where the scene lies; None = where the runs say.
        most_gaussians: a larger model is reduced to this number, with a note on the page.
        title: title of the page; None = the scene's name.
        labels: names and order of methods, see `labels.shown_names`.
        say: gets a line about each step.

    Raises:
        AwError: no run with a model, several scenes, no scene, or another page in the folder.
    """
    shown = read_models(paths, scene_folder=scene_folder, labels=labels)
    check_page_folder(output)
    text, models_bytes = page_text(
        shown.scene,
        shown.models,
        title=page_title(shown.scene) if title is None else title,
        most_gaussians=most_gaussians,
        notes=shown.notes,
        mixed=shown.mixed,
        next_steps=next_steps(shown),
        say=say,
    )
    write_text(output / PAGE, text)
    return Page(output / PAGE, len(text.encode("utf-8")), models_bytes)


def training_model(
    trainer: Trainer, label: str, masks: Mapping[str, np.ndarray] | None = None
) -> ViewedModel:
    """Return the model of a run that is still trained, for a page that is written again and again.

    Args:
        trainer: its trainer; nothing in it is changed.
        label: name of the model on the page, the same on each page of a training.
        masks: keep maps by name of the train view, [H, W] bool; `evaluate.keep_maps` computes them.
    """
    arrays = {name: value.cpu().numpy() for name, value in trainer.neutral_model().items()}
    hooks = trainer.hooks
    return ViewedModel(
        label=label,
        ply=trainer.folder / MODEL,
        render_settings=RenderSettings(hooks.sh_degree, hooks.antialias, hooks.blur, hooks.background),
        masks=masks,
        splats=SplatFile(arrays, trainer.data.scene.transform, hooks.antialias),
    )


class Viewer:
    """The page of one or more runs, which a notebook shows in a frame."""

    def __init__(self, paths: Sequence[Path], *, height: int = 640) -> None:
        """
        Args:
            paths: run folders, or folders of runs, all of one scene.
            height: height of the frame, px.

        Raises:
            AwError: as `view_runs`.
        """
        shown = read_models(paths)
        self.labels = tuple(model.label for model in shown.models)
        self.height = height
        self.page, _ = page_text(
            shown.scene,
            shown.models,
            title=page_title(shown.scene),
            notes=shown.notes,
            mixed=shown.mixed,
            next_steps=next_steps(shown),
        )

    def __repr__(self) -> str:
        return f"Viewer of {', '.join(self.labels)}; a notebook shows it, 'aw view' writes it to a file"

    def _repr_html_(self) -> str:
        """Return a frame whose scripts run, but have no access to the notebook's page."""
        page = html.escape(self.page, quote=True)
        return (
            f'<iframe sandbox="allow-scripts" srcdoc="{page}" '
            f'style="width:100%;height:{self.height}px;border:0"></iframe>'
        )
