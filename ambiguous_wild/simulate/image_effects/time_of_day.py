"""Time of day: another sun and another sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambiguous_wild.simulate.image_effects.photo_random import PhotoRandom
from ambiguous_wild.simulate.image_effects.settings import TimeOfDay
from ambiguous_wild.simulate.tracer import Light

# Gains of sun, sky and ground light at strength 1; in between powers of them, so hour 0 has gain 1.
_MORNING = ((0.45, 0.55, 0.75), (0.80, 0.95, 1.25), (0.80, 0.90, 1.10))  # thin cloud, blue
_EVENING = ((1.25, 0.85, 0.50), (0.85, 0.70, 0.70), (0.95, 0.75, 0.60))  # low and golden


def draw(settings: TimeOfDay, random: PhotoRandom) -> float:
    """The photo's hour: -1 morning, 0 as in the test photos, 1 evening; in random order."""
    return float(random.rng("time_of_day").uniform(-1, 1))


def time_of_day(light: Light, hour: float, strength: float, sweep_deg: float) -> tuple[Light, np.ndarray]:
    """The light at `hour`, and the gain [3] of the background sky."""
    ends = _EVENING if hour > 0 else _MORNING
    sun, sky, ground = (np.array(g) ** (abs(hour) * strength) for g in ends)
    turn = np.deg2rad(sweep_deg * hour)
    c, s = np.cos(turn), np.sin(turn)
    about_z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    lit = replace(
        light,
        sun=np.ascontiguousarray(light.sun @ about_z.T),
        sun_colour=light.sun_colour * sun,
        sky_colour=light.sky_colour * sky,
        ground_colour=light.ground_colour * ground,
    )
    return lit, sky
