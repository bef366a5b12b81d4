"""Distractors: shapes that are placed in the world anew for every photo.

Perspective, occlusion and shadows on distractors are exact. Unless the spec says `cast_shadows`, they cast
none on the static world, so that outside their pixels the photo with distractors equals the clean photo.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.simulate.image_effects import specular
from ambiguous_wild.simulate.kernels import BOX, ELLIPSOID, INSTANTS
from ambiguous_wild.simulate.shapes import Shape, barrier, figure, shape_table, transformed
from ambiguous_wild.simulate.spec import STATUES, CaptureSpec, Distractor, GroundPlan
from ambiguous_wild.simulate.tracer import ShapeTable, first_hits
from ambiguous_wild.simulate.world import World, car, object_shapes, placard, statue

_TRIES = 80  # layouts drawn for a photo, of which the best is taken
_SAME_PLACE_M = 0.6  # closer than this is the same place
_SAME_PLACE_SHARE = 0.15  # largest share of the photos with one distractor at the same place
_APART_M = 0.75
_CLEARANCE_M = {"car": 1.2}  # distance from static objects; other distractors keep 0.3 m
_PREVIEW_PX = 96
_FACES_DEG = {"car": 0.0}  # where it faces before it is turned; others face -y, at -90 degrees
_STRIDES_M = 0.35  # strides of a walker per metre
# A followed person sways: angle to either side; cycles per photo of the sway, the distance and the stride.
_SWAY_DEG, _SWAY, _NEARING, _STEPS = 7.0, 0.07, 0.045, 0.13


@dataclass(frozen=True)
class DistractorPose:
    """One distractor in one photo."""

    which: int  # index into the spec's distractors
    x_m: float
    y_m: float
    yaw_deg: float
    pose: float  # stride, arm and bend of a figure, 0 to 1


def distractor_shapes(distractor: Distractor, placement: DistractorPose, plan: GroundPlan) -> list[Shape]:
    """Make the distractor's shapes in the world, owned by ``placement.which + 1``.

    One that moves during the exposure is there at each instant, at another place.
    """
    at = (placement.x_m, placement.y_m, distractor.lift_m * placement.pose)
    parts = [_tinted(s, distractor) for s in _parts(distractor, placement.pose, plan)]
    owner = placement.which + 1
    if not distractor.blur_m:
        return transformed(parts, at, placement.yaw_deg, distractor.size, owner=owner)
    facing = np.deg2rad(placement.yaw_deg + _FACES_DEG.get(distractor.kind, -90.0))
    shapes = []
    for instant in range(INSTANTS):
        way = distractor.blur_m * ((instant + 0.5) / INSTANTS - 0.5)
        there = (at[0] + way * float(np.cos(facing)), at[1] + way * float(np.sin(facing)), at[2])
        shapes += transformed(parts, there, placement.yaw_deg, distractor.size, owner=owner, instant=instant)
    return shapes


def _parts(distractor: Distractor, pose: float, plan: GroundPlan) -> list[Shape]:
    """Make the distractor at its natural size, standing at the origin."""
    texture = distractor.texture
    match distractor.kind:
        case "visitor":
            bend = distractor.bend_deg * (0.5 - 0.5 * np.cos(4 * np.pi * pose))
            return figure(texture, distractor.head or texture, 0.06 + 0.26 * pose, pose, bend_deg=bend)
        case "twin":
            return [
                *object_shapes("base of a twin", texture),
                *transformed(figure(texture, texture, 0.07, 0.8), (0, 0, 0.12), 0.0),
            ]
        case "parcel":
            top = Shape(BOX, (0, 0, 0.2), (0.24, 0.22, 0.2), texture, offset=(0.35, 0.6))
            below = Shape(BOX, (0, 0, 0.35), (0.36, 0.28, 0.35), texture)
            return [below, *transformed([top], (0.05, 0, 0.7), 30.0)]
        case "pole" | "banner":
            return object_shapes(distractor.kind, texture)
        case "barrier":
            return barrier(texture)
        case "placard":
            return placard(texture, plan)
        case "car":
            return car(texture, paint=distractor.tint)
    if distractor.kind in STATUES:
        return [statue(distractor.kind, texture, 1.6)]
    return [Shape(ELLIPSOID, (0, 0, 0.4), (0.4, 0.4, 0.4), texture)]


def _tinted(shape: Shape, distractor: Distractor) -> Shape:
    """Tint the parts with the distractor's texture, not a head with another texture, nor glass of a car."""
    if shape.texture != distractor.texture or distractor.kind == "car" or distractor.tint == (1.0, 1.0, 1.0):
        return shape
    r, g, b = (x * y for x, y in zip(shape.tint, distractor.tint))
    return replace(shape, tint=(r, g, b))


