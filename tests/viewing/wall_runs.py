"""Finished runs with a model that shows the wall of the tiny scene, made without training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.builder.scene_package import list_files
from ambiguous_wild.io.files import sha256_file, write_json
from ambiguous_wild.io.images import write_png
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.io.scene_folder import load_scene
from tests.report.board_runs import change_result, write_run
from tests.tiny_scene import HEIGHT, TRAIN, WALL_Z, WIDTH, wall_colour, write_tiny_scene

SH_C0 = 0.28209479177387814


def wall_model(count: int = 2500, seed: int = 0) -> dict[str, np.ndarray]:
    """Flat, nearly opaque Gaussians in the colours of the wall, with some harmonics."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-2.6, 3.8, count), rng.uniform(-1.9, 1.9, count)
    means = np.column_stack([x, y, WALL_Z + rng.normal(0, 0.01, count)])
    arrays = {
        "means": means,
        "quats": rng.normal(size=(count, 4)) * 0.1 + [1.0, 0, 0, 0],
        "log_scales": np.log(rng.uniform(0.03, 0.09, (count, 3)) * [1, 1, 0.2]),
        "opacity_logits": rng.normal(1.5, 1.0, count),
        "sh0": (wall_colour(x, y) - 0.5) / SH_C0,
        "sh_rest": rng.normal(0, 0.03, (count, 15, 3)),
    }
    return {name: value.astype(np.float32) for name, value in arrays.items()}


def write_mixed_scene(root: Path) -> Path:
    """The tiny scene as `aw build-scene` describes one whose test photos were not chosen as clean."""
    scene = write_tiny_scene(root)
    record = {"schema_version": 1, "factor": 1, "name": root.name, "split": "every-8"}
    write_json(scene / "scene.json", record | {"files": list_files(scene, 1)})
    return scene


def write_shown_run(
    root: Path, scene: Path, method: str = "3dgs", seed: int = 0, *, count: int = 2500, **more: Any
) -> Path:
    """A run of `write_run` with a model, and with masks of two train photos."""
    ply = root / "model.ply"
    write_splat_ply(ply, wall_model(count, seed))
    run = write_run(root, scene, method, seed, size_b=ply.stat().st_size, **more)
    ply.replace(run / "point_cloud.ply")
    digest = sha256_file(run / "point_cloud.ply")
    change_result(
        run, lambda result: result["cost"].update(gaussians=count) or result.update(model_sha256=digest)
    )
    for name in TRAIN[:2]:
        keep = np.full((HEIGHT, WIDTH), 255, np.uint8)
        keep[14:26, 14:26] = 0
        (run / "masks").mkdir(exist_ok=True)
        write_png(run / "masks" / name, keep)
    assert load_scene(scene).train
    return run
