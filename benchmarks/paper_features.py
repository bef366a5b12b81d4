"""The paper's method and learnt masks with hand-made and with pretrained features, against 3dgs.

    python benchmarks/paper_features.py --captures DIR... --out DIR [--methods ...] [--backends ...]
        [--seeds 0 1 2] [--iterations 700] [--max-gaussians 12000] [--jobs 1] [--most N] [--results STEM]
        [--report-only]

A DIR is a scene folder or a folder of them. A back end gives features and instances (hand-made features:
graph segments); methods without either run once. `default` is what a method takes by itself. Each run is one
`aw bench` with one thread. Finished runs are kept and stopped ones resume; --most trains at most so many and
then writes the tables. Runs of the first seed come first, and among them the back ends in their order.

Writes benchmarks/results/paper-features.json, .csv and .md: PSNR, mask IoU, and processor time per iteration
over that of 3dgs; missing runs are listed. The texts of the runs go into paper-features-runs.tar.xz, from
which the queue goes on at another machine.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import pandas as pd
from captures import find_scenes
from ending import exit_code
from job_queue import Run, archive_of, check_settings, keep, parser_of, restore, run_all

from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.result_file import RESULT, read_result
from ambiguous_wild.io.atomic import write_json, write_text
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.vision.backends import CONV

RESULTS = Path(__file__).parent / "results" / "paper-features"
PLAIN = "3dgs"
METHODS = (PLAIN, "refinesplat", "refinesplat-paper", "robustsplat", "dronesplat", "refinesplat-printed")
# what a back end sets; methods that are not here have neither features nor instances that they use
USES = {
    "refinesplat-paper": ("features", "instances"),
    "refinesplat-printed": ("features", "instances"),
    "robustsplat": ("features",),
    "dronesplat": ("instances",),
}
BACKENDS = ("labhog", "efficientnet-lite0", "vgg16", "sceneconv")
DEFAULT = "default"
SHORT_DB = 0.5  # below 3dgs by more is marked


@dataclass(frozen=True)
class Job:
    """One run."""

    method: str
    backend: str  # "" for methods that use none
    scene: Path
    name: str  # of the scene
    seed: int

    def folder(self, out: Path) -> Path:
        return out / (self.backend or "none") / self.name / self.method / f"seed{self.seed}"

    def run(self, args: argparse.Namespace) -> Run:
        words = ["--scene", str(self.scene), "--seed", str(self.seed)]
        words += ["--iterations", str(args.iterations), "--max-gaussians", str(args.max_gaussians)]
        words += ["--device", "cpu", "--threads", "1", "--no-pictures", "--effects", "none", "--probes", "0"]
        words += ["-o", str(args.out / (self.backend or "none"))]
        name = f"{self.method} {self.backend} on {self.name}, seed {self.seed}"
        options = tuple(f"{k}={v}" for k, v in settings_of(self.method, self.backend).items())
        return Run(name, self.folder(args.out), self.method, tuple(words), options)


def settings_of(method: str, backend: str) -> dict[str, str]:
    """Options that give a method the back end; none for its own default."""
    if backend in ("", DEFAULT):
        return {}
    values = {"features": backend, "instances": backend if backend in CONV else "graph"}
    return {key: values[key] for key in USES[method]}


def backends_of(method: str, backends: Sequence[str]) -> list[str]:
    """Back ends that make a difference to a method."""
    if method not in USES:
        return [""]
    found: dict[str, str] = {}
    for backend in backends:
        found.setdefault(str(settings_of(method, backend)), backend)  # graph segments go with several
    return list(found.values())


def plan(args: argparse.Namespace) -> list[Job]:
    scenes = {folder: load_scene(folder).name for folder in find_scenes(args.captures)}
    jobs = [
        (args.seeds.index(seed), rank, Job(method, backend, scene, name, seed))
        for seed in args.seeds
        for scene, name in scenes.items()
        for method in args.methods
        for rank, backend in enumerate(backends_of(method, args.backends))
    ]
    return [job for _, _, job in sorted(jobs, key=lambda row: row[:2])]


def row_of(job: Job, out: Path) -> dict[str, Any] | None:
    """The figures of one run; None without a finished one."""
    path = job.folder(out) / RESULT
    if not path.is_file():
        return None
    result: dict[str, Any] = dict(read_result(path))
    if result["status"] != "ok":
        return None
    cost = result["cost"]
    return {
        "scene": job.name,
        "method": job.method,
        "backend": job.backend,
        "seed": job.seed,
        "psnr": fmean(float(r["psnr"]) for r in result["per_image"]),
        "iou": (result["masks"] or {}).get("iou"),
        "cpu_ms": 1000.0 * cost["cpu_s"] / cost["iterations"],
        "setup_s": cost.get("setup_s"),
        "gaussians": cost["gaussians"],
        "timing": cost.get("timing", {}).get("verdict", "unknown"),
    }


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row a scene, method and back end: means over seeds, and differences from 3dgs seed by seed."""
    plain = {(r["scene"], r["seed"]): r for r in rows if r["method"] == PLAIN}
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["method"], row["backend"]), []).append(row)
    found = []
    for (scene, method, backend), own in groups.items():
        pairs = [(r, plain[scene, r["seed"]]) for r in own if (scene, r["seed"]) in plain]
        ious = [r["iou"] for r in own if r["iou"] is not None]
        found.append(
            {
                "scene": scene,
                "method": method,
                "backend": backend,
                "seeds": len(own),
                "psnr": fmean(r["psnr"] for r in own),
                "sd": stdev(r["psnr"] for r in own) if len(own) > 1 else None,
                "gain_db": fmean(r["psnr"] - p["psnr"] for r, p in pairs) if pairs else None,
                "iou": fmean(ious) if ious else None,
                "cpu_ratio": fmean(r["cpu_ms"] / p["cpu_ms"] for r, p in pairs) if pairs else None,
            }
        )
    return found


