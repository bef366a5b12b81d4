"""Choose the effects that each method trains with, from `--effects`, the plan and scene.json.

Imports no torch before a plan is needed: a misspelt name is answered at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.methods.registry import MethodEntry
from ambiguous_wild.splat.effects import ALL, check_effects

if TYPE_CHECKING:
    from ambiguous_wild.harness.effects_plan import EffectsPlan

MIXED = "test photos may hold distractors"  # begins the note on such a scene in results, tables and pages
WORDS = ("auto", "none", "all")
EXTERNAL_NO_EFFECTS = (
    "an external program takes none"  # why a method trains without the effects that others have
)


def scene_protocol(scene: Scene) -> Literal["full", "half"]:
    """Return which part of a test photo is measured, from scene.json.

    Raises:
        AwError: scene.json names a protocol that does not exist.
    """
    protocol = _evaluation(scene).get("protocol", "full")
    if protocol not in ("full", "half"):
        raise AwError(
            f"{scene.root}: scene.json has the protocol {str(protocol)[:40]!r}; it must be full or half"
        )
    return protocol


def published_effects(scene: Scene) -> tuple[str, ...]:
    """Return the effects that are fitted to a test photo, from scene.json.

    Raises:
        AwError: scene.json names an effect that does not exist.
    """
    names = _evaluation(scene).get("effects", [])
    return check_effects(str(name) for name in names) if isinstance(names, list) else ()


def _evaluation(scene: Scene) -> Mapping[str, object]:
    section = scene.info.get("evaluation")
    return section if isinstance(section, dict) else {}


def mixed_tests(scene: Scene) -> str:
    """Return a note for a scene whose test photos were not chosen as clean; empty for every other scene.

    Where `aw build-scene` is given no test photos, every 8th photo tests, and scene.json says so.
    """
    split = str(scene.info.get("split", ""))
    if not split.startswith("every-"):
        return ""
    every = split.removeprefix("every-")
    return f"{MIXED}: every {every}th photo is a test photo, and everything in it counts as truth"


@dataclass(frozen=True)
class ChosenEffects:
    """The effects of one run, with the request and the plan behind them."""

    effects: tuple[str, ...] = ()
    asked: str = ""  # empty: no effects were asked for, and no effects.json is written
    plan: EffectsPlan | None = None

    def write(self, path: Path) -> None:
        """Write effects.json of the run."""
        if not self.asked:
            return
        from ambiguous_wild.io.files import write_json

        plan = None if self.plan is None else self.plan.plain()
        write_json(path, {"schema": 1, "asked": self.asked, "effects": list(self.effects), "plan": plan})


def parse_effects(wanted: str) -> tuple[str, ...]:
    """Return the effects that the text names, in the order in which they act; none for "auto" and "none".

    Raises:
        AwError: the text is neither such a word nor a list of effects.
    """
    if wanted in WORDS:
        return ALL if wanted == "all" else ()
    names = [name.strip() for name in wanted.split(",") if name.strip()]
    if not names:
        raise AwError("--effects is empty: write auto, none, all, or names with commas (docs/effects.md)")
    mixed = [name for name in names if name in WORDS]
    if mixed:
        raise AwError(f"--effects {wanted!r}: {mixed[0]!r} cannot be combined with other names")
    return check_effects(names)


def takes_effects(method: MethodEntry) -> bool:
    """Return whether the method takes effects: they are parts of our trainer, which programs do not use."""
    return method.program is None
