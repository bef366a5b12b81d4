"""More presets: other worlds, other cameras, other light."""

from __future__ import annotations

from dataclasses import replace

from ambiguous_wild.simulate.image_effects import settings as fx
from ambiguous_wild.simulate.preset_distractors import (
    AZURE,
    BLUE,
    CRIMSON,
    MAGENTA,
    PARCEL,
    RED,
    TWIN,
    VISITOR,
    YELLOW,
    designed,
    far,
)
from ambiguous_wild.simulate.spec import CaptureSpec, Distractor, Thing, WorldSpec

_HEIGHT = (1.0, 1.0, 1.7)  # m, of a statue

_STATUES = WorldSpec(
    furniture=False,
    statue=False,
    things=(
        Thing("bust", "stone", (-1.9, 0.2, 0.0), _HEIGHT, 15.0),
        Thing("knot", "clay", (0.0, 1.3, 0.0), (1.0, 1.0, 2.0), 20.0),
        Thing("hound", "stone", (1.9, 0.3, 0.0), _HEIGHT, -30.0),
        Thing("spire", "stone", (-3.4, 1.9, 0.0), (1.0, 1.0, 2.4), 0.0),
        Thing("bust", "timber", (3.3, 1.8, 0.0), (1.0, 1.0, 1.9), -20.0),
        Thing("hound", "clay", (-1.2, 2.9, 0.0), _HEIGHT, 40.0),
        Thing("knot", "stone", (1.5, 2.9, 0.0), _HEIGHT, -50.0),
        Thing("ball", "stone", (0.9, -0.7, 0.0), (0.7, 0.7, 0.7)),
        Thing("box", "timber", (-0.8, -0.6, 0.0), (0.6, 0.5, 0.4), 25.0),
    ),
)
_FIGURES = WorldSpec(
    furniture=False,
    things=(
        Thing("figure", "stone", (-2.0, 1.0, 0.0), _HEIGHT, 25.0),
        Thing("figure", "clay", (2.1, 0.9, 0.0), _HEIGHT, -35.0),
        Thing("figure", "stone", (-3.6, 2.4, 0.0), (1.0, 1.0, 1.8), 50.0),
        Thing("figure", "clay", (3.6, 2.5, 0.0), (1.0, 1.0, 1.8), -60.0),
        Thing("column", "stone", (0.9, 3.0, 0.0), (0.5, 0.5, 2.2)),
    ),
)


def _statue(name: str, kind: str, texture: str, **more: object) -> Distractor:
    return Distractor(name, kind, texture, "semantic", **more)  # type: ignore[arg-type]


def _coloured(name: str, tint: tuple[float, float, float], **more: object) -> Distractor:
    return Distractor(name, "visitor", "cloth", "semantic", head="cloth", tint=tint, **more)  # type: ignore[arg-type]


def _placard(name: str, texture: str, ambiguity: str, **more: object) -> Distractor:
    return Distractor(name, "placard", texture, ambiguity, **more)  # type: ignore[arg-type]


_PLAIN = (RED, BLUE, PARCEL)
_WALKER = replace(RED, path="walk", distance_m=(1.3, 4.5))
_WALK = ((-3.0, -1.5), (3.0, -1.0))

_WORLDS = (
    CaptureSpec(
        "statues",
        "a field of statues; a second bust, hound and knot change places",
        (
            _statue("second bust", "bust", "stone"),
            _statue("second hound", "hound", "clay"),
            _statue("second knot", "knot", "stone"),
        ),
        world=_STATUES,
        designed=designed("both"),
    ),
    CaptureSpec(
        "painted",
        "the same field; the bust, hound and knot that change places have bright colours",
        (
            _statue("blue bust", "bust", "cloth", tint=AZURE),
            _statue("red hound", "hound", "cloth", tint=CRIMSON),
            _statue("magenta knot", "knot", "cloth", tint=MAGENTA),
        ),
        world=_STATUES,
        designed=designed("semantic"),
    ),
    CaptureSpec(
        "beside",
        "visitors in bright colours, in the poses of the statues beside them",
        (_coloured("visitor in red", CRIMSON), _coloured("visitor in blue", AZURE)),
        world=_FIGURES,
        designed=designed("semantic"),
    ),
    CaptureSpec(
        "both",
        "copies of the static statue, with the textures of the walls and of the planters' leaves",
        (
            replace(TWIN, name="statue of brick", texture="brick"),
            replace(TWIN, name="statue of leaves", texture="foliage"),
        ),
        designed=designed("both"),
    ),
    CaptureSpec(
        "camouflage",
        "boards with the texture of the wall behind them, a visitor in brick",
        (
            _placard("board of brick", "wall_back", "colour"),
            _placard("second board of brick", "wall_right", "colour"),
            VISITOR,
        ),
        designed=designed("colour"),
    ),
    CaptureSpec(
        "banner",
        "flat banners: a blue one, and copies of two pictures that hang on the walls",
        (
            _placard("blue banner", "cloth", "none", tint=AZURE, size=1.2),
            _placard("second galaxy", "poster_hubble", "semantic"),
            _placard("second rocket", "poster_rocket", "semantic"),
        ),
        designed=designed("semantic"),
    ),
    CaptureSpec(
        "walkers",
        "three visitors who walk to and fro through the whole capture",
        (
            replace(_WALKER, name="visitor in blue", tint=AZURE, waypoints=_WALK, laps=2.5, presence=0.95),
            replace(_WALKER, waypoints=((2.6, -0.5), (-2.6, -2.0)), laps=3.5, presence=0.8),
            replace(
                _WALKER,
                name="visitor in yellow",
                tint=YELLOW,
                waypoints=((-3.4, 0.4), (-1.0, -1.2), (1.2, -0.9), (3.0, 0.0)),
                laps=1.5,
                presence=0.7,
            ),
        ),
        occlusion=(0.02, 0.25),
        designed=designed("neither"),
    ),
)