def all_distractor_shapes(
    spec: CaptureSpec, placements: tuple[DistractorPose, ...], plan: GroundPlan
) -> list[Shape]:
    """Return all distractors of one photo."""
    shapes = [s for p in placements for s in distractor_shapes(spec.distractors[p.which], p, plan)]
    gloss = spec.effects.specular
    return shapes if gloss is None else specular(shapes, gloss.textures, gloss.strength, gloss.sharpness)


def distractor_table(spec: CaptureSpec, placements: tuple[DistractorPose, ...], world: World) -> ShapeTable:
    """Return all distractors of one photo as a table for the ray caster."""
    return shape_table(all_distractor_shapes(spec, placements, world.plan), world.atlas)


def place_distractors(
    spec: CaptureSpec, cameras: list[Camera], world: World, rng: np.random.Generator
) -> list[tuple[DistractorPose, ...]]:
    """Place the distractors of every train photo.

    Layouts are drawn until the occlusion, measured in a small preview, lies in ``spec.occlusion``; if none
    does, the nearest one is taken. Who is present is drawn for each layout, or once a photo if the range
    starts at 0. No distractor with path "elsewhere" is at one place in more than 15 % of the photos, as it
    would be part of the scene.
    """
    chosen: list[tuple[DistractorPose, ...]] = []
    static = world.table()
    low, high = spec.occlusion
    # The place of a walker is given, and choosing among layouts would change how often it is present.
    tries = 1 if all(d.path != "elsewhere" for d in spec.distractors) else _TRIES
    for camera in cameras:
        if not spec.distractors:
            chosen.append(())
            continue
        small = camera.resized(_PREVIEW_PX, max(1, round(_PREVIEW_PX * camera.height / camera.width)))
        best: tuple[DistractorPose, ...] = ()
        best_gap = np.inf
        aim = rng.uniform(low, high)  # so that the shares spread over the whole range
        present = [rng.random() <= d.presence for d in spec.distractors] if low == 0 and tries > 1 else None
        if present is not None and not any(present):
            chosen.append(())
            continue
        if tries == 1:
            chosen.append(_draw(spec, camera, world, chosen, rng))
            continue
        _, depth_m = first_hits(small, static)
        for attempt in range(tries):
            layout = _draw(spec, camera, world, chosen, rng, present)
            seen, _ = first_hits(small, distractor_table(spec, layout, world), depth_m)
            share = float(np.mean(seen >= 0))
            tolerance = (high - low) * (0.1 + 0.4 * attempt / tries)
            gap = max(abs(share - aim) - tolerance, 0.0) + 10 * max(low - share, share - high, 0.0)
            if gap < best_gap:
                best, best_gap = layout, gap
            if gap == 0.0:
                break
        chosen.append(best)
    return chosen


def _draw(
    spec: CaptureSpec,
    camera: Camera,
    world: World,
    earlier: list[tuple[DistractorPose, ...]],
    rng: np.random.Generator,
    present: list[bool] | None = None,  # which distractors are present; None: draw that too
) -> tuple[DistractorPose, ...]:
    layout: list[DistractorPose] = []
    for which, distractor in enumerate(spec.distractors):
        if not present[which] if present is not None else rng.random() > distractor.presence:
            continue
        if distractor.path == "walk":
            if len(distractor.waypoints) == 1:
                place = _standing_placement(which, distractor, rng)
            else:
                place = _walker_placement(which, distractor, len(earlier) / max(spec.train_views - 1, 1))
            away = np.hypot(*(camera.center[:2] - (place.x_m, place.y_m)))
            if away >= distractor.distance_m[0] and _is_free(place, world, [], distractor):
                layout.append(place)
            continue
        if distractor.path == "ahead":
            place = _placement_ahead(which, distractor, camera, len(earlier))
            if _is_free(place, world, [], distractor):
                layout.append(place)
            continue
        for _ in range(12):
            place = _random_placement(which, distractor, camera, rng)
            if _is_free(place, world, layout, distractor) and _is_fresh(place, earlier, spec.train_views):
                layout.append(place)
                break
    return tuple(layout)


