"""`aw try`: every step is an ordinary command, and a second call continues."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from ambiguous_wild.harness.running.store import known_iterations
from tests.builder.capture_maker import write_capture
from tests.command_line import aw


def _commands(text: str) -> list[str]:
    return [line.split()[2] for line in text.splitlines() if line.startswith("$ aw ")]


@pytest.mark.slow
@pytest.mark.parametrize("video", [False, True])
def test_photos_or_a_video_become_a_table_and_a_page(tmp_path: Path, video: bool) -> None:
    raw, out = tmp_path / "walls", tmp_path / "out"
    write_capture(raw, 8)
    source = raw
    if video:
        photos = [cv2.imread(str(path)) for path in sorted(raw.iterdir())]
        source = tmp_path / "walls.avi"
        height, width = photos[0].shape[:2]
        film = cv2.VideoWriter(str(source), cv2.VideoWriter.fourcc(*"MJPG"), 5, (width, height))
        for photo in photos:
            film.write(photo)
        film.release()
    words = ("try", source, "-o", out, "--budget", "20s", "--threads", "1")
    done = aw(*words)
    assert done.returncode == 0, done.stderr
    wanted = ["screen", "build-scene", "plan", "bench", "view", "table"]
    assert _commands(done.stderr) == ["capture"] * video + wanted
    assert (out / "view/index.html").is_file() and (out / "comparison.png").is_file()
    assert "3dgs" in done.stdout and "refinesplat" in done.stdout
    assert known_iterations(out / "runs") == 300 and "takes longer" in done.stderr
    again = aw(*words[:-2], "--threads", "1")
    assert again.returncode == 0 and again.stderr.count("finished before, kept") == 2
    assert _commands(again.stderr) == ["capture"] * video + wanted[1:]


def test_what_is_neither_photos_nor_a_video_is_refused_first(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for words, message in ((["empty"], "holds no photos"), (["empty", "--budget", "5"], "no duration")):
        done = aw("try", *words, "-o", "out", cwd=tmp_path)
        assert done.returncode == 2 and message in done.stderr and done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
