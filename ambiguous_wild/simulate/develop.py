"""From a shot to its pictures: what the ray caster sees, then the effects that the spec names, in order.

    light (time of day, moving shadow, polished surfaces) -> rays -> lens, shutter, blur -> defocus
    -> vignetting -> exposure -> white balance -> noise -> 8 bits -> JPEG

A train photo and its clean version go through the same effects with the same random numbers: outside
``mask`` and ``shadow`` they are equal to the bit, before JPEG. Test photos have what belongs to the place
and the lens (specular, lens distortion) and nothing that differs from photo to photo.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.simulate.atlas import linear_to_srgb
from ambiguous_wild.simulate.distractors import Placement, movers
from ambiguous_wild.simulate.effects import (
    defocus,
    exposure_drift,
    iso_noise,
    jpeg,
    lens_distortion,
    motion_blur,
    moving_shadow,
    rolling_shutter,
    specular,
    time_of_day,
    vignetting,
    warp,
    white_balance,
)
from ambiguous_wild.simulate.effects.hand import hand_velocity
from ambiguous_wild.simulate.effects.moment import Moment
from ambiguous_wild.simulate.effects.settings import Effects
from ambiguous_wild.simulate.kernels import DOME
from ambiguous_wild.simulate.shapes import Shape, shape_table
from ambiguous_wild.simulate.spec import CaptureSpec
from ambiguous_wild.simulate.tracer import Light, ShapeTable, Traced, trace
from ambiguous_wild.simulate.world import World

_MOST_INSTANTS = 24  # of an exposure
Picture = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Shot:
    """One photo to take."""

    name: str  # IMG_0001.jpg
    split: str  # train or test
    camera: Camera
    placements: tuple[Placement, ...]


@dataclass(frozen=True)
class Developed:
    """The pictures of one shot."""

    photo: np.ndarray  # [H, W, 3] uint8, as it is stored
    clean: np.ndarray  # [H, W, 3] uint8, nobody there nor anybody's shadow, before JPEG
    owner: np.ndarray  # [H, W] uint8: the first distractor that any part of the pixel shows, 0 = none
    shadow: np.ndarray | None  # [H, W] bool: where a moving shadow darkens the static scene; None: not named
    effects: dict[str, Any]  # what was drawn for this photo, by effect


@dataclass(frozen=True)
class _Scene:
    """The place as this photo finds it."""

    static: ShapeTable
    thrown: ShapeTable | None  # what throws the moving shadow
    light: Light


@dataclass(frozen=True)
class Exposure:
    """A photo about to be taken: what the rays meet, and what the sensor makes of it."""

    wanted: Effects
    scene: _Scene
    camera: Camera  # of the rays; finer and larger than the photo's where pixels move
    things: ShapeTable
    move: Picture | None
    done: dict[str, Any]  # what was drawn so far, by effect


def develop(spec: CaptureSpec, world: World, shot: Shot, moment: Moment) -> Developed:
    """Take one photo: `prepare`, `expose` and `finish`.

    Args:
        spec: names the effects.
        world: what stands still.
        shot: the camera and who stands where.
        moment: where the effects' random numbers come from.
    """
    exposure = prepare(spec, world, shot, moment)
    return finish(shot, moment, exposure, expose(world, exposure))


def prepare(spec: CaptureSpec, world: World, shot: Shot, moment: Moment) -> Exposure:
    """All that comes before the rays."""
    wanted = spec.effects if shot.split == "train" else _lasting(spec.effects)
    done: dict[str, Any] = {}
    scene = _lit(wanted, world, moment, done)
    move, camera, light = _optics(wanted, shot.camera, scene.light, moment, done)
    things = movers(spec, shot.placements, world)
    return Exposure(wanted, replace(scene, light=light), camera, things, move, done)


def expose(world: World, exposure: Exposure) -> Traced:
    """The rays. They take all cores: one photo at a time."""
    scene = exposure.scene
    return trace(exposure.camera, scene.static, exposure.things, world.atlas, scene.light, scene.thrown)


def finish(shot: Shot, moment: Moment, exposure: Exposure, seen: Traced) -> Developed:
    """All that comes after the rays."""
    wanted, done = exposure.wanted, exposure.done
    distracted, clean, owner, shadow = _moved(exposure.move, seen)
    sensor = _exposure(wanted, shot.camera, moment, done)
    clean_pixels = _to_uint8(sensor(clean))
    pixels = clean_pixels if distracted is clean else _to_uint8(sensor(distracted))
    if wanted.jpeg is not None:
        quality = jpeg.draw(wanted.jpeg, moment)
        pixels = jpeg.jpeg(pixels, quality)
        done["jpeg"] = {"quality": quality}
    return Developed(pixels, clean_pixels, owner, shadow, done)


def depth_m(world: World, camera: Camera) -> np.ndarray:
    """z of the static surface as the stated pinhole camera sees it, [H, W] float32, m."""
    return trace(camera, world.table(), _nobody(world), world.atlas, world.light).depth_m


def _lasting(effects: Effects) -> Effects:
    """Of the effects those that belong to the place and the lens: the test photos' truth."""
    return Effects(specular=effects.specular, lens_distortion=effects.lens_distortion)


