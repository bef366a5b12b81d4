"""30 000 iterations on a small scene with difficult content stay finite and keep what was learnt.

The scene (48x27 px, from a seed): a wall, 40 needles of aspect 1000 in front of it, a sky brighter than
white, distractors, two photos that are masked completely, a camera behind the wall and one inside the
needles. With -s it prints the figures of docs/numerics.md.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.harness import evaluate
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat import training_loop
from ambiguous_wild.splat.calibration import warm_up
from ambiguous_wild.splat.cpu.cpu_render import render_cpu
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer

WIDTH, HEIGHT, FOCAL = 48, 27, 41.0
TRAIN, TEST, MASKED = 12, 3, (4, 9)  # views; which of them are all masked
CAP = 600  # Gaussians at most
ITERATIONS = 30_000
LOOKS = 100  # at the model over a run


# -- the scene ----------------------------------------------------------------------------------------


def world(seed: int = 7) -> Gaussians:
    """Wall at z = 4, needles in front of it, sky behind it: the model that the photos are rendered from."""
    rng = np.random.default_rng(seed)
    wall, needles, sky = 300, 40, 60
    n = wall + needles + sky
    means, scales, colour = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    means[:wall] = np.column_stack(
        [rng.uniform(-3, 3, wall), rng.uniform(-0.2, 1.6, wall), rng.normal(4, 0.02, wall)]
    )
    scales[:wall] = 0.12
    colour[:wall] = 0.5 + 0.4 * np.sin(3 * means[:wall] + np.array([0.0, 1.0, 2.0]))
    part = slice(wall, wall + needles)
    means[part] = np.column_stack(
        [rng.uniform(-2, 2, needles), rng.uniform(-0.8, 1.0, needles), rng.uniform(2.5, 3.5, needles)]
    )
    scales[part] = [0.4, 4e-4, 4e-4]  # aspect 1000
    colour[part] = rng.uniform(0, 1, (needles, 3))
    means[wall + needles :] = np.column_stack(
        [rng.uniform(-60, 60, sky), rng.uniform(-40, 10, sky), rng.uniform(45, 60, sky)]
    )
    scales[wall + needles :] = 9.0
    colour[wall + needles :] = 3.0  # white three times over: every photo is clipped there
    return Gaussians(
        means=_tensor(means),
        quats=_tensor(rng.normal(size=(n, 4))),
        log_scales=_tensor(np.log(scales)),
        opacity_logits=torch.full((n,), 3.0),
        sh0=_tensor((colour - 0.5) / SH_C0),
        sh_rest=torch.zeros(n, 0, 3),
    )


def cameras() -> list[Camera]:
    """TRAIN + TEST along a line; the last two of training look from behind and from among the needles."""
    found = []
    for i in range(TRAIN + TEST):
        x = -1.2 + 2.4 * (i % TRAIN) / (TRAIN - 1) + (0.1 if i >= TRAIN else 0.0)
        centre, turn = np.array([x, 0.0, 0.0]), -0.15 * x
        if i == TRAIN - 2:
            centre, turn = np.array([0.5, 0.2, 8.0]), math.pi
        if i == TRAIN - 1:
            centre = np.array([0.1, 0.0, 3.0])
        pose = np.eye(4)
        c, s = math.cos(turn), math.sin(turn)
        pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        pose[:3, 3] = -pose[:3, :3] @ centre
        found.append(Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose))
    return found


def write_scene(root: Path, seed: int = 7) -> Path:
    """The scene folder, as any COLMAP scene; returns `root`."""
    for folder in ("images", "masks/train", "sparse/0"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    truth, rng = world(seed), np.random.default_rng(seed + 1)
    names, poses = [], []
    for i, camera in enumerate(cameras()):
        name = f"train_{i:02d}.png" if i < TRAIN else f"test_{i - TRAIN}.png"
        photo = render_cpu(truth, camera, sh_degree=0).image.clamp(0, 1).numpy()
        if i < TRAIN and i % 3 == 0:  # a distractor, elsewhere in every third photo
            x, y = rng.integers(4, WIDTH - 14), rng.integers(8, HEIGHT - 10)
            photo[y : y + 8, x : x + 10] = rng.uniform(0, 1, 3)
        cv2.imwrite(str(root / "images" / name), np.round(photo[:, :, ::-1] * 255).astype(np.uint8))
        if i in MASKED:
            cv2.imwrite(str(root / "masks" / "train" / name), np.zeros((HEIGHT, WIDTH), np.uint8))
        names.append(name)
        poses.append(f"{i + 1} {_quaternion(camera)} {_words(camera.cam_from_world[:3, 3])} 1 {name}\n\n")
    pinhole = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    (root / "sparse/0/cameras.txt").write_text(pinhole)
    (root / "sparse/0/images.txt").write_text("".join(poses))
    (root / "sparse/0/points3D.txt").write_text("".join(_points(truth, rng)))
    (root / "train_list.txt").write_text("\n".join(names[:TRAIN]) + "\n")
    (root / "test_list.txt").write_text("\n".join(names[TRAIN:]) + "\n")
    return root


def _points(truth: Gaussians, rng: np.random.Generator) -> list[str]:
    """Every other centre with noise; one in thirty is an outlier, as in SfM."""
    xyz = truth.means.numpy()[::2] + rng.normal(0, 0.02, (len(truth.means[::2]), 3))
    xyz[::30] += rng.normal(0, 30.0, xyz[::30].shape)
    rgb = (np.clip(truth.sh0.numpy()[::2] * SH_C0 + 0.5, 0, 1) * 255).astype(int)
    return [f"{i} {_words(p)} {_words(c)} 0.5\n" for i, (p, c) in enumerate(zip(xyz, rgb), 1)]


def _quaternion(camera: Camera) -> str:
    angle = math.atan2(camera.cam_from_world[0, 2], camera.cam_from_world[0, 0])
    return _words([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0])


def _words(values: Any) -> str:
    return " ".join(repr(float(v)) if isinstance(v, (float, np.floating)) else str(v) for v in values)


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


# -- the run ------------------------------------------------------------------------------------------


def train(method: str, scene_root: Path, folder: Path) -> list[dict[str, Any]]:
    """Train to the end; returns a row per hundredth of the run."""
    scene = load_scene(scene_root)
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=folder.parent / ".cache")
    truth = evaluate.load_test_photos(scene)
    entry = get_method(method)
    config = TrainConfig(iterations=ITERATIONS, max_gaussians=CAP, probes=20)  # at rows of the timeline

    def probe(draw: Any) -> float:
        return evaluate.mean_psnr(truth, lambda camera: draw(camera).numpy())

    looks: list[dict[str, Any]] = []

    def look(trainer: Trainer) -> None:
        if trainer.iteration % (ITERATIONS // LOOKS) == 0:
            g = trainer.gaussians
            scales = g.log_scales.exp()
            looks.append(
                {
                    "iteration": trainer.iteration,
                    "largest_scale": float(scales.max()),
                    "largest_aspect": float((scales.amax(1) / scales.amin(1)).max()),
                    "finite": all(bool(torch.isfinite(t).all()) for _, t in g.items()),
                }
            )

    trainer = Trainer(data, entry.build(entry.options()), config, folder=folder, probe=probe)
    training_loop.train(trainer, tick=look)
    return [row | seen for row, seen in zip(trainer.timeline.rows, looks, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["3dgs", "refinesplat"])
def test_a_long_run_stays_finite_and_keeps_what_it_learnt(method, tmp_path):
    warm_up()
    folder = tmp_path / method
    rows = train(method, write_scene(tmp_path / "scene"), folder)
    loss = np.array([row["loss"] for row in rows])
    psnr = [row["psnr_probe"] for row in rows if row["psnr_probe"] is not None]
    tenth = len(loss) // 10
    first, last = loss[:tenth].mean(), loss[-tenth:].mean()
    best = np.convolve(loss, np.ones(tenth) / tenth, "valid").min()
    largest = {key: max(row[key] for row in rows) for key in ("gaussians", "largest_scale", "largest_aspect")}
    print(f"{method}: {largest}; loss: first, best, last tenth {first:.4f}, {best:.4f}, {last:.4f}")
    print(f"test PSNR: best, last {max(psnr):.1f}, {psnr[-1]:.1f} dB")
    assert rows[-1]["iteration"] == ITERATIONS
    assert all(row["finite"] for row in rows) and np.isfinite(loss).all()
    assert not (folder / "nonfinite").exists()
    assert largest["gaussians"] <= CAP
    assert last < first and last <= 1.1 * best
