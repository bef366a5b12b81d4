"""Recommend a method and settings for a scene and a training time, from measured runs of other scenes.

A setting is a method with its options, effects, resolution and number of Gaussians. Its PSNR at a time is
interpolated between the lengths that were run on a scene, linearly over log time. Scenes differ by more than
settings do, so PSNR is split into a part of the scene and a part of the setting (least squares over all
measured pairs), and the setting with the highest part is recommended. If the scene itself was measured, only
its own runs are used.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.harness.command_lines import length_options
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.metrics import stats
from ambiguous_wild.report.cost_curves import Curve, curves_of, duration, scenes_of, summary
from ambiguous_wild.report.cost_runs import CostRun, CostRuns, why_unranked

CLOSE_DB = 0.3  # a setting this near the best is marked as equally good
_TAKEN = (  # options of a run's command that belong to its setting
    "--method", "--effects", "--resolution", "--max-gaussians", "--set", "--plugin", "--device", "--start",
    "--protocol", "--factor",
)  # fmt: skip


@dataclass(frozen=True)
class Choice:
    """A setting, and its quality and cost within the budget."""

    name: str  # of the curve: the method, and settings that differ between the runs
    method: str
    behind: float  # dB below the best setting; 0.0 for the best
    spread: float  # sample deviation over scenes of the residual of both parts; NaN for one scene
    psnr: float  # dB: of the scene itself if it was measured, else the mean over the scenes of its runs
    scenes: int
    seconds: float  # of training: the budget, or the longest measured training if that is shorter
    setup_s: float
    ms_per_iteration: float
    gaussians: float
    model_mb: float
    words: tuple[str, ...]  # arguments of `aw bench`, without scene and length


@dataclass(frozen=True)
class Recommendation:
    """Settings in order of merit; the first is the recommended one."""

    scene: str
    budget_s: float  # of this machine
    reference_s: float  # the budget in the seconds of the runs
    own: bool  # the scene itself was measured
    choices: tuple[Choice, ...]
    notes: tuple[str, ...]

    def command(self, scene: str) -> str:
        """Return the command that trains the recommended setting."""
        length = length_options(None, self.budget_s)
        return shlex.join(["aw", "bench", *self.choices[0].words, "--scene", scene, *length])


def recommend(
    runs: Sequence[CostRun], scene: str, budget_s: float, *, speed: float = 1.0, scene_hash: str = ""
) -> Recommendation:
    """Rank the settings for a scene, the best first.

    Args:
        runs: runs from `read_cost_runs`; those that were not alone are used only if no run was alone.
        scene: name of the scene.
        budget_s: seconds of training on this machine.
        speed: seconds of the runs per second of this machine, see `speed_here`.
        scene_hash: hash of the scene, to find its own runs; empty = they are found by name.

    Raises:
        AwError: no setting was trained within the budget.
    """
    usable = [
        run for run in runs if not run.error and math.isfinite(run.psnr) and not knows_truth(run.method)
    ]
    if not usable and any(knows_truth(run.method) for run in runs):
        raise AwError("all runs know the truth (references), which no capture has: add runs of a method")
    if apart := sorted({run.apart for run in usable if run.apart}):
        raise AwError(f"nothing can be recommended: {apart[0]}; give folders of comparable runs")
    alone = [run for run in usable if run.timing.verdict == "alone"]
    notes = []
    if len(alone) < len(usable):
        use = "left out" if alone else "used, because no run was alone"
        notes.append(f"runs that were not alone, {use}: {why_unranked(usable)}")
    usable = alone or usable
    own = [run for run in usable if (run.scene_hash == scene_hash if scene_hash else run.scene == scene)]
    reference = budget_s * speed
    values = values_within(own or usable, reference)
    if not values:
        shortest = min((run.train_s for run in usable), default=math.nan)
        raise AwError(
            f"no run was trained within {reference:.0f} s (the shortest took {shortest:.0f} s): "
            "ask for a longer time, or add runs with a shorter one: aw bench --budget 30s"
        )
    measured, values = values, comparable(values)
    if apart := sorted({name for name, _ in measured} - {name for name, _ in values}):
        notes.append(f"not compared, as they share no scene with the others: {shortlist(apart)}")
    parts, rest = additive(values)
    if own and len(values) < 2:
        notes.append(f"{scene} was measured with one setting only")
    order = sorted(parts, key=lambda name: -parts[name])
    best = parts[order[0]]
    curves = grouped(curves_of(own or usable), lambda curve: curve.name)
    choices = tuple(
        _choice(curves[name], best - parts[name], rest[name], values, reference) for name in order
    )
    return Recommendation(scene, budget_s, reference, bool(own), choices, tuple(notes))


def value_at(curves: Sequence[Curve], scene: str, seconds: float) -> float:
    """Return the PSNR in dB of a setting after `seconds` of training, mean over seeds; NaN if not measured.

    It is interpolated between two lengths, linearly over log time, and constant after the longest.
    """
    ends = sorted(
        (summary(c, (scene,), lambda run: run.train_s).mean, c.end(scene)) for c in curves if c.on(scene)
    )
    ends = [(at, psnr) for at, psnr in ends if math.isfinite(at) and math.isfinite(psnr) and at > 0.0]
    # trainings end up to a step after the budget, and a machine's speed is known to some percent
    if not any(at <= 1.05 * seconds for at, _ in ends):
        return math.nan
    at, psnr = np.log([end[0] for end in ends]), np.array([end[1] for end in ends])
    return float(np.interp(math.log(seconds), at, psnr))


def comparable(values: dict[tuple[str, str], float]) -> dict[tuple[str, str], float]:
    """Return the largest part of the PSNR by (setting, scene) whose settings common scenes connect."""
    parts: list[set[tuple[str, str]]] = []
    for key in values:
        joined = [part for part in parts if any(key[0] == n or key[1] == s for n, s in part)]
        parts = [part for part in parts if part not in joined] + [{key}.union(*joined)]
    largest = max(parts, key=len)
    return {key: value for key, value in values.items() if key in largest}


def additive(values: dict[tuple[str, str], float]) -> tuple[dict[str, float], dict[str, float]]:
    """Split PSNR by (setting, scene) into a part of the setting plus a part of the scene, by least squares.

    Returns:
        The part of each setting in dB, up to a constant; and the sample deviation over scenes of the
        residual, NaN for a setting with one scene.
    """
    names, scenes = (sorted({key[k] for key in values}) for k in range(2))
    rows = np.zeros((len(values), len(names) + len(scenes)))
    for k, (name, scene) in enumerate(values):
        rows[k, names.index(name)] = rows[k, len(names) + scenes.index(scene)] = 1.0
    parts = np.linalg.lstsq(rows, np.array(list(values.values())), rcond=None)[0]
    residual = np.array(list(values.values())) - rows @ parts
    spread = {
        name: stats.sample_std([float(x) for x, key in zip(residual, values) if key[0] == name])
        for name in names
    }
    return dict(zip(names, map(float, parts))), spread


def values_within(runs: Sequence[CostRun], seconds: float) -> dict[tuple[str, str], float]:
    """Return the PSNR that is reached within `seconds`, by (name of the setting, scene)."""
    values = {}
    for name, curves in grouped(curves_of(runs), lambda curve: curve.name).items():
        for scene in scenes_of(curves):
            value = value_at(curves, scene, seconds)
            if math.isfinite(value):
                values[name, scene] = value
    return values


def _choice(
    curves: Sequence[Curve], behind: float, rest: float, values: dict[tuple[str, str], float], seconds: float
) -> Choice:
    within = [curve for curve in curves if curve.trained_s <= 1.05 * seconds]
    nearest = max(within or curves[:1], key=lambda curve: curve.trained_s)
    name, run = nearest.name, nearest.runs[0]
    own = [value for (setting, _), value in values.items() if setting == name]

    keys = ("ms_per_iteration", "gaussians", "model_mb")
    ms, gaussians, model_mb = (stats.mean([run.numbers[key] for run in nearest.runs]) for key in keys)
    longest = max(curve.trained_s for curve in curves)
    return Choice(
        name,
        nearest.method,
        behind,
        rest,
        stats.mean(own),
        len(own),
        min(seconds, longest),
        stats.mean([run.setup_s for run in nearest.runs]),
        ms,
        gaussians,
        model_mb,
        words_of(run),
    )


def words_of(run: CostRun) -> tuple[str, ...]:
    """Return the arguments of a run's command that make its setting, without scene, seed and length."""
    try:
        arguments = shlex.split(run.reproduce)[2:]
    except ValueError:  # not a command that this program wrote
        arguments = []
    kept: list[str] = []
    for flag, value in zip(arguments[::2], arguments[1::2]):
        if flag in _TAKEN:
            kept += [flag, run.asked if flag == "--effects" and run.asked in ("auto", "all") else value]
    if "--method" not in kept:
        effects = run.asked or ",".join(sorted(run.effects)) or "none"
        kept = ["--method", run.method, "--effects", effects]
    return tuple(kept)


