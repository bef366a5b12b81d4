"""Paired probes: what they leave out, what they measure, what is decided from them."""

import dataclasses
import json
import math
from typing import ClassVar

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.harness import make_plan, select_effects
from ambiguous_wild.harness.bench import Callbacks, bench
from ambiguous_wild.harness.effects_plan import Decision, Evidence, Plan, decide, read_plan
from ambiguous_wild.harness.make_plan import (
    HELD_BACK,
    LONGEST_ARM,
    SHARE,
    SHORTEST_ARM,
    TIMED,
    Trials,
    allowance,
    held_back,
    sampled,
    without_blocks,
)
from ambiguous_wild.harness.residual_probe import Occlusion, with_occlusion
from ambiguous_wild.harness.select_effects import LEAST_DB_MASKS, LEAST_PHOTOS, Gain, ProbeResult, compare
from ambiguous_wild.io.files import write_json
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.pace import TrainConfig
from tests.harness.test_planning import synthetic
from tests.tiny_scene import TRAIN, write_tiny_scene

QUIET = Evidence(0.0, 0.0, 1.0, 0.0, 0.1, observations=1000)


def plan_of(**found):
    return decide("dots", dataclasses.replace(QUIET, **found))


def arm(*psnr):
    return ProbeResult({f"{k}.png": value for k, value in enumerate(psnr)})


def answers(plan):
    return {select_effects.name_of(d): d.decision for d in plan.decisions if select_effects.name_of(d)}


# -- numbers ----------------------------------------------------------------------------------------


def test_a_gain_is_the_mean_over_photos_and_its_standard_error():
    gain = compare(arm(21.0, 22.0, 23.0, 24.0), arm(20.0, 22.0, 22.0, 22.0))  # differences 1, 0, 1, 2
    assert gain.db == pytest.approx(1.0)
    assert gain.error_db == pytest.approx(math.sqrt(2 / 3) / 2)
    assert compare(arm(*[20.0] * (LEAST_PHOTOS - 1)), arm(*[20.0] * 9)) is None


@pytest.mark.parametrize(
    ("db", "error", "pays"), [(0.3, 0.2, True), (0.3, 0.4, False), (0.04, 0.01, False), (-1.0, 0.1, False)]
)
def test_only_what_exceeds_its_noise_pays(db, error, pays):
    assert Gain(db, error).pays() is pays


# -- which effects are tried, and what follows --------------------------------------------------------


def test_limits_are_the_first_guess():
    assert select_effects.candidates(plan_of()) == ()
    assert select_effects.candidates(plan_of(sampling=3.0, exposure=0.2)) == ("exposure", "antialias")
    assert select_effects.candidates(plan_of(appearance=0.1)) == (
        "exposure",
        "appearance",
    )  # the cheaper one beside it
    assert select_effects.candidates(plan_of(appearance=0.03)) == ("exposure", "appearance")
    assert select_effects.candidates(plan_of(appearance=0.01, exposure=0.03)) == ()
    assert select_effects.candidates(plan_of(exposure=math.nan, reprojection_px=2.0)) == ("poses",)


def tried_with(plan, gains):
    """`gains`: dB of every set of effects over none."""
    asked, said = [], []

    def train(effects):
        asked.append(effects)
        return arm(*(20.0 + gains["+".join(effects)] + 0.01 * k * len(effects) for k in range(6)))

    names = select_effects.candidates(plan)
    found = select_effects.try_effects(plan, names, train, dict.fromkeys(names, 1.5), said.append)
    return found, asked, said


def test_each_effect_is_tried_beside_those_that_paid(tmp_path):
    plan = plan_of(sampling=3.0, exposure=0.2, reprojection_px=3.0)
    gains = {"": 0, "exposure": 0.6, "exposure+antialias": 0.5, "exposure+poses": 0.9}
    found, asked, said = tried_with(plan, gains)
    assert ("exposure", "antialias") in asked and ("antialias",) not in asked
    assert found.effects() == ("exposure", "poses")
    lines = {d.effect: d for d in found.decisions}
    assert lines["antialias"].decision == "off"
    assert lines["antialias"].gain_db == pytest.approx(-0.1 + 0.025)
    assert lines["antialias"].why == select_effects.PAYS_NOT and lines["exposure"].cost_ms == 1.5
    assert lines["SH degree"].gain_db is None
    assert len(said) == 3 and "antialias off: -0.08" in said[1]  # a line for every decision
    write_json(tmp_path / "plan.json", found.plain())
    assert read_plan(tmp_path / "plan.json") == found


