"""Render one photo: trace its rays, then apply the effects that the spec names, in this order.

    light (time of day, moving shadow, polished surfaces) -> rays -> lens, shutter, blur -> defocus
    -> vignetting -> exposure -> white balance -> noise -> 8 bits -> JPEG

A training photo and its clean version get the same effects with the same random numbers, so before JPEG they
have equal bits outside ``mask`` and ``shadow``. Test photos get only effects that are the same in all photos
(specular, lens distortion).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.srgb import srgb_to_linear
from ambiguous_wild.simulate import image_effects as fx
from ambiguous_wild.simulate.distractors import DistractorPose, all_distractor_shapes
from ambiguous_wild.simulate.fixed_things import alpha_over, overlay_layer
from ambiguous_wild.simulate.image_effects import PhotoRandom
from ambiguous_wild.simulate.kernels import DOME
from ambiguous_wild.simulate.shapes import Shape, shape_table
from ambiguous_wild.simulate.spec import CaptureSpec, Effects, FixedThing
from ambiguous_wild.simulate.tracer import Light, ShapeTable, TracedPhoto, build_atlas, first_hits, trace
from ambiguous_wild.simulate.truth_records import DrawnEffects
from ambiguous_wild.simulate.world import World

_MAX_INSTANTS = 24  # largest number of instants of an exposure
_CODES = srgb_to_linear((np.arange(255) + 0.5) / 255)  # linear light from which on a pixel has the next code
FIXED = 255  # number of what is fixed to the camera, as owner of a pixel
ImageFilter = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class PlannedPhoto:
    """One photo to render."""

    name: str  # IMG_0001.jpg
    split: str  # train or test
    camera: Camera
    placements: tuple[DistractorPose, ...]


@dataclass(frozen=True)
class RenderedPhoto:
    """The photo and its truth."""

    photo: np.ndarray  # [H, W, 3] uint8, as stored
    clean: np.ndarray  # [H, W, 3] uint8, without distractors and moving shadow, before JPEG
    owner: np.ndarray  # [H, W] uint8: number of the first distractor in the pixel, 0 = none; or `FIXED`
    shadow: np.ndarray | None  # [H, W] bool, as in `TracedPhoto`
    # [H, W] uint8: number of the static object in the middle of the pixel, 0 = none; of a train photo
    things: np.ndarray
    effects: DrawnEffects


@dataclass(frozen=True)
class _LitScene:
    """The static world and its light at the time of the photo."""

    static: ShapeTable
    shadow_casters: ShapeTable | None
    light: Light


@dataclass(frozen=True)
class PreparedPhoto:
    """A photo before its rays are traced."""

    effects: Effects
    scene: _LitScene
    camera: Camera  # for the rays; finer and larger than the photo's if an effect moves pixels
    distractors: ShapeTable
    fixed: FixedThing | None  # fixed to the camera
    move: ImageFilter | None  # effects that move pixels
    things: np.ndarray  # [S] uint8: number of the object that each static shape belongs to, 0 = none
    drawn: DrawnEffects  # random values of the effects so far


def prepare_photo(
    spec: CaptureSpec, world: World, planned: PlannedPhoto, random: PhotoRandom
) -> PreparedPhoto:
    """Do the steps before the rays are traced."""
    effects = spec.effects if planned.split == "train" else _constant_effects(spec.effects)
    drawn: DrawnEffects = {}
    shapes = all_distractor_shapes(spec, planned.placements, world.plan)
    scene = _lit(effects, world, random, drawn, shapes if spec.cast_shadows else None)
    move, camera, light = _optics(effects, planned.camera, scene.light, random, drawn)
    distractors = shape_table(shapes, world.atlas)
    fixed = spec.fixed if planned.split == "train" else None
    names = ["", *static_object_names(world)]
    things = np.array([names.index(s.thing) for s in world.shapes], np.uint8)
    lit = replace(scene, light=light)
    return PreparedPhoto(effects, lit, camera, distractors, fixed, move, things, drawn)


def static_object_names(world: World) -> list[str]:
    """Return the names of the static objects that a distractor may be taken for, numbered from 1."""
    return sorted({s.thing for s in world.shapes if s.thing})


def trace_photo(world: World, prepared: PreparedPhoto) -> TracedPhoto:
    """Trace the rays of one photo, on all cores."""
    scene = prepared.scene
    return trace(
        prepared.camera,
        scene.static,
        prepared.distractors,
        world.atlas,
        scene.light,
        scene.shadow_casters,
        shape_table(world.mirrors, world.atlas) if world.mirrors else None,
    )


def finish_photo(
    planned: PlannedPhoto, random: PhotoRandom, prepared: PreparedPhoto, traced: TracedPhoto
) -> RenderedPhoto:
    """Do the steps after the rays are traced."""
    effects, drawn = prepared.effects, prepared.drawn
    distracted, clean, owner, shadow = _moved(prepared.move, traced)
    if prepared.fixed is not None:
        top = overlay_layer(prepared.fixed, distracted, random.number, random.seed)
        distracted, owner = alpha_over(top, distracted), np.where(top[..., 3] > 0, FIXED, owner)
    sensor = _sensor(effects, planned.camera, random, drawn)
    clean_pixels = _to_uint8(sensor(clean))
    pixels = clean_pixels if distracted is clean else _to_uint8(sensor(distracted))
    if effects.jpeg is not None:
        quality = fx.draw_jpeg(effects.jpeg, random)
        pixels = fx.jpeg(pixels, quality)
        drawn["jpeg"] = {"quality": quality}
    things = _things(prepared, planned.camera) if planned.split == "train" else np.zeros_like(owner)
    return RenderedPhoto(pixels, clean_pixels, owner, shadow, things, drawn)


def _things(prepared: PreparedPhoto, camera: Camera) -> np.ndarray:
    """Return the number of the static object in each pixel, [H, W] uint8, as if no distractor were there."""
    which, _ = first_hits(prepared.camera, prepared.scene.static)
    labels = np.where(which >= 0, prepared.things[which], 0).astype(np.uint8)
    if prepared.move is None:
        return labels
    moved = np.zeros((camera.height, camera.width), np.uint8)
    for number in (int(n) for n in np.unique(labels) if n):
        moved[prepared.move((labels == number).astype(np.float32)) >= 0.5] = number
    return moved


def depth_m(world: World, camera: Camera) -> np.ndarray:
    """Return z of the static surface in the pinhole camera, [H, W] float32, m."""
    nothing = shape_table((), world.atlas)
    return trace(camera, world.table(), nothing, world.atlas, world.light).depth_m


def compile_tracer() -> None:
    """Compile the kernels, which are kept on disk."""
    atlas = build_atlas({"grey": np.ones((1, 1, 3), np.float32)})
    nothing, black = shape_table((), atlas), np.zeros(3)
    camera = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4))
    trace(camera, nothing, nothing, atlas, Light(np.ones((1, 3)), black, black, black))
    first_hits(camera, nothing)


def _constant_effects(effects: Effects) -> Effects:
    """Return the effects that are the same in all photos, which test photos get too."""
    return Effects(specular=effects.specular, lens_distortion=effects.lens_distortion)


def _lit(
    effects: Effects, world: World, random: PhotoRandom, drawn: DrawnEffects, casters: list[Shape] | None
) -> _LitScene:
    """Return the static world and its light; `casters`: distractors that cast shadows on it."""
    shapes: list[Shape] = list(world.shapes)
    light = world.light
    if effects.time_of_day is not None:
        day = effects.time_of_day
        hour = fx.draw_time_of_day(day, random)
        light, sky = fx.time_of_day(light, hour, day.strength, day.sweep_deg)
        shapes = [_sky(s, sky) if s.mapping == DOME else s for s in shapes]
        drawn["time_of_day"] = {"hour": hour}
    if effects.specular is not None:
        gloss = effects.specular
        shapes = fx.specular(shapes, gloss.textures, gloss.strength, gloss.sharpness)
        drawn["specular"] = {}
    if effects.moving_shadow is not None:
        lobes = fx.draw_moving_shadow(effects.moving_shadow, random)
        casters = [*(casters or []), *fx.moving_shadow(lobes, light.sun.mean(0))]
        drawn["moving_shadow"] = {"lobes": [list(lobe) for lobe in lobes]}
    shadow_casters = None if casters is None else shape_table(casters, world.atlas)
    return _LitScene(shape_table(shapes, world.atlas), shadow_casters, light)


def _sky(shape: Shape, gain: np.ndarray) -> Shape:
    r, g, b = (float(t * k) for t, k in zip(shape.tint, gain))
    return replace(shape, tint=(r, g, b))


def _optics(
    effects: Effects, camera: Camera, light: Light, random: PhotoRandom, drawn: DrawnEffects
) -> tuple[ImageFilter | None, Camera, Light]:
    """Return the linear filter from traced to the photo's pixels (None: identity), and the traced camera."""
    steps: list[ImageFilter] = []
    traced = camera
    shutter = (effects.rolling_shutter, effects.motion_blur)
    if effects.lens_distortion is not None or any(s is not None for s in shutter):
        fine = math.isqrt(len(light.sun))  # one ray in each finer pixel, so the number of rays stays
        sources = _sources(effects, camera, fine, random, drawn)
        traced, border = fx.supersampled_camera(camera, sources, fine)
        light = replace(light, sun=np.ascontiguousarray(light.sun[:1]))
        steps.append(lambda image: fx.resample(image, sources, border, fine))
    if effects.defocus is not None:
        radius = fx.draw_defocus(effects.defocus, random)
        drawn["defocus"] = {"radius_px": radius * camera.width}
        if radius > 0:
            kernel = fx.disc_kernel(radius * camera.width)
            steps.append(lambda image: fx.defocus(image, kernel))
    if not steps:
        return None, traced, light

    return _chained(steps), traced, light