def _nobody(world: World) -> ShapeTable:
    return shape_table((), world.atlas)


def _lit(wanted: Effects, world: World, moment: Moment, done: dict[str, Any]) -> _Scene:
    shapes: list[Shape] = list(world.shapes)
    light, thrown = world.light, None
    if wanted.time_of_day is not None:
        day = wanted.time_of_day
        hour = time_of_day.draw(day, moment)
        light, sky = time_of_day.time_of_day(light, hour, day.strength, day.sweep_deg)
        shapes = [_sky(s, sky) if s.mapping == DOME else s for s in shapes]
        done["time_of_day"] = {"hour": hour}
    if wanted.specular is not None:
        polish = wanted.specular
        shapes = specular.specular(shapes, polish.textures, polish.strength, polish.sharpness)
        done["specular"] = {}
    if wanted.moving_shadow is not None:
        lobes = moving_shadow.draw(wanted.moving_shadow, moment)
        thrown = shape_table(moving_shadow.moving_shadow(lobes, light.sun.mean(0)), world.atlas)
        done["moving_shadow"] = {"lobes": [list(lobe) for lobe in lobes]}
    return _Scene(shape_table(shapes, world.atlas), thrown, light)


def _sky(shape: Shape, gain: np.ndarray) -> Shape:
    r, g, b = (float(t * k) for t, k in zip(shape.tint, gain))
    return replace(shape, tint=(r, g, b))


def _optics(
    wanted: Effects, camera: Camera, light: Light, moment: Moment, done: dict[str, Any]
) -> tuple[Picture | None, Camera, Light]:
    """How the traced picture becomes the sensor's, linearly; None where they are the same."""
    steps: list[Picture] = []
    traced = camera
    shutter = (wanted.rolling_shutter, wanted.motion_blur)
    if wanted.lens_distortion is not None or any(s is not None for s in shutter):
        fine = math.isqrt(len(light.sun))  # as many rays as without: spread over finer pixels
        sources = _sources(wanted, camera, fine, moment, done)
        traced, border = warp.enlarged(camera, sources, fine)
        light = replace(light, sun=np.ascontiguousarray(light.sun[:1]))
        steps.append(lambda image: warp.resample(image, sources, border, fine))
    if wanted.defocus is not None:
        radius = defocus.draw(wanted.defocus, moment)
        done["defocus"] = {"radius_px": radius * camera.width}
        if radius > 0:
            kernel = defocus.disc(radius * camera.width)
            steps.append(lambda image: defocus.defocus(image, kernel))
    if not steps:
        return None, traced, light

    def move(image: np.ndarray) -> np.ndarray:
        for step in steps:
            image = step(image)
        return image

    return move, traced, light


