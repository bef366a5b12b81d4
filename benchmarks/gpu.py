"""GPU benchmarks: parity with float64, iteration time against plain gsplat, trainings, frames per second.

    bash benchmarks/gpu.sh                                  everything but `same`
    bash benchmarks/gpu.sh --call 1                         what fits ten minutes; then 2, 3 and 4
    python benchmarks/gpu.py --stages parity cost           only some stages
    python benchmarks/gpu.py --stages same --captures A B   CPU and GPU on the same captures, three seeds
    bash benchmarks/gpu.sh --pack DIR                       a kit for a machine without network

Each stage prints its results and writes benchmarks/results/gpu-STAGE.json; gpu.md is made from these files.
A stage that was stopped goes on where it was if --work is the same. `cost` and `profile` begin with the final
Gaussians of `3dgs`; a line says whether --work has that training, which is made first where it is absent.
`cost` compares at equal counts, without density control, alternating in blocks, so that machine load affects
all loops alike. Exits with 1 if parity or a training fails.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

from gpu_measure import DINO, random_dino, write
from gpu_report import to_markdown
from gpu_stages import STAGES, lacking, needs

from ambiguous_wild.core import AwError
from ambiguous_wild.io.atomic import write_text
from ambiguous_wild.splat.gpu.readiness import look, why_not

RESULTS = Path(__file__).parent / "results"
METHODS = ("3dgs", "robustsplat", "refinesplat")
USUAL = ("build", "parity", "train", "budget", "cost", "profile")
TURNS = 12
CALLS: dict[int, tuple[tuple[str, ...], tuple[str, ...]]] = {  # stages and methods of ten minutes each
    1: (("build", "parity", "train", "budget", "cost"), ("3dgs",)),
    2: (("build", "train", "budget", "cost"), ("refinesplat", "robustsplat")),
    3: (("build", "train", "budget", "cost", "profile"), (DINO,)),
    4: (("build", "same"), ("3dgs",)),
}
SAME_ITERATIONS = 3000  # of call 4: three seeds on the CPU fit into ten minutes


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--scene", type=Path, help="a scene folder; simulated without")
    p.add_argument("--work", type=Path, default=Path("gpu-benchmark"), help="scene, runs and caches")
    p.add_argument("--results", type=Path, default=RESULTS)
    p.add_argument("--call", type=int, choices=CALLS, help="the stages and methods of one call")
    p.add_argument("--stages", nargs="+", choices=list(STAGES))
    p.add_argument("--methods", nargs="+", help=f"also {DINO}: with DINOv2, random weights unless AW_WEIGHTS")
    p.add_argument(
        "--captures", nargs="+", type=Path, default=[], help="of the stage 'same'; default: --scene"
    )
    p.add_argument("--iterations", type=int)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--set", dest="settings", action="append", default=[], metavar="METHOD.KEY=VALUE")
    p.add_argument("--device", default="cuda")
    p.add_argument("--warm-up", type=int, default=300, help="iterations before a loop is timed")
    p.add_argument("--budget", type=float, default=60.0, help="seconds of the stage 'budget'")
    p.add_argument("--turns", type=int, default=TURNS)
    return p


def main(words: list[str] | None = None) -> int:
    p = parser()
    args = p.parse_args(words)
    stages, methods = CALLS[args.call] if args.call else (USUAL, METHODS)
    args.stages, args.methods = args.stages or list(stages), args.methods or list(methods)
    if args.iterations is None:
        args.iterations = SAME_ITERATIONS if args.call == 4 else 30_000
    lack = why_not(look()) if args.device == "cuda" else None
    if lack is not None:
        p.error(f"no GPU to measure: {lack}")
    if lacks := lacking(args.stages, args.methods):
        able = [method for method in args.methods if not lacking([], [method])]
        rest = f"; the others: --methods {' '.join(able)}" if 0 < len(able) < len(args.methods) else ""
        p.error("; ".join(lacks) + rest)
    if args.device == "cuda" and "build" not in args.stages:
        args.stages.insert(0, "build")  # loads the kernels; without them gsplat would compile all of its own
    args.work.mkdir(parents=True, exist_ok=True)
    try:
        if DINO in args.methods and not os.environ.get("AW_WEIGHTS"):
            os.environ["AW_WEIGHTS"] = str(random_dino(args.work / "random-weights").resolve())
        if args.scene is None and set(args.stages) & {"train", "budget", "cost", "profile", "same"}:
            from gpu_scene import make_scene  # needs OpenCV and the simulator

            args.scene = make_scene(
                args.work / "scene", name="courtyard-colour", train=150, test=20, width=582
            )
        return _run(args)
    except AwError as error:
        p.error(str(error))


def _run(args: argparse.Namespace) -> int:
    failed = False
    for name in args.stages:
        print(f"stage {name}", flush=True)
        if line := needs(args, name):
            print(line, flush=True)
        begin = time.perf_counter()
        found = STAGES[name](args)
        found["seconds_of_stage"] = time.perf_counter() - begin
        # of a call its own file, so that the next call leaves it
        part = f"{name}-{args.call}" if args.call and name in ("budget", "cost", "profile") else name
        write(args, part, found)
        print(f"{name}: {found['seconds_of_stage']:.0f} s", flush=True)
        failed |= name == "parity" and found["passed"] < found["cases"]
        failed |= bool(found.get("failed"))
    there = {
        path.stem.removeprefix("gpu-"): json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(args.results.glob("gpu-*.json"))
    }
    write_text(args.results / "gpu.md", to_markdown(there))
    print(to_markdown(there))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
