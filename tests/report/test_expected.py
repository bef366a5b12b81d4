"""The time that `aw bench` names before runs of the full length."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ambiguous_wild.harness import grid as expected
from ambiguous_wild.harness.benchmark import Callbacks, bench
from ambiguous_wild.splat import calibration
from ambiguous_wild.splat.train_config import default_iterations
from tests.tiny_scene import write_tiny_scene


@pytest.mark.parametrize(
    ("pixels", "gaussians", "measured_ms"),
    [(240 * 134, 32_134, 14.5), (243 * 181, 43_982, 11.9), (480 * 268, 102_342, 34.6)],
)  # reference milliseconds of runs that had the machine alone
def test_measured_runs_lie_in_the_range(pixels: int, gaussians: int, measured_ms: float) -> None:
    said = expected.expected_s(1000, pixels, gaussians)
    assert expected.MIN_RATIO * said <= measured_ms <= expected.MAX_RATIO * said


@pytest.mark.parametrize(("photos", "iterations"), [(1, 7000), (35, 7000), (60, 12_000), (400, 30_000)])
def test_few_photos_are_trained_for_fewer_iterations(photos: int, iterations: int) -> None:
    assert default_iterations(photos) == iterations


class Heard(Callbacks):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        self.lines.append(text)

    def planned(self, cells, one_by_one):
        raise KeyboardInterrupt  # what is said before is said by now


def said_by(scene: Path, out: Path, **length: object) -> str:
    heard = Heard()
    with pytest.raises(KeyboardInterrupt):
        bench(["3dgs", "absgs"], scene, output=out, effects="none", callbacks=heard, **length)
    return "\n".join(heard.lines)


def test_only_runs_whose_length_nobody_chose_are_told_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = write_tiny_scene(tmp_path / "wall")
    monkeypatch.setattr(calibration.Calibration, "seconds", lambda self: 1.0)  # 16 times slower
    told = said_by(scene, tmp_path / "a")
    assert "2 runs of 7000 iterations" in told and "--budget" in told
    unit = {"min": 1.0, "h": 60.0}
    low, high = (float(found) * unit[name] for found, name in re.findall(r"([\d.]+) (min|h)\b", told)[:2])
    assert 0 < low < high
    assert "no --iterations" not in said_by(scene, tmp_path / "b", iterations=5)
    assert "no --iterations" not in said_by(scene, tmp_path / "c", budgets_s=[5.0])


def test_finished_runs_are_not_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = write_tiny_scene(tmp_path / "wall")
    name = "ambiguous_wild.harness.cell_run.is_finished"
    monkeypatch.setattr(name, lambda folder: "absgs" in folder.parts)
    assert "1 run of 7000 iterations" in said_by(scene, tmp_path / "a")
    assert "2 runs of 7000" in said_by(scene, tmp_path / "a", overwrite="always")
    monkeypatch.setattr(name, lambda folder: True)
    assert "no --iterations" not in said_by(scene, tmp_path / "a")
