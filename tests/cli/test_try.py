"""`aw try`: every step is an ordinary command, and a second call continues."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ambiguous_wild.cli.bench import command as bench_command
from ambiguous_wild.cli.bench import parse_budget
from ambiguous_wild.cli.try_all import SHORTEST_S, train_within
from ambiguous_wild.harness.result_file import read_result
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
    # of the test photos it speaks once, and neither of the next command nor of options that it does not have
    said = done.stdout + done.stderr
    assert said.count("test photos may hold distractors") == 1 and "* PSNR" not in said
    assert "--test-list" not in said and "next: aw bench" not in said
    assert (out / "runs/study.yaml").is_file()
    assert "splat file of refinesplat: " in done.stderr and "aw masks " in done.stderr
    assert '"reload_s":0.0' in page.read_text()
    assert f"--budget {SHORTEST_S:g}s" in done.stderr and "a sketch" in done.stderr
    assert f"A sharp splat, by training it on: aw try {raw} -o {out} --threads 1 --budget 5m" in done.stderr
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


class Made(Exception):
    pass


def budgets(monkeypatch: pytest.MonkeyPatch, scene: Path, methods: str, seconds: float) -> dict[str, Any]:
    """What `train_within` asks of `bench`."""
    asked: dict[str, Any] = {}

    def bench(names: list[str], of: Path, **words: Any) -> None:
        asked.update(words, names=names)
        raise Made

    monkeypatch.setattr("ambiguous_wild.harness.benchmark.bench", bench)
    with pytest.raises(Made):
        out = scene.parent / "nothing"
        train_within(methods, scene, out / "runs", out / "plan.json", out / "view", seconds, 1)
    return asked


def test_the_same_budget_gives_the_same_length_and_methods_share_it(
    monkeypatch: pytest.MonkeyPatch, scene: Path
) -> None:
    first, again = (budgets(monkeypatch, scene, "refinesplat", 300.0) for _ in range(2))
    assert first["budgets_s"] == again["budgets_s"] and first["train"] == again["train"]
    assert 200 < first["budgets_s"][0] < 300 and first["overwrite"] == "longer"
    both = budgets(monkeypatch, scene, "3dgs,refinesplat", 300.0)
    assert both["names"] == ["3dgs", "refinesplat"]
    assert both["budgets_s"][0] < first["budgets_s"][0] / 2
    longer = budgets(monkeypatch, scene, "refinesplat", 900.0)
    assert longer["budgets_s"][0] == first["budgets_s"][0] + 600.0
    assert longer["train"]["max_gaussians"] >= first["train"]["max_gaussians"]
    assert budgets(monkeypatch, scene, "refinesplat", 1.0)["budgets_s"] == [SHORTEST_S]


def test_it_writes_the_study_that_bench_reads(monkeypatch: pytest.MonkeyPatch, scene: Path) -> None:
    asked = budgets(monkeypatch, scene, "3dgs,refinesplat", 300.0)
    recorded, runs = asked["callbacks"], asked["output"]
    recorded.written = False
    recorded.record()
    study = runs / "study.yaml"
    words = bench_command.make_context("bench", [str(study)]).params
    assert words["methods"] == ("3dgs", "refinesplat") and [s.resolve() for s in words["scenes"]] == [scene]
    assert [parse_budget(text) for text in words["budgets"]] == asked["budgets_s"]
    assert words["max_gaussians"] == asked["train"]["max_gaussians"]
    assert Path(words["effects"][0]).resolve() == asked["plan"].resolve()


@pytest.mark.parametrize("name", ["notes.txt", "walk.mp4"])
def test_a_file_that_is_no_video_leaves_nothing(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("text")
    done = aw("try", name, "-o", "above/out", cwd=tmp_path)
    assert done.returncode == 2 and f"{name} is no video that can be read" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == [name]


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
