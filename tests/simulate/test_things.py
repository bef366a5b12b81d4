"""What stands, walks and zooms: statues from distance grids, things of a spec, walkers, focal lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.simulate import capture_writer, shapes
from ambiguous_wild.simulate.capture_writer import look_at
from ambiguous_wild.simulate.distractors import DistractorPose, distractor_shapes, place_distractors
from ambiguous_wild.simulate.kernels import QUAD, VOLUME
from ambiguous_wild.simulate.presets import preset, resized
from ambiguous_wild.simulate.shapes import UNSEEN, Shape, shape_table
from ambiguous_wild.simulate.spec import PLANS, STATUES, Distractor, Thing, WorldSpec
from ambiguous_wild.simulate.tracer import Light, build_atlas, trace
from ambiguous_wild.simulate.world import thing_footprint, thing_shapes

ATLAS = build_atlas({"stone": np.full((4, 4, 3), 0.5, np.float32)})
LIGHT = Light(np.array([[0.0, -0.6, 0.8]]), np.ones(3), np.full(3, 0.3), np.full(3, 0.3))
EYE = np.array([0.0, -6.0, 0.0])
CAMERA = Camera(120, 120, 240.0, 240.0, 60.0, 60.0, look_at(EYE, np.zeros(3), 0.0))


def test_a_ball_of_distances_is_seen_where_the_ball_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(shapes.STATUES, "test ball", lambda p: np.linalg.norm(p, axis=-1) - 0.7)
    shape = Shape(VOLUME, (0.1, 0.0, -0.2), (1.5, 1.5, 1.5), "stone", volume="test ball")
    wall = Shape(QUAD, (0, 3, 0), (9, 9, 0), "stone", ((1, 0, 0), (0, 0, 1), (0, -1, 0)))
    seen = trace(
        CAMERA, shape_table([wall], ATLAS), shape_table([replace(shape, owner=1)], ATLAS), ATLAS, LIGHT
    )
    rows, columns = np.mgrid[0:120, 0:120] + 0.5
    rays = np.stack([(columns - 60) / 240, np.ones_like(rows), (60 - rows) / 240], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    to = np.array(shape.center) - EYE
    off = np.sqrt(to @ to - (rays @ to) ** 2)
    assert ((seen.owner > 0) == (off < 1.05))[np.abs(off - 1.05) > 0.02].all()
    alone = trace(CAMERA, shape_table([shape], ATLAS), shape_table([], ATLAS), ATLAS, LIGHT)
    along = rays @ to - np.sqrt(np.maximum(1.05**2 - off**2, 0))
    inside = off < 0.9
    assert alone.depth_m[inside] == pytest.approx((along * rays[..., 1])[inside], abs=0.02)


@pytest.mark.parametrize("name", STATUES)
def test_a_statue_is_one_solid_on_its_foot_inside_its_sphere(name: str) -> None:
    from scipy import ndimage

    values = shapes.grid(name)
    solid = values < 0
    assert 0.02 < solid.mean() < 0.35 and ndimage.label(solid)[1] == 1
    axis = np.linspace(-1, 1, shapes.SIZE)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    assert max(np.abs(a[solid]).max() for a in (x, y, z)) < 0.95
    assert z[solid].min() == pytest.approx(-0.9, abs=0.035)
    for a in range(3):  # outside, a ray that advances by 0.8 of the distance does not step through a wall
        low, high = np.moveaxis(values, a, 0)[:-1], np.moveaxis(values, a, 0)[1:]
        outside = (low > 0) & (high > 0)
        assert np.abs(high - low)[outside].max() / (axis[1] - axis[0]) < 1.25


def test_statues_throw_shadows_and_the_unseen_is_not_seen() -> None:
    ground = Shape(QUAD, (0, 0, -1.0), (9, 9, 0), "stone", casts=False)
    above = Camera(80, 80, 60.0, 60.0, 40.0, 40.0, look_at(np.array([0, -0.1, 9.0]), np.zeros(3), 0.0))
    bust = Shape(VOLUME, (0, 0, 0.5), (1.5, 1.5, 1.5), "stone", volume="bust")
    nobody = shape_table([], ATLAS)
    free = trace(above, shape_table([ground], ATLAS), nobody, ATLAS, LIGHT)
    unseen = trace(above, shape_table([ground, replace(bust, owner=UNSEEN)], ATLAS), nobody, ATLAS, LIGHT)
    assert np.array_equal(free.depth_m, unseen.depth_m)
    dark = unseen.clean[..., 0] < 0.6 * free.clean[..., 0]
    assert 0.003 < dark.mean() < 0.1 and np.array_equal(unseen.clean[~dark], free.clean[~dark])
    seen = trace(above, shape_table([ground, bust], ATLAS), nobody, ATLAS, LIGHT)
    assert (seen.depth_m < free.depth_m - 0.5).mean() > 0.003


@pytest.mark.parametrize("kind", ["box", "ball", "column", "board", "figure", *STATUES])
def test_a_thing_stands_on_the_ground_at_its_place(kind: str) -> None:
    thing = Thing(kind, "stone", (0.5, -1.0, 0.0), (0.8, 0.4, 1.6), 30.0)  # type: ignore[arg-type]
    camera = Camera(
        90, 150, 150.0, 150.0, 45.0, 75.0, look_at(np.array([0.5, -7.0, 0.8]), np.array([0.5, -1, 0.8]), 0.0)
    )
    things = shape_table([replace(s, owner=1) for s in thing_shapes(thing, PLANS["courtyard"])], ATLAS)
    rows, columns = np.nonzero(trace(camera, shape_table([], ATLAS), things, ATLAS, LIGHT).owner)
    scale = 150.0 / 6.0
    top, foot = (75 - rows.min()) / scale + 0.8, (74 - rows.max()) / scale + 0.8
    assert foot == pytest.approx(0.0, abs=0.12) and 1.3 < top < 1.75
    assert (columns.min() + columns.max()) / 2 == pytest.approx(45, abs=5)
    assert thing_footprint(thing)[:2] == (0.5, -1.0)
    assert (
        thing_footprint(replace(thing, at_m=(0.5, -1.0, 2.0)))[2] == 0 < thing_footprint(thing)[2]
    )  # above all heads


def test_a_walker_keeps_to_its_way_and_speed() -> None:
    walker = Distractor(
        "w",
        "visitor",
        "cloth",
        "none",
        presence=1.0,
        distance_m=(0.3, 4.5),
        path="walk",
        waypoints=((-3.0, -2.0), (3.0, -2.0)),
        laps=1.0,
    )
    spec = replace(
        resized(preset("walkers"), views=9, width=64), distractors=(walker,), detail_px_per_m=6.0, samples=1
    )
    world, shots = capture_writer.plan_capture(spec, 0)
    x = [s.placements[0].x_m for s in shots[:9]]
    assert x == pytest.approx([-3, -1.5, 0, 1.5, 3, 1.5, 0, -1.5, -3], abs=1e-9)
    assert {round(s.placements[0].y_m, 6) for s in shots[:9]} == {-2.0}
    yaws = (
        {round(s.placements[0].yaw_deg) % 360 for s in shots[1:4]},
        {round(s.placements[0].yaw_deg) % 360 for s in shots[5:8]},
    )
    assert yaws == ({90}, {270})
    shy = replace(spec, distractors=(replace(walker, distance_m=(3.0, 4.5)),))
    cameras = [s.camera for s in shots[:9]]
    there = place_distractors(shy, cameras, world, np.random.default_rng(0))
    away = [np.hypot(*(c.center[:2] - (at, -2.0))) for c, at in zip(cameras, x)]
    assert [bool(p) for p in there] == [d >= 3.0 for d in away] and 0 < sum(map(bool, there)) < 9
    rare = replace(spec, distractors=(replace(walker, presence=0.3),))
    placed = place_distractors(rare, cameras, world, np.random.default_rng(0))
    assert 0 < sum(bool(p) for p in placed) < 9


def test_who_stands_keeps_its_place_and_a_visitor_turns_and_bends() -> None:
    visitor = Distractor("v", "visitor", "cloth", "none", presence=1.0, distance_m=(0.3, 6.0), bend_deg=80.0,
                         path="walk", waypoints=((-1.0, -1.0),))  # fmt: skip
    bust = replace(visitor, name="b", kind="bust", bend_deg=0.0, waypoints=((1.0, -1.0),))
    spec = replace(
        resized(preset("walkers"), views=9, width=64),
        distractors=(visitor, bust),
        detail_px_per_m=6.0,
        samples=1,
    )
    _, shots = capture_writer.plan_capture(spec, 0)
    placements = [shot.placements for shot in shots[:9]]
    for which, x, turns in ((0, -1.0, 9), (1, 1.0, 1)):
        of = [p for group in placements for p in group if p.which == which]
        assert {(p.x_m, p.y_m) for p in of} == {(x, -1.0)} and len(of) == 9
        assert len({p.yaw_deg for p in of}) == len({p.pose for p in of}) == turns


def test_a_bent_figure_has_its_head_where_the_turn_about_its_hip_puts_it() -> None:
    upright, bowed = shapes.figure("cloth", "skin"), shapes.figure("cloth", "skin", bend_deg=90.0)
    feet, head = slice(0, 4), [k for k, s in enumerate(upright) if s.center[2] > 1.6]
    assert upright[feet] == bowed[feet] and len(head) == 2
    for k in head:  # at a right angle, what was above the hip lies in front of it
        x, y, z = upright[k].center
        hip = 0.92
        assert bowed[k].center == pytest.approx((x, -(z - hip), hip + y))


def front(shapes: list[Shape]) -> np.ndarray:
    """Where a car or a person faces: away from the red lamps, or where the face is in the hair. [2] unit."""
    centre = np.array([s.center[:2] for s in shapes])
    red = np.array([s.tint[1] < 0.1 * s.tint[0] for s in shapes])
    hair, face = (s.center[:2] for s in sorted(shapes, key=lambda s: -s.center[2])[:2])
    ahead = centre.mean(0) - centre[red].mean(0) if red.any() else np.subtract(face, hair)
    return ahead / np.linalg.norm(ahead)


@pytest.mark.parametrize("kind", ["car", "visitor"])
@pytest.mark.parametrize("yaw", [0.0, 70.0, -130.0])
def test_who_is_blurred_moves_where_it_faces_during_the_exposure(kind: str, yaw: float) -> None:
    still = Distractor("d", kind, "cloth", "none")  # type: ignore[arg-type]
    place = DistractorPose(0, 0.5, -1.0, yaw, 0.3)
    whole = distractor_shapes(still, place, PLANS["yard"])
    moving = distractor_shapes(replace(still, blur_m=0.8), place, PLANS["yard"])
    centres = np.array([[s.center for s in moving if s.instant == k] for k in range(4)])
    assert len(moving) == 4 * len(whole)
    assert centres.mean(0) == pytest.approx(np.array([s.center for s in whole]))
    steps = np.diff(centres, axis=0)
    assert steps[..., 2] == pytest.approx(0)
    assert steps[..., :2] == pytest.approx(np.broadcast_to(0.2 * front(whole), (3, len(whole), 2)), abs=1e-6)


def test_a_car_that_drives_faces_its_way() -> None:
    car = Distractor("c", "car", "enamel", "none", presence=1.0, distance_m=(0.3, 12.0), path="walk",
                     waypoints=((-3.0, -2.0), (3.0, 1.0)))  # fmt: skip
    spec = replace(resized(preset("walkers"), views=8, width=64), distractors=(car,), detail_px_per_m=6.0)
    spec = replace(spec, samples=1, world=WorldSpec(furniture=False, statue=False))
    _, shots = capture_writer.plan_capture(spec, 0)
    places = [shot.placements[0] for shot in shots[:8]]  # 0 to 3 there, 4 to 7 back
    ways = np.diff([(p.x_m, p.y_m) for p in places], axis=0)
    for k in (0, 1, 2, 4, 5, 6):
        ahead = front(distractor_shapes(car, places[k], PLANS["courtyard"]))
        assert ahead == pytest.approx(ways[k] / np.linalg.norm(ways[k]), abs=1e-6), k
    assert ways[0] @ ways[6] < 0


def test_one_whom_the_camera_follows_sways_in_front_of_it_and_is_seen_from_behind() -> None:
    spec = replace(resized(preset("followed"), width=64), detail_px_per_m=6.0, samples=1)
    _, shots = capture_writer.plan_capture(spec, 0)
    low, high = spec.distractors[0].distance_m
    angles, away = [], []
    for shot in shots[: spec.train_views]:
        if not shot.placements:  # furniture stands there
            continue
        (place,) = shot.placements
        to = np.array([place.x_m, place.y_m]) - shot.camera.center[:2]
        forward = shot.camera.cam_from_world[2, :2]
        heading = np.rad2deg(np.arctan2(forward[1], forward[0]))
        angles.append((np.rad2deg(np.arctan2(to[1], to[0])) - heading + 180) % 360 - 180)
        away.append(np.hypot(*to))
        assert np.cos(np.deg2rad(place.yaw_deg - heading - 90)) == pytest.approx(1)  # figures face -y
    assert low - 1e-9 <= min(away) and max(away) <= high + 1e-9 and np.ptp(away) > 0.8 * (high - low)
    assert np.abs(angles).max() < 8 and np.ptp(angles) > 8 and np.abs(np.diff(angles)).max() < 4


def test_zoom_varies_the_focal_length_in_photo_truth_and_exif(tmp_path) -> None:
    spec = replace(resized(preset("zoom"), views=6, width=64), detail_px_per_m=6.0, samples=1, distractors=())
    spec = replace(spec, occlusion=(0.0, 0.0))
    capture_writer.simulate(spec, tmp_path / "raw")
    _, shots = capture_writer.plan_capture(spec, 0)
    base = capture_writer.plan_capture(replace(spec, zoom=(1.0, 1.0)), 0)[1]
    factors = [s.camera.fx / b.camera.fx for s, b in zip(shots, base)]
    assert min(factors) < 1.0 and max(factors) > 1.6 and all(0.85 <= f <= 1.9 for f in factors)
    for shot in shots:
        fields = Image.open(tmp_path / "raw" / shot.split / shot.name).getexif().get_ifd(0x8769)
        stated = float(fields[0x920A]) * float(fields[0xA20E]) / 25.4
        assert stated == pytest.approx(shot.camera.fx, rel=1e-4)
