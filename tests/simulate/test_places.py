"""The room and the yard: walls with openings, cameras inside, distractors clear of what stands."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.core.camera import Camera
from ambiguous_wild.simulate import capture_writer
from ambiguous_wild.simulate.capture_writer import look_at
from ambiguous_wild.simulate.distractors import distractor_table
from ambiguous_wild.simulate.presets import PRESETS, resized
from ambiguous_wild.simulate.spec import PLANS, TEXTURES, CaptureSpec
from ambiguous_wild.simulate.spec_file import dump_spec, parse_spec
from ambiguous_wild.simulate.tracer import trace
from ambiguous_wild.simulate.world import SHEETS, WALL_AXES, on_wall, wall

PLACES = [name for name, spec in PRESETS.items() if spec.world.place != "courtyard"]


def small(name: str, views: int = 8, width: int = 96) -> CaptureSpec:
    return replace(resized(PRESETS[name], views=views, width=width), detail_px_per_m=5.0, samples=1)


def empty(name: str, views: int = 8) -> CaptureSpec:
    return replace(small(name, views), distractors=(), occlusion=(0.0, 0.0))


@pytest.mark.parametrize("place", ["room", "yard"])
def test_a_wall_is_whole_but_for_its_openings(place):
    plan = PLANS[place]
    openings = [(-1.0, 0.5, 0.9, 2.0), (1.0, 2.0, 0.0, 2.1)]
    for name in plan.walls:
        across, up = plan.surfaces[name]
        pieces = wall(plan, name, openings)
        area = sum(4 * s.half[0] * s.half[1] for s in pieces)
        assert area == pytest.approx(across * up - 1.5 * 1.1 - 1.0 * 2.1)
        along = np.array(WALL_AXES[name][0], float)
        for s in pieces:  # each piece shows its own part of the texture
            assert s.offset[0] == pytest.approx(0.5 + (np.array(s.center) @ along) / across)
            assert s.offset[1] == pytest.approx(s.center[2] / up)
            assert plan.gap(*s.center[:2]) == pytest.approx(0.0, abs=1e-9)


def test_one_looks_out_of_the_windows_and_not_through_the_walls():
    world = capture_writer.plan_capture(empty("room", views=3), 0)[0]
    plan = PLANS["room"]

    def depth(along: float, height: float) -> float:
        target = np.array(on_wall(plan, "wall_left", along, height, 0.0))
        eye = np.array([target[0] + 1.5, target[1], 1.5])
        camera = Camera(9, 9, 200.0, 200.0, 4.5, 4.5, look_at(eye, target, 0.0))
        found = trace(
            camera, world.table(), distractor_table(empty("room"), (), world), world.atlas, world.light
        )
        return float(found.depth_m[4, 4])

    assert depth(-0.95, 1.5) > 10.0  # the sky
    assert depth(1.1, 1.5) == pytest.approx(1.5, abs=0.02)


@pytest.mark.parametrize("name", ["room", "yard"])
def test_cameras_are_inside_and_look_where_the_walk_says(name):
    spec = empty(name, views=12)
    for seed in range(3):
        world, shots = capture_writer.plan_capture(spec, seed)
        for shot in shots:
            out = shot.camera.center[:2] - np.array(world.hub[:2])
            ahead = shot.camera.cam_from_world[2, :2]
            assert world.plan.gap(*shot.camera.center[:2]) > 0.1
            assert (ahead @ out > 0) == (spec.walk == "outward")
    if spec.walk == "outward":
        looks = np.sort([np.arctan2(*s.camera.cam_from_world[2, 1::-1]) for s in shots if s.split == "train"])
        assert np.diff(np.append(looks, looks[0] + 2 * np.pi)).max() < 2.2 * 2 * np.pi / 12  # all around


@pytest.mark.parametrize("name", PLACES)
def test_distractors_stand_clear_and_cover_what_the_preset_says(name):
    spec = small(name)
    world, shots = capture_writer.plan_capture(spec, 1)
    static = world.table()
    shares = []
    for shot in shots:
        for p in shot.placements:
            clear = 1.2 if spec.distractors[p.which].kind == "car" else 0.3
            away = np.hypot(*(world.keep_out[:, :2] - (p.x_m, p.y_m)).T) - world.keep_out[:, 2]
            assert away.min() >= clear and world.plan.gap(p.x_m, p.y_m) >= 0.3 + clear - 1e-9
        if shot.split == "train":
            table = distractor_table(spec, shot.placements, world)
            shares.append((trace(shot.camera, static, table, world.atlas, world.light).owner > 0).mean())
    low, high = spec.occlusion
    assert max(shares) <= high + 0.05 and np.mean(shares) >= low + 0.02 * bool(spec.distractors)


def test_a_place_is_named_in_the_file_and_has_limits_of_its_own():
    text = "world:\n  place: yard\n  things:\n  - {kind: car, texture: enamel, at_m: [8, 0, 0]}"
    spec = parse_spec(text + "\nwalk: outward\narc_deg: 360\nradius_m: [0.5, 1]\n")
    assert parse_spec(dump_spec(spec)) == spec
    with pytest.raises(AwError, match=r"world.things\[0\].at_m x: between -5.6 and 5.6"):
        parse_spec(text.replace("yard", "courtyard"))
    with pytest.raises(AwError, match="arc_deg: between 5 and 150"):
        parse_spec("arc_deg: 360")
    parse_spec("eye_m: [2.9, 3.2]")
    with pytest.raises(AwError, match=r"eye_m: between 0\.2 and 2\.4"):  # the room has a ceiling
        parse_spec("world: {place: room}\neye_m: [2.3, 2.5]")
    with pytest.raises(AwError, match="place"):
        parse_spec("world: {place: beach}")
    with pytest.raises(AwError, match="into a wall of the room"):
        capture_writer.plan_capture(parse_spec("world: {place: room}\ndetail_px_per_m: 5"), 0)


def test_every_texture_that_a_spec_may_name_is_painted():
    assert set(SHEETS) == set(TEXTURES)


def test_cameras_and_rays_do_not_depend_on_the_processor():
    """BLAS would: its last digits follow from the kernels that it chooses for the processor."""
    code = (
        "import numpy as np\n"
        "from ambiguous_wild.core import Camera\n"
        "from ambiguous_wild.simulate.capture_writer import look_at\n"
        "rng = np.random.default_rng(0)\n"
        "poses = [look_at(*rng.normal(size=(2, 3)), rng.normal()) for _ in range(200)]\n"
        "centres = [Camera(8, 8, 9.0, 9.0, 4.0, 4.0, pose).center for pose in poses]\n"
        "print(np.concatenate([np.ravel(poses), np.ravel(centres)]).tobytes().hex())"
    )
    said = {
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"OPENBLAS_CORETYPE": kernels},
            capture_output=True, check=True, text=True,
        ).stdout
        for kernels in ("Nehalem", "Haswell")
    }  # fmt: skip
    assert len(said) == 1 and len(said.pop()) > 200 * 19 * 16 - 1
