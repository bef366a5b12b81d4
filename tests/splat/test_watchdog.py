"""The first value that is not finite is named, kept for replay, undone on request; health is left alone."""

import json
import math
from dataclasses import replace

import pytest
import torch

from ambiguous_wild.harness.grid import plan_cells
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.effects.autograd_effect import AutogradEffect, Leaf
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.training_loop import train
from ambiguous_wild.splat.watchdog import FOLDER, GOOD, MAX_ROLLBACKS, REPORT, STEP, NonFinite, Watchdog
from tests.splat.scenes import bits, trained, trainer_for
from tests.splat.test_trainer import parts_of


class Poison(MaskPolicy):
    """A cotangent with a NaN in it, at the iterations given; None = whenever this view comes."""

    def __init__(self, iterations=(), view=None):
        self.iterations, self.view = set(iterations), view

    def cotangent(self, step, keep):
        if step.iteration not in self.iterations and step.view != self.view:
            return None
        bad = torch.zeros_like(step.photo)
        bad[20, 30, 1] = math.nan
        return bad


def poisoned(scene, folder, poison, **config):
    return trainer_for(scene, folder, parts=MethodHooks(mask=poison), iterations=60, probes=0, **config)


def test_a_gradient_is_named_and_kept_for_replay(scene, tmp_path):
    trainer = poisoned(scene, tmp_path / "run", Poison([17]))
    view = scene.train[trainer.run_schedule.view(17)].name
    with pytest.raises(
        NonFinite, match=rf"gradient of .*means.* iteration 17, view {view}.*--replay"
    ) as info:
        train(trainer)
    assert trainer.iteration == 16
    assert all(bool(torch.isfinite(t).all()) for _, t in trainer.gaussians.items())
    finding = info.value.finding
    assert {"means", "quats", "log_scales", "opacity_logits", "sh0"} <= set(finding.names)
    where = tmp_path / "run" / FOLDER / "000017"
    report = json.loads((where / REPORT).read_text())
    assert (report["iteration"], report["view"], report["count"]) == (17, view, finding.count)
    assert not (where / GOOD).exists()  # nothing was saved yet: the beginning is the last good state
    assert report["starts_from"] == "the beginning"
    seen = checkpoint.load(where / STEP)
    rows = ~torch.isfinite(seen["d_means"]).all(1)
    assert rows.nonzero()[:10, 0].tolist() == list(finding.rows)
    assert torch.equal(seen["photo"], trainer.data.photos[trainer.run_schedule.view(17)])


class NoSlope(AutogradEffect):
    """At iteration 17 the gradient of `gain` alone is not finite: a root has no slope at 0."""

    name = "no-slope"

    def leaves(self, data, rng):
        return {"gain": Leaf(torch.zeros(len(data.photos)), 0.01, per_photo=True)}

    def tone(self, image, alpha, leaf, context):
        return image + (torch.sqrt(0 * leaf["gain"]) if context.iteration == 17 else 0 * leaf["gain"])


def test_a_gradient_of_an_effect_is_named_before_it_is_learnt(scene, tmp_path):
    effect = NoSlope()
    trainer = trainer_for(scene, tmp_path, parts=MethodHooks(effects=(effect,)), iterations=60, probes=0)
    with pytest.raises(NonFinite, match=r"^gradient of no-slope\.gain is not finite at iteration 17") as info:
        train(trainer)
    assert (info.value.finding.count, info.value.finding.rows) == (0, ())
    assert bool(torch.isfinite(effect.state_dict()["gain"]["values"]).all())


class PoisonsOther(MaskPolicy):
    """Gradients of another field that are not finite."""

    def gradients(self, step, keep):
        parameters = {name: torch.zeros_like(value) for name, value in step.gaussians.items()}
        zeros = Gradients(**parameters, screen=torch.zeros(len(step.gaussians), 2))
        bad = replace(zeros, means=torch.full_like(zeros.means, math.nan))
        return replace(zeros, fields={"transient": bad})


