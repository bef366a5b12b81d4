"""A run that met a NaN is run up to it again, from its own folder alone."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from ambiguous_wild.cli.main import cli
from ambiguous_wild.core import AwError
from ambiguous_wild.harness import replay as replay_module
from ambiguous_wild.harness.cell_run import OURS
from ambiguous_wild.harness.grid import cell_folder, plan_cells, run_cells
from ambiguous_wild.harness.replay import open_run, replay_run
from ambiguous_wild.harness.result_file import read_result
from ambiguous_wild.io.images import read_keep_map, read_png_rgb, write_png
from ambiguous_wild.io.mask_reasons import read_reasons
from ambiguous_wild.methods import MethodEntry, register
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig
from tests.tiny_scene import write_tiny_scene


class Poison(MaskPolicy):
    def cotangent(self, step, keep):
        return torch.full_like(step.photo, math.nan) if step.iteration == 9 else None


@pytest.fixture
def run(tmp_path):
    register(MethodEntry("poison", "a NaN at iteration 9", lambda options: MethodHooks(mask=Poison())))
    scene = write_tiny_scene(tmp_path / "scene")

    def go(action, method="poison"):
        train = TrainConfig(iterations=12, probes=0, on_nonfinite=action)
        (cell,) = plan_cells([method], [scene], [0], train)
        (report,) = run_cells([cell], tmp_path / "runs")
        return cell_folder(tmp_path / "runs", cell), report

    return go


def test_the_same_value_is_found_again_and_the_run_is_left_alone(run):
    folder, report = run("stop")
    assert report.outcome == "failed"
    assert "gradient of" in report.error
    assert "aw stress --replay" in report.error
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    again = replay_run(folder)
    assert again.matches
    assert again.started_at == 0
    assert before == {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    done = CliRunner().invoke(cli, ["stress", "--replay", str(folder)])
    assert done.exit_code == 0
    assert done.output.count("iteration 9") == 2


def test_a_rollback_is_a_fact_of_the_result(run):
    folder, report = run("rollback")
    assert report.outcome == "trained", report.error
    (fact,) = read_result(folder / "metrics.json")["facts"]["rollbacks"]
    assert (fact["iteration"], fact["to"]) == (9, 0)


def test_a_run_without_findings_is_named(tmp_path):
    with pytest.raises(AwError, match="all its values were finite"):
        replay_run(tmp_path)


def test_a_damaged_report_is_named(run):
    folder, _ = run("stop")
    (folder / "nonfinite" / "000009" / "report.json").write_text("[]")
    with pytest.raises(AwError, match="is damaged"):
        replay_run(folder)


def test_a_parameter_found_before_saving_is_found_again(run):
    class Late(DensityControl):
        def refine(self, step, gaussians, optimiser):
            gaussians, events = super().refine(step, gaussians, optimiser)
            if step.iteration == 12:
                gaussians.log_scales[3, 1] = math.nan  # no step comes after that would meet it
            return gaussians, events

    register(MethodEntry("late", "a NaN in a parameter", lambda options: MethodHooks(density=Late)))
    folder, report = run("stop", "late")
    assert report.outcome == "failed"
    assert "parameter of log_scales" in report.error
    again = replay_run(folder)
    assert again.matches, again


@pytest.fixture(scope="module")
def masked(tmp_path_factory):
    """A finished run of refinesplat."""
    root = tmp_path_factory.mktemp("masked")
    train = TrainConfig(iterations=300, probes=0)
    (cell,) = plan_cells(["refinesplat"], [write_tiny_scene(root / "scene")], [0], train)
    (report,) = run_cells([cell], root / "runs")
    assert report.outcome == "trained", report.error
    return report.folder


def test_an_opened_run_draws_the_masks_that_it_wrote(masked):
    before = {p: p.read_bytes() for p in masked.rglob("*") if p.is_file()}
    trainer = open_run(masked)
    for view, photo in enumerate(trainer.data.scene.train):
        keep = trainer.hooks.mask.predict(trainer.make_step(trainer.iteration, view, downsampling=1))
        written = read_keep_map((masked / "masks" / photo.name).with_suffix(".png"))
        assert torch.equal(keep > 0.5, torch.from_numpy(written))
    assert before == {p: p.read_bytes() for p in masked.rglob("*") if p.is_file()}


def test_a_pixel_is_explained(masked):
    written = read_keep_map(sorted((masked / "masks").rglob("*.png"))[0])
    photo = sorted((masked / "masks").rglob("*.png"))[0].stem
    said = {}
    for kept in (True, False):
        row, column = (int(v) for v in np.argwhere(written == kept)[0])
        done = CliRunner().invoke(cli, ["explain", str(masked), photo, str(column), str(row)])
        assert done.exit_code == 0, done.output
        said[kept] = done.output
    assert said[True].startswith("kept: ") and said[False].startswith("masked: it ")
    assert "mask: yes" in said[False] and "threshold of the scene's instances: " in said[False]
    # what the run stores for the page is what the command says first
    stored = read_reasons(masked / "reasons.json")
    assert {Path(name).stem for name in stored} == {path.stem for path in (masked / "masks").rglob("*.png")}
    reasons = next(reasons for name, reasons in stored.items() if Path(name).stem == photo)
    for kept in (True, False):
        row, column = (int(v) for v in np.argwhere(written == kept)[0])
        assert said[kept].splitlines()[0] == reasons.at(column, row)
    words = np.array(["", *(sentence.partition(":")[0] for sentence in reasons.sentences)])[reasons.regions]
    assert ((words == "kept") == (written > 0)).all()


def test_whatever_a_run_writes_is_replaced_with_it(masked):
    assert {path.name for path in masked.iterdir()} <= set(OURS)


def test_the_captures_own_mask_and_corrections_are_reasons(masked, monkeypatch):
    load = replay_module.load_train_data

    def with_mask(scene, **more):
        data = load(scene, **more)
        own = [torch.zeros(photo.shape[:2]) for photo in data.photos]
        hand = torch.zeros_like(own[0])
        hand[:, 1] = -1.0
        hand[:, 2] = own[0][:, 2] = 1.0  # as `corrected` joins both
        return dataclasses.replace(data, user_keep=[own[0]] * len(own), by_hand=[hand] * len(own))

    monkeypatch.setattr(replay_module, "load_train_data", with_mask)
    photo = sorted((masked / "masks").rglob("*.png"))[0].stem
    for column, sentence in (
        ("0", "masked: the capture's own mask leaves it out"),
        ("1", "masked: by hand"),
        ("2", "kept: by hand"),
    ):
        done = CliRunner().invoke(cli, ["explain", str(masked), photo, column, "0"])
        assert done.output.startswith(f"{sentence}\n"), done.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nowhere.png", "0", "0"), "unknown train photo"),
        (("{photo}", "999", "0"), "no pixel 999, 0"),
        ((), "PHOTO, COLUMN, ROW not given: name a run, a train photo of it, and a pixel"),
        (("{photo}", "1"), "ROW not given"),
    ],
)
def test_what_cannot_be_explained_is_named(masked, words, message):
    photo = sorted((masked / "masks").rglob("*.png"))[0].stem
    done = CliRunner().invoke(cli, ["explain", str(masked), *(word.format(photo=photo) for word in words)])
    assert done.exit_code != 0 and message in f"{done.exception} {' '.join(done.output.split())}"
    with pytest.raises(AwError, match="is no run of 'aw bench'"):
        open_run(masked.parent)


def test_a_run_is_not_explained_on_another_scene(masked):
    scene = masked.parents[3] / "scene"
    path = scene / "images" / "train_0.png"
    before = path.read_bytes()
    write_png(path, 255 - read_png_rgb(path))
    try:
        with pytest.raises(AwError, match="measured on another state of"):
            open_run(masked)
    finally:
        path.write_bytes(before)
    scene.rename(scene.with_name("moved"))
    try:
        with pytest.raises(AwError, match="move the scene back"):
            open_run(masked)
    finally:
        scene.with_name("moved").rename(scene)
