"""Run folders with timelines and settings, for the tests of the cost report."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ambiguous_wild.harness.result_file import write_result
from ambiguous_wild.report.cost_curves import Curve, curves_of
from ambiguous_wild.report.cost_runs import CostRuns, read_cost_runs
from tests.harness.fake_runs import fake_result

RISING = [(10.0, 10.0), (20.0, 18.0), (40.0, 20.0)]
BUSY = {"verdict": "contended", "reason": "2 runs shared the machine", "kernel": "cpu-1"}
ALONE: dict[str, Any] = {"verdict": "alone", "reason": "", "kernel": "cpu-1"}


def cost_run(
    root: Path,
    method: str,
    scene: str = "yard",
    seed: int = 0,
    *,
    psnr: tuple[float, ...] = (20.0, 22.0),
    train_s: float = 60.0,
    effects: tuple[str, ...] = (),
    options: dict[str, Any] | None = None,
    budget_s: float | None = None,
    probes: list[tuple[float, float]] | None = None,
    ms: float = 100.0,
    model_mb: float = 1.0,
    reference_s: float | None = None,
    timing: dict[str, Any] | None = ALONE,
    train: dict[str, Any] | None = None,
    **changes: Any,
) -> Path:
    """A finished run with a timeline of (seconds, dB); returns its folder.

    Its reference seconds are its wall seconds unless given; a `timing` of None is that of an earlier version.
    """
    folder = root / scene / "".join(c if c.isalnum() else "_" for c in method) / f"seed{seed}"
    result = fake_result(method, scene, seed, psnr, options=options or {}, **changes)
    if result["cost"]:
        result["cost"] |= {"train_s": train_s, "setup_s": 5.0, "ms_per_iteration": ms, "model_mb": model_mb}
        for key in ("timing", "reference_s"):
            result["cost"].pop(key, None)
        if timing is not None:
            seconds = train_s if reference_s is None else reference_s
            result["cost"] |= {"timing": timing, "reference_s": seconds}
    if effects:
        result["facts"]["effects"] = list(effects)
    write_result(folder / ("failed.json" if result["status"] == "failed" else "metrics.json"), result)
    config = {
        "method": method,
        "train": {"iterations": 100, "budget_s": budget_s, "seed": seed, "probes": 8} | (train or {}),
        "scene": {"name": scene, "factor": 1},
        "device": "cpu",
    } | ({"effects": list(effects)} if effects else {})
    (folder / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    rows = probes if probes is not None else [(train_s, float(np.mean(psnr)))] if psnr else []
    with open(folder / "timeline.csv", "w", newline="", encoding="utf-8") as f:
        writer = csv.writer(f)
        writer.writerow(["wall_s", "iteration", "loss", "gaussians", "psnr_probe"])
        writer.writerows([at, 1, 0.1, 10, "" if value is None else value] for at, value in rows)
    return folder


def rising(
    root: Path, method: str, scene: str = "yard", seed: int = 0, *, end: float = 20.0, **more: Any
) -> Path:
    """A run of 40 s whose PSNR rises as `RISING`, to `end` dB."""
    probes = [*RISING[:2], (40.0, end)]
    return cost_run(root, method, scene, seed, psnr=(end,), train_s=40.0, probes=probes, **more)


def read(*folders: Path) -> CostRuns:
    return read_cost_runs(folders)


def curves(folder: Path) -> list[Curve]:
    return curves_of(read(folder).runs)
