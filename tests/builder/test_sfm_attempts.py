"""Structure from motion works harder only where photos are left out."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ambiguous_wild.builder import stages
from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.pose_hypothesis import TWO_POSES
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.builder.settings import BuildSettings, SfmPlan
from ambiguous_wild.builder.sfm import StructureFromMotion
from ambiguous_wild.builder.stages import SfmStages, Stages
from ambiguous_wild.core import AwError
from ambiguous_wild.io.images import write_png
from ambiguous_wild.io.photos import read_photo
from tests.builder.capture_maker import write_capture


def attempts(
    monkeypatch: pytest.MonkeyPatch,
    registered: dict[str, int],
    photos: int,
    reliable: dict[str, int] | None = None,
    part: int = 1,
    two_poses: tuple[str, ...] = (),
) -> tuple[list[str], Any]:
    """The plans that were tried, and what was chosen, where each registers so many photos.

    Those in `two_poses` leave a photo out to which covisible photos give two poses.
    """
    tried: list[str] = []

    def attempt(
        self: Stages, work: Any, screened: Any, photos: Any, masks: Any, plan: Any, before: Any, known: Any
    ) -> SfmStages:
        assert (before.mapping.facts["plan"] if before else None) == (tried[-1] if tried else None)
        tried.append(plan.name)
        if plan.name not in registered:  # it registers nothing
            registered[plan.name] = 0
        model = {"images": registered[plan.name], "points": 9999} if registered[plan.name] else None
        components = [["p.jpg"] * registered[plan.name]]
        facts = {"model": model, "plan": plan.name, "fixed": [], "components": components}
        facts["left_out"] = {"p.jpg": f"{TWO_POSES}: ..."} if plan.name in two_poses else {}
        facts["reliable"] = (reliable or registered)[plan.name]
        part = SimpleNamespace(folder=Path("nowhere"), facts=facts)
        return SfmStages(part, part, part)

    monkeypatch.setattr(Stages, "_attempt", attempt)
    screened = SimpleNamespace(facts={"skipped": []})
    self = Stages(
        SimpleNamespace(), BuildSettings(part=part), None, None, Path("scene"), 1, Bar(enabled=False), False
    )
    one = ScreenedPhoto("p.jpg", "p.jpg", width=1000, height=800)
    return tried, self._sfm(SimpleNamespace(), screened, [one] * photos, None).mapping.facts["plan"]


def test_fast_is_enough_where_it_places_everything(monkeypatch):
    assert attempts(monkeypatch, {"fast": 30, "wider": 30}, 30) == (["fast"], "fast")


def test_a_path_that_does_not_close_is_mapped_again(monkeypatch):
    registered = {"fast": 29, "thorough": 30}
    assert attempts(monkeypatch, registered, 30) == (["fast"], "fast")
    tried, chosen = attempts(monkeypatch, registered, 30, two_poses=("fast",))
    assert (tried[-1], chosen) == ("thorough", "thorough")


def test_a_part_that_does_not_exist_is_refused(monkeypatch):
    with pytest.raises(AwError, match=r"no part 2: the photos form one part; omit --part"):
        attempts(monkeypatch, {"fast": 30}, 30, part=2)


@pytest.mark.parametrize(
    ("fast", "wider", "thorough", "tried", "chosen"),
    [
        (20, 28, 30, 2, "wider"),
        (26, 25, 20, 4, "fast"),
        (28, 30, 30, 1, "fast"),  # two of thirty may have no clear place
        (26, 26, 26, 4, "thorough"),  # of equal ones the later
        (0, 14, 12, 4, "wider"),
        (0, 14, 28, 3, "thorough"),
    ],
)
def test_the_attempt_that_places_more_is_kept(monkeypatch, fast, wider, thorough, tried, chosen):
    """All pairs are matched only if less than nine tenths are registered."""
    names, kept = attempts(monkeypatch, {"fast": fast, "wider": wider, "thorough": thorough}, 30)
    assert names == ["fast", "wider", "thorough", "covariant"][:tried] and kept == chosen


def test_photos_placed_without_doubt_count_first(monkeypatch):
    registered, reliable = {"fast": 20, "thorough": 23}, {"fast": 20, "thorough": 3}
    assert attempts(monkeypatch, registered, 25, reliable) == (["fast", "thorough"], "fast")


def test_nothing_is_mapped_where_pairs_connect_too_few_photos(tmp_path):
    plan = SfmPlan("fast", "opencv", 3000, 0.8, "retrieval", 1, 0, 2.0, 1, 0.0, 1, 4, worth=0.5)
    photos = [ScreenedPhoto(f"{k}.jpg", f"{k}.png") for k in range(9)]
    attempt = StructureFromMotion(photos, tmp_path, BuildSettings(), plan, 1, Bar(enabled=False))
    result = attempt.map(tmp_path, tmp_path, 4)
    assert result["model"] is None and result["components"] == [] and result["plan"] == "fast"
    with pytest.raises(FileNotFoundError):  # five are enough to try, and there is no database here
        attempt.map(tmp_path, tmp_path, 5)


def test_all_pairs_of_many_photos_are_matched_only_if_less_than_half_is_placed(monkeypatch):
    assert attempts(monkeypatch, {"fast": 70, "wider": 70}, 120) == (["fast", "wider"], "wider")
    registered = {"fast": 50, "wider": 50, "thorough": 90}
    assert attempts(monkeypatch, registered, 120) == (["fast", "wider", "thorough"], "thorough")


def test_few_photos_are_matched_thoroughly_at_once(monkeypatch):
    assert attempts(monkeypatch, {"fast": 20, "thorough": 24}, 25) == (["fast", "thorough"], "thorough")


def test_other_features_are_tried_where_the_careful_ones_leave_over_a_tenth_out(monkeypatch):
    registered = {"fast": 8, "thorough": 13, "covariant": 16}
    assert attempts(monkeypatch, registered, 16) == (["fast", "thorough", "covariant"], "covariant")


def test_photos_that_fast_loses_are_placed_by_thorough(monkeypatch, tmp_path):
    """COLMAP itself; fast looks at tiny photos here, and finds next to nothing."""
    write_capture(tmp_path / "raw", 8)
    real = StructureFromMotion.extract_features

    def blinded(self: StructureFromMotion, *words: Any) -> Any:
        tiny = dataclasses.replace(self.settings, max_side=40)
        return real(dataclasses.replace(self, settings=tiny) if self.plan.sift == "opencv" else self, *words)

    monkeypatch.setattr(StructureFromMotion, "extract_features", blinded)
    settings = BuildSettings(factor=2, max_features=800)
    info = build_scene(tmp_path / "raw", tmp_path / "scene", settings, jobs=2).info
    assert info["counts"]["registered"] == 8 and info["chosen"]["sfm"] == "thorough"
    assert list(info["seconds"]).count("features") == 1


def test_photos_that_are_left_out_look_for_more_partners(monkeypatch, tmp_path):
    """Pairs that are matched already stay, and are not matched again."""
    write_capture(tmp_path / "raw", 8)
    # a pair each: the photos do not chain
    fast = SfmPlan("fast", "opencv", 3000, 0.8, "retrieval", 1, 0, 2.0, 1, 0.0, 1, 4)
    wider = dataclasses.replace(fast, name="wider", similar=7, continues=True)
    monkeypatch.setattr(stages, "plans", lambda photos, settings: [fast, wider])
    info = build_scene(tmp_path / "raw", tmp_path / "scene", BuildSettings(factor=2), jobs=2).info
    assert info["counts"]["registered"] == 8 and info["chosen"]["sfm"] == "wider"
    assert 8 <= info["counts"]["pairs"] <= 28


def test_photos_are_not_placed_again_from_the_same_pairs(monkeypatch, tmp_path):
    """A photo of noise has no partner, however many photos it is compared with."""
    height, width, _ = read_photo(write_capture(tmp_path / "raw", 8)[0])[1].shape
    write_png(tmp_path / "raw/q.png", np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8))
    fast = SfmPlan("fast", "opencv", 3000, 0.8, "retrieval", 7, 0, 2.0, 1, 0.0, 1, 4)
    wider = dataclasses.replace(fast, name="wider", similar=8, continues=True)
    monkeypatch.setattr(stages, "plans", lambda photos, settings: [fast, wider])
    placed, real = [], StructureFromMotion.map
    monkeypatch.setattr(StructureFromMotion, "map", lambda *words: placed.append(words) or real(*words))
    info = build_scene(tmp_path / "raw", tmp_path / "scene", BuildSettings(factor=2), jobs=2).info
    assert info["counts"]["registered"] == 8 and len(placed) == 1
