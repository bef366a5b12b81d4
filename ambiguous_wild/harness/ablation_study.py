"""Plan an ablation study. Its variants are ordinary cells: their runs resume, and `aw table` reads them."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import Facts, config_hash, flatten, to_plain, with_options
from ambiguous_wild.harness.ablation_records import (
    DIFFERENCES,
    METRICS,
    REPORT,
    StudyFacts,
    StudyReport,
    SummaryRecord,
    VariantRow,
)
from ambiguous_wild.harness.cell import Cell
from ambiguous_wild.harness.command_lines import option_text
from ambiguous_wild.harness.continued import as_continued
from ambiguous_wild.harness.grid import cell_folder, plan_cells
from ambiguous_wild.harness.measures import MASK_LABELS, Measure
from ambiguous_wild.harness.result_file import (
    FAILED,
    RESULT,
    RunResult,
    mask_scores,
    mean_of,
)
from ambiguous_wild.harness.store import checked_result
from ambiguous_wild.harness.timing import timing_of
from ambiguous_wild.methods.ablation_groups import DEFAULT, Group, Variant, choose_groups, folder_name
from ambiguous_wild.methods.describe import BACK_ENDS
from ambiguous_wild.methods.registry import MethodEntry, get_method
from ambiguous_wild.metrics import stats
from ambiguous_wild.splat.train_config import TrainConfig

_KEYS = tuple(m.key for m in METRICS)


@dataclass(frozen=True)
class PlannedVariant:
    """A variant and its cells, scene by scene and seed by seed."""

    group: str
    variant: Variant
    cells: tuple[Cell, ...]
    missing: str = ""  # why there are no cells
    same_as: str = ""  # the default, or an earlier variant, with the same settings


@dataclass(frozen=True)
class AblationStudy:
    """An ablation study, ready to run."""

    method: str
    groups: tuple[Group, ...]
    settings: tuple[str, ...]  # that replace defaults in every row
    default: tuple[Cell, ...]
    rows: tuple[PlannedVariant, ...]  # in the order of the groups; each group begins with the default

    @property
    def note(self) -> str:
        """The method's note about itself, for the options of the default rows."""
        return get_method(self.method).about([flatten(to_plain(self.default[0].options))])

    def facts(self) -> StudyFacts:
        """Return the facts in which two studies must agree before one report can hold both."""
        return {
            "method": self.method,
            "settings": list(self.settings),
            "train": to_plain(self.default[0].train) | {"seed": None},
            "scenes": list(dict.fromkeys(cell.scene.name for cell in self.default)),
            "seeds": list(dict.fromkeys(cell.train.seed for cell in self.default)),
        }

    @property
    def cells(self) -> list[Cell]:
        """The cells to train, each once, the default first."""
        unique: dict[tuple[str, str, int], Cell] = {}
        for cell in (*self.default, *(cell for row in self.rows for cell in row.cells)):
            unique.setdefault((cell.method.name, cell.scene.name, cell.train.seed), cell)
        return list(unique.values())


def plan_study(
    method: str,
    scenes: Sequence[Path],
    seeds: Sequence[int],
    train: TrainConfig,
    *,
    groups: Sequence[str] = (),
    settings: Sequence[str] = (),
    device: str = "cpu",
    factor: int | None = None,
    default_length: bool = False,
) -> AblationStudy:
    """Plan every variant on every scene with every seed; nothing is trained.

    A variant whose method, option or weights are missing becomes a row with the reason. Variants with equal
    settings share their runs, whichever groups are chosen.

    Args:
        method: a name of `aw methods` that declares ablations.
        scenes: scene folders.
        seeds: seeds of training.
        train: length and bookkeeping.
        groups: names of groups; empty = all.
        settings: "key=value", replace defaults in every row, the default row included.
        device: "cpu" or "cuda".
        factor: N of the folder images_N; None = the one that the scene was built for.
        default_length: replace `train.iterations` by each scene's default.

    Raises:
        AwError: unknown method, group, option in `settings` or scene.
    """
    entry = get_method(method)
    every = entry.ablation_groups()
    chosen = choose_groups(method, every, groups)
    own = [f"{method}.{text}" for text in settings]
    plan = functools.partial(
        plan_cells,
        scenes=scenes,
        seeds=seeds,
        train=train,
        device=device,
        factor=factor,
        default_length=default_length,
    )
    default = tuple(plan([method], settings=own))
    names = _Names(entry, default[0].options, every)
    rows = []
    for group in chosen:
        rows.append(PlannedVariant(group.name, Variant(DEFAULT), default))
        for variant in group.variants:
            try:
                if variant.method:
                    _check_features(variant)
                    host = variant.method.partition("@")[0] == method
                    given = own if host else _settings_of(variant, method, settings)
                    cells = plan([variant.method], settings=given)
                    if given or variant.settings:  # without settings the run has the method's own name
                        of_graft = variant.settings if host else ()
                        cells = _renamed(cells, variant.method, of_graft, folder_name(method, group, variant))
                    rows.append(PlannedVariant(group.name, variant, tuple(cells)))
                    continue
                options = names.options(variant)
                _check_features(variant)
            except AwError as error:
                rows.append(PlannedVariant(group.name, variant, (), missing=str(error)))
                continue
            name = names.of[config_hash(options)]
            renamed = dataclasses.replace(entry, name=name)
            cells = [dataclasses.replace(cell, method=renamed, options=options) for cell in default]
            own_name = folder_name(method, group, variant)
            same = "" if name == own_name else DEFAULT if name == method else name.partition("@")[2]
            rows.append(PlannedVariant(group.name, variant, tuple(cells), same_as=same))
    return AblationStudy(method, chosen, tuple(settings), default, tuple(rows))