def _chained(steps: list[ImageFilter]) -> ImageFilter:
    return lambda image: reduce(lambda changed, step: step(changed), steps, image)


def _sources(
    effects: Effects, camera: Camera, fine: int, random: PhotoRandom, drawn: DrawnEffects
) -> list[np.ndarray]:
    """Return where the photo's fine pixels lie in the pinhole camera, one array per instant of exposure."""
    points = fx.subpixel_points(camera, fine)
    if effects.lens_distortion is not None:
        lens = effects.lens_distortion
        points = fx.lens_distortion(points, lens.k1, lens.k2)
        drawn["lens_distortion"] = {"k1": lens.k1, "k2": lens.k2}
    rows = camera.height * fine
    turns = np.zeros((rows, 3))
    instants = np.zeros((1, 3))
    if effects.rolling_shutter is not None:
        roll = effects.rolling_shutter
        velocity = fx.camera_angular_velocity(random, roll.speed_deg_s)
        turns = fx.camera_rotations(velocity, roll.readout_s, rows)
        drawn["rolling_shutter"] = {"deg_s": np.rad2deg(velocity).tolist(), "readout_s": roll.readout_s}
    if effects.motion_blur is not None:
        blur = effects.motion_blur
        velocity = fx.camera_angular_velocity(random, blur.speed_deg_s)
        length = float(np.linalg.norm(velocity, axis=-1)) * blur.exposure_s * camera.fx
        count = min(max(2, math.ceil(length * fine)), _MAX_INSTANTS)
        instants = fx.camera_rotations(velocity, blur.exposure_s, count)
        drawn["motion_blur"] = {"exposure_s": blur.exposure_s, "length_px": length}
    if not turns.any() and not instants.any():
        return [fx.to_pixels(points, camera)]
    return [fx.to_pixels(fx.rotated_points(points, turns + now), camera) for now in instants]


