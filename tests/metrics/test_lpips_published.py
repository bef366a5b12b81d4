"""With the published networks LPIPS is that of the package `lpips`: skipped where they are not installed.

Ten pairs of pictures, and their LPIPS by `lpips` 0.1.4. The values were computed once, with torch 2.13.0 on a
CPU, from the uint8 pictures of `published_pairs`.
"""

import numpy as np
import pytest

from ambiguous_wild.metrics import lpips

PUBLISHED = {
    "lpips_alex": (
        0.018513, 0.379416, 0.246490, 0.179372, 0.050346, 0.005041, 0.035329, 0.154292, 0.100920, 0.493710,
    ),
    "lpips_vgg": (
        0.168040, 0.448240, 0.212299, 0.307806, 0.158087, 0.004724, 0.045857, 0.207488, 0.188385, 0.774789,
    ),
    "lpips_vgg_01": (
        0.139763, 0.411417, 0.216793, 0.303400, 0.148021, 0.003750, 0.041033, 0.209548, 0.165069, 0.714193,
    ),
}  # fmt: skip


def picture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """[H, W, 3] uint8: waves of many lengths, as in photos, with edges between flat patches."""
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float64)
    image = np.zeros((height, width, 3))
    for _ in range(24):
        length, angle = 4.0 * 40.0 ** rng.random(), 2 * np.pi * rng.random()
        phase = (rows * np.sin(angle) + columns * np.cos(angle)) * 2 * np.pi / length
        image += np.sin(phase + 6.28 * rng.random())[..., None] * rng.normal(0, length**0.5, 3)
    for _ in range(6):
        top, left = rng.integers(0, height), rng.integers(0, width)
        image[top : top + height // 3, left : left + width // 3] = rng.normal(0, 12, 3)
    return (127.5 + 110 * np.tanh(image / 25)).round().astype(np.uint8)


def published_pairs() -> list[tuple[np.ndarray, np.ndarray]]:
    """Noise, blur, shift, brightness, contrast, patch, steps, another picture; sides of 64 to 160 px."""
    rng = np.random.default_rng(20)
    pairs = []
    for number in range(10):
        height, width = (int(n) for n in rng.integers(64, 161, 2))
        a = picture(rng, height, width)
        b = a.astype(np.float64)
        if number in (0, 1):
            b += rng.normal(0, (6, 30)[number], b.shape)
        elif number in (2, 3):
            for axis in (0, 1):
                b = sum(np.roll(b, k, axis) for k in range(-number, number + 1)) / (2 * number + 1)
        elif number == 4:
            b = np.roll(b, (1, 2), (0, 1))
        elif number == 5:
            b += 25
        elif number == 6:
            b = 127.5 + 0.6 * (b - 127.5)
        elif number == 7:
            b[: height // 3, : width // 2] = rng.integers(0, 256, 3)
        elif number == 8:
            b = (b // 48) * 48 + 24
        else:
            b = picture(rng, height, width).astype(np.float64)
        pairs.append((a, b.clip(0, 255).round().astype(np.uint8)))
    return pairs


@pytest.mark.usefixtures("machine_weights")
@pytest.mark.parametrize("name", PUBLISHED)
def test_ten_pairs_give_the_values_of_the_reference_package(name: str) -> None:
    reason = lpips.available()[name]
    if reason is not None:
        pytest.skip(reason)
    metric = lpips.load(name)
    found = [metric(a, b) for a, b in published_pairs()]
    assert found == pytest.approx(PUBLISHED[name], abs=1e-4)
