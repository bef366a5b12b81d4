"""The trait that each method exists for, against 3dgs: a queue of `aw bench` runs that stops and goes on.

    python benchmarks/baselines.py --captures DIR... --out DIR [--sections transient appearance ...]
        [--seeds 0 1 2] [--iterations 1500] [--max-gaussians 12000] [--only METHOD...] [--jobs 2]
        [--results FILE] [--report-only]

A DIR is a scene folder or a folder of them; sections take the scenes whose names hold their words (SECTIONS).
Each run has one thread; --jobs run at the same time. Finished runs are kept, stopped ones resume. Writes
benchmarks/results/baselines.md, which ends with the paper's main table of the runs of section main:

transient    share of the gap between 3dgs and exact masks (3dgs+truth) that a method closes, in dB of PSNR
appearance   dB above 3dgs on the right half of test photos, the left half fitted
main         dB above 3dgs, every method of the paper's main table; nothing is fitted to test photos
density      dB above 3dgs at an equal number of Gaussians; pup-3dgs at a fifth of them
resolution   dB above 3dgs at a quarter, half, once and twice the size that was trained at
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import cv2
import numpy as np
import torch
from job_queue import Run, exit_code, find_scenes, parser_of, run_all

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.harness.result_file import RESULT, read_result
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.io.files import write_text
from ambiguous_wild.io.images import read_png_rgb, to_uint8
from ambiguous_wild.io.ply import read_splat_ply
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.metrics.image import psnr
from ambiguous_wild.report.papers import paper
from ambiguous_wild.report.plain_formats import to_markdown as to_layout
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.render import render

RESULTS = Path(__file__).parent / "results" / "baselines.md"
ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Section:
    """Methods that are compared on the same scenes."""

    scenes: tuple[str, ...]  # words that a scene's name holds
    references: tuple[str, ...]
    methods: tuple[str, ...]
    half: bool = False  # the left half of test photos is fitted


SECTIONS = {
    "transient": Section(
        ("plain", "colour", "twin", "seneca", "monstree"),
        ("3dgs", "3dgs+truth"),
        ("spotlesssplats", "spotlesssplats-cluster", "nexussplats", "hybridgs", "t-3dgs", "forestsplats",
         "desplat", "asymgs", "robustsplat", "dronesplat"),
    ),
    "appearance": Section(
        ("time-of-day", "exposure", "reichstag"),
        ("3dgs",),
        ("wildgaussians", "gs-w", "splatfacto-w", "swag", "nexussplats"),
        half=True,
    ),
    "main": Section(
        ("courtyard", "seneca", "monstree"),
        ("3dgs",),
        ("mip-splatting", "gs-w", "wildgaussians", "splatfacto-w", "swag", "nexussplats", "spotlesssplats",
         "spotlesssplats-cluster", "desplat", "hybridgs", "t-3dgs", "forestsplats", "asymgs", "asymgs-twin",
         "absgs", "mcmc", "pup-3dgs", "uad", "robustsplat", "dronesplat", "refinesplat-paper",
         "refinesplat"),
    ),
    "density": Section(("clean",), ("3dgs",), ("absgs", "mcmc", "uad", "pup-3dgs")),
    "resolution": Section(("clean",), ("3dgs",), ("mip-splatting",)),
}  # fmt: skip
# defaults that depend on what weights are on the machine; they need `aw weights get efficientnet-lite0`
OPTIONS = {
    "robustsplat": ("features=efficientnet-lite0",),
    "refinesplat-paper": ("features=efficientnet-lite0", "instances=efficientnet-lite0"),
}
# as published for captures, in which the light does not change
CAPTURES = dict.fromkeys(("wildgaussians", "nexussplats"), ("appearance=false",))
SIZES = (0.25, 0.5, 1.0, 2.0)  # of the photos trained on


@dataclass(frozen=True)
class Job:
    """One run."""

    method: str
    scene: Path
    seed: int
    half: bool
    most: int  # Gaussians

    def folder(self, out: Path) -> Path:
        group = f"{'half' if self.half else 'full'}-{self.most}"
        return out / group / load_name(self.scene) / self.method / f"seed{self.seed}"

    def run(self, out: Path, iterations: int) -> Run:
        words = ["--scene", str(self.scene), "--seed", str(self.seed)]
        words += ["--iterations", str(iterations), "--max-gaussians", str(self.most), "--device", "cpu"]
        words += ["--threads", "1", "--no-pictures", "--effects", "none", "--probes", "0"]
        words += ["--protocol", "half" if self.half else "full"]
        words += ["-o", str(out / f"{'half' if self.half else 'full'}-{self.most}")]
        name = f"{self.method} on {load_name(self.scene)}, seed {self.seed}"
        options = OPTIONS.get(self.method, ()) + (() if self.half else CAPTURES.get(self.method, ()))
        return Run(name, self.folder(out), self.method, tuple(words), options)


_names: dict[Path, str] = {}


def load_name(scene: Path) -> str:
    """The name under which its runs lie."""
    if scene not in _names:
        _names[scene] = load_scene(scene).name
    return _names[scene]


def scenes_of(section: Section, scenes: Iterable[Path]) -> list[Path]:
    return [scene for scene in scenes if any(word in load_name(scene) for word in section.scenes)]


def plan(args: argparse.Namespace, scenes: Sequence[Path]) -> dict[str, list[Job]]:
    """The runs of each section; a run that two sections need is in both, and trained once."""
    planned: dict[str, list[Job]] = {}
    for name in args.sections:
        section, jobs = SECTIONS[name], []
        wanted = [m for m in section.methods if not args.only or m in args.only]
        for scene in scenes_of(section, scenes) if wanted else []:
            jobs += [
                Job(method, scene, seed, section.half, args.max_gaussians)
                for method in (*section.references, *wanted)
                for seed in args.seeds
            ]
        planned[name] = jobs
    return planned


# -- what came out ----------------------------------------------------------------------------------


def result_of(job: Job, out: Path) -> dict[str, Any] | None:
    path = job.folder(out) / RESULT
    return dict(read_result(path)) if path.is_file() else None


def mean_psnr(result: dict[str, Any]) -> float:
    return fmean(float(row["psnr"]) for row in result["per_image"])


def pace(result: dict[str, Any]) -> float:
    return float(result["cost"]["ms_per_iteration"])


def row_of(
    section: str, method: str, scene: Path, jobs: Sequence[Job], args: argparse.Namespace
) -> dict[str, Any] | None:
    """A method on a scene against the section's references, seed by seed as far as all are finished."""
    found: dict[tuple[str, int], dict[str, Any]] = {}
    needed = {method, *SECTIONS[section].references}
    for job in jobs:
        if job.scene == scene and job.method in needed:
            result = result_of(job, args.out)
            if result is not None and result["status"] == "ok":
                found[job.method, job.seed] = result
    seeds = [seed for seed in args.seeds if all((name, seed) in found for name in needed)]
    if not seeds:
        return None
    mine, plain = ([found[name, seed] for seed in seeds] for name in (method, "3dgs"))
    gains = [mean_psnr(a) - mean_psnr(b) for a, b in zip(mine, plain)]
    row: dict[str, Any] = {
        "section": section,
        "method": method,
        "scene": load_name(scene),
        "seeds": len(seeds),
        "psnr": fmean(map(mean_psnr, mine)),
        "gain_db": fmean(gains),
        "gain_sd": stdev(gains) if len(gains) > 1 else None,
        "gaussians": fmean(float(r["cost"]["gaussians"]) for r in mine),
        "ms_ratio": fmean(pace(a) / pace(b) for a, b in zip(mine, plain)),
        "iou": (mine[0]["masks"] or {}).get("iou"),
    }  # fmt: skip
    if section == "transient":
        exact = [found["3dgs+truth", seed] for seed in seeds]
        gap = fmean(mean_psnr(a) - mean_psnr(b) for a, b in zip(exact, plain))
        row |= {"gap_db": gap, "share": row["gain_db"] / gap if gap > 0 else None}
    return row