def _moved(
    move: ImageFilter | None, traced: TracedPhoto
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Move the pixels of distracted, clean, owner and shadow; bits stay equal where nothing differs."""
    clean, owner, shadow = traced.clean, traced.owner, traced.shadow
    if move is None:
        return traced.distracted, clean, owner, shadow
    clean = move(clean)
    if not owner.any() and (shadow is None or not shadow.any()):
        shape = clean.shape[:2]
        return clean, clean, np.zeros(shape, np.uint8), None if shadow is None else np.zeros(shape, bool)
    distracted = move(traced.distracted)
    owner_moved = np.zeros(clean.shape[:2], np.uint8)
    for number in reversed([int(n) for n in np.unique(owner) if n]):
        owner_moved[_support(move, owner == number)] = number
    touched = owner_moved > 0
    if shadow is not None:
        shadow = _support(move, shadow)
        touched = touched | shadow
    # Copied, not computed, so that the bits are equal outside distractors and shadow.
    return np.where(touched[..., None], distracted, clean), clean, owner_moved, shadow


def _support(move: ImageFilter, mask: np.ndarray) -> np.ndarray:
    """Return every pixel that a masked pixel contributes to, beyond rounding."""
    return np.asarray(move(mask.astype(np.float32)) > 1e-6)


def _sensor(effects: Effects, camera: Camera, random: PhotoRandom, drawn: DrawnEffects) -> ImageFilter:
    """Combine vignetting, exposure, white balance and noise into one filter."""
    steps: list[ImageFilter] = []
    if effects.vignetting is not None:
        falloff = effects.vignetting.falloff
        drawn["vignetting"] = {"falloff": falloff}
        steps.append(lambda image: fx.vignetting(image, falloff))
    if effects.exposure_drift is not None:
        stops = fx.draw_exposure_drift(effects.exposure_drift, random)
        drawn["exposure_drift"] = {"stops": stops}
        steps.append(lambda image: fx.exposure_drift(image, stops))
    if effects.white_balance is not None:
        gains = fx.draw_white_balance(effects.white_balance, random)
        drawn["white_balance"] = {"gains": list(gains)}
        steps.append(lambda image: fx.white_balance(image, gains))
    if effects.iso_noise is not None:
        iso = fx.draw_iso_noise(effects.iso_noise, random)
        normal = fx.normal_noise(random, camera.height, camera.width)
        drawn["iso_noise"] = {"iso": iso}
        steps.append(lambda image: fx.iso_noise(image, normal, iso))

    return _chained(steps)


def _to_uint8(linear: np.ndarray) -> np.ndarray:
    """Round linear light to sRGB codes, by thresholds: a power's last bit differs between processors."""
    return np.searchsorted(_CODES, linear, side="right").astype(np.uint8)
