"""Train methods on scenes and measure them: what `aw bench` does, as a call with a report.

    from ambiguous_wild import bench

    report = bench(["3dgs", "refinesplat"], ["scene"], output="runs", iterations=3000)
    for run in report.runs:
        print(run.method, run.scene, run.outcome, run.mean("psnr"))

Imports nothing heavy until names and options are checked.
"""

from __future__ import annotations

import dataclasses
import math
import re
import shlex
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.harness.callbacks import Callbacks as Callbacks
from ambiguous_wild.harness.callbacks import Engine as Engine
from ambiguous_wild.harness.callbacks import Lines as Lines
from ambiguous_wild.harness.measures import check_user_metrics, load_metrics
from ambiguous_wild.harness.session import Session

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell, CellReport, Outcome, Overwrite, Protocol
    from ambiguous_wild.harness.effects_plan import EffectsPlan
    from ambiguous_wild.harness.result_file import RunResult
    from ambiguous_wild.harness.store import Runs
    from ambiguous_wild.harness.trained_models import Viewer
    from ambiguous_wild.methods.entry import MethodEntry

GraftSlot = Literal["mask", "density", "regulariser"]
PathLike = str | Path
_BETWEEN_METHODS = re.compile(r",(?!\s*\w*\s*=)")


class TrainSettings(TypedDict, total=False):
    """Settings of training beside its length: fields of `TrainConfig`, with its defaults."""

    resolution: Literal["auto", "full", "coarse-to-fine"]
    max_gaussians: int | None  # None = the method's own ceiling
    probes: int  # times the test PSNR is measured on the way
    checkpoint_every_s: float
    on_nonfinite: Literal["stop", "rollback"]


@dataclass(frozen=True)
class RunReport:
    """The outcome of one run, and its result."""

    method: str
    scene: str
    seed: int
    group: str  # folder below the output, e.g. "budget-60s"; empty where there is one group
    effects: tuple[str, ...]
    folder: Path
    outcome: Outcome
    error: str  # empty unless the outcome is "failed"
    result: RunResult | None  # as in metrics.json; None = no result that can be read

    def __repr__(self) -> str:
        psnr = self.mean("psnr")
        summary = (
            self.outcome + ("" if psnr is None else f", {psnr:.2f} dB") + (self.error and f": {self.error}")
        )
        return f"RunReport({self.method} on {self.scene}, seed {self.seed}: {summary})"

    def mean(self, metric: str) -> float | None:
        """Return the mean of a metric's finite values over the test views; None where a view has none."""
        from ambiguous_wild.harness.result_file import mean_of

        mean = mean_of(self.result, metric)
        return None if math.isnan(mean) else mean

    def show(self, height: int = 640) -> Viewer:
        """Return the page of `aw view` for this run; a notebook shows it if it is the last value of a cell.

        Args:
            height: height of the frame, px.

        Raises:
            AwError: the run has no model, or its scene has been moved.
        """
        from ambiguous_wild.harness.trained_models import Viewer

        return Viewer([self.folder], height=height)


@dataclass(frozen=True)
class BenchReport:
    """All runs of a `bench`, in the order in which they were planned."""

    output: Path
    runs: tuple[RunReport, ...]

    def __repr__(self) -> str:
        counts = ", ".join(f"{n} {outcome}" for outcome, n in self.outcomes.items())
        return f"BenchReport({self.output}: {counts})"

    @property
    def failed(self) -> tuple[RunReport, ...]:
        return tuple(run for run in self.runs if run.outcome == "failed")

    @property
    def outcomes(self) -> dict[Outcome, int]:
        """Number of runs by outcome: trained, kept, skipped or failed."""
        return dict(Counter(run.outcome for run in self.runs))

    @property
    def folders(self) -> tuple[Path, ...]:
        """One folder for each training length and choice of effects; `read` takes one of them."""
        return tuple(dict.fromkeys(self.output / run.group for run in self.runs))

    def read(self, folder: Path | None = None) -> Runs:
        """Read all results below a folder as pandas tables, e.g. for `report.comparison.comparison`.

        Args:
            folder: one of `folders`; None = the first.
        """
        from ambiguous_wild.harness.store import read_runs

        return read_runs(self.folders[0] if folder is None else folder)

    def show(self, height: int = 640) -> Viewer:
        """Return the page of `aw view` with all models side by side, for a notebook; see `RunReport.show`."""
        from ambiguous_wild.harness.trained_models import Viewer

        return Viewer([run.folder for run in self.runs if run.outcome != "failed"], height=height)