def resolution_rows(jobs: Sequence[Job], args: argparse.Namespace) -> list[dict[str, Any]]:
    """PSNR of every run at other sizes than it was trained at, from its splats."""
    rows: list[dict[str, Any]] = []
    for job in jobs:
        if result_of(job, args.out) is None:
            continue
        scene = load_scene(job.scene)
        known = read_splat_ply(job.folder(args.out) / "point_cloud.ply")
        model = Gaussians(**{name: torch.from_numpy(values) for name, values in known.items()})  # type: ignore[arg-type]
        parts = get_method(job.method).build(get_method(job.method).options())
        row: dict[str, Any] = {"method": job.method, "scene": scene.name, "seed": job.seed}
        for size in SIZES:
            values = []
            for view, photo in truth_at(scene, size):
                camera = view.camera.resized(photo.shape[1], photo.shape[0])
                drawn = render(
                    model, camera, sh_degree=model.sh_degree, antialias=parts.antialias, blur=parts.blur
                )
                values.append(psnr(to_uint8(drawn.image.numpy()), photo))
            row[f"psnr_{size:g}"] = fmean(values) if values else None
        rows.append(row)
    return rows


def main_table(planned: dict[str, list[Job]], args: argparse.Namespace) -> str:
    """The paper's table of the finished runs of section main; empty without one."""
    jobs = [job for job in planned.get("main", []) if result_of(job, args.out) is not None]
    if not jobs:
        return ""
    runs = read_runs(args.out / f"full-{args.max_gaussians}")
    scenes = list(dict.fromkeys(load_name(job.scene) for job in jobs))
    table = to_layout(paper(runs, metrics=("psnr", "ssim", "lpips_alex"), scenes=scenes, per_table=5))
    return table.replace(f"{args.out}/", "")  # stopped runs are named: below --out, wherever that is