def in_words(recommendation: Recommendation, scene: str) -> str:
    """Return the recommendation as text for a terminal."""
    best = recommendation.choices[0]
    machine = f"{duration(recommendation.budget_s)} on this machine"
    if not math.isclose(recommendation.reference_s, recommendation.budget_s, rel_tol=0.005):
        machine += f" ({duration(recommendation.reference_s)} of the reference machine)"
    where = "measured on this scene" if recommendation.own else f"mean over {best.scenes} measured scenes"
    lines = [
        f"for {recommendation.scene} within {machine}: {best.name}",
        f"  {recommendation.command(scene)}",
        _known(
            f"  PSNR {best.psnr:.2f} dB ({where})",
            (best.ms_per_iteration, "{:.1f} ms/iteration"),
            *_size(best),
            (best.setup_s, "set-up {:.1f} s"),
        ),
    ]
    for other in recommendation.choices[1:]:
        close = " (within the noise of a scene)" if other.behind < CLOSE_DB else ""
        lines.append(_known(f"  {other.name}: {other.behind:.2f} dB less{close}", *_size(other)))
    return "\n".join([*lines, *recommendation.notes]) + "\n"


def _size(choice: Choice) -> tuple[tuple[float, str], ...]:
    return (choice.gaussians, "{:,.0f} Gaussians"), (choice.model_mb, "{:.1f} MB")


def _known(first: str, *more: tuple[float, str]) -> str:
    """Return the values in their formats; an external program may not report all of them."""
    return ", ".join([first, *(form.format(value) for value, form in more if math.isfinite(value))])


def speed_here(cost_runs: CostRuns) -> float:
    """Return the reference seconds per second of this machine, by the calibration of the runs.

    Args:
        cost_runs: the runs; their kernel decides on which device this machine is measured.

    Raises:
        AwError: the runs used a GPU, and this machine has none that can be used.
    """
    import torch

    from ambiguous_wild.harness.timing import slowness
    from ambiguous_wild.splat.calibration import KERNELS, prepare_cpu
    from ambiguous_wild.splat.readiness import choose_device

    kernels = {run.timing.kernel for run in cost_runs.runs if not run.error}
    device = next((device for device, size in KERNELS.items() if size.name in kernels), "cpu")
    if device == "cpu":
        prepare_cpu(None)
        torch.set_num_threads(1)
    else:
        choose_device("cuda", lambda text: None)
    return 1.0 / slowness(device)
