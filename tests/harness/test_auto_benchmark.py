"""benchmarks/auto.py: the sets of effects that `auto` is compared with."""

import pytest

from ambiguous_wild.simulate.presets import PRESETS
from tests.benchmark_scripts import benchmark

ALWAYS = ["none", "near", "dense"]


@pytest.mark.parametrize(
    ("scene", "designed", "more"),
    [
        # colour per photo has two answers: each is tried
        ("time-of-day", {"appearance"}, ["exposure", "appearance"]),
        ("zoom", {"antialiasing"}, ["antialias"]),
        ("courtyard", set(), []),
        ("glossy", set(), []),  # designed for harmonics, which no effect adds
        (
            "everything",  # several questions: their answers together
            {"appearance", "antialiasing"},
            ["exposure,antialias", "appearance,antialias"],
        ),
    ],
)
def test_a_preset_is_tried_with_what_it_was_designed_for(scene, designed, more):
    with benchmark("auto") as auto:
        assert set(PRESETS[scene].designed.effects) & auto.ANSWERS.keys() == designed
        assert auto.picked_by_hand(scene) == [*ALWAYS, *more]


def test_what_may_help_is_tried_on_a_scene_that_nobody_designed():
    assert "monstree" not in PRESETS
    with benchmark("auto") as auto:
        assert auto.picked_by_hand("monstree") == [
            *ALWAYS, "exposure", "antialias", "exposure,dense", "antialias,dense",
        ]  # fmt: skip
