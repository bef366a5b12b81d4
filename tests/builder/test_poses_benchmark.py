"""benchmarks/poses.py: what counts as placed rightly, and the table."""

import cv2
import numpy as np
import pytest

from tests.benchmark_scripts import benchmark


@pytest.fixture
def poses():
    with benchmark("poses") as module:
        yield module


def turned(*vector: float) -> np.ndarray:
    return cv2.Rodrigues(np.radians(vector))[0]


def path(count: int = 8) -> dict:
    rng = np.random.default_rng(0)
    return {f"p{k}": (turned(*rng.uniform(-40, 40, 3)), rng.uniform(-2, 2, 3), 500.0) for k in range(count)}


def moved(known: dict) -> dict:
    """The same path in another world: turned, scaled, shifted."""
    world, shift = turned(20, -50, 10), np.array([3.0, -1.0, 2.0])
    return {n: (r @ world.T, 2.5 * world @ c + shift, f) for n, (r, c, f) in known.items()}


def test_another_world_is_no_error(poses):
    row = poses.compare(moved(path()), path())
    assert row["right"] == row["judged"] == 8 and row["wrong"] == {}
    assert row["position_percent"] == pytest.approx(0, abs=1e-6) and row["focal_percent"] == 0


def test_a_turned_and_a_moved_photo_are_wrong_and_do_not_drag_the_others(poses):
    found = moved(path())
    rotation, centre, focal = found["p2"]
    found["p2"] = turned(10, 0, 0) @ rotation, centre, focal
    rotation, centre, focal = found["p5"]
    found["p5"] = rotation, centre + 2.5 * np.array([1.0, 0, 0]), focal
    del found["p7"]
    row = poses.compare(found, path())
    assert set(row["wrong"]) == {"p2", "p5"} and row["judged"] == 7 and row["right"] == 5
    assert row["wrong"]["p2"][0] == pytest.approx(10, abs=0.01)
    assert row["wrong"]["p5"][0] < 0.01 and 5 < row["wrong"]["p5"][1] < 60


def test_the_table_tells_refused_wrong_and_missing(poses):
    rows = [
        {"capture": "a-0", "way": "auto", "photos": 9, "known": 9, "judged": 8, "right": 8, "wrong": {},
         "position_percent": 0.1, "focal_percent": -0.2},
        {"capture": "a-0", "way": "colmap", "photos": 9, "known": 9, "judged": 9, "right": 8,
         "wrong": {"p": [74.0, 90.0]}, "provisional": ["p", "q"],
         "position_percent": 0.4, "focal_percent": 9.0},
        {"capture": "b-0", "way": "auto", "refused": "too few"},
    ]  # fmt: skip
    text = poses.markdown(rows)
    assert "| a-0 | 9 | 8 of 8; 0.10 %; -0.20 % | 8 of 9; 1 wrong, 74.0; 0.40 %; +9.00 % |" in text
    assert "| b-0 | 0 | refused |  |" in text
    assert "Over the 1 captures" in text and "- auto: 8 of 9 photos right, 0 wrong (0 of them" in text
    assert "- colmap: 8 of 9 photos right, 1 wrong (1 of them named as provisional), 0 left out" in text


def test_ways_of_before_need_a_checkout(poses, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        poses.main(["--data", str(tmp_path), "--out", str(tmp_path), "--ways", "before-auto"])
    assert stopped.value.code == 2 and "--before" in capsys.readouterr().err


def test_a_base_without_photos_is_one_line(poses, tmp_path, capsys):
    words = ["--data", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out"), "--bases", "skull"]
    assert poses.exit_code(lambda: poses.main(words)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"{tmp_path / 'nowhere/skull'}: no such folder" in error
    assert not (tmp_path / "out").exists()