def as_continued_study(study: AblationStudy, output: Path) -> AblationStudy:
    """Return the study with each cell as the continuation of its run in OUTPUT, see `as_continued`."""
    cells = {folder: as_continued(c, folder) for c in study.cells for folder in [cell_folder(output, c)]}

    def of(row: Sequence[Cell]) -> tuple[Cell, ...]:
        return tuple(cells[cell_folder(output, cell)] for cell in row)

    rows = tuple(dataclasses.replace(row, cells=of(row.cells)) for row in study.rows)
    return dataclasses.replace(study, default=of(study.default), rows=rows)


def _settings_of(variant: Variant, method: str, settings: Sequence[str]) -> list[str]:
    """Return the settings of a variant that is another method.

    They are the study's settings if the method is the donor of the graft, the study's networks if the other
    method has such options (other networks would decide the comparison), and the variant's own settings.
    """
    peer, name = get_method(variant.method), variant.method.partition("@")[0]
    shared = [f"{method}.{text}" for text in settings if peer.option_keys(method, "key")]
    options = to_plain(get_method(name).options())
    networks = [key for key in BACK_ENDS if key in options]
    nets = [f"{name}.{text}" for text in settings if text.partition("=")[0] in networks]
    return [*shared, *nets, *(f"{method}.{text}" for text in variant.settings)]


def earlier_groups(study: AblationStudy, output: Path) -> list[str]:
    """Return the groups that an earlier report in the folder has and this study lacks.

    The list is empty if the report is damaged, or of another scene, seed, length or setting.
    """
    try:
        report = json.loads((output / REPORT).read_text(encoding="utf-8"))
        same = all(report[key] == value for key, value in study.facts().items())
        names = [str(group["name"]) for group in report["groups"]] if same else []
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    declared = {group.name for group in get_method(study.method).ablation_groups()}
    return [n for n in names if n in declared and n not in {group.name for group in study.groups}]


def _renamed(cells: Sequence[Cell], method: str, settings: Sequence[str], name: str) -> list[Cell]:
    """Return cells of another method with these settings, under the given name."""
    given = {key: value for key, _, value in (setting.partition("=") for setting in settings)}
    options = with_options(cells[0].options, given, f"option of {method}")
    entry = dataclasses.replace(cells[0].method, name=name)
    return [dataclasses.replace(cell, method=entry, options=options) for cell in cells]


class _Names:
    """Names of runs by their options: a run is called after the first variant with these options.

    Groups that were not chosen are included, so that a run keeps its folder when other groups are chosen.
    """

    def __init__(self, entry: MethodEntry, default: Any, groups: Sequence[Group]) -> None:
        self.entry, self.default = entry, default
        self.of = {config_hash(default): entry.name}
        for group in groups:
            for variant in group.variants:
                if variant.method:
                    continue
                try:
                    key = config_hash(self.options(variant))
                except AwError:  # the method has no such option
                    continue
                self.of.setdefault(key, folder_name(entry.name, group, variant))

    def options(self, variant: Variant) -> Any:
        pairs = [setting.partition("=") for setting in variant.settings]
        return with_options(self.default, {key: value for key, _, value in pairs}, "option")


def _check_features(variant: Variant) -> None:
    """Raise AwError if the variant's features cannot be made: weights or a package are missing."""
    if variant.features:
        from ambiguous_wild.vision.backends import make_features

        make_features(variant.features)


