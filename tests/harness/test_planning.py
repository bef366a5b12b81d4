"""Evidence on small tracks with an effect injected and without; what `--effects` makes of it."""

import contextlib
import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from ambiguous_wild.core import AwError, Camera, Scene, SparsePoints, View
from ambiguous_wild.harness import effects_plan, mask_plan
from ambiguous_wild.harness import effects_plan as decide_module
from ambiguous_wild.harness.cell import RunOptions, scene_identity
from ambiguous_wild.harness.chosen_effects import parse_effects
from ambiguous_wild.harness.effects_plan import (
    FEW_PHOTOS,
    OUTWARD,
    EffectsPlan,
    decide,
    measure_evidence,
    plan_effects,
    read_plan,
)
from ambiguous_wild.harness.grid import cell_folder, choose_effects, plan_cells, run_cells
from ambiguous_wild.harness.mask_plan import Occlusion, residual_mask, summarise, with_occlusion
from ambiguous_wild.io.files import write_json
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.splat.train_config import TrainConfig
from tests.tiny_scene import write_tiny_scene

VIEWS, POINTS, WIDTH, HEIGHT, FOCAL = 12, 150, 160, 90, 200.0


def look_at(centre):
    z = -centre / np.linalg.norm(centre)
    x = np.cross([0, 1.0, 0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def synthetic(*, exposure=0.0, place=0.0, zoom=1.0, shine=0.0, seed=0):
    """A cloud of coloured dots from an arc of cameras; each keyword injects one effect."""
    rng = np.random.default_rng(seed)
    xyz, rgb = rng.uniform(-1, 1, (POINTS, 3)), rng.uniform(0.25, 0.6, (POINTS, 3))
    normal = rng.normal(size=(POINTS, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    views, photos, xy, seen = [], [], [], []
    for k in range(VIEWS):
        angle = np.radians(-40 + 80 * k / (VIEWS - 1))
        centre = 5.0 * np.array([np.sin(angle), 0.2 * np.sin(3 * angle), -np.cos(angle)])
        focal = FOCAL * zoom ** (k / (VIEWS - 1))
        camera = Camera(WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, look_at(centre))
        local = xyz @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        uv = local[:, :2] / local[:, 2:] * focal + [WIDTH / 2, HEIGHT / 2]
        inside = ((uv > 3) & (uv < [WIDTH - 3, HEIGHT - 3])).all(axis=1)
        direction = (centre - xyz) / np.linalg.norm(centre - xyz, axis=1, keepdims=True)
        colour = rgb + shine * (normal * direction).sum(axis=1, keepdims=True)
        colour = colour * np.exp(exposure * rng.normal(size=3)) * np.exp(place * rng.normal(size=(POINTS, 1)))
        photo = np.full((HEIGHT, WIDTH, 3), 0.4) + rng.normal(size=(HEIGHT, WIDTH, 3)) * 0.01
        for i in np.argsort(-local[:, 2]):  # near ones last
            if inside[i]:
                c, r = np.floor(uv[i]).astype(int)
                photo[r - 2 : r + 3, c - 2 : c + 3] = colour[i]
        views.append(View(f"{k}.png", None, camera, "train"))
        photos.append(np.clip(photo + rng.normal(size=photo.shape) * 0.01, 0, 1))
        xy.append(uv)
        seen.append(inside)
    seen, xy = np.stack(seen, 1), np.stack(xy, 1)  # [POINTS, VIEWS]
    offsets = np.concatenate([[0], np.cumsum(seen.sum(axis=1))])
    points = SparsePoints(
        xyz, (rgb * 255).astype(np.uint8), np.zeros(POINTS), offsets,
        np.nonzero(seen)[1].astype(np.int32), xy[seen].astype(np.float32),
    )  # fmt: skip
    return Scene(None, "dots", tuple(views), points), photos


def measured(**kw):
    """As of many photos; here are few, to be quick."""
    return dataclasses.replace(measure_evidence(*synthetic(**kw)), photos=FEW_PHOTOS + 1)


def decisions(**kw):
    return {d.effect: d for d in decide("dots", measured(**kw)).decisions}


INJECTED = {
    "exposure": {"exposure": 0.15},
    "appearance": {"place": 0.4},
    "antialias": {"zoom": 3.0},
}


@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_is_called_for_where_nothing_was_put_in(seed):
    found = decisions(seed=seed)
    off = dict.fromkeys([*INJECTED, "dense"], "off")
    assert {name: d.decision for name, d in found.items()} == {**off, "skybox": "on"}


@pytest.mark.parametrize(
    "effect", [*INJECTED, "shine"]
)  # no effect is for a colour that follows the direction
def test_what_was_put_in_is_called_for_and_nothing_else(effect):
    answers = {name: d.decision for name, d in decisions(**INJECTED.get(effect, {"shine": 0.25})).items()}
    assert {name for name, a in answers.items() if a == "on"} == {effect} & {*INJECTED} | {"skybox"}


@pytest.mark.parametrize(
    ("photos", "answer"), [(0, "unknown"), (2, "unknown"), (3, "on"), (24, "on"), (25, "off")]
)
def test_few_photos_call_for_a_dense_start(photos, answer):
    plan = decide("dots", dataclasses.replace(measured(), photos=photos))
    assert [d.decision for d in plan.decisions if d.effect == "dense"] == [answer]
    assert plan.effects() == (("dense",) if answer == "on" else ("skybox",))
    assert (
        choose_effects("auto", synthetic()[0], [get_method("refinesplat")], plan)["refinesplat"].effects
        == plan.effects()
    )


@pytest.mark.parametrize(("outward", "dense"), [(0.1, "off"), (1.1, "off"), (7.0, "on")])
def test_cameras_in_the_middle_of_a_place_call_for_a_dense_start(outward, dense):
    plan = decide("dots", dataclasses.replace(measured(), outward=outward))
    (line,) = (d for d in plan.decisions if d.effect == "dense")
    assert line.decision == dense
    shown = (line.value, line.threshold, line.unit)
    assert shown == ((outward, OUTWARD, "times") if dense == "on" else (25, FEW_PHOTOS, "photos"))


def test_a_dense_start_takes_the_room_of_a_skybox():
    plan = decide("dots", dataclasses.replace(measured(), photos=FEW_PHOTOS))
    (line,) = (d for d in plan.decisions if d.effect == "skybox")
    assert line.decision == "off" and "dense start" in line.why


def test_cameras_around_a_thing_look_inward_and_those_in_its_middle_outward():
    scene, photos = synthetic()
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])  # each camera looks back, at points mirrored in its centre
    assert measure_evidence(scene, photos).outward < 0.2
    views, xyz = [], []
    for view in scene.views:
        camera = dataclasses.replace(view.camera, cam_from_world=turned @ view.camera.cam_from_world)
        views.append(dataclasses.replace(view, camera=camera))
        xyz.append(view.camera.center + 10.0 * camera.cam_from_world[2, :3] + np.eye(3)[[0, 1, 2, 0, 1]])
    count = len(views) * 5
    points = SparsePoints(
        np.concatenate(xyz), np.zeros((count, 3), np.uint8), np.zeros(count), np.arange(count + 1),
        np.repeat(np.arange(len(views)), 5).astype(np.int32), np.zeros((count, 2), np.float32),
    )  # fmt: skip
    scene = dataclasses.replace(scene, views=tuple(views), points=points)
    assert effects_plan.outward_ratio(scene) > OUTWARD
    assert math.isnan(effects_plan.outward_ratio(dataclasses.replace(scene, views=tuple(views[:2]))))


@pytest.mark.parametrize("jitter", [0.0, 1e-4])
def test_cameras_at_one_place_look_neither_inward_nor_outward(jitter):
    scene, _ = synthetic()
    views = []
    for k, view in enumerate(scene.views):  # all turn about the place of the first
        pose = view.camera.cam_from_world.copy()
        centre = scene.views[0].camera.center + jitter * np.eye(3)[k % 3]
        pose[:3, 3] = -pose[:3, :3] @ centre
        camera = dataclasses.replace(view.camera, cam_from_world=pose)
        views.append(dataclasses.replace(view, camera=camera))
    found = dataclasses.replace(
        measured(), outward=effects_plan.outward_ratio(dataclasses.replace(scene, views=tuple(views)))
    )
    assert math.isnan(found.outward)
    assert decide("dots", found).effects() == ("skybox",)


def test_what_stands_before_points_is_no_light_that_differs_by_place(monkeypatch):
    scene, photos = synthetic()
    rng = np.random.default_rng(0)
    for photo in photos:  # a fourteenth of each is covered
        row, column = rng.integers(0, HEIGHT - 25), rng.integers(0, WIDTH - 40)
        photo[row : row + 25, column : column + 40] = rng.uniform(0.1, 0.9, 3)
    assert measure_evidence(scene, photos).appearance < decide_module.APPEARANCE / 2
    monkeypatch.setattr(effects_plan, "OUTLYING", math.inf)
    assert measure_evidence(scene, photos).appearance > decide_module.APPEARANCE


@pytest.mark.parametrize("changed", [2, 3, 4, 8])
def test_light_of_few_photos_is_not_taken_for_what_stands_before_points(changed):
    (scene, photos), (_, relit) = synthetic(), synthetic(place=0.4)
    for k in np.linspace(0, VIEWS - 1, changed).astype(int):
        photos[k] = relit[k]
    assert measure_evidence(scene, photos).appearance > 1.3 * decide_module.APPEARANCE


def test_the_numbers_are_what_was_put_in():
    assert measure_evidence(*synthetic(exposure=0.15)).exposure == pytest.approx(0.15, rel=0.35)
    assert measure_evidence(*synthetic(zoom=3.0)).sampling == pytest.approx(3.0 ** (0.9), rel=0.1)


def test_a_scene_without_tracks_reads_no_photo_and_says_unknown():
    scene, _ = synthetic()
    empty = dataclasses.replace(scene.points, track_views=np.full_like(scene.points.track_views, -1))
    plan = plan_effects(dataclasses.replace(scene, points=empty))
    answers = {d.effect: d.decision for d in plan.decisions}
    assert answers.pop("skybox") == "on"
    assert set(answers.values()) == {"unknown"}
    assert plan.effects() == ("skybox",)


def test_a_plan_survives_its_file(tmp_path):
    plan = with_occlusion(decide("dots", measured(zoom=3.0)), Occlusion(0.1, 0.02, 0.3))
    plan = plan.with_costs({"antialias": 0.5})
    write_json(tmp_path / "plan.json", plan.plain())
    again = read_plan(tmp_path / "plan.json")
    assert again.plain() == plan.plain()
    assert again.effects() == ("antialias", "skybox")
    assert [d.cost_ms for d in again.decisions if d.effect == "antialias"] == [0.5]
    for text in (
        "{half",
        "[]",
        '{"schema": 2}',
        json.dumps(plan.plain() | {"decisions": [{"decision": "on"}]}),
        json.dumps({k: v for k, v in plan.plain().items() if k != "scene_hash"}),  # of any scene
    ):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(AwError, match="is no plan"):
            read_plan(tmp_path / "bad.json")


def test_what_a_probe_leaves():
    rng = np.random.default_rng(0)
    render = rng.uniform(0.2, 0.8, (90, 160, 3))
    everywhere = np.ones((90, 160), bool)
    photo = np.clip(render + rng.normal(size=render.shape) * 0.1, 0, 1)  # detail that was not learnt
    assert not residual_mask(photo, render, everywhere).any()
    photo[30:60, 40:80] = render[30:60, 40:80] + 0.3
    patch = residual_mask(photo, render, everywhere)
    truth = np.zeros_like(patch)
    truth[30:60, 40:80] = True
    assert (patch & truth).sum() > 0.9 * truth.sum() and (patch & ~truth).sum() < 0.35 * truth.sum()
    assert not residual_mask(photo, render, ~truth)[truth].any()
    found = summarise([patch] + [np.zeros_like(patch)] * 9)
    assert found.share == pytest.approx(patch.mean() / 10) and found.worst == pytest.approx(patch.mean())
    assert found.compact == 0.0  # larger than a twentieth of the photo


# -- --effects ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("found", "rounds", "share"),
    [([0.0005], [300], 0.0005), ([0.02, 0.001], [300, 1200], 0.001), ([0.02, 0.015], [300, 1200], 0.015)],
)
def test_what_stands_out_must_stay_when_a_longer_probe_has_learnt_the_rest(monkeypatch, found, rounds, share):
    told, made, ticks = iter(found), [], []

    def instead(scene, effects, *, iterations, tick):
        made.append((scene, effects, iterations))
        tick()
        return Occlusion(next(told), 0.0, 0.0)

    @contextlib.contextmanager
    def bar(total):
        yield SimpleNamespace(update=lambda: ticks.append(total))

    monkeypatch.setattr(mask_plan, "occlusion", instead)
    left = mask_plan.measure_occlusion("scene", ("exposure",), bar=bar)
    assert left.share == share
    assert made == [("scene", ("exposure",), n) for n in rounds]
    assert ticks == rounds


def test_words_and_lists():
    assert parse_effects("auto") == parse_effects("none") == ()
    assert parse_effects("poses, exposure") == ("exposure", "poses")
    for wrong, message in (("auto,poses", "be combined"), (" , ", "is empty"), ("exposur", "did you mean")):
        with pytest.raises(AwError, match=message):
            parse_effects(wrong)


def test_every_method_that_can_takes_the_effects_of_the_scene():
    scene, _ = synthetic()
    plan = decide("dots", measured(zoom=3.0, exposure=0.15))
    methods = [get_method(name) for name in ("3dgs", "refinesplat", "refinesplat@mask=truth")]
    program = dataclasses.replace(get_method("3dgs"), name="theirs", program=object())
    chosen = choose_effects("auto", scene, [*methods, program], plan)
    assert {chosen[m.name].effects for m in methods} == {("exposure", "antialias", "skybox")}
    assert chosen["theirs"].effects == () and not chosen["theirs"].asked
    assert choose_effects("poses", scene, [*methods, program], plan)["theirs"].effects == ()
    assert {c.effects for c in choose_effects("none", scene, methods, plan).values()} == {()}
    with pytest.raises(AwError, match="of scene dots, not of other"):
        choose_effects("auto", dataclasses.replace(scene, name="other"), methods, plan)


SHORT = TrainConfig(iterations=40, probes=0)


def test_a_scene_that_calls_for_nothing_keeps_the_identity_of_its_runs(scene):
    (none,) = plan_cells(["refinesplat"], [scene], [0], SHORT)
    (auto,) = plan_cells(["refinesplat"], [scene], [0], SHORT, effects="auto", plan=EffectsPlan("scene", ()))
    (listed,) = plan_cells(["refinesplat"], [scene], [0], SHORT, effects="poses")
    assert none.identity == auto.identity != listed.identity
    assert none.config == auto.config


def test_a_plan_of_another_state_of_the_scene_is_refused(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    plan = EffectsPlan("scene", (), scene_hash=scene_identity(load_scene(scene)))
    write_json(tmp_path / "plan.json", plan.plain())
    given = {"effects": "auto", "plan": read_plan(tmp_path / "plan.json")}
    assert plan_cells(["3dgs"], [scene], [0], SHORT, **given)
    (photo := next((scene / "images").iterdir())).write_bytes(photo.read_bytes() + b"0")
    with pytest.raises(AwError, match="of another state of scene scene"):
        plan_cells(["3dgs"], [scene], [0], SHORT, **given)


def test_a_run_says_what_was_on_and_why_and_ships_the_filtered_model(scene, tmp_path):
    plan = EffectsPlan("scene", decide("scene", measured(zoom=3.0)).decisions)
    cells = plan_cells(["3dgs"], [scene], [0], SHORT, effects="auto", plan=plan, protocol="half")
    (report,) = run_cells(cells, tmp_path, RunOptions(tmp_path / ".cache", pictures=False))
    assert report.outcome == "trained", report.error
    said = json.loads((cell_folder(tmp_path, cells[0]) / "effects.json").read_text())
    assert said["asked"] == "auto" and said["effects"] == ["antialias", "skybox"]
    assert {d["effect"] for d in said["plan"]["decisions"]} == {*INJECTED, "skybox", "dense"}
    facts = report.result["facts"]
    assert facts["effects"] == ["antialias", "skybox"] and facts["protocol"] == "half"
    assert facts["effect_facts"]["antialias"]["filter_size_median"] > 0
    assert not any(math.isnan(row["psnr"]) for row in report.result["per_image"])
    with pytest.raises(AwError, match="effects was"):
        run_cells(plan_cells(["3dgs"], [scene], [0], SHORT, protocol="half"), tmp_path)


def test_options_are_checked_before_a_plan_is_made(tmp_path, monkeypatch):
    scene = write_tiny_scene(tmp_path / "scene")
    monkeypatch.setattr("ambiguous_wild.harness.grid.choose_effects", pytest.fail)
    with pytest.raises(AwError, match="most is at least 0, got -1"):
        plan_cells(
            ["refinesplat"], [scene], [0], TrainConfig(),
            settings=["refinesplat.first_look.most=-1"], effects="auto",
        )  # fmt: skip