def bench(
    methods: str | Sequence[str],
    scenes: PathLike | Sequence[PathLike],
    *,
    output: PathLike = "runs",
    seeds: Sequence[int] = (0,),
    iterations: int | None = None,
    budgets_s: Sequence[float] = (),
    effects: str | Sequence[str] = "auto",
    plan: EffectsPlan | PathLike | None = None,
    settings: Sequence[str] = (),
    parts: Mapping[GraftSlot, str] | None = None,
    passes: int = 1,
    train: TrainSettings | None = None,
    plugins: Sequence[PathLike] = (),
    metrics: PathLike | Sequence[PathLike] = (),
    device: Literal["auto", "cpu", "cuda"] = "auto",
    threads: int | None = None,
    jobs: int | None = None,
    engine: Engine | None = None,
    factor: int | None = None,
    protocol: Protocol | None = None,
    start: PathLike | None = None,
    corrections: PathLike | None = None,
    overwrite: Overwrite = "missing",
    cache: PathLike | None = None,
    pictures: bool = True,
    callbacks: Callbacks | None = None,
) -> BenchReport:
    """Train every method on every scene with every seed, and measure the test views.

    Args:
        methods: names of `aw methods`, FILE.py:RECIPE, external:FILE.yaml or nerfbaselines:METHOD.
        scenes: scene folders.
        output: folder of the runs: OUTPUT/[GROUP/]SCENE/METHOD/seed0.
        seeds: every method is trained once with each seed.
        iterations: length of a training; None = 200 for each train photo of the scene, 7000 to 30 000.
        budgets_s: length in seconds of training instead; several = every length, each in its own group.
        effects: "none", "all", "auto" (the plan of the scene) or names with commas, for all methods alike;
            several = every choice, each in its own group.
        plan: a plan of `aw plan`, or its file, for the only scene; None = made where one is needed.
        settings: options of methods, "METHOD.KEY=VALUE".
        parts: parts of other methods that every method takes, e.g. {"mask": "refinesplat"}; for
            "mask" also a folder of masks.
        passes: 2 = train again from the start with the final masks; the runs are called METHOD+2passes.
        train: other settings of training.
        plugins: Python files that register methods, or FILE.py:RECIPE.
        metrics: Python files with your own metrics, see docs/metrics.md.
        device: where to train; "auto" = the GPU where it can be used.
        threads: threads of the CPU kernels; None = all cores. The result does not depend on it.
        jobs: number of cells that run at a time on this machine; None = what `engine` says.
        engine: where cells run; None = this machine.
        factor: N of the folder images_N to train on; None = the one that the scene was built for.
        protocol: "full" or "half" (right halves are measured, NeRF-W); None = scene.json's, else "full".
        start: a splat file or a point cloud (PLY) to start from; None = the scene's points.
        corrections: masks corrected by hand, which the page of `aw view` saves; of the only scene.
        overwrite: "missing" keeps finished runs and resumes stopped ones, "longer" also continues runs that
            are shorter or have other corrections, "changed" also trains again where a method's file has
            changed, "always" starts anew, "never" leaves folders that exist.
        cache: folder for features and instance masks; None = OUTPUT/.cache.
        pictures: draw what the method saw into RUN/pictures.
        callbacks: called at every event; None = no calls. `Lines()` prints a line for each run.

    Returns:
        A report with every run, failed ones included: see `failed`.

    Raises:
        AwError: unknown method, scene, effect or option, or a folder of another configuration; all are
            checked before anything is trained.
    """
    callbacks = Callbacks() if callbacks is None else callbacks
    engine = Engine() if engine is None else engine
    engine = engine if jobs is None else dataclasses.replace(engine, jobs=jobs)
    engine.check()
    files = {"--overwrite longer": overwrite == "longer", "--corrections": corrections, "--start": start}
    needed = [option for option, given in files.items() if given]
    if engine.transfer == "store" and needed:
        raise AwError(
            f"{needed[0]} needs a file that --set "
            "engine.transfer=store does not send: leave it out, with -o on storage that all nodes share"
        )
    metrics = [metrics] if isinstance(metrics, str | Path) else metrics
    for file in metrics:
        load_metrics(Path(file))
    entries = find_methods([methods] if isinstance(methods, str) else methods, plugins, parts or {}, passes)
    folders = [Path(scenes)] if isinstance(scenes, str | Path) else [Path(scene) for scene in scenes]
    choices = [effects] if isinstance(effects, str) else list(effects)
    _check_effects(choices, plan, folders, entries.values())
    if iterations is not None and budgets_s:
        raise AwError("iterations and budgets_s exclude each other: a run is as long as one of them says")
    out = Path(output)
    with Session(engine, threads, callbacks) as session:
        from ambiguous_wild.harness.cell import RunOptions
        from ambiguous_wild.harness.continued import as_continued, with_corrections
        from ambiguous_wild.harness.effects_plan import read_plan
        from ambiguous_wild.harness.external_runs import check_program
        from ambiguous_wild.harness.grid import (
            cell_folder,
            cells_to_run,
            check_grafts,
            expand_budgets,
            expected_time_line,
            plan_cells,
            run_cells,
            try_recipes,
        )
        from ambiguous_wild.harness.job import read_sources
        from ambiguous_wild.harness.training import check_passes
        from ambiguous_wild.io.files import check_output
        from ambiguous_wild.splat.calibration import prepare_cpu
        from ambiguous_wild.splat.train_config import TrainConfig

        used_device = session.device(device)
        config = TrainConfig(
            iterations=TrainConfig.iterations if iterations is None else iterations,
            budget_s=budgets_s[0] if budgets_s else None,
            **(train or {}),
        )
        say = callbacks.say
        planned = {
            wanted: plan_cells(
                list(entries.values()),
                folders,
                seeds,
                config,
                settings=settings,
                device=used_device,
                factor=factor,
                effects=wanted,
                plan=read_plan(Path(plan)) if isinstance(plan, str | Path) else plan,
                protocol=protocol,
                start=None if start is None else Path(start),
                default_length=iterations is None and not budgets_s,
            )
            for wanted in dict.fromkeys(choices)
        }
        cells = expand_budgets(planned, budgets_s)
        if corrections is not None:
            cells = with_corrections(cells, Path(corrections))
        if overwrite == "longer":
            cells = [as_continued(cell, cell_folder(out, cell)) for cell in cells]
        warnings = check_grafts(cells)
        for cell in {cell.method.name: cell for cell in cells}.values():
            check_passes(cell)
        to_run = [] if engine.remote else cells_to_run(cells, out, overwrite)
        for cell in {cell.method.name: cell for cell in to_run}.values():
            check_program(cell)
        to_train = [cell for cell in to_run if cell.method.program is None]
        for line in try_recipes(to_train):
            say(line)
        for cell in {cell.scene_id: cell for cell in to_run}.values():
            check_user_metrics(cell.scene)
        check_output(out / "run")  # before half a minute of compiling
        for line in [*_remarks(cells), *warnings]:
            say(line)
        if used_device == "cpu" and not engine.remote and any(cell.method.program is None for cell in cells):
            prepare_cpu(threads, say)
            if to_train and iterations is None and not budgets_s:
                say(expected_time_line(to_train))
        one_by_one = session.in_process(cells)
        callbacks.planned(cells, one_by_one)
        options = RunOptions(out / ".cache" if cache is None else Path(cache), overwrite, pictures)
        if one_by_one:
            reports = run_cells(cells, out, options, callbacks)
        else:
            sources = read_sources(plugins, list(entries), metrics)
            reports = session.run(cells, out, options, sources)
    bench_report = BenchReport(out, tuple(_run_report(cell, report) for cell, report in zip(cells, reports)))
    if hint := _rescore_hint(bench_report, metrics):
        say(hint)
    return bench_report


