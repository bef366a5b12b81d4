"""Which method and settings to train a scene with for a given time, from measured runs of other scenes.

A setting is a method with its options, effects, resolution and number of Gaussians. Its PSNR for a time is
that of its trainings on each scene, on straight lines over log time between the lengths that were run. Scenes
differ by more than settings do, so PSNR is split into a part of the scene and a part of the setting (least
squares over all pairs that were measured); the setting of the highest part is recommended. A scene that was
measured itself is judged by its own runs.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.metrics import stats
from ambiguous_wild.report.cost_curves import Curve, curves_of, summary
from ambiguous_wild.report.cost_read import CostRun, CostRuns, why_unranked

CLOSE_DB = 0.3  # a setting this near the best is told as an alternative
_TAKEN = ("--method", "--effects", "--resolution", "--max-gaussians", "--set", "--plugin", "--device")


@dataclass(frozen=True)
class Choice:
    """A setting and what it is worth within the budget."""

    name: str  # of the curve: the method, and settings that differ between the runs
    method: str
    behind: float  # dB behind the best setting; 0.0 for it
    spread: (
        float  # sample deviation over scenes of what the scene's and the setting's part leave; NaN for one
    )
    psnr: float  # dB: of the scene itself where it was measured, else the mean over the scenes of its runs
    scenes: int
    seconds: float  # of training: the budget, or the longest training of it that was measured
    setup_s: float
    ms_per_iteration: float
    gaussians: float
    model_mb: float
    words: tuple[str, ...]  # of `aw bench`, without scene and length


@dataclass(frozen=True)
class Recommendation:
    """Settings in order of merit; the first is the recommended one."""

    scene: str
    budget_s: float  # of this machine
    reference_s: float  # the same in the seconds of the runs
    own: bool  # the scene itself was measured
    choices: tuple[Choice, ...]
    notes: tuple[str, ...]

    def command(self, scene: str) -> str:
        """The command that trains the recommended setting."""
        budget = f"{self.budget_s:.6f}".rstrip("0").rstrip(".") + "s"
        return shlex.join(["aw", "bench", *self.choices[0].words, "--scene", scene, "--budget", budget])


def recommend(
    runs: Sequence[CostRun], scene: str, budget_s: float, *, speed: float = 1.0, scene_hash: str = ""
) -> Recommendation:
    """The settings for a scene, the best first.

    Args:
        runs: from `read_cost_runs`; those that were not alone count only where no other was.
        scene: its name.
        budget_s: seconds of training on this machine.
        speed: seconds of the runs in a second of this machine (reference seconds: its calibration).
        scene_hash: of the scene, to know its own runs by; empty = by name.

    Raises:
        AwError: no setting was trained within the budget.
    """
    usable = [
        run for run in runs if not run.error and math.isfinite(run.psnr) and not knows_truth(run.method)
    ]
    alone = [run for run in usable if run.timing.verdict == "alone"]
    notes = []
    if len(alone) < len(usable):
        left = "left out" if alone else "all of them, used all the same"
        notes.append(f"runs that were not alone, {left}: {why_unranked(usable)}")
    usable = alone or usable
    own = [run for run in usable if (run.scene_hash == scene_hash if scene_hash else run.scene == scene)]
    reference = budget_s * speed
    values = values_within(own or usable, reference)
    if not values:
        shortest = min((run.train_s for run in usable), default=math.nan)
        raise AwError(
            f"no run was trained within {reference:.0f} s (the shortest took {shortest:.0f} s): "
            "give a longer --budget, or runs of a shorter one: aw bench --budget 30s"
        )
    parts, rest = additive(values)
    if own and len(values) < 2:
        notes.append(f"{scene} was measured with one setting only")
    order = sorted(parts, key=lambda name: -parts[name])
    best = parts[order[0]]
    curves = _curves_by_name(own or usable)
    choices = tuple(
        _choice(curves[name], best - parts[name], rest[name], values, reference) for name in order
    )
    return Recommendation(scene, budget_s, reference, bool(own), choices, tuple(notes))


def value_at(curves: Sequence[Curve], scene: str, seconds: float) -> float:
    """PSNR in dB of a setting after `seconds` of training on a scene, mean over seeds; NaN if not measured.

    Between two lengths on a straight line over log time; after the longest as the longest.
    """
    ends = sorted(
        (summary(c, (scene,), lambda run: run.train_s).mean, summary(c, (scene,), lambda run: run.psnr).mean)
        for c in curves
        if c.on(scene)
    )
    ends = [(at, psnr) for at, psnr in ends if math.isfinite(at) and math.isfinite(psnr) and at > 0.0]
    # a budget is met to within a step, and a machine's speed to within some percent
    early = [end for end in ends if end[0] <= 1.05 * seconds]
    if not early:
        return math.nan
    at, psnr = np.log([end[0] for end in ends]), np.array([end[1] for end in ends])
    return float(np.interp(math.log(seconds), at, psnr))


def additive(values: dict[tuple[str, str], float]) -> tuple[dict[str, float], dict[str, float]]:
    """PSNR by (setting, scene) as a part of the setting plus a part of the scene, by least squares.

    Returns:
        The part of each setting in dB, up to a constant; and the sample deviation over scenes of what both
        parts leave, NaN for a setting of one scene.
    """
    names, scenes = (sorted({key[k] for key in values}) for k in range(2))
    rows = np.zeros((len(values), len(names) + len(scenes)))
    for k, (name, scene) in enumerate(values):
        rows[k, names.index(name)] = rows[k, len(names) + scenes.index(scene)] = 1.0
    found = np.linalg.lstsq(rows, np.array(list(values.values())), rcond=None)[0]
    left = np.array(list(values.values())) - rows @ found
    rest = {
        name: stats.spread([float(x) for x, key in zip(left, values) if key[0] == name]) for name in names
    }
    return dict(zip(names, map(float, found))), rest


def values_within(runs: Sequence[CostRun], seconds: float) -> dict[tuple[str, str], float]:
    """PSNR within so many seconds, by (name of the setting, scene)."""
    found = {}
    for name, curves in _curves_by_name(runs).items():
        for scene in sorted({s for curve in curves for s in curve.scenes}):
            value = value_at(curves, scene, seconds)
            if math.isfinite(value):
                found[name, scene] = value
    return found


def _curves_by_name(runs: Sequence[CostRun]) -> dict[str, list[Curve]]:
    found: dict[str, list[Curve]] = {}
    for curve in curves_of(runs):
        found.setdefault(curve.name, []).append(curve)
    return found


def _choice(
    curves: Sequence[Curve], behind: float, rest: float, values: dict[tuple[str, str], float], seconds: float
) -> Choice:
    within = [curve for curve in curves if curve.trained_s <= 1.05 * seconds]
    nearest = max(within or curves[:1], key=lambda curve: curve.trained_s)
    name, run = nearest.name, nearest.runs[0]
    own = [value for (setting, _), value in values.items() if setting == name]

    def mean(key: str) -> float:
        return stats.mean([run.numbers[key] for run in nearest.runs])

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
        mean("ms_per_iteration"),
        mean("gaussians"),
        mean("model_mb"),
        words_of(run),
    )


def words_of(run: CostRun) -> tuple[str, ...]:
    """What of a run's command makes its setting: neither scene, seed nor length."""
    try:
        said = shlex.split(run.reproduce)[2:]
    except ValueError:  # not a command of ours
        said = []
    kept: list[str] = []
    for flag, value in zip(said[::2], said[1::2]):
        if flag in _TAKEN:
            kept += [flag, run.asked if flag == "--effects" and run.asked in ("auto", "all") else value]
    if "--method" not in kept:
        effects = run.asked or ",".join(sorted(run.effects)) or "none"
        kept = ["--method", run.method, "--effects", effects]
    return tuple(kept)


