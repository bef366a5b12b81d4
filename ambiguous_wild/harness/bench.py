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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.harness.callbacks import Callbacks as Callbacks
from ambiguous_wild.harness.callbacks import Engine as Engine
from ambiguous_wild.harness.callbacks import Lines as Lines
from ambiguous_wild.harness.measures import load_metrics, try_own
from ambiguous_wild.harness.session import Session

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell, CellReport, Outcome, Overwrite, Protocol
    from ambiguous_wild.harness.effects_plan import Plan
    from ambiguous_wild.harness.models import Viewer
    from ambiguous_wild.harness.result_file import RunResult
    from ambiguous_wild.harness.store import Runs

Place = Literal["mask", "density", "regulariser"]
Words = str | Path
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
    """What became of one run."""

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
        what = f"{self.outcome}{'' if psnr is None else f', {psnr:.2f} dB'}{self.error and f': {self.error}'}"
        return f"RunReport({self.method} on {self.scene}, seed {self.seed}: {what})"

    def mean(self, metric: str) -> float | None:
        """Mean of an image metric over the test views, of the finite values; None where any is missing."""
        from ambiguous_wild.harness.result_file import mean_of

        mean = mean_of(self.result, metric)
        return None if math.isnan(mean) else mean

    def show(self, height: int = 640) -> Viewer:
        """The page of `aw view` for this run; as the last value of a notebook's cell it is shown there.

        Args:
            height: of the frame, px.

        Raises:
            AwError: the run has no model, or its scene is not where it was.
        """
        from ambiguous_wild.harness.models import Viewer

        return Viewer([self.folder], height=height)


@dataclass(frozen=True)
class BenchReport:
    """Every run of a `bench`, in the order in which they were planned."""

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
        """How many runs were trained, kept, skipped or failed."""
        return dict(Counter(run.outcome for run in self.runs))

    @property
    def folders(self) -> tuple[Path, ...]:
        """A folder for each length and choice of effects: `read` takes one of them."""
        return tuple(dict.fromkeys(self.output / run.group for run in self.runs))

    def read(self, folder: Path | None = None) -> Runs:
        """All results below a folder as pandas tables, e.g. for `tables.comparison.comparison`.

        Args:
            folder: one of `folders`; None = the first.
        """
        from ambiguous_wild.harness.store import read_runs

        return read_runs(self.folders[0] if folder is None else folder)

    def show(self, height: int = 640) -> Viewer:
        """The page of `aw view` with every model side by side, for a notebook; see `RunReport.show`."""
        from ambiguous_wild.harness.models import Viewer

        return Viewer([run.folder for run in self.runs if run.outcome != "failed"], height=height)