@dataclass(frozen=True)
class VariantResult:
    """The result of one cell."""

    scene: str
    seed: int
    folder: Path
    result: RunResult | None  # as in metrics.json; None: failed or not run
    error: str = ""

    def value(self, metric: str) -> float | None:
        """Return one number of the run, see `METRICS`; None if it is missing."""
        if self.result is None:
            return None
        cost = self.result["cost"]
        if metric in MASK_LABELS:
            return mask_scores(self.result).get(metric)
        if metric == "total_s":
            train_s, setup_s = cost.get("train_s"), cost.get("setup_s")
            return None if train_s is None or setup_s is None else train_s + setup_s
        if metric in cost:
            return cost[metric]  # type: ignore[literal-required]
        mean = mean_of(self.result, metric)
        return None if math.isnan(mean) else mean

    @property
    def untimed(self) -> str:
        """The reason why times are not ranked; empty for a run that was alone, or has no result."""
        timing = timing_of(self.result["cost"]) if self.result else None
        return f"{timing.verdict}: {timing.reason}" if timing and timing.verdict != "alone" else ""


def read_outcomes(cells: Sequence[Cell], output: Path) -> list[VariantResult]:
    """Read the results of cells from their folders."""
    outcomes = []
    for cell in cells:
        folder = cell_folder(output, cell)
        where = (cell.scene.name, cell.train.seed, folder)
        if not (folder / RESULT).is_file() and not (folder / FAILED).is_file():
            outcomes.append(VariantResult(*where, None, "not run"))
            continue
        result = checked_result(folder)
        if result["config_hash"] != cell.identity:
            outcomes.append(VariantResult(*where, None, "a run of another configuration, left as it is"))
        elif result["status"] == "ok":
            outcomes.append(VariantResult(*where, result))
        else:
            outcomes.append(VariantResult(*where, None, str(result["error"])))
    return outcomes


def report(study: AblationStudy, output: Path, made_by: str = "") -> StudyReport:
    """Return the study as plain data: for each variant its values, differences and runs.

    Args:
        study: the study; its runs may be unfinished.
        output: the folder of its runs.
        made_by: the command that makes the report again.
    """
    default = read_outcomes(study.default, output)
    rows = [_row(row, read_outcomes(row.cells, output), default) for row in study.rows]
    for row in rows:
        if row["variant"] == DEFAULT:
            of = [other for other in rows if other["group"] == row["group"] and other is not row]
            row["settings"] = _default_value(study, [other["settings"] for other in of])
    return {
        "schema": 1,
        "made_by": made_by,
        "note": study.note,
        **study.facts(),
        "groups": [{"name": g.name, "title": g.title, "source": g.source} for g in study.groups],
        "rows": rows,
    }


def _row(row: PlannedVariant, outcomes: list[VariantResult], default: list[VariantResult]) -> VariantRow:
    failed = [o for o in outcomes if o.result is None]
    status: Literal["ok", "failed", "missing"] = "missing" if row.missing else "failed" if failed else "ok"
    reason = row.missing or "; ".join(dict.fromkeys(f"{o.scene}, seed {o.seed}: {o.error}" for o in failed))
    values = {key: _summary([o.value(key) for o in outcomes]) for key in _KEYS}
    pairs = list(zip(outcomes, default, strict=False))
    differences = {m.key: _summary([_minus(m, o, d) for o, d in pairs]) for m in DIFFERENCES}
    return {
        "group": row.group,
        "variant": row.variant.name,
        "settings": [*row.variant.settings, *_networks(row)],
        "text": row.variant.text,
        "status": status,
        "reason": reason,
        "same_as": row.same_as,
        "values": values,
        "differences": differences,
        "runs": [_run_row(outcome) for outcome in outcomes],
    }


def _minus(m: Measure, o: VariantResult, default: VariantResult) -> float | None:
    """Return the difference of two runs; None if a value is missing, or a time cannot be compared."""
    a, b = o.value(m.key), default.value(m.key)
    return None if a is None or b is None or (m.timed and (o.untimed or default.untimed)) else a - b


def _run_row(o: VariantResult) -> Facts:
    row: Facts = {"scene": o.scene, "seed": o.seed, "folder": str(o.folder), "error": o.error or None}
    return row | {"untimed": o.untimed} | {key: o.value(key) for key in _KEYS}


def _networks(row: PlannedVariant) -> list[str]:
    """Return the features and instances of a variant that is another method."""
    if not row.variant.method or not row.cells:
        return []
    options = to_plain(row.cells[0].options)
    return [f"{key}={options[key]}" for key in BACK_ENDS if key in options]


def _default_value(study: AblationStudy, settings: Sequence[Sequence[str]]) -> list[str]:
    """Return KEY=VALUE of the default where the variants are values of this one option."""
    keys = {setting.partition("=")[0] for of in settings for setting in of}
    options = flatten(to_plain(study.default[0].options))
    if len(keys) != 1 or any(len(of) != 1 for of in settings) or not keys <= options.keys():
        return []
    (key,) = keys
    return [f"{key}={option_text(options[key])}"]


def _summary(values: list[float | None]) -> SummaryRecord:
    numbers = [math.nan if v is None else float(v) for v in values]
    mean, spread = stats.mean(numbers), stats.sample_std(numbers)
    return {"mean": _number(mean), "spread": _number(spread)}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
