"""Composites on real photos as a benchmark: distractors pasted at several placements, well-seen test photos.

    python benchmarks/composites.py --data DIR --out DIR [--bases NAME=FACTOR ...] [--placements 5]
        [--prepare-only] [options of captures.py: --methods, --seeds, --iterations, --jobs, --report-only]

--data holds a folder a base: its photos, or images/ with them; cut-outs lie in --data/cutouts. Each base is
built once (`aw build-scene`). Its test photos are those that the others support best: a surface counts as
supported where three of them see it. Odd placements paste cut-outs, even ones the scene's own texture.
Training and tables are those of captures.py, in benchmarks/results/composites.md. Everything resumes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import captures
import numpy as np
from job_queue import aw, exit_code

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.harness.regions import train_visibility
from ambiguous_wild.io.files import write_text
from ambiguous_wild.io.scene_folder import load_scene

RESULTS = Path(__file__).parent / "results" / "composites.md"
BASES = ("seneca=5", "monstree=4", "sceaux=4", "skull=5")
LYING = ("seneca",)  # photographed from above: distractors lie at any angle
TEST_SHARE = 8  # every so many-th photo tests, at least three


def support(scene: Scene) -> dict[str, float]:
    """Of every view the share of its pixels that at least three other views see."""
    shares = {}
    for view in scene.views:
        alone = replace(
            scene,
            views=tuple(replace(v, split="test" if v.name == view.name else "train") for v in scene.views),
        )
        looks = train_visibility(alone, lambda _: None)
        shares[view.name] = 0.0 if isinstance(looks, str) else float(looks[view.name].supported.mean())
    return shares


def best_supported(shares: dict[str, float], count: int) -> list[str]:
    """The best views, `count` at most, none beside another in the order of names."""
    order = sorted(shares)
    taken: set[int] = set()
    for k in sorted(range(len(order)), key=lambda k: (-shares[order[k]], k)):
        if len(taken) < count and not {k - 1, k + 1} & taken:
            taken.add(k)
    return [order[k] for k in sorted(taken)]


def build_base(data: Path, name: str, factor: int, out: Path) -> Path:
    """The base scene with its test list."""
    root = out / "bases" / name
    chosen, listed = root.with_name(f"{name}.csv"), root.with_name(f"{name}.txt")
    if chosen.is_file() and (root / "sparse").is_dir():
        built = load_scene(root).info["loaded_factor"]
        if built != factor:
            raise AwError(
                f"{root} was built at factor {built}, not {factor}; choose another --out or delete it"
            )
        return root
    photos = data / name / "images"
    source = photos if photos.is_dir() else data / name
    build = ("build-scene", str(source), "-o", str(root), "--factor", str(factor), "--overwrite")
    aw(*build, "--keep-work")  # a scene has its test photos from its build; the next one continues from here
    scene = load_scene(root)
    shares = support(scene)
    tests = best_supported(shares, max(len(scene.views) // TEST_SHARE, 3))
    write_text(listed, "".join(f"{name}\n" for name in tests))
    aw(*build, "--test-list", str(listed))
    rows = [f"{name},{shares[name]:.4f},{'test' if name in tests else 'train'}" for name in sorted(shares)]
    write_text(chosen, "photo,supported,split\n" + "\n".join(rows) + "\n")
    print(
        f"{name}: {len(tests)} test photos, {np.mean([shares[t] for t in tests]):.1%} supported", flush=True
    )
    return root


def paste(base: Path, placement: int, cutouts: Path, out: Path) -> Path:
    """One placement of distractors: cut-outs where its number is odd, the scene's texture where even."""
    kind = "cutouts" if placement % 2 else "patches"
    root = out / "scenes" / f"{base.name}-{kind}-{placement}"
    if not (root / "sparse").is_dir():
        pose = "lying" if base.name in LYING else "standing"
        words = ["--cutouts", str(cutouts)] if kind == "cutouts" else ["--patches"]
        aw("composite", str(base), "-o", str(root), "--seed", str(placement), "--pose", pose, *words)
    return root


def arguments(words: Sequence[str] | None = None) -> tuple[argparse.Namespace, list[str]]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--bases", nargs="+", default=list(BASES), metavar="NAME=FACTOR")
    parser.add_argument("--placements", type=int, default=5)
    parser.add_argument("--prepare-only", action="store_true")
    args, rest = parser.parse_known_args(words)
    for base in args.bases:
        name, _, factor = base.partition("=")
        if not factor.isdigit() or int(factor) < 1 or name != Path(name).name:
            parser.error(f"--bases takes NAME=FACTOR, e.g. seneca=5; got {base}")
    if args.placements < 1:
        parser.error("--placements counts from 1")
    captures.arguments(["--captures", ".", "--out", ".", *rest])  # refused now, not after the bases are built
    return args, rest


def main(words: Sequence[str] | None = None) -> int:
    args, rest = arguments(words)
    scenes = []
    for base in args.bases:
        name, _, factor = base.partition("=")
        root = build_base(args.data, name, int(factor), args.out)
        scenes += [paste(root, k, args.data / "cutouts", args.out) for k in range(1, args.placements + 1)]
    if args.prepare_only:
        return 0
    results = [] if "--results" in rest else ["--results", str(RESULTS)]
    return captures.main(["--captures", *map(str, scenes), "--out", str(args.out / "runs"), *results, *rest])


if __name__ == "__main__":
    sys.exit(exit_code(main))