def bench(
    methods: str | Sequence[str],
    scenes: Words | Sequence[Words],
    *,
    output: Words = "runs",
    seeds: Sequence[int] = (0,),
    iterations: int | None = None,
    budgets_s: Sequence[float] = (),
    effects: str | Sequence[str] = "auto",
    plan: Plan | Words | None = None,
    settings: Sequence[str] = (),
    parts: Mapping[Place, str] | None = None,
    passes: int = 1,
    train: TrainSettings | None = None,
    plugins: Sequence[Words] = (),
    metrics: Words | Sequence[Words] = (),
    device: Literal["auto", "cpu", "cuda"] = "auto",
    threads: int | None = None,
    jobs: int | None = None,
    engine: Engine | None = None,
    factor: int | None = None,
    protocol: Protocol | None = None,
    start: Words | None = None,
    overwrite: Overwrite = "missing",
    cache: Words | None = None,
    pictures: bool = True,
    callbacks: Callbacks | None = None,
) -> BenchReport:
    """Train every method on every scene with every seed, and measure the test views.

    Args:
        methods: names of `aw methods`, FILE.py:RECIPE, external:FILE.yaml or nerfbaselines:METHOD.
        scenes: scene folders.
        output: folder of the runs: OUTPUT/[GROUP/]SCENE/METHOD/seed0.
        seeds: of training.
        iterations: length of a training; None = 30000.
        budgets_s: seconds of training instead; several = every length, each in a group of its own.
        effects: "none", "all", "auto" (the plan of the scene) or names with commas, for all methods alike;
            several = every choice, each in a group of its own.
        plan: of `aw plan`, or its file, for the one scene; None = made where one is needed.
        settings: options of methods, "METHOD.KEY=VALUE".
        parts: parts of other methods that every method takes, e.g. {"mask": "refinesplat"}.
        passes: 2 = train again from the start with the final masks; the runs are called METHOD+2passes.
        train: other settings of training.
        plugins: Python files that register methods.
        metrics: Python files with metrics of your own, see docs/metrics.md.
        device: where to train; "auto" = the GPU where it can be used.
        threads: of the CPU kernels; None = all cores. The result does not depend on it.
        jobs: cells at a time on this machine; None = what `engine` says.
        engine: where cells run; None = this machine.
        factor: which images_N; None = what the scene was built for.
        protocol: "full" or "half" (right halves are measured, NeRF-W); None = scene.json's, else "full".
        start: a splat file or a point cloud (PLY) to start from; None = the scene's points.
        overwrite: as `aw bench --overwrite`.
        cache: for features and instance masks; None = OUTPUT/.cache.
        pictures: draw what the method saw into RUN/pictures.
        callbacks: told what happens; None = nothing is. `Lines()` prints a line a run.

    Returns:
        A report with every run. A run that failed is in it too: look at `failed`.

    Raises:
        AwError: unknown method, scene, effect or option, or a folder of another configuration; all found
            before anything is trained.
    """
    told = Callbacks() if callbacks is None else callbacks
    where = Engine() if engine is None else engine
    where = where if jobs is None else dataclasses.replace(where, jobs=jobs)
    where.check()
    metrics = [metrics] if isinstance(metrics, str | Path) else metrics
    for file in metrics:
        load_metrics(Path(file))
    names = _check_methods([methods] if isinstance(methods, str) else methods, plugins, parts or {}, passes)
    folders = [Path(scenes)] if isinstance(scenes, str | Path) else [Path(scene) for scene in scenes]
    choices = [effects] if isinstance(effects, str) else list(effects)
    _check_effects(choices, plan, folders, names)
    if iterations is not None and budgets_s:
        raise AwError("iterations and budgets_s exclude each other: a run is as long as one of them says")
    out = Path(output)
    with Session(where, threads, told) as session:
        from ambiguous_wild.harness.cell import RunOptions
        from ambiguous_wild.harness.external import check_program
        from ambiguous_wild.harness.grid import (
            Probing,
            check_grafts,
            expected_line,
            grouped,
            plan_cells,
            run_cells,
            try_recipes,
            unfinished,
        )
        from ambiguous_wild.harness.job import read_sources
        from ambiguous_wild.harness.training import check_passes
        from ambiguous_wild.io.files import check_output
        from ambiguous_wild.splat.calibration import prepare_cpu
        from ambiguous_wild.splat.pace import TrainConfig

        chosen = session.device(device)
        config = TrainConfig(
            iterations=iterations or TrainConfig.iterations,
            budget_s=budgets_s[0] if budgets_s else None,
            **(train or {}),
        )
        read = _read_plan(plan)
        place = out / ".cache" if cache is None else Path(cache)
        shortest = dataclasses.replace(config, budget_s=min(budgets_s, default=None))
        probing = Probing(shortest, place / "plans", lambda: prepare_cpu(threads, told.say), told.say)
        planned = {
            wanted: plan_cells(
                names,
                folders,
                seeds,
                config,
                settings=settings,
                device=chosen,
                factor=factor,
                effects=wanted,
                plan=read,
                protocol=protocol,
                start=None if start is None else Path(start),
                probing=probing,
            )
            for wanted in dict.fromkeys(choices)
        }
        cells = grouped(planned, budgets_s)
        warnings = check_grafts(cells)
        for cell in {cell.method.name: cell for cell in cells}.values():
            check_passes(cell)
        for line in [*_remarks(cells), *warnings]:
            told.say(line)
        to_run = [] if where.remote else unfinished(cells, out, overwrite)
        for cell in {cell.method.name: cell for cell in to_run}.values():
            check_program(cell)
        to_train = [cell for cell in to_run if cell.method.program is None]
        for line in try_recipes(to_train):
            told.say(line)
        for cell in {cell.scene_id: cell for cell in to_run}.values():
            try_own(cell.scene)
        check_output(out / "run")  # before half a minute of compiling
        if chosen == "cpu" and not where.remote and any(cell.method.program is None for cell in cells):
            prepare_cpu(threads, told.say)
            if to_train and iterations is None and not budgets_s:
                told.say(expected_line(to_train))
        one_by_one = session.in_process(cells)
        told.planned(cells, one_by_one)
        if one_by_one:
            reports = run_cells(
                cells,
                out,
                overwrite=overwrite,
                cache_dir=place,
                tick=told.tick,
                pictures=pictures,
                on_start=told.started,
                on_end=told.ended,
            )
        else:
            sources = read_sources(plugins, names, metrics)
            reports = session.run(cells, out, RunOptions(place, overwrite, pictures), sources)
    made = BenchReport(out, tuple(_run_report(cell, report) for cell, report in zip(cells, reports)))
    if said := _rescorable(made, metrics):
        told.say(said)
    return made