def in_words(found: Recommendation, scene: str) -> str:
    """The recommendation for a terminal."""
    best = found.choices[0]
    machine = f"{_time(found.budget_s)} on this machine"
    if not math.isclose(found.reference_s, found.budget_s, rel_tol=0.005):
        machine += f" ({_time(found.reference_s)} of the reference machine)"
    where = "measured on this scene" if found.own else f"mean over {best.scenes} measured scenes"
    lines = [
        f"for {found.scene} within {machine}: {best.name}",
        f"  {found.command(scene)}",
        f"  PSNR {best.psnr:.2f} dB ({where}), {best.ms_per_iteration:.1f} ms/iteration, "
        f"{best.gaussians:,.0f} Gaussians, {best.model_mb:.1f} MB, set-up {best.setup_s:.1f} s",
    ]
    for other in found.choices[1:]:
        close = " (within the noise of a scene)" if other.behind < CLOSE_DB else ""
        lines.append(
            f"  {other.name}: {other.behind:.2f} dB less{close}, {other.gaussians:,.0f} Gaussians, "
            f"{other.model_mb:.1f} MB"
        )
    return "\n".join([*lines, *found.notes]) + "\n"


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.3g} min"


def speed_here(found: CostRuns, say: Callable[[str], None] = lambda text: None) -> float:
    """Reference seconds in a second of this machine, by the calibration that the runs were timed with.

    Args:
        found: the runs; their kernel says on which device.
        say: told when kernels have to be compiled first.

    Raises:
        AwError: the runs are of a GPU, and there is none here that can be used.
    """
    import torch

    from ambiguous_wild.harness.timing import slowness
    from ambiguous_wild.splat.calibration import KERNELS, prepare_cpu
    from ambiguous_wild.splat.readiness import choose

    kernels = {run.timing.kernel for run in found.runs if not run.error}
    device = next((device for device, size in KERNELS.items() if size.name in kernels), "cpu")
    if device == "cpu":
        prepare_cpu(None, say)
        torch.set_num_threads(1)
    else:
        choose("cuda", say)
    return 1.0 / slowness(device)
