"""Photos of two textured walls that meet at an angle: enough depth to register, rendered in milliseconds.

Each wall is a plane, so its picture in any pinhole camera is a homography of its texture.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.io.images import write_png

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
_TEXELS = 512  # a side of a wall's texture


@cache
def texture(seed: int) -> np.ndarray:
    """Blobs of many sizes: corners at every scale SIFT looks at."""
    rng = np.random.default_rng(seed)
    image = np.zeros((_TEXELS, _TEXELS, 3), np.float32)
    for cells, weight in ((8, 0.3), (32, 0.4), (96, 0.5)):
        noise = rng.random((cells, cells, 3), dtype=np.float32)
        image += weight * cv2.resize(noise, (_TEXELS, _TEXELS), interpolation=cv2.INTER_NEAREST)
    return np.clip(255 * image / image.max(), 0, 255).astype(np.uint8)


def walls(seeds: tuple[int, int] = (1, 2)) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, int]]:
    """(corner, edge u, edge v, texture seed) of each wall, world units."""
    up = np.array([0.0, 4.0, 0.0])
    return [
        (np.array([-3.0, -2.0, 4.5]), np.array([3.0, 0.0, 1.5]), up, seeds[0]),
        (np.array([0.0, -2.0, 6.0]), np.array([3.0, 0.0, -1.5]), up, seeds[1]),
    ]


def render(eye: np.ndarray, target: np.ndarray, seeds: tuple[int, int] = (1, 2)) -> np.ndarray:
    """[H, W, 3] uint8 as a camera at `eye` looking at `target` sees the walls."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    k = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    photo = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    for corner, u, v, seed in walls(seeds):
        plane = np.column_stack([u / _TEXELS, v / _TEXELS, corner - eye])  # texel -> world, from the eye
        homography = k @ rotation @ plane
        warped = cv2.warpPerspective(texture(seed), homography, (WIDTH, HEIGHT), flags=cv2.INTER_AREA)
        cover = cv2.warpPerspective(np.full((_TEXELS, _TEXELS), 255, np.uint8), homography, (WIDTH, HEIGHT))
        photo[cover > 127] = warped[cover > 127]
    return photo


def eyes(count: int) -> list[np.ndarray]:
    """Camera centres on an arc in front of the walls."""
    angles = np.linspace(-0.5, 0.5, count)
    return [np.array([3.0 * np.sin(a), 0.2 * np.cos(5 * a), 5.0 - 4.5 * np.cos(a)]) for a in angles]


def write_capture(
    folder: Path, count: int = 6, prefix: str = "p", seeds: tuple[int, int] = (1, 2)
) -> list[Path]:
    """Photos `p00.jpg`, `p01.jpg`, ... in `folder`; walls of other seeds are another place."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for i, eye in enumerate(eyes(count)):
        path = folder / f"{prefix}{i:02d}.jpg"
        pixels = render(eye, np.array([0.0, 0.0, 5.2]), seeds)
        path.write_bytes(
            cv2.imencode(".jpg", pixels[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        )
        paths.append(path)
    return paths


# -- the scene that many tests share: `built` in tests/conftest.py ----------------------------------------

SETTINGS = BuildSettings(factor=2, max_features=800, name="walls", license="CC0-1.0")
COUNT = 6  # photos


def write_split_capture(root: Path) -> Path:
    """train/ and test/ as the simulator lays them out, with truth and masks; returns `root`."""
    paths = write_capture(root / "train", COUNT)
    (root / "test").mkdir()
    for path in (paths[1], paths[4]):
        path.rename(root / "test" / path.name)
    for i in range(COUNT):
        distractor = np.zeros((HEIGHT, WIDTH), np.uint8)
        distractor[: HEIGHT // 2, : 20 * i] = 255
        write_png(root / "truth" / "distractor" / f"p{i:02d}.png", distractor)
        write_png(root / "truth" / "clean" / f"p{i:02d}.png", np.full((HEIGHT, WIDTH, 3), 40 * i, np.uint8))
    (root / "truth" / "capture.json").write_text('{"seed": 1}')
    return root
