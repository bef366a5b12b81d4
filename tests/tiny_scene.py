"""A scene folder small enough to train in a second: one coloured wall, cameras that step sideways."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core import Scene

WIDTH, HEIGHT, FOCAL, WALL_Z = 64, 48, 60.0, 4.0
TRAIN = [f"train_{i}.png" for i in range(6)]
TEST = [f"test_{i}.png" for i in range(2)]
SQUARE = slice(14, 26)  # rows and columns of the distractor, moved by 4 px a photo


def wall_colour(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Smooth colours in [0.1, 0.9] at wall positions, [..., 3]."""
    waves = [np.sin(2.1 * x + 0.3) * np.cos(1.7 * y), np.sin(1.3 * y - 1.0 + x), np.cos(2.4 * x - y)]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)


def _photo(camera_x: float) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x = camera_x + (columns - WIDTH / 2) / FOCAL * WALL_Z
    y = (rows - HEIGHT / 2) / FOCAL * WALL_Z
    return (wall_colour(x, y) * 255 + 0.5).astype(np.uint8)


def write_tiny_scene(root: Path, *, distractors: bool = True) -> Path:
    """Write images/, sparse/0 (text), split lists and truth/ under `root`; returns `root`."""
    for folder in ("images", "sparse/0", "truth/distractor"):
        (root / folder).mkdir(parents=True)
    positions = {name: 0.25 * i for i, name in enumerate(TRAIN)} | {
        n: 0.3 + 0.5 * i for i, n in enumerate(TEST)
    }
    poses = []
    for number, (name, x) in enumerate(positions.items(), start=1):
        photo, mask = _photo(x), np.zeros((HEIGHT, WIDTH), np.uint8)
        if distractors and name in TRAIN:
            left = 4 * TRAIN.index(name)
            square = (SQUARE, slice(SQUARE.start + left, SQUARE.stop + left))
            photo[square], mask[square] = (250, 20, 20), 255
        cv2.imwrite(str(root / "images" / name), photo[:, :, ::-1])
        if name in TRAIN:
            cv2.imwrite(str(root / "truth" / "distractor" / name), mask)
        poses.append(f"{number} 1 0 0 0 {-x} 0 0 1 {name}\n\n")
    (root / "sparse/0/cameras.txt").write_text(
        f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    )
    (root / "sparse/0/images.txt").write_text("".join(poses))
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-2.2, 3.4, 400), rng.uniform(-1.7, 1.7, 400), np.full(400, WALL_Z)])
    rgb = (wall_colour(xyz[:, 0], xyz[:, 1]) * 255).astype(int)
    lines = [
        f"{i} {p[0]} {p[1]} {p[2]} {c[0]} {c[1]} {c[2]} 0.5\n" for i, (p, c) in enumerate(zip(xyz, rgb), 1)
    ]
    (root / "sparse/0/points3D.txt").write_text("".join(lines))
    (root / "train_list.txt").write_text("\n".join(TRAIN) + "\n")
    (root / "test_list.txt").write_text("\n".join(TEST) + "\n")
    return root


def with_points(scene: Scene, count: int) -> Scene:
    """The scene with its first points alone: what every pixel is compared with is dear without kernels."""
    points = scene.points
    fewer = {name: value[:count] for name, value in vars(points).items() if len(value) == len(points)}
    return replace(scene, points=replace(points, **fewer, track_offsets=points.track_offsets[: count + 1]))
