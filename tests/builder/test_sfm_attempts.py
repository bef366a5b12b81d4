"""Structure from motion works harder only where photos are left out."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ambiguous_wild.builder import stages
from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.builder.stages import SfmStages, Stages
from tests.builder.capture_maker import write_capture


def attempts(monkeypatch: pytest.MonkeyPatch, placed: dict[str, int], photos: int) -> tuple[list[str], Any]:
    """The plans that were tried, and what was chosen, where each places so many photos."""
    tried: list[str] = []

    def attempt(self: Stages, work: Any, screened: Any, masks: Any, plan: Any) -> SfmStages:
        tried.append(plan.name)
        models = [{"model": 0, "images": placed[plan.name], "points": 9999}] if placed[plan.name] else []
        part = SimpleNamespace(folder=Path("nowhere"), facts={"models": models, "plan": plan.name})
        return SfmStages(part, part, part)

    monkeypatch.setattr(Stages, "_attempt", attempt)
    facts = {"photos": [{"width": 1000, "height": 800}] * photos, "skipped": []}
    self = Stages(SimpleNamespace(), BuildSettings(), None, None, 1, Bar(enabled=False), False)
    return tried, self._sfm(SimpleNamespace(), SimpleNamespace(facts=facts), None).mapping.facts["plan"]


def test_fast_is_enough_where_it_places_everything(monkeypatch):
    assert attempts(monkeypatch, {"fast": 30, "thorough": 30}, 30) == (["fast"], "fast")


def test_the_attempt_that_places_more_is_kept(monkeypatch):
    assert attempts(monkeypatch, {"fast": 20, "thorough": 28}, 30) == (["fast", "thorough"], "thorough")
    assert attempts(monkeypatch, {"fast": 29, "thorough": 28}, 30)[1] == "fast"
    assert attempts(monkeypatch, {"fast": 28, "thorough": 28}, 30)[1] == "thorough"
    assert attempts(monkeypatch, {"fast": 0, "thorough": 28}, 30)[1] == "thorough"


def test_photos_that_fast_loses_are_placed_by_thorough(monkeypatch, tmp_path):
    """COLMAP itself; fast looks at photos of an eighth of the size here, and finds next to nothing."""
    write_capture(tmp_path / "raw", 8)
    real = stages.plans

    def blinded(photos: Any, settings: BuildSettings) -> list[Any]:
        fast, thorough = real(photos, settings)
        return [dataclasses.replace(fast, first_octave=3), thorough]

    monkeypatch.setattr(stages, "plans", blinded)
    settings = BuildSettings(factor=2, max_features=800)
    info = build_scene(tmp_path / "raw", tmp_path / "scene", settings, jobs=2).info
    assert info["counts"]["registered"] == 8 and info["chosen"]["sfm"] == "thorough"
    assert list(info["seconds"]).count("features") == 1