def _random_placement(
    which: int, distractor: Distractor, camera: Camera, rng: np.random.Generator
) -> DistractorPose:
    """Draw a random point on the ground within the picture, at the distractor's distance."""
    column = rng.uniform(0.06, 0.94) * camera.width
    ray = np.array([(column - camera.cx) / camera.fx, 0.0, 1.0])
    direction = (camera.cam_from_world[:3, :3].T * ray).sum(-1)
    flat = direction[:2] / np.linalg.norm(direction[:2], axis=-1)
    x, y = camera.center[:2] + rng.uniform(*distractor.distance_m) * flat
    return DistractorPose(which, float(x), float(y), float(rng.uniform(-180, 180)), float(rng.random()))


def _standing_placement(which: int, distractor: Distractor, rng: np.random.Generator) -> DistractorPose:
    """Place a distractor that stands still; a visitor turns and moves its arms."""
    x, y = distractor.waypoints[0]
    yaw, pose = (rng.uniform(-180, 180), rng.random()) if distractor.kind == "visitor" else (0.0, 0.4)
    return DistractorPose(which, float(x), float(y), float(yaw), float(pose))


def _walker_placement(which: int, distractor: Distractor, progress: float) -> DistractorPose:
    """Place a walker at `progress` (0 to 1) of the capture: to and fro along its waypoints, facing ahead."""
    corners = np.array(distractor.waypoints)
    legs = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    along = (2 * distractor.laps * progress) % 2.0  # 0 to 1 forward, 1 to 2 back
    there = along <= 1.0
    gone = (along if there else 2.0 - along) * legs.sum()
    leg = min(int(np.searchsorted(np.cumsum(legs), gone)), len(legs) - 1)
    share = (gone - legs[:leg].sum()) / max(legs[leg], 1e-9)
    x, y = corners[leg] + share * (corners[leg + 1] - corners[leg])
    ahead = (corners[leg + 1] - corners[leg]) * (1 if there else -1)
    yaw = np.rad2deg(np.arctan2(ahead[1], ahead[0])) - _FACES_DEG.get(distractor.kind, -90.0)
    stride = 0.5 + 0.5 * np.sin(2 * np.pi * _STRIDES_M * 2 * distractor.laps * progress * legs.sum())
    return DistractorPose(which, float(x), float(y), float(yaw), float(stride))


def _placement_ahead(which: int, distractor: Distractor, camera: Camera, number: int) -> DistractorPose:
    """Place a person whom the camera follows: in front of it, swaying slowly, seen from behind."""
    sway, nearing, stride = (np.sin(2 * np.pi * f * number + which) for f in (_SWAY, _NEARING, _STEPS))
    forward = camera.cam_from_world[2, :2]
    heading = np.arctan2(forward[1], forward[0])
    aside = heading + np.deg2rad(_SWAY_DEG) * sway
    away = np.interp(nearing, (-1, 1), distractor.distance_m)
    x, y = camera.center[:2] + away * np.array([np.cos(aside), np.sin(aside)])
    yaw = np.rad2deg(heading) + 90.0  # figures face -y
    return DistractorPose(which, float(x), float(y), float(yaw), float(0.5 + 0.5 * stride))


def _is_free(
    place: DistractorPose, world: World, others: list[DistractorPose], distractor: Distractor
) -> bool:
    clearance = _CLEARANCE_M.get(distractor.kind, 0.3)
    if world.plan.gap(place.x_m, place.y_m) < 0.3 + clearance:
        return False
    away = np.hypot(world.keep_out[:, 0] - place.x_m, world.keep_out[:, 1] - place.y_m) - world.keep_out[:, 2]
    if away.min(initial=np.inf) < clearance:
        return False
    return all(np.hypot(o.x_m - place.x_m, o.y_m - place.y_m) > _APART_M + clearance - 0.3 for o in others)


def _is_fresh(place: DistractorPose, earlier: list[tuple[DistractorPose, ...]], photos: int) -> bool:
    same = [
        p
        for layout in earlier
        for p in layout
        if p.which == place.which and np.hypot(p.x_m - place.x_m, p.y_m - place.y_m) < _SAME_PLACE_M
    ]
    return len(same) + 1 <= max(1, int(_SAME_PLACE_SHARE * photos))
