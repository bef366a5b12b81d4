"""Peak memory of building, training and viewing with many large photos, before and now, as a table.

    aw simulate courtyard-colour --views 160 --width 320 -o capture
    aw build-scene capture -o scene --factor 1
    python benchmarks/memory.py scene --work WORK [--before TREE] [--only WORD ...]

The photos of the scene, here 203, are enlarged to 12 megapixels (JPEG files that are built again) and to
1600x1200 px (with the poses of the scene), because memory depends on their size and number, not on what they
show. A third input is a model of a million Gaussians at the scene's points. --before measures an earlier
state of the code too, a worktree. What is measured is kept in WORK, so that a command that was stopped goes
on. Where less memory is to be there than the machine has, run it in a control group.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from job_queue import exit_code, write_section

from ambiguous_wild.core import AwError, View
from ambiguous_wild.core.machine import usable_memory
from ambiguous_wild.io.colmap_model import read_model, write_model
from ambiguous_wild.io.files import atomic_dir, write_json, write_text
from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.io.scene_folder import load_scene

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "memory.md"
PIXELS = 12_000_000  # of a photo that is built
TRAINED = (1600, 1200)  # px, width and height of a photo that is trained on
GAUSSIANS, FEW = 1_000_000, 16  # and number of photos of the runs with them
NOISE = 2.0  # codes, standard deviation: files of the size of a camera's
EVERY_S = 0.2  # between two looks at the processes
MASKS_AT_ONCE = ["--set", "refinesplat.mask_start=0", "--set", "refinesplat.min_mask_start=1"]


@dataclasses.dataclass(frozen=True)
class Row:
    """A command of `aw`, and what it is called in the table."""

    name: str
    words: tuple[str, ...]


def rows(work: Path, out: Path, photos: int) -> list[Row]:
    """What is measured, with the inputs of `prepare` in `work`, and outputs in `out`."""
    few, model = str(work / "few"), str(work / "million.ply")

    def bench(method: str, scene: str, *more: str) -> tuple[str, ...]:
        words = ("bench", "--method", method, "--scene", str(work / scene), "-o", str(out / "runs"), *more)
        return (*words, "--effects", "none", "--no-pictures")

    # every photo is visited once
    once, million = ("--iterations", str(photos)), ("--start", model, "--iterations", str(FEW))
    return [
        Row(f"build-scene, {photos} photos of 12 megapixels", ("build-scene", str(work / "photos"), "-o",
            str(out / "scene"))),
        Row(f"bench 3dgs, {photos} photos at {TRAINED[0]} px", bench("3dgs", "scene", *once)),
        Row(f"bench refinesplat, {photos} photos at {TRAINED[0]} px",
            bench("refinesplat", "scene", *once, *MASKS_AT_ONCE)),
        Row(f"bench 3dgs, a million Gaussians, {FEW} photos", bench("3dgs", "few", *million)),
        Row(f"bench refinesplat, a million Gaussians, {FEW} photos",
            bench("refinesplat", "few", *million, *MASKS_AT_ONCE)),
        Row("view, a million Gaussians", ("view", model, "--scene", few, "-o", str(out / "view"))),
        Row("video, a million Gaussians", ("video", model, "--scene", few, "-o", str(out / "video.mp4"),
            "--seconds", "0.5")),
    ]  # fmt: skip


def prepare(source: Path, work: Path) -> int:
    """Make the inputs of `rows` from a built scene; returns the number of its photos."""
    scene = load_scene(source)
    if not (work / "photos").is_dir():
        with atomic_dir(work / "photos") as folder:
            for view in scene.views:
                width, height = view.camera.width, view.camera.height
                factor = (PIXELS / (width * height)) ** 0.5
                large = enlarged(
                    read_png_rgb(view.image_path), (round(factor * width), round(factor * height))
                )
                name = Path(view.name).with_suffix(".jpg").name
                cv2.imwrite(str(folder / name), large[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
    write_scene(work / "scene", source, scene.views)
    write_scene(work / "few", source, scene.views[:: max(len(scene.views) // FEW, 1)])
    if not (work / "million.ply").is_file():
        rng = np.random.default_rng(0)
        around = scene.points.xyz[rng.integers(len(scene.points), size=GAUSSIANS)]
        size = 0.02 * scene.extent
        arrays = {
            "means": around + rng.normal(scale=size, size=around.shape),
            "quats": rng.normal(size=(GAUSSIANS, 4)),
            "log_scales": np.log(0.03 * size) + rng.normal(scale=0.5, size=around.shape),
            "opacity_logits": rng.normal(size=GAUSSIANS),
            "sh0": rng.normal(size=around.shape),
            "sh_rest": 0.1 * rng.normal(size=(GAUSSIANS, 15, 3)),
        }
        write_splat_ply(
            work / "million.ply", {n: a.astype(np.float32) for n, a in arrays.items()}, scene.transform
        )
    return len(scene.views)


def write_scene(folder: Path, source: Path, views: Sequence[View]) -> None:
    """Write these views of a scene with photos of `TRAINED` px, unless they are there."""
    if folder.is_dir():
        return
    model = read_model(source / "sparse" / "0")
    of_name = {image.name: image for image in model.images.values()}
    cameras, images = {}, {}
    with atomic_dir(folder) as temporary:
        for view in views:
            write_png(temporary / "images" / view.name, enlarged(read_png_rgb(view.image_path), TRAINED))
            image = of_name[view.name]
            k, camera = image.image_id, model.cameras[image.camera_id]
            factor = np.array(TRAINED) / (camera.width, camera.height)
            params = tuple((np.array(camera.pinhole()).reshape(2, 2) * factor).ravel().tolist())
            images[k] = dataclasses.replace(image, camera_id=k, xys=image.xys * factor)
            cameras[k] = dataclasses.replace(
                camera, camera_id=k, width=TRAINED[0], height=TRAINED[1], params=params
            )
        (temporary / "sparse" / "0").mkdir(parents=True)
        write_model(temporary / "sparse" / "0", dataclasses.replace(model, cameras=cameras, images=images))
        tests = [view.name for view in views[:: len(views) // 2 - 1]]
        write_text(temporary / "test.txt", "".join(f"{name}\n" for name in tests))


def enlarged(photo: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The photo [H, W, 3] uint8 at this width and height, with noise."""
    large = cv2.resize(photo, size, interpolation=cv2.INTER_CUBIC)
    noise = np.random.default_rng(0).standard_normal(large.shape, np.float32)
    return np.clip(large + np.rint(NOISE * noise), 0, 255).astype(np.uint8)


