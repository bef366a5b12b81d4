"""benchmarks/auto.py: the sets of effects that `auto` is compared with."""

import json
import math

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.simulate.presets import PRESETS
from tests.benchmark_scripts import benchmark
from tests.tiny_scene import write_tiny_scene

ALWAYS = ["none", "dense", "skybox"]


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
            *ALWAYS, "exposure", "antialias", "exposure,dense", "exposure,skybox",
        ]  # fmt: skip


PSNR = {
    "none": 20.0,
    "dense": 21.0,
    "skybox": 20.5,
    "exposure": 22.0,
    "antialias": 19.0,
    "exposure,dense": 22.5,
    "exposure,skybox": 22.2,
}


@pytest.fixture
def script(monkeypatch):
    """The script, whose runs are `PSNR`; `auto` chooses exposure."""
    with benchmark("auto") as auto:
        auto.trained = []

        def train(scene, effects, out, iterations, seeds):
            auto.trained.append((scene.name, effects))
            if scene.name == "broken":
                raise auto.Stopped("aw bench: error: no disk")
            name = "exposure" if effects == "auto" else effects
            values = [PSNR[name] + seed for seed in seeds]
            supported = [math.nan if scene.name == "hall" else 30.0 - v for v in values]
            return {
                "seeds": {"psnr": values, "psnr_supported": supported},
                "effects": name,
                "tried": {"exposure": [0.5, 0.1]},
            }

        monkeypatch.setattr(auto, "train", train)
        yield auto


def test_auto_is_compared_with_the_best_set_in_the_mean_of_the_seeds(script, tmp_path):
    for name in ("hall", "yard", "broken"):
        write_tiny_scene(tmp_path / name)
    words = [
        "--scenes",
        *(str(tmp_path / n) for n in ("broken", "hall", "yard")),
        "--out",
        str(tmp_path / "runs"),
    ]
    done = script.main([*words, "--results", str(tmp_path / "auto"), "--seeds", "0", "1"])
    assert done == 1  # of the broken scene
    assert ("hall", "exposure") not in script.trained  # what auto chose is not trained twice
    hall, yard = json.loads((tmp_path / "auto.json").read_text())["scenes"]  # but the others are there
    assert hall["psnr"]["best"] == "exposure,dense" and hall["psnr"]["sets"]["exposure"] == 22.5
    assert hall["psnr"]["below_best_db"] == pytest.approx(0.5)
    assert hall["psnr"]["over_none_db"] == pytest.approx(2.0)
    assert "psnr_supported" not in hall and yard["psnr_supported"]["best"] == "none"
    told = (tmp_path / "auto.md").read_text()
    assert (
        "| hall | exposure | 22.50 | 20.50 | exposure,dense 23.00 | 0.50 | +2.00 | exposure +0.50 ± 0.10 |"
        in told
    )
    assert "Within 0.1 dB of the best on 0 of 1; mean below it 2.00 dB" in told


def test_mistakes_are_told_before_anything_is_trained(script, tmp_path, capsys):
    write_tiny_scene(tmp_path / "hall")
    words = ["--scenes", str(tmp_path / "hall"), "--out", str(tmp_path / "runs")]
    for wrong in (["--jobs", "0"], ["--seeds", "-1"], ["--iterations", "0"]):
        with pytest.raises(SystemExit) as ended:
            script.main([*words, *wrong])
        assert ended.value.code == 2
    with pytest.raises(AwError, match="is no scene folder"):
        script.main(["--scenes", str(tmp_path / "gone"), *words[2:]])
    assert script.trained == []
