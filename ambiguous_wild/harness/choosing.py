"""Choose the effects that each method trains with, from `--effects`, the plan and scene.json.

Imports no torch before a plan is needed: a misspelt name is answered at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.methods.registry import MethodEntry
from ambiguous_wild.splat.effects import DEGREES, check_effects

if TYPE_CHECKING:
    from ambiguous_wild.harness.effects_plan import Plan


def scene_protocol(scene: Scene) -> Literal["full", "half"]:
    """Which part of a test photo is measured.

    Raises:
        AwError: scene.json names a protocol that does not exist.
    """
    protocol = _evaluation(scene).get("protocol", "full")
    if protocol not in ("full", "half"):
        raise AwError(
            f"{scene.root}: scene.json has the protocol {str(protocol)[:40]!r}; full and half are known"
        )
    return protocol


def published_effects(scene: Scene) -> tuple[str, ...]:
    """The effects that are fitted to a test photo.

    Raises:
        AwError: scene.json names an effect that does not exist.
    """
    names = _evaluation(scene).get("effects", [])
    return check_effects(str(name) for name in names) if isinstance(names, list) else ()


def _evaluation(scene: Scene) -> Mapping[str, Any]:
    known = scene.info.get("evaluation")
    return known if isinstance(known, dict) else {}


MIXED = "test photos may hold distractors"  # begins what results, tables and pages say of such a scene


def mixed_tests(scene: Scene) -> str:
    """What to say of a scene whose test photos nobody chose as clean; empty for every other.

    Where `aw build-scene` is given no test photos, every 8th photo tests, and scene.json says so.
    """
    split = str(scene.info.get("split", ""))
    if not split.startswith("every-"):
        return ""
    return f"{MIXED}: every {split.removeprefix('every-')}th photo tests, and what is in it counts as truth"


WORDS = ("auto", "none", "all")
NOT_OURS = "an external program takes none"  # why a method trains without the effects of its bench


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
        from ambiguous_wild.io.files import write_json

        plan = None if self.plan is None else self.plan.plain()
        write_json(path, {"schema": 1, "asked": self.asked, "effects": list(self.effects), "plan": plan})


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


def chosen_by(planned: Sequence[str], scene: Scene, method: MethodEntry) -> Chosen:
    """What one method trains with under `--effects auto`: the same for all that can take effects.

    Args:
        planned: effects that the plan of the scene calls for.
        scene: the scene.
        method: the method.

    Raises:
        AwError: unknown effect.
    """
    if not takes_effects(method):
        return Chosen()
    return Chosen(check_effects([*planned, *published_effects(scene)]), "auto")


def takes_effects(method: MethodEntry) -> bool:
    """Whether the method trains on our trainer: effects are parts of that, and a program has its own."""
    return method.program is None


def describe(effects: Sequence[str]) -> str:
    """For a line of text."""
    return ", ".join(f"SH degree {DEGREES[e]}" if e in DEGREES else e for e in effects) or "none"
