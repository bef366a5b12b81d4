"""From photos to a table of methods, in Python.

    python examples/01_photos_to_table.py                        a small simulated capture, made on the spot
    python examples/01_photos_to_table.py --raw my_photos -o my_results --iterations 30000

The same four steps on the command line: aw simulate, aw build-scene, aw bench, aw table.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ambiguous_wild import bench, build_scene, table
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.harness.benchmark import Lines
from ambiguous_wild.report.plain_formats import to_markdown
from ambiguous_wild.simulate.capture_writer import simulate
from ambiguous_wild.simulate.presets import preset


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--raw", type=Path, help="folder of photos; without it a capture is simulated")
    parser.add_argument("-o", "--output", type=Path, default=Path("example_photos_to_table"))
    parser.add_argument("--method", action="append", help="repeatable; default: 3dgs and refinesplat")
    parser.add_argument("--iterations", type=int, default=150)
    parser.add_argument("--factor", type=int, help="train on photos so many times smaller")
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    wanted = parser.parse_args()
    methods = wanted.method or ["3dgs", "refinesplat"]

    # 1. Photos. A simulated capture has train photos with distractors, clean test photos and exact masks.
    raw = wanted.raw
    if raw is None:
        raw = wanted.output / "raw"
        simulate(preset("tiny"), raw)

    # 2. A scene: photos are checked, COLMAP finds the cameras, photos are undistorted and split.
    #    Finished stages are kept: a second call of the script goes on where the first one stopped.
    built = build_scene(raw, wanted.output / "scene", BuildSettings(factor=wanted.factor))
    print(f"scene: {built.scene}")

    # 3. Train every method on the scene, render the test views, measure them. Finished runs are kept.
    report = bench(
        methods,
        built.scene,
        output=wanted.output / "runs",
        iterations=wanted.iterations,
        device=wanted.device,
        callbacks=Lines(),  # prints a line when a run begins and one when it ends
    )
    for run in report.failed:
        print(f"failed: {run.method}: {run.error}")

    # 4. The table: quality, cost and masks, a row for each method.
    tables = table(report.read(), metrics=["psnr", "ssim", "mask_iou", "train_s", "gaussians"])
    print(tables)
    path = wanted.output / "table.md"
    path.write_text(to_markdown(tables), encoding="utf-8")
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
