"""The commands that make a scene again in an empty folder, from what the scene records of itself."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.simulate.presets import PRESETS, resized
from ambiguous_wild.simulate.spec_file import plain_spec

# options of `aw build-scene`
FLAGS = ("camera", "matcher", "mapper", "max_features", "seed", "masks_missing", "sfm")


def preparation(scene: Scene | None) -> list[str]:
    """`aw simulate` and `aw build-scene` for a simulated scene; empty where photos cannot be made again.

    Args:
        scene: of a run; None: not at hand.
    """
    truth = _read(scene.root / "truth" / "capture.json") if scene is not None else {}
    settings = scene.info.get("settings") if scene is not None else None
    if scene is None or not truth or not isinstance(settings, dict):
        return []
    simulate = _simulate(truth, scene.name)
    raw = f"raw/{scene.name}"
    return [*simulate, shlex.join(_build(raw, scene.name, settings))] if simulate else []


def _read(path: Path) -> dict[str, Any]:
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return facts if isinstance(facts, dict) else {}


def _simulate(truth: Mapping[str, Any], name: str) -> list[str]:
    """By its preset where that gives the same spec; else the spec itself, as a file."""
    spec, seed = truth.get("spec"), truth.get("seed")
    if not isinstance(spec, dict) or not isinstance(seed, int):
        return []
    end = [*(["--seed", str(seed)] if seed else []), "-o", f"raw/{name}"]
    known = PRESETS.get(str(truth.get("preset")))
    if known is not None:
        views = spec.get("train_views") if spec.get("train_views") != known.train_views else None
        width = spec.get("width") if spec.get("width") != known.width else None
        try:
            same = json.loads(json.dumps(plain_spec(resized(known, views, width)))) == spec
        except (AwError, TypeError):
            same = False
        if same:
            size = [*(["--views", str(views)] if views else []), *(["--width", str(width)] if width else [])]
            return [shlex.join(["aw", "simulate", known.name, *size, *end])]
    file = f"{name}.yaml"
    text = json.dumps(spec, ensure_ascii=True)  # JSON is YAML
    return [
        f"printf %s {shlex.quote(text)} > {shlex.quote(file)}",
        shlex.join(["aw", "simulate", f"./{file}", *end]),
    ]


def _build(raw: str, name: str, settings: Mapping[str, Any]) -> list[str]:
    usual = {f.name: f.default for f in fields(BuildSettings)}
    settings = {"sfm": "thorough", **settings}  # the only way there was before scenes recorded it
    words = ["aw", "build-scene", raw, "-o", name]
    if settings.get("factor") is not None:
        words += ["--factor", str(settings["factor"])]
    for key in FLAGS:
        if key in settings and settings[key] != usual[key]:
            words += [f"--{key.replace('_', '-')}", str(settings[key])]
    return words + (["--strict"] if settings.get("strict") else [])