@pytest.mark.parametrize(
    ("appearance", "on"), [(1.2, ("appearance",)), (0.55, ("exposure",)), (0.6, ("exposure",))]
)
def test_the_embedding_must_pay_beyond_exposure(appearance, on):
    gains = {"": 0, "exposure": 0.6, "appearance": appearance}
    found, _, _ = tried_with(plan_of(appearance=0.1, exposure=0.2), gains)
    assert found.effects() == on
    if "appearance" in on:
        assert {d.effect: d.why for d in found.decisions}["exposure"] == select_effects.COVERED


def test_within_noise_the_limit_decides_on_colour():
    plan = plan_of(sampling=3.0, exposure=0.2, appearance=0.1)
    names = select_effects.candidates(plan)

    def train(effects):  # each effect: +0.2 +- 0.2 dB
        return arm(*(20.0 + len(effects) * (0.2 + 0.5 * (-1) ** k) for k in range(6)))

    found = select_effects.try_effects(plan, names, train, dict.fromkeys(names, 1.0), print)
    assert found.effects() == ("exposure",)  # neither antialiasing nor appearance beyond it
    assert {d.effect: d.why for d in found.decisions}["exposure"] == select_effects.GUESSED
    below = plan_of(appearance=0.03, exposure=0.01)  # both are tried, no limit is reached
    found = select_effects.try_effects(
        below, select_effects.candidates(below), train, dict.fromkeys(names, 1.0), print
    )
    assert found.effects() == ()


def test_too_few_photos_leave_the_limits():
    names = ("exposure", "antialias")
    plan = plan_of(sampling=3.0, exposure=0.2)
    found = select_effects.try_effects(
        plan, names, lambda _: arm(20.0, 21.0), dict.fromkeys(names, 0.0), print
    )
    assert answers(found) == {"exposure": "on", "antialias": "off", "appearance": "off", "poses": "off"}


def test_a_limit_alone_switches_on_colour_only():
    found = select_effects.untried(plan_of(sampling=3.0, exposure=0.2, reprojection_px=3.0), "too short")
    assert found.effects() == ("exposure",)
    assert [d.why.endswith("not tried: too short") for d in found.decisions if d.effect == "antialias"]


def test_masks_are_off_where_leaving_the_patches_out_does_not_pay():
    plan = with_occlusion(plan_of(), Occlusion(0.02, 0.02, 0.1))
    for gain, answer in ((Gain(0.2, 0.05), "on"), (Gain(0.01, 0.005), "off"), (Gain(0.1, 0.2), "off")):
        found = {d.effect: d for d in select_effects.with_masks_tried(plan, gain).decisions}
        assert {found[name].decision for name in select_effects.MASK_LINES} == {answer}
        assert found["masks"].gain_db == gain.db
    assert select_effects.with_masks_tried(plan, None) == plan
    much = with_occlusion(plan_of(), Occlusion(2 * select_effects.CERTAIN, 0.02, 0.1))
    found = select_effects.with_masks_tried(much, Gain(-0.1, 0.05)).decisions[0]
    assert found.decision == "on" and found.gain_db == -0.1


# -- cost ---------------------------------------------------------------------------------------------


def test_probes_take_a_tenth_of_the_run_at_most():
    scene = synthetic()[0]
    lengths = []
    for iterations in (100, 700, 2000, 3000, 5000, 30_000, 100_000):
        room = allowance(scene, TrainConfig(iterations=iterations))
        for arms in (2, 3, 5):
            length = room.arm_iterations(arms)
            assert length == 0 or SHORTEST_ARM <= length <= LONGEST_ARM
            assert length == 0 or room.share(arms * (length + TIMED)) <= SHARE + 1e-9
        lengths.append(room.arm_iterations(2))
        assert room.masks_fit == (room.masks_s <= SHARE * room.run_s)
    assert lengths == sorted(lengths) and lengths[0] == 0 and lengths[-1] == LONGEST_ARM


# -- probes -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(write_tiny_scene(tmp_path_factory.mktemp("data") / "scene", distractors=False))


