"""Choose the effects that each method trains with, from `--effects` and the plan of the scene.

Imports no torch before a plan is needed: a misspelt name is answered at once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.harness.running.published import published_effects
from ambiguous_wild.methods.registry import MethodEntry
from ambiguous_wild.splat.effects import ALL, DEGREES, check_effects

if TYPE_CHECKING:
    from ambiguous_wild.harness.planning.decide import Plan
    from ambiguous_wild.splat.pace import TrainConfig

WORDS = ("default", "auto", "none", "all")
PLANNED = ("default", "auto")  # the plan of the scene decides


@dataclass(frozen=True)
class Chosen:
    """The effects of one run, and why these."""

    effects: tuple[str, ...] = ()
    asked: str = ""  # empty: no effects were asked for, and no effects.json is written
    plan: Plan | None = None

    def write(self, path: Path) -> None:
        """effects.json of the run."""
        if not self.asked:
            return
        from ambiguous_wild.io.atomic import write_json

        plan = None if self.plan is None else self.plan.plain()
        write_json(path, {"schema": 1, "asked": self.asked, "effects": list(self.effects), "plan": plan})


@dataclass(frozen=True)
class Probing:
    """How a plan is made from probes: for which run, and where they are kept."""

    train: TrainConfig  # length of the runs
    folder: Path
    prepare: Callable[[], None]  # makes the CPU kernels ready
    say: Callable[[str], None]  # told every decision


def check_wanted(wanted: str) -> tuple[str, ...]:
    """The names in a list of effects, in the order in which they act; none for a word such as "auto".

    Raises:
        AwError: no word and no list of effects.
    """
    if wanted in WORDS:
        return ()
    names = [name.strip() for name in wanted.split(",") if name.strip()]
    if not names:
        raise AwError("--effects is empty: write auto, none, all, or names with commas (docs/effects.md)")
    mixed = [name for name in names if name in WORDS]
    if mixed:
        raise AwError(f"--effects {wanted!r}: {mixed[0]!r} stands alone")
    return check_effects(names)


def choose(
    wanted: str,
    scene: Scene,
    methods: Sequence[MethodEntry],
    plan: Plan | None = None,
    probing: Probing | None = None,
) -> dict[str, Chosen]:
    """What every method trains with on this scene, by its name.

    Args:
        wanted: as `--effects` takes it; "default" is auto for the methods that allow effects, of those alone.
        scene: the scene.
        methods: the methods.
        plan: made before; None = made now if any method needs it.
        probing: for a plan that is made now; None = the limits decide alone.

    Raises:
        AwError: unknown effect, or a plan of another scene.
    """
    named = check_wanted(wanted)
    if plan is not None and plan.scene != scene.name:
        raise AwError(f"the plan is of scene {plan.scene}, not of {scene.name}: run 'aw plan {scene.root}'")
    if wanted not in PLANNED:
        effects = ALL if wanted == "all" else named
        return {m.name: Chosen(effects, "" if wanted == "none" else wanted) for m in methods}
    if plan is None and any(reads_plan(wanted, method) for method in methods):
        plan = _make_plan(scene, probing)
    found = None if plan is None else plan.effects()
    chosen = {m.name: chosen_by(found, wanted, scene, m) or Chosen() for m in methods}
    return {name: dataclasses.replace(c, plan=plan if c.asked else None) for name, c in chosen.items()}


def chosen_by(planned: Sequence[str] | None, wanted: str, scene: Scene, method: MethodEntry) -> Chosen | None:
    """What one method trains with where a plan decides; nothing is planned.

    Args:
        planned: effects that the plan of the scene calls for; None = there is no plan.
        wanted: one of `PLANNED`.
        scene: the scene.
        method: the method.

    Returns:
        None where the method needs a plan and there is none.

    Raises:
        AwError: unknown effect.
    """
    among = _allowed(wanted, method)
    if among == ():
        return Chosen()
    if planned is None:
        return None
    found = [*planned, *published_effects(scene)]
    return Chosen(check_effects(e for e in found if among is None or e in among), "auto")


def reads_plan(wanted: str, method: MethodEntry) -> bool:
    """Whether a plan decides about anything where `--effects` says this."""
    return wanted in PLANNED and _allowed(wanted, method) != ()


def _allowed(wanted: str, method: MethodEntry) -> tuple[str, ...] | None:
    """The effects among which a plan chooses; None = all."""
    # a graft takes none: its name says all that it is made of
    return None if wanted == "auto" else method.auto_effects


def _make_plan(scene: Scene, probing: Probing | None) -> Plan:
    if probing is None:
        from ambiguous_wild.harness.planning.decide import plan_without_training
        from ambiguous_wild.harness.planning.tried import untried

        return untried(plan_without_training(scene), "no probes were asked for")
    from ambiguous_wild.harness.planning.probed import plan_with_probes

    plan = plan_with_probes(
        scene, probing.train, probing.folder, masks=False, prepare=probing.prepare, say=probing.say
    )
    if plan.cost is not None:
        probing.say(f"{scene.name}: {plan.cost.line()}")
    return plan


def describe(effects: Sequence[str]) -> str:
    """For a line of text."""
    return ", ".join(f"SH degree {DEGREES[e]}" if e in DEGREES else e for e in effects) or "none"
