"""The picture that compares runs."""

import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.grid import plan_cells, run_cells
from ambiguous_wild.harness.sheets import BAR, GAP, cell, write_sheet
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.viewing.video import labelled
from tests.tiny_scene import HEIGHT, WIDTH, write_tiny_scene


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sheet")
    scene = write_tiny_scene(folder / "scene")
    run_cells(plan_cells(["3dgs"], [scene], [0], TrainConfig(iterations=20, probes=0)), folder / "runs")
    return folder / "runs"


def test_a_column_for_the_photo_and_each_method_a_row_for_each_view(runs, tmp_path):
    assert write_sheet(read_runs(runs), tmp_path / "sheet.png") == 1
    sheet = read_png_rgb(tmp_path / "sheet.png")
    assert sheet.shape == (5 * (HEIGHT + BAR + GAP), 2 * (WIDTH + GAP), 3)
    photo = read_png_rgb(runs.parent / "scene" / "images" / "test_0.png")
    render = read_png_rgb(runs / "scene" / "3dgs" / "seed0" / "renders" / "test" / "test_0.png")
    assert np.array_equal(sheet[BAR : BAR + HEIGHT, :WIDTH], photo)
    assert np.array_equal(sheet[BAR : BAR + HEIGHT, WIDTH + GAP : 2 * WIDTH + GAP], render)


@pytest.mark.parametrize("draw", [cell, lambda text, image: labelled(image, text)], ids=["sheet", "video"])
def test_letters_that_the_font_lacks_are_no_question_marks(draw):
    image = np.full((90, 320, 3), 200, np.uint8)
    assert np.array_equal(draw("Tést_0.png ﬁ", image), draw("Test_0.png fi", image))
    assert np.array_equal(draw("写真\n", image), draw(r"\u5199\u771f\n", image))


def test_a_sheet_called_jpg_is_one(runs, tmp_path):
    write_sheet(read_runs(runs), tmp_path / "sheet.jpg")
    assert (tmp_path / "sheet.jpg").read_bytes().startswith(b"\xff\xd8\xff")


def test_a_scene_that_is_not_there_is_named(runs, tmp_path):
    with pytest.raises(AwError, match="no finished run"):
        write_sheet(read_runs(runs), tmp_path / "sheet.png", scene="elsewhere")
    moved = runs.parent / "moved"
    (runs.parent / "scene").rename(moved)
    try:
        with pytest.raises(AwError, match="move the scene back"):
            write_sheet(read_runs(runs), tmp_path / "sheet.png")
    finally:
        moved.rename(runs.parent / "scene")


def test_photos_of_another_state_are_no_truth(runs, tmp_path):
    path = runs.parent / "scene" / "images" / "test_0.png"
    before = path.read_bytes()
    write_png(path, 255 - read_png_rgb(path))
    try:
        with pytest.raises(AwError, match="measured on another state of"):
            write_sheet(read_runs(runs), tmp_path / "sheet.png")
    finally:
        path.write_bytes(before)
    both = read_runs(runs)
    other = both.runs.assign(method="other", scene_hash="a")
    with pytest.raises(AwError, match="'scene' differs between these runs"):
        write_sheet(replace(both, runs=pd.concat([both.runs, other])), tmp_path / "sheet.png")
    assert not (tmp_path / "sheet.png").exists()


@pytest.mark.parametrize("lost", ["renders", "config.yaml"])
def test_a_run_that_lost_its_files_is_named(runs, tmp_path, lost):
    copy = shutil.copytree(runs, tmp_path / "runs") / "scene" / "3dgs" / "seed0"
    (copy / lost).rename(tmp_path / "lost")
    with pytest.raises(AwError, match=rf"seed0 .*{lost}.*restore it"):
        write_sheet(read_runs(tmp_path / "runs"), tmp_path / "sheet.png")