def truth_at(scene: Scene, size: float) -> list[tuple[Any, np.ndarray]]:
    """Test views and their photos at a share of the loaded size; none where no larger photos exist."""
    factor = int(scene.info.get("loaded_factor") or 1)
    if size > 1:
        if factor % round(size):
            return []
        larger = {v.name: v for v in load_scene(scene.root, factor=factor // round(size)).test}
        return [(view, read_png_rgb(larger[view.name].image_path)) for view in scene.test]
    found = []
    for view in scene.test:
        photo = read_png_rgb(view.image_path)
        if size < 1:
            shape = (round(photo.shape[1] * size), round(photo.shape[0] * size))
            photo = cv2.resize(photo, shape, interpolation=cv2.INTER_AREA)
        found.append((view, photo))
    return found


def recipe_lines(method: str) -> int:
    """Lines of the recipe's files: those of its folder, or its one file."""
    module = str(get_method(method).recipe).partition(":")[0].split(".")
    path = ROOT.joinpath(*module)
    files = sorted(path.parent.glob("*.py")) if module[-1] == "recipe" else [path.with_suffix(".py")]
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def to_markdown(data: dict[str, Any]) -> str:
    def number(value: float | None, digits: int = 2, sign: bool = False) -> str:
        return "-" if value is None else f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}"

    lines = [
        "# Baselines against 3dgs",
        "",
        f"{data['iterations']} iterations, at most {data['max_gaussians']} Gaussians, seeds "
        f"{', '.join(map(str, data['seeds']))} as far as run, one thread. Made by `benchmarks/baselines.py`.",
        "",
        "| section | method | lines | scene | seeds | PSNR | gain dB | sd | gap closed | IoU | Gaussians "
        "| x ms/it |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in data["rows"]:
        cells = [row["section"], row["method"], str(data["lines"][row["method"]]), row["scene"],
                 str(row["seeds"]), number(row["psnr"]), number(row["gain_db"], sign=True),
                 number(row["gain_sd"]), number(row.get("share")), number(row["iou"]),
                 f"{row['gaussians']:.0f}", number(row["ms_ratio"])]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    if data["resolutions"]:
        lines += ["", "| method | scene | seed | " + " | ".join(f"PSNR at {s:g}x" for s in SIZES) + " |",
                  "|---" * (3 + len(SIZES)) + "|"]  # fmt: skip
        for row in data["resolutions"]:
            values = [number(row[f"psnr_{size:g}"]) for size in SIZES]
            lines.append("| " + " | ".join([row["method"], row["scene"], str(row["seed"]), *values]) + " |")
    if data["missing"]:
        lines += ["", "No result yet: " + "; ".join(data["missing"]) + "."]
    return "\n".join(lines) + "\n"


def report(planned: dict[str, list[Job]], args: argparse.Namespace) -> dict[str, Any]:
    rows, missing = [], []
    for section, jobs in planned.items():
        for scene in dict.fromkeys(job.scene for job in jobs):
            methods = dict.fromkeys(j.method for j in jobs if j.method not in SECTIONS[section].references)
            for method in methods:
                row = row_of(section, method, scene, jobs, args)
                if row is None:
                    missing.append(f"{method} on {load_name(scene)} ({section})")
                else:
                    rows.append(row)
    return {
        "iterations": args.iterations,
        "max_gaussians": args.max_gaussians,
        "seeds": args.seeds,
        "lines": {name: recipe_lines(name) for name in dict.fromkeys(row["method"] for row in rows)},
        "rows": rows,
        "resolutions": resolution_rows(planned.get("resolution", []), args),
        "missing": missing,
    }


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = parser_of(__doc__, RESULTS, iterations=1500)
    parser.add_argument("--max-gaussians", type=int, default=12_000)
    parser.add_argument("--sections", nargs="+", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--only", nargs="+", default=[], metavar="METHOD", help="and the references")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    args = arguments(words)
    planned = plan(args, find_scenes(args.captures))
    jobs = list(dict.fromkeys(job for section in planned.values() for job in section))
    jobs.sort(key=lambda job: args.seeds.index(job.seed))  # a table of one seed comes first
    if not jobs:
        raise AwError(
            f"no scene for {', '.join(args.sections)}: their names hold none of the sections' words"
        )
    runs = [job.run(args.out, args.iterations) for job in jobs]
    failed = [] if args.report_only else run_all(runs, args.jobs)
    text = to_markdown(report(planned, args))
    if table := main_table(planned, args):
        text += f"\n## In the paper's layout\n\n{table}"
    write_text(args.results, text)
    print(text)
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