def _sources(
    wanted: Effects, camera: Camera, fine: int, moment: Moment, done: dict[str, Any]
) -> list[np.ndarray]:
    """Where the photo's fine pixels look, one array an instant of the exposure."""
    points = warp.fine_points(camera, fine)
    if wanted.lens_distortion is not None:
        lens = wanted.lens_distortion
        points = lens_distortion.lens_distortion(points, lens.k1, lens.k2)
        done["lens_distortion"] = {"k1": lens.k1, "k2": lens.k2}
    rows = camera.height * fine
    turns = np.zeros((rows, 3))
    instants = np.zeros((1, 3))
    if wanted.rolling_shutter is not None:
        roll = wanted.rolling_shutter
        velocity = hand_velocity(moment, roll.speed_deg_s)
        turns = rolling_shutter.rolling_shutter(velocity, roll.readout_s, rows)
        done["rolling_shutter"] = {"deg_s": np.rad2deg(velocity).tolist(), "readout_s": roll.readout_s}
    if wanted.motion_blur is not None:
        blur = wanted.motion_blur
        velocity = hand_velocity(moment, blur.speed_deg_s)
        length = float(np.linalg.norm(velocity)) * blur.exposure_s * camera.fx
        count = min(max(2, math.ceil(length * fine)), _MOST_INSTANTS)
        instants = motion_blur.motion_blur(velocity, blur.exposure_s, count)
        done["motion_blur"] = {"exposure_s": blur.exposure_s, "length_px": length}
    if not turns.any() and not instants.any():
        return [warp.in_pixels(points, camera)]
    return [warp.in_pixels(warp.turned(points, turns + now), camera) for now in instants]


def _moved(
    move: Picture | None, seen: Traced
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Distracted, clean, owner and shadow on the sensor: equal to the bit where nothing differs."""
    clean, owner, shadow = seen.clean, seen.owner, seen.shadow
    if move is None:
        return seen.distracted, clean, owner, shadow
    clean = move(clean)
    if not owner.any() and (shadow is None or not shadow.any()):
        shape = clean.shape[:2]
        return clean, clean, np.zeros(shape, np.uint8), None if shadow is None else np.zeros(shape, bool)
    distracted = move(seen.distracted)
    who = np.zeros(clean.shape[:2], np.uint8)
    for number in reversed([int(n) for n in np.unique(owner) if n]):
        who[_support(move, owner == number)] = number
    touched = who > 0
    if shadow is not None:
        shadow = _support(move, shadow)
        touched = touched | shadow
    # The same float where nobody is, not one that should be equal.
    return np.where(touched[..., None], distracted, clean), clean, who, shadow


def _support(move: Picture, mask: np.ndarray) -> np.ndarray:
    """Every pixel that any masked one has a share in. A transform's rounding is no share."""
    return np.asarray(move(mask.astype(np.float32)) > 1e-6)


def _exposure(wanted: Effects, camera: Camera, moment: Moment, done: dict[str, Any]) -> Picture:
    """What happens to the light on its way from the lens to the numbers."""
    steps: list[Picture] = []
    if wanted.vignetting is not None:
        falloff = wanted.vignetting.falloff
        done["vignetting"] = {"falloff": falloff}
        steps.append(lambda image: vignetting.vignetting(image, falloff))
    if wanted.exposure_drift is not None:
        stops = exposure_drift.draw(wanted.exposure_drift, moment)
        done["exposure_drift"] = {"stops": stops}
        steps.append(lambda image: exposure_drift.exposure_drift(image, stops))
    if wanted.white_balance is not None:
        gains = white_balance.draw(wanted.white_balance, moment)
        done["white_balance"] = {"gains": list(gains)}
        steps.append(lambda image: white_balance.white_balance(image, gains))
    if wanted.iso_noise is not None:
        iso = iso_noise.draw(wanted.iso_noise, moment)
        normal = iso_noise.pattern(moment, camera.height, camera.width)
        done["iso_noise"] = {"iso": iso}
        steps.append(lambda image: iso_noise.iso_noise(image, normal, iso))

    def expose(image: np.ndarray) -> np.ndarray:
        for step in steps:
            image = step(image)
        return image

    return expose


def _to_uint8(linear: np.ndarray) -> np.ndarray:
    return np.round(255.0 * linear_to_srgb(linear)).astype(np.uint8)
