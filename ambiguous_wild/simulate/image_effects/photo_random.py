"""Random numbers of one photo, with an independent stream for each effect."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

_EFFECTS = 1000  # spawn key: world, walk and layout are 0 to 2


@dataclass(frozen=True)
class PhotoRandom:
    """One photo of a capture. Streams are independent: adding an effect changes no other."""

    seed: int
    number: int  # of the photo, from 0
    progress: float  # of the capture, 0 to 1

    def rng(self, name: str) -> np.random.Generator:
        """The generator of one effect for this photo."""
        return _generator(self.seed, name, self.number + 1)

    def phase(self, name: str) -> float:
        """A number in [0, 1) per effect, the same for the whole capture."""
        return float(_generator(self.seed, name, 0).random())

    def drift(self, name: str, cycles: float = 1.5) -> float:
        """A value in [-1, 1] that drifts slowly over the capture, with a little jitter."""
        slow = np.sin(2 * np.pi * (cycles * self.progress + self.phase(name)))
        return float(0.8 * slow + 0.2 * self.rng(name).uniform(-1, 1))


def _generator(seed: int, name: str, number: int) -> np.random.Generator:
    key = (_EFFECTS, zlib.crc32(name.encode()), number)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
