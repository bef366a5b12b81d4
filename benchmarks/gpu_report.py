"""The report of `gpu.py`, from the results of the stages that were run."""

from __future__ import annotations

from typing import Any

# what was promised: ratio or figure, the most (or least) it may be
TARGETS = {"3dgs / gsplat": 1.05, "3dgs / gsplat, no wait": 1.05, "refinesplat-dinov2 / 3dgs": 1.3}
TRAIN_S = 180.0  # refinesplat, 30 000 iterations in all
FPS = 500.0
SAME_DB = 0.15


def to_markdown(stages: dict[str, dict[str, Any]]) -> str:
    """The report as Markdown; stages without results are left out."""
    parts = ["# On a GPU", "", "Made by `bash benchmarks/gpu.sh`; the figures are in `gpu-*.json` beside it."]
    for name, write in (
        ("build", _build), ("parity", _parity), ("train", _train), ("budget", _budget),
        ("cost", _cost), ("same", _same)
    ):  # fmt: skip
        for key in sorted(k for k in stages if k == name or k.startswith(f"{name}-")):
            e = stages[key]["environment"]
            versions = f"torch {e['packages']['torch']}, gsplat {stages[key]['gsplat']}"
            parts += ["", *write(stages[key]), "", f"({e.get('gpu', e['device'])}, {versions})"]
    return "\n".join(parts) + "\n"


def _build(s: dict[str, Any]) -> list[str]:
    return [f"First picture and its gradients, kernels compiled or loaded: {s['seconds']:.1f} s; "
            f"alpha is clamped at {s['max_alpha']}."]  # fmt: skip


def _parity(s: dict[str, Any]) -> list[str]:
    lines = [f"## Against float64: {s['passed']} of {s['cases']} hard cases", ""]
    if s.get("left_out"):
        lines += [s["left_out"], ""]
    lines += ["| case | worst error | allowed | |", "|---|---:|---:|---|"]
    for row in s["rows"]:
        error = "none" if row["error"] is None else f"{row['error']:.1e}"
        allowed = "none" if row["tolerance"] is None else f"{row['tolerance']:.1e}"
        verdict = "passed" if row["passed"] else "FAILED"
        lines.append(f"| {row['key']} | {error} | {allowed} | {verdict} |")
    return lines


def _train(s: dict[str, Any]) -> list[str]:
    scene = s["scene"]
    size = f"{scene['train']} photos of {scene['width']}x{scene['height']}"
    lines = [f"## Whole trainings, {size}", ""]
    heads = (
        "iterations",
        "setup s",
        "training s",
        "ms an iteration",
        "Gaussians",
        "PSNR dB",
        "FPS",
        "peak MB",
    )
    lines += [f"| method | {' | '.join(heads)} |", "|---|" + "---:|" * len(heads)]
    for r in s["rows"]:
        peak = f"{r['peak_cuda_mb']:.0f}" if "peak_cuda_mb" in r else ""
        lines.append(
            f"| {r['method']} | {r['iterations']} | {r['setup_s']:.1f} | {r['train_s']:.1f} | "
            f"{r['ms_per_iteration']:.2f} | {r['gaussians']} | {r['psnr']:.2f} | {r['fps']:.0f} | {peak} |"
        )
    names = list(dict.fromkeys(name for r in s["rows"] for name in r["ms_parts"]))
    lines += ["", "ms an iteration by part, by the GPU's own events:", ""]
    lines += ["| method | " + " | ".join(names) + " |", "|---|" + "---:|" * len(names)]
    for r in s["rows"]:
        cells = [f"{r['ms_parts'][n]:.2f}" if n in r["ms_parts"] else "" for n in names]
        lines.append(f"| {r['method']} | " + " | ".join(cells) + " |")
    for r in s["rows"]:
        if r["method"].startswith("refinesplat") and r["iterations"] == 30_000:
            spent = r["setup_s"] + r["train_s"]
            lines += [
                "",
                f"{r['method']} in all: {spent:.0f} s ({_verdict(spent <= TRAIN_S)} of {TRAIN_S:.0f} s).",
            ]
    lines += [f"\n{method} failed: {why}" for method, why in s.get("failed", {}).items()]
    if s["rows"]:
        best = max(r["fps"] for r in s["rows"])
        lines += ["", f"Frames a second: {best:.0f} at most ({_verdict(best > FPS)} of {FPS:.0f})."]
    return lines


def _budget(s: dict[str, Any]) -> list[str]:
    lines = [f"## Trainings of {s['budget_s']:.0f} s", "", "| method | iterations | Gaussians | PSNR dB |"]
    lines.append("|---|---:|---:|---:|")
    lines += [
        f"| {r['method']} | {r['iterations']} | {r['gaussians']} | {r['psnr']:.2f} |" for r in s["rows"]
    ]
    return lines


def _cost(s: dict[str, Any]) -> list[str]:
    lines = [f"## An iteration at {s['gaussians']} Gaussians, loops in turns", ""]
    lines += ["| loop | ms |", "|---|---:|"]
    lines += [f"| {name} | {ms:.2f} |" for name, ms in s["ms"].items()]
    lines.append("")
    for name, ratio in s["ratios"].items():
        target = TARGETS.get(name)
        said = "" if target is None else f" ({_verdict(ratio <= target)} of {target})"
        lines.append(f"- {name}: {ratio:.2f}{said}")
    lines += [f"- {name} failed: {why}" for name, why in s.get("left_out", {}).items()]
    return lines


def _same(s: dict[str, Any]) -> list[str]:
    lines = [f"## CPU and GPU, {s['iterations']} iterations, mean of three seeds", ""]
    lines += ["| capture | method | CPU dB | GPU dB | apart | |", "|---|---|---:|---:|---:|---|"]
    for g in s["gaps"]:
        verdict = _verdict(abs(g["gap"]) <= SAME_DB)
        figures = f"{g['cpu']:.2f} | {g['gpu']:.2f} | {g['gap']:+.2f}"
        lines.append(f"| {g['capture']} | {g['method']} | {figures} | {verdict} |")
    return lines


def _verdict(holds: bool) -> str:
    return "within" if holds else "MISSED: beyond"
