"""Pictures of a run: they change nothing of it, survive a kill, and show what they say."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.harness import sheets
from ambiguous_wild.harness.cell import RunOptions
from ambiguous_wild.harness.evaluate import write_masks
from ambiguous_wild.harness.grid import plan_cells, run_cells
from ambiguous_wild.harness.pictures import (
    CELL,
    MOMENTS,
    ROWS,
    TrainingPictures,
    draw_all,
    draw_density,
    picture_row,
)
from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.io.palette import ramp
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import train
from ambiguous_wild.viewing.video import labelled
from tests.splat.scenes import bits
from tests.tiny_scene import HEIGHT, TRAIN, WIDTH

ITERATIONS = 120


@pytest.fixture(scope="module")
def scene(scene):
    return load_scene(scene)


def trainer_for(scene, folder, parts=None) -> Trainer:
    """RefineSplat with a short warm-up, growth and merging, so that there is something to see."""
    if parts is None:
        entry = get_method("refinesplat")
        options = entry.options()
        density = replace(options.density, min_every=20, merge_every=1.0)
        options = replace(options, psi=replace(options.psi, steps=40), density=density, min_mask_start=20)
        parts = entry.build(options)
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=folder)
    return Trainer(data, parts, TrainConfig(iterations=ITERATIONS, probes=0), folder=folder)


@pytest.fixture(scope="module")
def watched(scene, tmp_path_factory):
    """A run with pictures: (trainer, folder, what was written)."""
    folder = tmp_path_factory.mktemp("runs") / "watched"
    trainer = trainer_for(scene, folder)
    recorder = TrainingPictures(trainer, folder)
    train(trainer, tick=recorder)
    return trainer, folder, draw_all(trainer, recorder, folder)


def test_a_run_is_the_same_bits_with_and_without_pictures(scene, watched, tmp_path):
    blind = trainer_for(scene, tmp_path)
    train(blind)
    trainer, folder, _ = watched
    assert bits(blind) == bits(trainer)
    one, two = (checkpoint.load(f / "checkpoint" / "last.safetensors")["mask"] for f in (tmp_path, folder))
    assert one["visits"] == two["visits"] and one["shares"] == two["shares"] and one["theta"] == two["theta"]


def test_every_picture_is_there_a_row_a_moment(watched):
    _, folder, written = watched
    names = {path.name for path in written}
    assert names == {"entropies.png", "density.png"} | {f"training_train_{k}.png" for k in (0, 2, 5)}
    assert all(path.is_file() and path.parent == folder / "pictures" for path in written)
    assert not (folder / ROWS).exists()
    picture = read_png_rgb(folder / "pictures" / "training_train_0.png")
    row = sheets.BAR + sheets.GAP + round(HEIGHT * CELL / WIDTH)
    assert picture.shape == (len(MOMENTS) * row, 8 * (CELL + sheets.GAP), 3)


def test_a_run_that_stopped_has_the_pictures_of_one_that_did_not(scene, watched, tmp_path):
    first = trainer_for(scene, tmp_path)
    recorder = TrainingPictures(first, tmp_path)
    while first.iteration < 71:
        first.step()
        recorder(first)
        if first.iteration == 40:
            first.save()  # what comes later is lost
    second = trainer_for(scene, tmp_path)
    assert second.resume() and second.iteration == 40
    recorder = TrainingPictures(second, tmp_path)
    train(second, tick=recorder)
    draw_all(second, recorder, tmp_path)
    for name in ("training_train_0.png", "training_train_5.png"):
        whole = read_png_rgb(watched[1] / "pictures" / name)
        np.testing.assert_array_equal(read_png_rgb(tmp_path / "pictures" / name), whole)


def test_looking_costs_no_training_time(watched):
    trainer, _, _ = watched
    before = dict(trainer.clock.parts_s), trainer.clock.now()
    picture_row(trainer, 1)
    assert (dict(trainer.clock.parts_s), trainer.clock.now()) == before


def test_pictures_grow_while_any_method_trains(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path, MethodHooks())  # no masks, so no panels of a method
    recorder = TrainingPictures(trainer, tmp_path)
    heights = []
    while trainer.iteration < 0.25 * trainer.config.iterations:
        trainer.step()
        recorder(trainer)
        paths = sorted((tmp_path / "pictures").glob("training_*.png"))
        heights.append(read_png_rgb(paths[0]).shape[0] if paths else 0)
    row = sheets.BAR + sheets.GAP + round(HEIGHT * CELL / WIDTH)
    assert sorted(set(heights)) == [0, row, 2 * row, 3 * row]
    trainer.iteration = 0  # rolled back to before the first moment
    recorder(trainer)
    assert [read_png_rgb(path).shape[0] for path in recorder.finish(trainer)] == 3 * [3 * row]


def test_no_view_is_drawn_for_the_masks_of_a_method_without_any(scene, tmp_path, monkeypatch):
    trainer = trainer_for(scene, tmp_path, MethodHooks())
    monkeypatch.setattr(trainer, "make_step", None)
    assert write_masks(trainer, tmp_path / "masks") is None and (tmp_path / "masks").is_dir()


def test_pictures_can_be_left_away(scene, tmp_path):
    cells = plan_cells(["3dgs"], [scene.root], [0], TrainConfig(iterations=20, probes=0))
    (report,) = run_cells(cells, tmp_path, RunOptions(tmp_path / ".cache", pictures=False))
    assert report.outcome == "trained"
    assert not (report.folder / "pictures").exists()


def test_the_log_of_density_control_adds_up(watched):
    trainer, _, _ = watched
    rounds = trainer.density.log.rounds
    count = trainer.run_schedule.start
    for r in rounds:
        count += r.cloned + r.split - r.pruned - r.merged
        assert r.count == count
    assert count == len(trainer.gaussians)
    assert sum(r.merged for r in rounds) == trainer.density.merged
    assert trainer.density.log.added.passed == sum(r.cloned + 2 * r.split for r in rounds) > 0
    assert [r.iteration for r in rounds] == sorted({r.iteration for r in rounds})


def test_nothing_grown_nothing_drawn(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path)
    assert draw_density(trainer, tmp_path / "density.png") == []


def test_a_contact_sheet_shows_photos_tinted(scene, tmp_path):
    keep = np.full((HEIGHT, WIDTH), 255, np.uint8)
    keep[:, : WIDTH // 2] = 0
    for name in TRAIN:
        write_png(tmp_path / "masks" / name, keep)
    (path,) = sheets.write_contact(scene, tmp_path / "masks", tmp_path / "p" / "masks.jpg")
    sheet = cv2.imread(str(path))[:, :, ::-1].astype(float)
    assert sheet.shape[1] == 5 * (320 + sheets.GAP)  # six photos, five in a row
    photo = read_png_rgb(scene.root / "images" / "train_3.png").astype(float)
    inside = sheet[sheets.BAR : sheet.shape[0] // 2 - sheets.GAP, 3 * (320 + sheets.GAP) :][:, :320]
    left, right = inside[:, :150].mean((0, 1)), inside[:, 170:].mean((0, 1))
    np.testing.assert_allclose(right, photo[:, 34:].mean((0, 1)), atol=4)
    np.testing.assert_allclose(
        left, 0.45 * photo[:, :30].mean((0, 1)) + 0.55 * np.array([255, 30, 30]), atol=4
    )
    assert sheets.write_contact(scene, tmp_path / "none", tmp_path / "none.jpg") == []


def test_the_ramp_is_monotone_from_green_to_red_and_nan_is_grey():
    colours = ramp(np.array([-1.0, 0.0, 0.5, 1.0, 2.0, np.nan]), 0.0, 1.0).astype(int)
    assert (colours[0] == colours[1]).all() and (colours[3] == colours[4]).all()
    assert colours[1][1] > colours[1][0] and colours[3][0] > colours[3][1]  # green, then red
    assert (colours[5] == 60).all()
    assert (ramp(np.ones(3), 1.0, 1.0) == ramp(np.zeros(3), 0.0, 1.0)).all()  # no range: no division by 0


def test_long_captions_stay_on_their_picture():
    framed = sheets.cell(
        "a caption that is far longer than the picture below it is wide", np.zeros((9, 40, 3), np.uint8)
    )
    assert framed.shape == (9 + sheets.BAR + sheets.GAP, 40 + sheets.GAP, 3)
    assert (framed[: sheets.BAR, 40:] == 255).all() and (framed[: sheets.BAR] < 255).any()


@pytest.mark.parametrize(
    "draw", [sheets.cell, lambda text, image: labelled(image, text)], ids=["sheet", "video"]
)
def test_letters_that_the_font_lacks_are_no_question_marks(draw):
    image = np.full((90, 320, 3), 200, np.uint8)
    assert np.array_equal(draw("Tést_0.png ﬁ", image), draw("Test_0.png fi", image))
    assert np.array_equal(draw("写真\n", image), draw(r"\u5199\u771f\n", image))
