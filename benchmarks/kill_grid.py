"""`aw bench` over methods x scenes x seeds, killed (-9) at random moments, against an uninterrupted run.

    python benchmarks/kill_grid.py [-o DIR] [--methods METHOD...] [--kills 2] [--iterations 60] [--random 0]
        [--engines]

Scenes are tiny simulated captures with true poses. The killed run must end with all cells and the same files
as the uninterrupted one: same names, same bytes, except for times, frames per second and memory. --engines:
the same grid with `--jobs 2`, and on Ray, must give these files too. Exit code 1 otherwise.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ending import exit_code

from ambiguous_wild.io.images import write_png
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.simulate.capture import plan
from ambiguous_wild.simulate.image_effects.photo_random import PhotoRandom as Moment
from ambiguous_wild.simulate.presets import preset, resized
from ambiguous_wild.simulate.render import depth_m
from ambiguous_wild.simulate.render import render_photo as develop
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.cpu.warmup import warm_up
from ambiguous_wild.vision.sparse_surface import world_points

METHODS = ("3dgs", "robustsplat", "refinesplat")
ENGINES = {"jobs": ("--jobs", "2"), "ray": ("--engine", "ray", "--jobs", "2")}
CLOCK = {"train_s", "setup_s", "ms_per_iteration", "ms_parts", "fps", "fps_low", "fps_high", "peak_rss_mb"}
CLOCK |= {"elapsed_s", "parts_s", "wall_s", "cpu_s", "reference_s", "timing", "meter"}
CLOCK |= {"cores"}  # that the process may use: whoever shares the machine may change it between two starts
POINTS_A_VIEW = 60


def write_scene(root: Path, seed: int, *, views: int = 8, width: int = 96) -> Path:
    """A simulated capture as a COLMAP scene with true poses; points lie on its true surfaces."""
    spec = resized(preset("tiny"), views, width)
    world, shots = plan(spec, seed)
    rng = np.random.default_rng(seed)
    for folder in ("images", "sparse/0", "truth/distractor"):
        (root / folder).mkdir(parents=True)
    cameras, images, points = [], [], []
    for number, shot in enumerate(shots, 1):
        name, camera = f"{Path(shot.name).stem}.png", shot.camera
        made = develop(spec, world, shot, Moment(seed, number, 0.5))
        write_png(root / "images" / name, made.photo)
        if shot.split == "train":
            write_png(root / "truth/distractor" / name, (made.owner > 0).astype(np.uint8) * 255)
            xyz = world_points(camera, 1.0 / depth_m(world, camera)).reshape(-1, 3)
            chosen = rng.choice(len(xyz), POINTS_A_VIEW, replace=False)
            points += [(*xyz[i], *made.photo.reshape(-1, 3)[i]) for i in chosen]
        pose = camera.cam_from_world
        w, x, y, z = quaternion(pose[:3, :3])
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        cameras.append(f"{number} PINHOLE {' '.join(map(str, numbers))}\n")
        images.append(f"{number} {w} {x} {y} {z} {pose[0, 3]} {pose[1, 3]} {pose[2, 3]} {number} {name}\n\n")
    for side in ("train", "test"):
        names = [f"{Path(s.name).stem}.png\n" for s in shots if s.split == side]
        (root / f"{side}_list.txt").write_text("".join(names))
    (root / "sparse/0/cameras.txt").write_text("".join(cameras))
    (root / "sparse/0/images.txt").write_text("".join(images))
    lines = [f"{i} {' '.join(map(str, point))} 0.5\n" for i, point in enumerate(points, 1)]
    (root / "sparse/0/points3D.txt").write_text("".join(lines))
    return root


def quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a rotation [3, 3]."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return float(w), float(x), float(y), float(z)


def bench_command(
    methods: Sequence[str], scenes: Sequence[Path], seeds: Sequence[int], iterations: int, output: Path
) -> list[str]:
    """The `aw bench` command of the whole grid."""
    words = [sys.executable, "-m", "ambiguous_wild.cli.main", "bench", "--iterations", str(iterations)]
    words += ["--device", "cpu", "--threads", "1", "--checkpoint-every", "0.5", "-o", str(output)]
    for flag, values in (("--method", methods), ("--scene", scenes), ("--seed", seeds)):
        words += [w for value in values for w in (flag, str(value))]
    return words


def killed_run(
    command: Sequence[str], kills: Sequence[tuple[int, float]], results: Path
) -> list[dict[str, Any]]:
    """Start the command, kill it at each moment, then let it end; returns what happened.

    Args:
        command: a grid.
        kills: in order: cells that are finished, and seconds to wait then. Time alone would depend on load.
        results: folder of the runs.
    """
    story = []
    for moment in (*kills, None):
        begin = time.monotonic()
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        if moment is not None:
            watched = threading.Thread(target=_kill_at, args=(process, *moment, results), daemon=True)
            watched.start()
        said = process.communicate()[1]
        last = said.strip().splitlines()[-1] if said.strip() else ""
        story.append(
            {
                "after_s": round(time.monotonic() - begin, 1),
                "code": process.returncode,
                "cells": len(list(results.rglob("metrics.json"))),
                "said": last,
            }
        )
    return story


def _kill_at(process: subprocess.Popen[str], cells: int, wait_s: float, results: Path) -> None:
    """Kill it `wait_s` after `cells` cells are finished."""
    while process.poll() is None and len(list(results.rglob("metrics.json"))) < cells:
        time.sleep(0.05)
    time.sleep(wait_s)
    if process.poll() is None:
        os.kill(process.pid, signal.SIGKILL)


def content(path: Path) -> Any:
    """What must be the same in both runs."""
    if path.suffix == ".json":
        return untimed(json.loads(path.read_text(encoding="utf-8")))
    if path.name == "timeline.csv":
        with open(path, encoding="utf-8", newline="") as file:
            return untimed(list(csv.DictReader(file)))
    if path.suffix == ".safetensors":
        return plain(untimed(checkpoint.load(path)))
    return path.read_bytes()


def untimed(value: Any) -> Any:
    """Plain data without values that depend on time or load."""
    if isinstance(value, dict):
        kept = {k: v for k, v in value.items() if k not in CLOCK and not k.startswith("ms_")}
        return {k: untimed(v) for k, v in kept.items()}
    return [untimed(v) for v in value] if isinstance(value, list) else value


def plain(value: Any) -> Any:
    """Tensors as bytes, so that == compares them."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list):
        return [plain(v) for v in value]
    return (str(value.dtype), value.shape, value.numpy().tobytes()) if hasattr(value, "numpy") else value


