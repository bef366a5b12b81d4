"""How the papers of a scene's dataset measure, as scene.json states it under "evaluation"."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.splat.effects import check_effects


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
