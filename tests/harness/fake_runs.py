"""Result files made on the spot, shared by the tests of store, tables and `aw table`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ambiguous_wild.harness.result_file import write_result


def fake_result(
    method: str, scene: str = "yard", seed: int = 0, psnr: tuple[float, ...] = (20.0, 22.0), **changes: Any
) -> dict[str, Any]:
    """A finished result with one image for every PSNR; `changes` replace top-level fields."""
    images = [
        {"name": f"{i}.png", "psnr": p, "ssim": min(p / 50, 1.0), "lpips_alex": None}
        for i, p in enumerate(psnr)
    ]
    result: dict[str, Any] = {
        "schema": 1,
        "method": method,
        "scene": scene,
        "seed": seed,
        "status": "ok",
        "error": None,
        "options": {},
        "per_image": images,
        "missing": {"lpips_alex": "weights missing: put heads.pth into W"},
        "masks": None,
        "facts": {},
        "cost": {
            "train_s": 10.0 + seed,
            "iterations": 100,
            "ms_per_iteration": 100.0,
            "ms_parts": {"render": 60.0},
            "fps": 30.0,
            "gaussians": 1234,
            "model_mb": 0.3,
            "device": "cpu",
            "threads": 2,
            "reference_s": 8.0 + seed,
            "timing": {"verdict": "alone", "reason": "", "kernel": "cpu-1"},
        },
        "config_hash": "c",
        "scene_hash": "s",
        "version": "0.1.0",
    }
    return result | changes


def failed(method: str, scene: str = "yard", seed: int = 0) -> dict[str, Any]:
    """The result of a run that died."""
    return fake_result(
        method, scene, seed, (), status="failed", error="loss is not finite", missing={}, cost={}
    )


def save(root: Path, *results: dict[str, Any]) -> Path:
    """Write every result to its place below `root`, as `aw bench` does."""
    for r in results:
        folder = "".join(c if c.isalnum() else "_" for c in r["method"])
        name = "failed.json" if r["status"] == "failed" else "metrics.json"
        write_result(root / r["scene"] / folder / f"seed{r['seed']}" / name, r)
    return root


def start(root: Path, method: str, scene: str = "yard", seed: int = 0) -> Path:
    """A run that was begun and not finished; returns its folder."""
    folder = root / scene / method / f"seed{seed}"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(f"method: {method}\nscene: {{name: {scene}}}\n", encoding="utf-8")
    return folder