def test_gradients_of_other_fields_are_checked(scene, tmp_path):
    hooks = MethodHooks(mask=PoisonsOther())
    trainer = trainer_for(scene, tmp_path, parts=hooks, iterations=10, probes=0)
    with pytest.raises(NonFinite, match=r"^gradient of transient\.means is not finite at iteration 1"):
        trainer.step()


@pytest.mark.parametrize("name", ["means", "sh_rest"])
def test_a_parameter_is_found_and_never_saved(scene, tmp_path, name):
    trainer = trainer_for(scene, tmp_path, iterations=60, probes=0, checkpoint_every_s=1e9)

    def spoil(trainer):
        if trainer.iteration == 12:
            getattr(trainer.gaussians, name)[5].fill_(math.inf)

    with pytest.raises(NonFinite, match=f"parameter of {name} in 1 Gaussians") as info:
        train(trainer, tick=spoil)
    finding = info.value.finding
    assert finding.rows == (5,)
    assert finding.since <= 13 <= finding.iteration
    assert finding.iteration == 50  # nothing grew before, nothing was saved
    assert not trainer.checkpoint_path.exists()


def test_a_loss_is_named(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path, iterations=20)
    trainer.data.photos[2][4, 4] = math.nan
    with pytest.raises(NonFinite, match=r"loss is not finite at iteration \d, view train_2\.png"):
        train(trainer)


def test_a_rollback_goes_on_as_if_the_photo_had_been_left_out(scene, tmp_path):
    trainer = poisoned(
        scene, tmp_path / "a", Poison([17, 40]), on_nonfinite="rollback", checkpoint_every_s=1e9
    )
    train(trainer)
    other = poisoned(scene, tmp_path / "b", Poison())
    left_out = {(other.run_schedule.epoch(i), other.run_schedule.view(i)) for i in (17, 40)}
    other.watchdog.skips = lambda epoch, view: (epoch, view) in left_out
    train(other)
    assert bits(trainer) == bits(other)
    facts = trainer.watchdog.facts()["rollbacks"]
    assert [row["iteration"] for row in facts] == [17, 40]
    assert [row["to"] for row in facts] == [0, 0]
    assert len(list((tmp_path / "a" / FOLDER).iterdir())) == 2
    assert math.isfinite(trainer.timeline.rows[-1]["loss"])
    again = poisoned(scene, tmp_path / "a", Poison([17, 40]), on_nonfinite="rollback")
    again.resume()
    assert again.watchdog.facts() == trainer.watchdog.facts()


def test_a_photo_that_never_works_ends_the_run(scene, tmp_path):
    trainer = poisoned(scene, tmp_path, Poison(view=3), on_nonfinite="rollback")
    with pytest.raises(NonFinite, match=f"after {MAX_ROLLBACKS} rollbacks"):
        train(trainer)


@pytest.mark.parametrize("method", ["3dgs", "refinesplat"])
def test_a_healthy_run_has_the_same_bits_without_it(scene, tmp_path, method, monkeypatch):
    looked = trained(scene, tmp_path / "a", parts=parts_of(method), iterations=60)
    saved = checkpoint.load(tmp_path / "a" / "checkpoint" / "last.safetensors")
    assert "rollbacks" not in saved
    for name in ("check_loss", "check_gradients", "check_parameters"):
        monkeypatch.setattr(Watchdog, name, lambda self, *args, **kw: None)
    assert bits(looked) == bits(trained(scene, tmp_path / "b", parts=parts_of(method), iterations=60))


def test_large_but_sound_sums_are_no_finding(scene, tmp_path):
    trainer = trainer_for(scene, tmp_path)
    trainer.gaussians.means[:, 0] = 3e38  # their sum overflows
    trainer.watchdog.check_parameters(1, 0, trainer.gaussians)


def test_the_identity_of_a_run_does_not_know_of_it(scene):
    cells = [
        plan_cells(["3dgs"], [scene.root], [0], replace(TrainConfig(), on_nonfinite=action))[0]
        for action in ("stop", "rollback")
    ]
    assert cells[0].identity == cells[1].identity