def test_blocks_are_a_share_of_every_photo_and_not_under_its_mask(scene, tmp_path):
    bench = Trials(scene, tmp_path)
    for block in bench.blocks:
        assert block.double().mean().item() == pytest.approx(HELD_BACK, abs=0.06)
    again, other = held_back(bench.data, 0), held_back(bench.data, 1)
    assert all(torch.equal(a, b) for a, b in zip(bench.blocks, again))
    assert not all(torch.equal(a, b) for a, b in zip(bench.blocks, other))
    keep = torch.ones(bench.blocks[0].shape)
    keep[:, :32] = 0
    masked = dataclasses.replace(bench.data, user_keep=[keep] * 6)
    assert not any(block[:, :32].any() for block in held_back(masked, 0))


def test_nothing_of_the_blocks_is_learnt(scene, tmp_path, monkeypatch):
    kept = []

    def gaussians(change):
        bench = Trials(scene, tmp_path)
        if change:
            for photo, block in zip(bench.data.photos, bench.blocks):
                photo[block] = 1 - photo[block]
        monkeypatch.setattr(
            "ambiguous_wild.harness.make_plan.Trainer",
            lambda *args, **more: kept.append(trainer(*args, **more)) or kept[-1],
        )
        bench.train((), 20)
        return kept[-1].gaussians

    from ambiguous_wild.splat.trainer import Trainer as trainer

    for (name, a), (_, b) in zip(gaussians(False).items(), gaussians(True).items()):
        assert torch.equal(a, b), name


def test_points_say_nothing_of_held_back_pixels():
    found, photos = synthetic()
    blocks = [torch.zeros(photo.shape[:2], dtype=torch.bool) for photo in photos]
    for block in blocks:
        block[:, :80] = True
    points = without_blocks(found, blocks)
    hidden = points.track_views == -1
    assert np.array_equal(hidden, found.points.track_xy[:, 0] < 80)
    assert np.array_equal(points.track_views[~hidden], found.points.track_views[~hidden])


def test_a_long_capture_is_sampled_evenly():
    found = synthetic()[0]
    many = dataclasses.replace(found, views=found.views * 10)
    few, places = sampled(many)
    assert len(few.train) == len(places) == 60 and places[0] == 0 and places[-1] == 119
    assert set(np.diff(places)) <= {2, 3}
    assert sampled(found) == (found, list(range(12)))


def test_photos_of_different_brightness_call_for_exposure_and_others_do_not(scene, tmp_path):
    def gain(factors):
        bench = Trials(scene, tmp_path)
        for photo, factor in zip(bench.data.photos, factors):
            photo *= factor
        return compare(bench.train(("exposure",), 120), bench.train((), 120))

    assert gain((0.6, 1.0, 0.7, 1.0, 0.6, 1.0)).pays()
    assert abs(gain((1.0,) * 6).db) < 0.3


def test_leaving_distractors_out_helps_and_leaving_the_scene_out_harms(scene, tmp_path):
    root = write_tiny_scene(tmp_path / "scene")
    truth = [cv2.imread(str(root / "truth" / "distractor" / name), 0) > 0 for name in TRAIN]
    patches = [torch.from_numpy(patch) for patch in truth]

    def gain(found):
        bench = Trials(found, tmp_path)
        arms = [bench.train((), 120, patches=patches, masked=masked) for masked in (True, False)]
        return compare(*arms)

    static, spoilt = gain(scene), gain(load_scene(root))
    assert not static.pays(LEAST_DB_MASKS) and spoilt.db > 0 > static.db


# -- the whole ----------------------------------------------------------------------------------------


class Counted:
    """Instead of trainings."""

    trained: tuple[tuple[str, ...], ...] = ()
    broken_at = 99

    def __init__(self, scene, folder, *, seed):
        self.data, self.chosen = None, list(range(6))

    def train(self, effects, iterations, **more):
        if len(Counted.trained) == Counted.broken_at:
            raise KeyboardInterrupt
        Counted.trained += (effects,)
        return arm(*(20.0 + len(effects) + 0.01 * k for k in range(6)))


