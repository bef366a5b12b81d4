"""Run folders that pass every check of `aw leaderboard add`, made on the spot without training."""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from click.testing import CliRunner, Result

from ambiguous_wild.cli.leaderboard import command
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.harness.cell import scene_identity
from ambiguous_wild.harness.result_file import artefact_hashes, config_identity, write_result
from ambiguous_wild.io.files import write_json, write_text
from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.metrics import image as image_metrics
from tests.tiny_scene import write_tiny_scene

METRICS = ("psnr", "ssim", "ssim_inria")


def aw(*words: object) -> Result:
    """`aw leaderboard WORDS`; an error is raised."""
    return CliRunner().invoke(command, [str(w) for w in words], catch_exceptions=False)


def add(board: Path, *words: object, dataset: str = "Tiny set") -> Result:
    return aw("add", *words, "--board", board, "--dataset", dataset)


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def one_run(folder: Path) -> Path:
    """A run of its own, to be spoilt, on the scene `folder`/wall."""
    return write_run(folder / "runs", write_tiny_scene(folder / "wall"))


def own_scene(root: Path, *, distractors: bool = True) -> Path:
    """A tiny scene with a point of its own, so that it is not another one under a second name."""
    scene = write_tiny_scene(root, distractors=distractors)
    with (scene / "sparse/0/points3D.txt").open("a") as points:
        points.write(f"401 {zlib.crc32(root.name.encode()) / 2**32} 0 4 9 9 9 0.5\n")
    return scene


def write_run(
    root: Path,
    scene: Path,
    method: str = "3dgs",
    seed: int = 0,
    *,
    noise: float = 12.0,
    train_s: float = 60.0,
    size_b: int = 500_000,
    iterations: int = 100,
    options: dict[str, Any] | None = None,
    cpu: str = "Test CPU",
    alone: bool | None = None,
    masks: dict[str, Any] | None = None,
    **more: Any,
) -> Path:
    """RUNS/<scene>/<folder>/seed<k>: renders are the photos with noise, the numbers are measured on them.

    `noise` is in units of 1/255; `alone` says whether it had the machine alone, None: not recorded; with
    scores under `masks` there is a mask a train photo; what `more` holds goes into config.yaml before it is
    hashed.
    """
    opened = load_scene(scene)
    builtin = method.split("@")[0] in ("3dgs", "refinesplat", "robustsplat", "dronesplat")
    config: dict[str, Any] = {
        "method": method,
        "source": "" if builtin else hashlib.sha256(method.encode()).hexdigest(),
        "options": options or {},
        "train": {
            "iterations": iterations, "budget_s": None, "seed": seed, "resolution": "auto",
            "max_gaussians": None, "torch_threads": 1, "checkpoint_every_s": 60.0, "probes": 8,
        },
        "scene": {
            "name": opened.name, "sha256": scene_identity(opened),
            "factor": opened.info.get("loaded_factor"), "path": str(scene),
        },
        "device": "cpu",
        "version": "0.1.0",
    } | more  # fmt: skip
    config["config_hash"] = config_identity(config)
    run = root / opened.name / config_hash(method)[:8] / f"seed{seed}"
    run.mkdir(parents=True)
    write_text(run / "config.yaml", yaml.safe_dump(config, sort_keys=False, allow_unicode=True))
    write_json(run / "env.json", {"cpu": cpu, "platform": "test"})
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {1000 + seed}\nproperty float x\nend_header\n"
    )
    (run / "point_cloud.ply").write_bytes(head.encode().ljust(size_b, b"p"))
    rng = np.random.default_rng([seed, zlib.crc32(f"{method} {opened.name}".encode())])
    rows = []
    for view in opened.test:
        photo = read_png_rgb(view.image_path)
        drawn = photo + rng.normal(0.0, noise * rng.uniform(0.9, 1.1), photo.shape)
        path = (run / "renders" / "test" / view.name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, np.clip(drawn, 0, 255).round().astype(np.uint8))
        render = read_png_rgb(path)
        rows.append({"name": view.name} | {m: getattr(image_metrics, m)(render, photo) for m in METRICS})
    result = {
        "schema": 1, "method": method, "scene": opened.name, "seed": seed, "status": "ok", "error": None,
        "options": config["options"], "per_image": rows,
        "missing": {"lpips_alex": "weights missing"}, "masks": masks,
        "facts": {key: more[key] for key in ("protocol", "effects") if key in more},
        "cost": {
            "train_s": (train_s := train_s * rng.uniform(0.95, 1.05)), "iterations": iterations,
            "ms_per_iteration": 1e3 * train_s / max(iterations, 1), "gaussians": 1000 + seed,
            "fps": 30.0 + seed, "model_mb": size_b / 1e6, "device": "cpu", "threads": 2,
            "ms_parts": {"render": 1.0},
        },
        "config_hash": config["config_hash"], "scene_hash": config["scene"]["sha256"], "version": "0.1.0",
    }  # fmt: skip
    if alone is not None:
        verdict = {"verdict": "alone", "reason": ""}
        verdict = verdict if alone else {"verdict": "contended", "reason": "two other programs"}
        result["cost"] |= {"timing": verdict | {"kernel": "cpu-1"}, "reference_s": 2 * train_s}
    if masks is not None:
        (run / "masks").mkdir()
        for view in opened.train:
            keep = np.full((view.camera.height, view.camera.width), 255, np.uint8)
            keep[: view.camera.height // 4] = 0
            cv2.imwrite(str((run / "masks" / view.name).with_suffix(".png")), keep)
    write_result(run / "metrics.json", result | artefact_hashes(run, rows))
    return run


def change_result(run: Path, change: Callable[[dict], object]) -> None:
    """Edit the metrics.json of a run as a hand would."""
    path = run / "metrics.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def change_image(run: Path, at: int = 0, **values: object) -> None:
    """Replace metrics of a test image; a function gets the value that is there, None removes it."""

    def change(result: dict) -> None:
        row = result["per_image"][at]
        for key, value in values.items():
            row[key] = value(row[key]) if callable(value) else value
            if value is None:
                del row[key]

    change_result(run, change)