def report(jobs: Sequence[Job], args: argparse.Namespace) -> dict[str, Any]:
    known = [(job, row_of(job, args.out)) for job in jobs]
    rows = [row for _, row in known if row is not None]
    return {
        "environment": environment("cpu"),
        "iterations": args.iterations,
        "max_gaussians": args.max_gaussians,
        "seeds": args.seeds,
        "contended": sum(row["timing"] != "alone" for row in rows),
        "rows": summary(rows),
        "runs": rows,
        "missing": [
            f"{job.method} {job.backend}".strip() + f" on {job.name}, seed {job.seed}"
            for job, row in known
            if row is None
        ],
    }


def to_markdown(data: dict[str, Any]) -> str:
    scenes = list(dict.fromkeys(row["scene"] for row in data["rows"]))
    cells = {(r["scene"], r["method"], r["backend"]): r for r in data["rows"]}
    kinds = sorted(
        {(r["method"], r["backend"]) for r in data["rows"]},
        key=lambda k: (METHODS.index(k[0]) if k[0] in METHODS else len(METHODS), k[1]),
    )

    def cell(scene: str, method: str, backend: str) -> str:
        row = cells.get((scene, method, backend))
        if row is None:
            return ""
        iou = "" if row["iou"] is None else f" / {row['iou']:.2f}"
        mark = " !" if row["gain_db"] is not None and row["gain_db"] < -SHORT_DB else ""
        return f"{row['psnr']:.2f}{iou}{mark}"

    def mean_of(method: str, backend: str, key: str) -> str:
        values = [r[key] for s in scenes if (r := cells.get((s, method, backend))) and r[key] is not None]
        return f"{fmean(values):+.2f} ({len(values)})" if values else ""

    lines = [
        "# The paper's method with hand-made and pretrained features",
        "",
        f"{data['iterations']} iterations, at most {data['max_gaussians']} Gaussians, one thread, seeds "
        f"{', '.join(map(str, data['seeds']))} as far as run. Test dB / mask IoU; ! = over {SHORT_DB} dB "
        "below 3dgs. Gain: mean over the captures that are run (their number). Made by "
        "`benchmarks/paper_features.py`.",
        "",
        "| method | features | " + " | ".join(scenes) + " | gain dB | processor time / 3dgs |",
        "|---" * (len(scenes) + 4) + "|",
    ]
    for method, backend in kinds:
        of_scenes = " | ".join(cell(scene, method, backend) for scene in scenes)
        cost = mean_of(method, backend, "cpu_ratio").lstrip("+")
        gain = mean_of(method, backend, "gain_db")
        lines.append(f"| {method} | {backend or '-'} | {of_scenes} | {gain} | {cost} |")
    total = len(data["runs"])
    lines += ["", f"Other programs ran on the machine during {data['contended']} of {total} runs: times of "
              "these are estimates."]  # fmt: skip
    if data["missing"]:
        lines += ["", "Not run yet: " + "; ".join(data["missing"]) + "."]
    return "\n".join(lines) + "\n"


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = parser_of(__doc__, iterations=700, tables=".json, .csv and .md")
    parser.set_defaults(results=RESULTS)
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--backends", nargs="+", default=list(BACKENDS), choices=[*BACKENDS, DEFAULT])
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    args = arguments(words)
    jobs = plan(args)
    stem, runs = args.results, [job.run(args) for job in jobs]
    check_settings(stem, iterations=args.iterations, max_gaussians=args.max_gaussians)
    restore(args.out, archive_of(stem))
    failed = [] if args.report_only else run_all(runs, args.jobs, args.most)
    keep(args.out, archive_of(stem))
    data = report(jobs, args)
    write_json(stem.with_name(stem.name + ".json"), data)
    write_text(stem.with_name(stem.name + ".csv"), pd.DataFrame(data["runs"]).to_csv(index=False))
    write_text(stem.with_name(stem.name + ".md"), to_markdown(data))
    print(to_markdown(data))
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