def test_a_plan_goes_on_where_it_was_interrupted(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(Counted, "trained", ())
    monkeypatch.setattr(make_plan, "Trials", Counted)
    monkeypatch.setattr(make_plan, "plan_without_training", lambda _: plan_of(sampling=3.0, exposure=0.2))
    monkeypatch.setattr(make_plan, "step_costs", lambda data, names, folder: dict.fromkeys(names, 2.0))
    prepared = []

    def make(iterations=30_000):
        return make_plan.plan_with_probes(
            scene, TrainConfig(iterations=iterations), tmp_path, masks=False,
            prepare=lambda: prepared.append(True),
        )  # fmt: skip

    Counted.broken_at = 2
    with pytest.raises(KeyboardInterrupt):
        make()
    Counted.broken_at = 99
    plan = make()
    assert Counted.trained == ((), ("exposure",), ("exposure", "antialias"))  # each once
    assert plan.effects() == ("exposure", "antialias") and 0 < plan.cost.share <= SHARE
    again = make()
    assert len(Counted.trained) == 3
    assert again.decisions == plan.decisions
    (file,) = tmp_path.iterdir()
    file.write_text("{half")  # a file that cannot be read is made again
    assert make().decisions == plan.decisions and len(Counted.trained) == 6
    short = make(iterations=500)
    assert short.effects() == ("exposure",) and short.cost is None and len(Counted.trained) == 6
    assert len(prepared) == 5


def test_kept_probes_of_fewer_effects_are_completed(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(Counted, "trained", ())
    timed = []

    def costs(data, names, folder):
        timed.append(tuple(names))
        return dict.fromkeys(names, 2.0)

    monkeypatch.setattr(make_plan, "Trials", Counted)
    monkeypatch.setattr(make_plan, "step_costs", costs)

    def make(**found):
        monkeypatch.setattr(make_plan, "plan_without_training", lambda _: plan_of(**found))
        return make_plan.plan_with_probes(scene, TrainConfig(), tmp_path, masks=False, prepare=lambda: None)

    make(exposure=0.2)
    plan = make(exposure=0.2, sampling=3.0)  # one more effect is worth a probe
    assert plan.effects() == ("exposure", "antialias")
    assert timed == [("exposure",), ("antialias",)] and len(list(tmp_path.iterdir())) == 1


def test_a_run_under_a_budget_goes_on_with_the_probes_it_began(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(make_plan, "Trials", Counted)
    monkeypatch.setattr(make_plan, "plan_without_training", lambda _: plan_of(exposure=0.2))
    monkeypatch.setattr(make_plan, "step_costs", lambda data, names, folder: dict.fromkeys(names, 2.0))

    def make(slower):
        monkeypatch.setattr("ambiguous_wild.harness.make_plan.slowness", lambda: slower)
        config = TrainConfig(budget_s=60.0)
        return make_plan.plan_with_probes(scene, config, tmp_path, masks=False, prepare=lambda: None)

    first = make(1.0)
    assert len(Counted.trained) == 2
    later = make(1000.0)  # a machine that is busy now: no reason to decide otherwise
    assert len(Counted.trained) == 2 and later.decisions == first.decisions


def test_a_scene_that_calls_for_nothing_costs_nothing(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(make_plan, "plan_without_training", lambda _: plan_of())

    def never():
        raise AssertionError("nothing is to be compiled")

    plan = make_plan.plan_with_probes(scene, TrainConfig(), tmp_path, masks=False, prepare=never)
    assert plan == plan_of() and isinstance(plan, Plan) and isinstance(plan.decisions[0], Decision)
    assert list(tmp_path.iterdir()) == []


def test_bench_tries_within_its_own_length_and_keeps_what_it_tried(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(
        make_plan,
        "plan_without_training",
        lambda found: dataclasses.replace(plan_of(sampling=3.0), scene=found.name),
    )

    class Heard(Callbacks):
        lines: ClassVar[list[str]] = []

        def say(self, text):
            self.lines.append(text)

    more = {"output": tmp_path, "effects": "auto", "pictures": False, "device": "cpu"}
    report = bench("3dgs", scene.root, iterations=20, callbacks=Heard(), **more)
    (run,) = report.runs
    assert run.outcome == "trained" and run.effects == ()
    said = json.loads((run.folder / "effects.json").read_text())
    why = {d["effect"]: d["why"] for d in said["plan"]["decisions"]}
    assert why["antialias"].endswith(make_plan.TOO_SHORT)
    assert f"scene: antialias not tried: {make_plan.TOO_SHORT}" in Heard.lines
    assert list((tmp_path / ".cache" / "plans").glob("scene-*.json"))