def family(process: int) -> Iterator[int]:
    """The process and all that it has started, directly or not."""
    yield process
    with suppress(OSError):
        for task in Path(f"/proc/{process}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from family(int(child))


def resident(process: int) -> tuple[int, int]:
    """Proportional and largest resident memory of a process, kB; 0 where it has ended."""
    sizes = {"Pss": 0, "VmHWM": 0}
    for name in ("smaps_rollup", "status"):
        with suppress(OSError):
            for line in Path(f"/proc/{process}/{name}").read_text().splitlines():
                key, _, value = line.partition(":")
                if key in sizes:
                    sizes[key] = int(value.split()[0])
    return sizes["Pss"], sizes["VmHWM"]


def measure(row: Row, tree: Path, log: Path) -> Iterator[float]:
    """Run the command; yields the peak so far, in GB, of one process or of all together.

    Raises:
        MemoryError: the system killed it.
        AwError: the command failed; the log has what it said.
    """
    environment = os.environ | {"PYTHONPATH": str(tree)}
    command = [sys.executable, "-m", "ambiguous_wild.cli.main", *row.words]
    peak = 0
    with (
        log.open("w") as said,
        subprocess.Popen(command, env=environment, cwd=tree, stdout=said, stderr=said) as running,
    ):
        try:
            while running.poll() is None:
                sizes = [resident(process) for process in family(running.pid)]
                peak = max(peak, sum(pss for pss, _ in sizes), *(largest for _, largest in sizes))
                yield peak * 1024 / 1e9
                time.sleep(EVERY_S)
        finally:
            running.terminate()
    if running.returncode == -signal.SIGKILL:
        raise MemoryError
    if running.returncode:
        raise AwError(f"{row.name} ended with {running.returncode}; see {log}")


def table(peaks: dict[str, dict[str, float]]) -> str:
    """The peaks in gigabytes."""
    lines = [
        "Gigabytes of all processes together (`python benchmarks/memory.py`, proportional set size), with "
        f"{(usable_memory() or 0) / 1e9:.1f} GB usable.",
        "",
        "| command | before | now |",
        "|---|---:|---:|",
    ]
    for name, row in peaks.items():
        cells = (
            f"killed at {row[side]:.2f}" if f"{side} killed" in row else f"{row.get(side, math.nan):.2f}"
            for side in ("before", "now")
        )
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="a scene folder of `aw build-scene`")
    parser.add_argument("--work", type=Path, required=True, help="inputs, outputs and what was measured")
    parser.add_argument("--before", type=Path, metavar="TREE", help="root of an earlier state of the code")
    parser.add_argument("--only", nargs="+", default=[""], metavar="WORD", help="rows whose names have one")
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args()
    work = args.work.resolve()
    photos = prepare(args.scene, work)
    trees = {"now": ROOT} | ({"before": args.before.resolve()} if args.before else {})
    kept = work / "peaks.json"
    peaks = json.loads(kept.read_text()) if kept.is_file() else {}
    for side, tree in trees.items():
        (work / side).mkdir(exist_ok=True)
        for row in rows(work, work / side, photos):
            done = f"{side} done"
            if done in peaks.get(row.name, {}) or not any(word in row.name for word in args.only):
                continue
            of_row = peaks.setdefault(row.name, {})
            log = work / side / f"{row.words[0]}.log"
            try:
                with suppress(MemoryError):
                    of_row[f"{side} killed"] = True
                    for peak in measure(row, tree, log):
                        of_row[side] = max(peak, of_row.get(side, 0.0))
                    del of_row[f"{side} killed"]
                of_row[done] = True
            finally:  # a run that is stopped goes on, and its peak counts
                write_json(kept, peaks)
            print(f"{side}: {row.name}: {of_row[side]:.2f} GB", flush=True)
    write_section(args.results, "Peaks", table(peaks))


if __name__ == "__main__":
    sys.exit(exit_code(main))