def find_methods(
    methods: Sequence[str], plugins: Sequence[PathLike], parts: Mapping[GraftSlot, str], passes: int
) -> dict[str, MethodEntry]:
    """Return the methods, with the parts they take, by the name that finds them again in another process.

    A misspelt name is an error before torch is imported.
    """
    from ambiguous_wild.methods.entry import second_pass_name, trained_once
    from ambiguous_wild.methods.graft import ALIASES, graft_name
    from ambiguous_wild.methods.references import MASKS
    from ambiguous_wild.methods.registry import all_methods, get_method, load_plugin

    for plugin in plugins:
        load_plugin(Path(plugin))
    donors: dict[str, str | None] = dict(parts.items())
    mask = donors.get("mask")
    if mask and mask not in {*all_methods(), *ALIASES} and Path(mask).is_dir():
        donors["mask"] = MASKS + mask
    names = []
    for name in (one for text in methods for one in split_methods(text)):
        once = trained_once(name)
        names.append(second_pass_name(graft_name(once, donors), passes if once == name else 2))
    entries = [(name, get_method(name)) for name in names]
    return {name if entry.given_as else entry.name: entry for name, entry in entries}


def check_request(
    methods: Sequence[str],
    plugins: Sequence[PathLike],
    parts: Mapping[GraftSlot, str],
    settings: Sequence[str],
    effects: Sequence[str],
) -> None:
    """Check what does not need a scene, before one is made; arguments and errors as of `bench`."""
    from ambiguous_wild.harness.grid import resolved_options

    entries = find_methods(methods, plugins, parts, 1)
    _check_effects(effects, None, [], entries.values())
    resolved_options(list(entries.values()), settings)


