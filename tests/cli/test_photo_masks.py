"""`aw masks`: every step is an ordinary command, all photos are trained, and each gets a mask."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.scene_folder import load_scene
from tests.builder.capture_maker import write_capture
from tests.command_line import aw


def _commands(text: str) -> list[str]:
    return [line.split()[2] for line in text.splitlines() if line.startswith("$ aw ")]


@pytest.mark.slow
def test_photos_become_masks(tmp_path: Path) -> None:
    photos = write_capture(tmp_path / "walls", 8)
    done = aw("masks", tmp_path / "walls", "-o", tmp_path / "masks", "--budget", "10s", "--for", "colmap")
    assert done.returncode == 0, done.stderr
    assert _commands(done.stderr) == ["build-scene", "plan", "bench", "view", "masks"]
    scene = load_scene(tmp_path / "masks-work/scene")
    assert len(scene.train) == 8 and not scene.test
    for photo in photos:
        mask = read_gray(tmp_path / "masks" / f"{photo.name}.png")
        assert mask.shape == read_png_rgb(photo).shape[:2] and set(np.unique(mask)) <= {0, 255}
    assert "wrote 8 masks to" in done.stdout and "black = distractor" in done.stdout
    again = aw("masks", tmp_path / "walls", "-o", tmp_path / "masks")
    assert again.returncode == 2 and "masks exists" in again.stderr and not _commands(again.stderr)


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("masks", "none", "-o", "out"), "does not exist"),
        (("masks", "raw", "-o", "full"), "full exists; nothing is overwritten"),
        (("masks", "raw", "-o", "out", "--inpaint", "full"), "full exists; nothing is overwritten"),
        (("masks", "raw", "-o", "out", "--budget", "10 parsecs"), "budget '10 parsecs' is no duration"),
        (("masks", "raw", "-o", "out", "--for", "blender"), "'blender' is not one of"),
        (("masks", "raw", "-o", "out"), "holds no photos"),
        (("masks", "scene", "-o", "out"), "scene is a scene: give its photos, or a run"),
        (("masks", "walls", "-o", "out", "--inpaint", "walls/clean"), "lies inside the photos"),
        (
            ("masks", "walls", "-o", "out", "--inpaint", "out"),
            "out is, holds or lies in the folder of the masks",
        ),
        (
            ("masks", "walls", "-o", "out", "--inpaint", "out/clean"),
            "clean is, holds or lies in the folder",
        ),
        (("masks", "walls", "-o", "out", "--inpaint", "out-work/clean"), "lies inside the scene and the run"),
        (("masks", "walls", "-o", "out"), "the masks of p02.jpg and p02.png would both be p02.png"),
        (("masks", "../walls", "-o", "."), ". is the folder you are in, which would be replaced"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(words: tuple[str, ...], error: str, tmp_path: Path) -> None:
    for name in ("raw/a.txt", "full/mine.txt", "scene/scene.json"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    first, *_ = write_capture(tmp_path / "walls", 4)
    write_png(tmp_path / "walls/p01.png", read_png_rgb(tmp_path / "walls/p01.jpg"))  # in two formats
    write_png(tmp_path / "walls/p02.png", read_png_rgb(first))
    (tmp_path / "empty").mkdir()
    before = sorted(tmp_path.rglob("*"))
    done = aw(*words, cwd=tmp_path / ("empty" if words[3] == "." else ""))
    assert done.returncode == 2 and error in done.stderr and done.stderr.count("error: ") == 1
    assert sorted(tmp_path.rglob("*")) == before
