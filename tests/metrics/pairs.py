"""Picture pairs on which every metric is held to an oracle: four random, six hard ones."""

from __future__ import annotations

import numpy as np

Pair = tuple[np.ndarray, np.ndarray]


def pairs(smallest: int) -> dict[str, Pair]:
    """Name -> two pictures [H, W, 3] uint8, as they come from a PNG.

    Args:
        smallest: shortest side in px that the metric takes; one pair has just that.
    """
    found = {f"random {k}": _random(k, smallest) for k in range(4)}
    shape = (smallest + 5, smallest + 9, 3)
    flat = np.zeros(shape, np.uint8)
    rng = np.random.default_rng(99)
    noise = rng.integers(0, 256, shape, dtype=np.uint8)
    ramp = np.broadcast_to(np.linspace(0, 255, shape[1])[None, :, None], shape).astype(np.uint8)
    tiny = rng.integers(0, 256, (2, smallest, smallest, 3), dtype=np.uint8)
    return found | {
        "constant": (flat + np.uint8(60), flat + np.uint8(61)),
        "identical": (noise, noise.copy()),
        "one pixel off": (noise, np.roll(noise, 1, axis=1)),
        "black and white": (flat, flat + np.uint8(255)),
        "smallest": (tiny[0], tiny[1]),
        "gradient": (ramp, np.ascontiguousarray(ramp[:, ::-1])),
    }


def _random(seed: int, smallest: int) -> Pair:
    """A smooth picture and the same with noise, blur or another exposure, of odd and even sides."""
    rng = np.random.default_rng(seed)
    height, width = smallest + rng.integers(0, 12, 2)
    rows, columns = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    waves = rng.uniform(0.1, 1.2, (3, 2))
    a = np.stack([0.5 + 0.4 * np.sin(w[0] * rows + w[1] * columns) for w in waves], axis=-1)
    changed = (
        a + rng.uniform(0.01, 0.3) * rng.standard_normal(a.shape),
        (a + np.roll(a, 1, axis=0) + np.roll(a, 2, axis=1)) / 3,
        a * rng.uniform(0.5, 1.4, 3) + rng.uniform(-0.1, 0.1),
    )[seed % 3]
    first, second = (np.clip(255 * x + 0.5, 0, 255).astype(np.uint8) for x in (a, changed))
    return first, second