def files_of(root: Path) -> dict[str, Path]:
    """Every file of the runs by path, without caches."""
    found = (p for p in sorted(root.rglob("*")) if p.is_file())
    return {n: p for p in found if not (n := p.relative_to(root).as_posix()).startswith(".cache")}


def differences(one: Path, other: Path) -> list[str]:
    """What differs between two folders of runs."""
    left, right = files_of(one), files_of(other)
    alone = [f"only in one run: {name}" for name in sorted(left.keys() ^ right.keys())]
    shared = sorted(left.keys() & right.keys())
    return alone + [f"differs: {name}" for name in shared if content(left[name]) != content(right[name])]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, help="folder to keep; default: a temporary one")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), metavar="METHOD")
    parser.add_argument("--kills", type=int, default=2)
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--random", type=int, default=0, help="seed of the moments of the kills")
    parser.add_argument("--engines", action="store_true", help="also two processes, and Ray")
    args = parser.parse_args()
    for name in args.methods:
        get_method(name)  # an unknown one is named before anything runs
    with tempfile.TemporaryDirectory() as temporary:
        root = args.output or Path(temporary)
        scenes = [write_scene(root / "scenes" / f"tiny{k}", k) for k in range(args.scenes)]
        seeds = range(args.seeds)
        quiet, disturbed = root / "quiet", root / "killed"
        warm_up(print)  # compiling is no part of the time in which the kills fall
        begin = time.monotonic()

        def command(output: Path) -> list[str]:
            return bench_command(args.methods, scenes, seeds, args.iterations, output)

        subprocess.run(command(quiet), check=True)
        whole_s = time.monotonic() - begin
        rng = random.Random(args.random)
        cells = len(args.methods) * args.scenes * args.seeds
        moments = sorted(rng.randrange(cells) for _ in range(args.kills))
        kills = [(done, 6.0 * (done == 0) + rng.uniform(0.0, 2.0)) for done in moments]
        story = killed_run(command(disturbed), kills, disturbed)
        wrong = differences(quiet, disturbed)
        for name, words in ENGINES.items() if args.engines else ():
            subprocess.run([*command(root / name), *words], check=True)
            wrong += [f"{name}: {line}" for line in differences(quiet, root / name)]
        compared = len(files_of(quiet))
    print(f"\n| start | ended after s | exit code | cells finished of {cells} | last line |")
    print("|---|---:|---:|---:|---|")
    for number, step in enumerate(story, 1):
        print(f"| {number} | {step['after_s']} | {step['code']} | {step['cells']} | {step['said']} |")
    print(f"\nundisturbed: {whole_s:.0f} s; files compared: {compared}; different: {len(wrong)}")
    print("\n".join(wrong))
    killed = sum(step["code"] == -signal.SIGKILL for step in story)
    if killed < args.kills:
        print(f"only {killed} of {args.kills} kills met a running command: try another --random")
    return int(bool(wrong) or story[-1]["cells"] != cells or killed < args.kills)


if __name__ == "__main__":
    sys.exit(exit_code(main))