_CAMERAS = (
    CaptureSpec(
        "zoom",
        "distances and focal lengths that change the image scale by a factor of four",
        _PLAIN,
        radius_m=(3.0, 6.0),
        zoom=(0.85, 1.9),
        arc_deg=96.0,
        designed=designed("neither", "antialiasing"),
    ),
    CaptureSpec(
        "shaky",
        "an unsteady hand: rolling shutter and motion blur",
        _PLAIN,
        effects=fx.Effects(
            rolling_shutter=fx.RollingShutter(speed_deg_s=18.0),
            motion_blur=fx.MotionBlur(exposure_s=1 / 30, speed_deg_s=18.0),
        ),
        # Not for pose refinement: COLMAP's poses hold the hand's motion (docs/effects.md).
        designed=designed("neither"),
    ),
    CaptureSpec(
        "phone",
        "a cheap phone: noise, hard JPEG, dark corners",
        _PLAIN,
        effects=fx.Effects(iso_noise=fx.IsoNoise(), jpeg=fx.Jpeg(), vignetting=fx.Vignetting()),
        designed=designed("neither"),
    ),
    CaptureSpec(
        "defocus",
        "every third photo is out of focus",
        _PLAIN,
        effects=fx.Effects(defocus=fx.Defocus()),
        designed=designed("neither"),
    ),
    CaptureSpec(
        "distortion",
        "a wide-angle lens with barrel distortion, no distractors",
        occlusion=(0.0, 0.0),
        focal_35mm=22.0,
        effects=fx.Effects(lens_distortion=fx.LensDistortion()),
        designed=designed("neither", distractors=False),
    ),
)

_DAYS = (
    CaptureSpec(
        "exposure",
        "automatic exposure that drifts, no distractors",
        occlusion=(0.0, 0.0),
        effects=fx.Effects(exposure_drift=fx.ExposureDrift()),
        designed=designed("neither", "appearance", distractors=False),
    ),
    CaptureSpec(
        "white-balance",
        "automatic white balance that turns warm and cold",
        _PLAIN,
        effects=fx.Effects(white_balance=fx.WhiteBalance(warmth=0.9, tint=0.15)),
        designed=designed("neither", "appearance"),
    ),
    CaptureSpec(
        "time-of-day",
        "photos of the morning, of noon and of the evening",
        _PLAIN,
        effects=fx.Effects(time_of_day=fx.TimeOfDay()),
        designed=designed("neither", "appearance"),
    ),
    CaptureSpec(
        "shadow",
        "no distractors, but moving shadows",
        occlusion=(0.0, 0.0),
        effects=fx.Effects(moving_shadow=fx.MovingShadow()),
        designed=designed("neither"),
    ),
    CaptureSpec(
        "glossy",
        "polished stone, clay and timber, no distractors",
        occlusion=(0.0, 0.0),
        effects=fx.Effects(specular=fx.Specular(("stone", "clay", "timber"), strength=1.0, sharpness=30.0)),
        designed=designed("neither", "sh", distractors=False),
    ),
    CaptureSpec(
        "everything",
        "every effect at once, gently, and distractors of every kind",
        (VISITOR, TWIN, far(replace(RED, tint=MAGENTA, name="visitor in magenta")), PARCEL),
        zoom=(0.85, 1.5),
        effects=fx.Effects(
            time_of_day=fx.TimeOfDay(strength=0.5, sweep_deg=10.0),
            moving_shadow=fx.MovingShadow(presence=0.5),
            specular=fx.Specular(strength=0.4),
            lens_distortion=fx.LensDistortion(k1=-0.05),
            rolling_shutter=fx.RollingShutter(speed_deg_s=6.0),
            motion_blur=fx.MotionBlur(speed_deg_s=6.0),
            defocus=fx.Defocus(share=0.15, radius=(0.001, 0.002)),
            vignetting=fx.Vignetting(falloff=0.25),
            exposure_drift=fx.ExposureDrift(stops=0.4),
            white_balance=fx.WhiteBalance(warmth=0.3, tint=0.06),
            iso_noise=fx.IsoNoise(iso=(200.0, 600.0)),
            jpeg=fx.Jpeg(quality=(60, 80)),
        ),
        designed=designed("both", "appearance", "antialiasing", "sh"),
    ),
)

GALLERY = (*_WORLDS, *_CAMERAS, *_DAYS)
