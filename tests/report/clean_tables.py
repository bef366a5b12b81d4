"""Random collections of tables in which everything is right, as papers print them."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3, "memory": 2}
BETTER = {"psnr": 1, "ssim": 1, "lpips": -1}
COLUMNS = ("table", "method", "setting", "dataset", "scene", "metric", "variant", "value", "mark", "printed")


def clean_tables(seed: int) -> list[Row]:
    """Main tables, one of means, an ablation and one of memory; here and there a method fails on a scene."""
    rng = np.random.default_rng(seed)
    methods = [f"method {i}" for i in range(rng.integers(4, 11))]
    rows: list[Row] = []
    for d in range(rng.integers(1, 4)):
        scenes = [f"scene {d}{i}" for i in range(rng.integers(2, 10))]
        rows += _main(rng, f"set {d}", scenes, methods)
    rows += _means(rows, methods)
    rows += _ablation(rng, rows)
    rows += _memory(rng, rows)
    return rows


def write(rows: list[Row], path: Path) -> Path:
    with open(path, "w", newline="", encoding="utf-8") as f:
        writer = csv.DictWriter(f, COLUMNS)
        writer.writeheader()
        writer.writerows({**dict.fromkeys(COLUMNS, ""), **r, "printed": r["value"]} for r in rows)
    return path


def _row(table: str, method: str, dataset: str, scene: str, metric: str, value: float, **more: Any) -> Row:
    text = f"{value:.{DIGITS[metric]}f}"
    variant = {"memory": "MB of the model file"}.get(metric, "stated")
    return {"table": table, "method": method, "setting": "", "dataset": dataset, "scene": scene,
            "metric": metric, "variant": variant, "value": text, **more}  # fmt: skip


def _main(rng: np.random.Generator, dataset: str, scenes: list[str], methods: list[str]) -> list[Row]:
    skill = rng.normal(0, rng.uniform(0.3, 1.5), len(methods))
    rows = []
    for scene in scenes:
        level = rng.normal(22, 3)
        for k, method in enumerate(methods):
            psnr = level + skill[k] + rng.normal(0, 0.6)
            psnr -= 8 * (rng.random() < 0.02)  # it failed here
            ssim = float(np.clip(0.75 + 0.035 * (psnr - 22) + rng.normal(0, 0.03), 0.05, 0.99))
            lpips = float(np.clip(0.25 - 0.03 * (psnr - 22) + rng.normal(0, 0.03), 0.02, 0.95))
            for metric, value in (("psnr", psnr), ("ssim", ssim), ("lpips", lpips)):
                rows.append(_row(dataset, method, dataset, scene, metric, value))
    _mark(rows)
    return rows


def _mark(rows: list[Row]) -> None:
    for scene in {r["scene"] for r in rows}:
        for metric, sign in BETTER.items():
            column = [r for r in rows if (r["scene"], r["metric"]) == (scene, metric)]
            for r in column:
                ahead = sum(sign * (float(o["value"]) - float(r["value"])) > 0 for o in column)
                r["mark"] = str(ahead + 1) if ahead < 3 else ""


def _means(rows: list[Row], methods: list[str]) -> list[Row]:
    found = []
    for method in methods:
        for metric in BETTER:
            of = {}
            for r in rows:
                if (r["method"], r["metric"]) == (method, metric):
                    of.setdefault(r["dataset"], []).append(float(r["value"]))
            averages = {d: float(np.mean(v)) for d, v in of.items()}
            found += [_row("means", method, d, "mean", metric, v) for d, v in averages.items()]
            if len(averages) > 1:
                found.append(
                    _row("means", method, "all", "mean", metric, float(np.mean([*averages.values()])))
                )
    return found


def _ablation(rng: np.random.Generator, rows: list[Row]) -> list[Row]:
    """The main table's entry, and the same with parts left out."""
    whole = [r for r in rows if r["table"] == "set 0" and r["method"] == "method 0"][:3]
    found = [{**r, "table": "ablation", "mark": ""} for r in whole]
    for setting in ("part a off", "part b off", "both off"):
        for r in whole:
            step = rng.uniform(0.3, 1.2) if r["metric"] == "psnr" else rng.uniform(0.01, 0.05)
            value = float(r["value"]) - BETTER[r["metric"]] * step
            found.append({**_row("ablation", r["method"], r["dataset"], r["scene"], r["metric"], value),
                          "setting": setting})  # fmt: skip
    return found


def _memory(rng: np.random.Generator, rows: list[Row]) -> list[Row]:
    cells = sorted({(r["method"], r["dataset"], r["scene"]) for r in rows if not r["setting"]})
    return [
        _row("memory", m, d, s, "memory", float(rng.lognormal(5, 0.7))) for m, d, s in cells if s != "mean"
    ]
