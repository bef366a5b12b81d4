"""`aw try`: every step is an ordinary command, and a second call continues."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.cli.try_all import SHORTEST_S
from ambiguous_wild.harness.result_file import read_result
from ambiguous_wild.harness.store import known_budget
from tests.builder.capture_maker import write_capture
from tests.command_line import aw


def _commands(text: str) -> list[str]:
    return [line.split()[2] for line in text.splitlines() if line.startswith("$ aw ")]


@pytest.mark.slow
def test_photos_become_a_page_that_a_larger_budget_continues(tmp_path: Path) -> None:
    raw, out = tmp_path / "walls", tmp_path / "out"
    write_capture(raw, 8)
    words = ("try", raw, "-o", out, "--threads", "1")
    done = aw(*words, "--budget", "20s")
    assert done.returncode == 0, done.stderr
    assert _commands(done.stderr) == ["screen", "build-scene", "plan", "bench", "view"]
    page, run = out / "view/index.html", out / "runs/walls/refinesplat/seed0"
    assert f"look at it while it trains: {page}" in done.stderr
    assert f"splat of refinesplat: {run / 'point_cloud.ply'}" in done.stderr
    assert '"reload_s":0.0' in page.read_text()
    assert known_budget(out / "runs")[0] == SHORTEST_S and "a sketch" in done.stderr
    reached = read_result(run / "metrics.json")["cost"]["iterations"]
    again = aw(*words, "--budget", "20s")
    assert again.returncode == 0 and again.stderr.count("finished before, kept") == 1
    longer = aw(*words, "--budget", "75s")
    assert longer.returncode == 0 and _commands(longer.stderr) == ["build-scene", "plan", "bench", "view"]
    result = read_result(run / "metrics.json")
    assert result["cost"]["iterations"] > reached
    assert result["facts"]["length"].startswith(f"{reached} iterations, continued to")


@pytest.mark.slow
def test_two_methods_share_the_time_and_are_compared(tmp_path: Path) -> None:
    raw, out = tmp_path / "walls", tmp_path / "out"
    write_capture(raw, 8)
    done = aw("try", raw, "-o", out, "--threads", "1", "--budget", "20s", "--method", "3dgs,refinesplat")
    assert done.returncode == 0, done.stderr
    wanted = ["screen", "build-scene", "plan", "bench", "view", "table", "figure"]
    assert _commands(done.stderr) == wanted and (out / "comparison.png").is_file()
    assert "3dgs" in done.stdout and "refinesplat" in done.stdout


def test_a_video_is_captured_once(tmp_path: Path) -> None:
    """It shows nothing, so that the scene cannot be built."""
    film = cv2.VideoWriter(str(tmp_path / "dark.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 5, (64, 48))
    for level in range(6):
        film.write(np.full((48, 64, 3), 9 * level, np.uint8))
    film.release()
    for end in ("photos in out/photos", "done before: out/photos"):
        done = aw("try", "dark.avi", "-o", "out", cwd=tmp_path)
        assert done.returncode == 2 and done.stderr.count("error: ") == 1
        assert _commands(done.stderr) == ["capture", "screen", "build-scene"]
        assert end in done.stdout + done.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["photos"]
    (tmp_path / "dark.avi").rename(tmp_path / "other.avi")
    done = aw("try", "other.avi", "-o", "out", cwd=tmp_path)
    assert done.returncode == 2 and "holds frames of dark.avi, not of other.avi" in done.stderr


@pytest.mark.parametrize(("folder", "name"), [("statue/images", "statue"), ("statue/left", "left")])
def test_a_scene_is_not_called_images(tmp_path: Path, folder: str, name: str) -> None:
    (tmp_path / folder).mkdir(parents=True)
    for i in range(3):  # of which no scene can be built
        cv2.imwrite(str(tmp_path / folder / f"{i}.jpg"), np.full((48, 64, 3), 90 * i, np.uint8))
    done = aw("try", folder, "-o", "out", cwd=tmp_path)
    assert f"build-scene {folder} -o out/scene --name {name}\n" in done.stderr
