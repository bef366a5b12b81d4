"""ISO noise: Poisson-like shot noise and read noise, both Gaussian, in linear light."""

from __future__ import annotations

import numpy as np

from ambiguous_wild.simulate.image_effects.photo_random import PhotoRandom
from ambiguous_wild.simulate.image_effects.settings import IsoNoise

_SHOT = 1.2e-4  # variance at full signal and ISO 100: a full well of about 8000 electrons
_READ = 5e-4  # standard deviation at ISO 100


def draw(settings: IsoNoise, random: PhotoRandom) -> float:
    """The photo's ISO."""
    return float(random.rng("iso_noise").uniform(*settings.iso))


def pattern(random: PhotoRandom, height: int, width: int) -> np.ndarray:
    """Standard normal numbers [H, W, 3] float32; the same for a photo and its clean version."""
    return random.rng("iso_noise pattern").standard_normal((height, width, 3), dtype=np.float32)


def iso_noise(
    image: np.ndarray,  # [H, W, 3] float32, linear light
    normal: np.ndarray,  # [H, W, 3] float32, standard normal
    iso: float,
) -> np.ndarray:
    """The image with noise of variance `_SHOT` gain signal + (`_READ` gain)^2, gain = iso / 100.

    Source: the affine noise model of Foi et al. 2008, IEEE TIP 17(10).
    """
    gain = iso / 100.0
    variance = _SHOT * gain * np.clip(image, 0.0, None) + (_READ * gain) ** 2
    return image + np.sqrt(variance).astype(np.float32) * normal