def split_methods(text: str, folder: Path = Path()) -> list[str]:
    """Return the methods in a text: "a,b" are two, except in a graft with two places (a@mask=b,density=c).

    Args:
        text: names with commas, or a reference whose file exists and has a comma in its name.
        folder: the folder that paths in the text are relative to.
    """
    from ambiguous_wild.methods.references import reference_file

    file = reference_file(text)
    is_file = file is not None and (folder / file).exists()
    return [text] if is_file else [part.strip() for part in _BETWEEN_METHODS.split(text)]


def _check_effects(
    choices: Sequence[str],
    plan: EffectsPlan | PathLike | None,
    scenes: Sequence[Path],
    methods: Collection[MethodEntry],
) -> None:
    """Raise AwError for an unknown effect, or effects or a plan that no method would use."""
    from ambiguous_wild.harness.chosen_effects import EXTERNAL_NO_EFFECTS, parse_effects, takes_effects

    for wanted in choices:
        parse_effects(wanted)
        if wanted not in ("auto", "none") and not any(map(takes_effects, methods)):
            names = ", ".join(method.name for method in methods)
            raise AwError(
                f"--effects {wanted} would not be used by {names}: {EXTERNAL_NO_EFFECTS}; leave it out"
            )
    if plan is None:
        return
    name = plan if isinstance(plan, str | Path) else plan.scene
    if len(scenes) > 1:
        raise AwError(
            f"the plan {name} is of one scene; bench {len(scenes)} scenes one by one, or without it"
        )
    if "auto" not in choices or not any(map(takes_effects, methods)):
        raise AwError(
            f"the plan {name} would not be used: {', '.join(method.name for method in methods)} with "
            f"--effects {', '.join(choices)}; add --effects auto"
        )


def _remarks(cells: Sequence[Cell]) -> list[str]:
    """Return a line for each set of effects, and for each method that cannot take them."""
    from ambiguous_wild.harness.chosen_effects import EXTERNAL_NO_EFFECTS, takes_effects

    lines = []
    effects = dict.fromkeys((c.scene.name, c.chosen.effects) for c in cells if c.chosen.effects)
    lines += [f"{scene}: all methods train with the effects {', '.join(names)}" for scene, names in effects]
    without = {c.method.name: c.method for c in cells if effects and not takes_effects(c.method)}
    lines += [f"{name} trains without effects: {EXTERNAL_NO_EFFECTS}" for name in without]
    return lines


def _rescore_hint(report: BenchReport, metrics: Sequence[PathLike] = ()) -> str:
    """Return a line with the metrics that `aw rescore` could add to kept runs; empty where there are none."""
    kept = [r.result for r in report.runs if r.outcome in ("kept", "skipped") and r.result is not None]
    if not metrics and not any(result["missing"] for result in kept):
        return ""
    from ambiguous_wild.harness.store import computable_metrics

    names = computable_metrics(kept)
    command = shlex.join(["aw", "rescore", str(report.output), *(f"--metric-file={f}" for f in metrics)])
    return (
        f"runs that were kept lack {', '.join(names)}, which can be measured now: {command}" if names else ""
    )


def _run_report(cell: Cell, report: CellReport) -> RunReport:
    from ambiguous_wild.harness.cell_run import is_finished
    from ambiguous_wild.harness.result_file import RESULT, read_result

    result = report.result
    if result is None and report.outcome != "failed" and is_finished(report.folder):
        result = read_result(report.folder / RESULT)
    return RunReport(
        method=cell.method.name,
        scene=cell.scene.name,
        seed=cell.train.seed,
        group=cell.group,
        effects=cell.chosen.effects,
        folder=report.folder,
        outcome=report.outcome,
        error=report.error,
        result=result,
    )