def _check_methods(
    methods: Sequence[str], plugins: Sequence[Words], parts: Mapping[Place, str], passes: int
) -> list[str]:
    """The methods' names with the parts they take; a misspelt one is answered before torch is imported.

    "a,b" are two methods, but for the places of a graft (a@mask=b,density=c) and files with a comma.
    """
    from ambiguous_wild.methods.graft import graft_name
    from ambiguous_wild.methods.references import reference_file
    from ambiguous_wild.methods.registry import get_method, load_plugin
    from ambiguous_wild.methods.second_pass import second_pass_name, trained_once

    for plugin in plugins:
        load_plugin(Path(plugin))
    donors: dict[str, str | None] = dict(parts.items())
    names = []
    for text in methods:
        file = reference_file(text)
        whole = file is not None and file.exists()
        for name in [text] if whole else [part.strip() for part in _BETWEEN_METHODS.split(text)]:
            once = trained_once(name)
            names.append(second_pass_name(graft_name(once, donors), passes if once == name else 2))
    entries = [get_method(name) for name in names]
    return [name if entry.given_as else entry.name for name, entry in zip(names, entries)]


def _check_effects(
    choices: Sequence[str], plan: Plan | Words | None, scenes: Sequence[Path], methods: Sequence[str]
) -> None:
    from ambiguous_wild.harness.choosing import check_wanted, takes_effects
    from ambiguous_wild.methods.registry import get_method

    for wanted in choices:
        check_wanted(wanted)
    if plan is None:
        return
    name = plan if isinstance(plan, str | Path) else plan.scene
    if len(scenes) > 1:
        raise AwError(f"--plan {name} is of one scene; bench {len(scenes)} scenes one by one, or without it")
    if "auto" not in choices or not any(takes_effects(get_method(m)) for m in methods):
        raise AwError(
            f"--plan {name} would not be read: {', '.join(methods)} with --effects {', '.join(choices)}; "
            "add --effects auto"
        )


def _read_plan(plan: Plan | Words | None) -> Plan | None:
    if not isinstance(plan, str | Path):
        return plan
    from ambiguous_wild.harness.effects_plan import read_plan

    return read_plan(Path(plan))


def _remarks(cells: Sequence[Cell]) -> list[str]:
    """Effects that are on, who cannot take them, warnings of the scenes; each once."""
    from ambiguous_wild.harness.choosing import NOT_OURS, takes_effects

    lines = []
    on = dict.fromkeys((c.scene.name, c.chosen.effects) for c in cells if c.chosen.effects)
    lines += [f"{scene}: all methods train with the effects {', '.join(names)}" for scene, names in on]
    without = {c.method.name: c.method for c in cells if on and not takes_effects(c.method)}
    lines += [f"{name} trains without effects: {NOT_OURS}" for name in without]
    for scene in {cell.scene.name: cell.scene for cell in cells}.values():
        lines += [f"warning: {scene.name}: {warning}" for warning in scene.info.get("warnings", ())]
    return lines


def _rescorable(made: BenchReport, metrics: Sequence[Words] = ()) -> str:
    """What `aw rescore` could add to runs that were kept; empty where it could add nothing."""
    kept = [run.result for run in made.runs if run.outcome in ("kept", "skipped") and run.result is not None]
    if not metrics and not any(result["missing"] for result in kept):
        return ""
    from ambiguous_wild.harness.store import could_be_measured

    names = could_be_measured(kept)
    command = shlex.join(["aw", "rescore", str(made.output), *(f"--metric-file={file}" for file in metrics)])
    return (
        f"runs that were kept lack {', '.join(names)}, which can be measured now: {command}" if names else ""
    )


def _run_report(cell: Cell, report: CellReport) -> RunReport:
    from ambiguous_wild.harness.result_file import RESULT, read_result
    from ambiguous_wild.harness.run import is_finished

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
