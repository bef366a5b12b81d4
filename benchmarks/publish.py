"""The published figures of quality, made anew: captures, scenes, runs, board. Stops and goes on.

    python benchmarks/publish.py --work DIR [--data DIR] [--seeds 0 1 2] [--methods ...] [--iterations 1000]
        [--jobs 2] [--only NAME...] [--set METHOD.OPTION=VALUE...] [--large]

Captures: the suite aw-sim; distractors pasted on the photos of --data before structure from motion (`aw
composite`); and, if --only names them, photos of --data in which something moves, with polygons that a person
drew around it (movers.json, px of the file): in train photos for the scores of masks, in test photos so that
PSNR leaves it out (`psnr_valid`). --data holds a folder of photos for each, and cutouts/; without it only the
suite is made. --large: photos of twice the side, about 480 px, from aw-sim-large and the same composites.
--methods all: every method of `aw methods`. All methods of a scene train with the effects of its plan.
Checked runs go to the board, leaderboard/measured, then `python benchmarks/figures.py` writes the tables; the
table of photos with polygons goes to results/movers.md.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from job_queue import Run, aw, count, exit_code, run_all, seed, write_section

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.suites import MEASURED as FACTS
from ambiguous_wild.datasets.suites import Suite, get_suite
from ambiguous_wild.io.files import atomic_dir, write_text
from ambiguous_wild.io.images import read_gray, write_png
from ambiguous_wild.io.photos import read_photo
from ambiguous_wild.io.plain_yaml import read_mapping
from ambiguous_wild.io.scene_folder import read_list
from ambiguous_wild.methods.registry import all_methods
from ambiguous_wild.metrics.ambiguity import COLOUR_METRIC
from ambiguous_wild.report.ambiguity_summary import semantic_metric
from ambiguous_wild.report.simulated_suite import prepare_simulated

ROOT = Path(__file__).parents[1]
SUITE, LARGE = get_suite("aw-sim"), get_suite("aw-sim-large")
BASES = {"seneca": 4, "monstree": 4, "sceaux": 4, "tiny_aerial": 2}  # downsampling to 240 px and more
KINDS = ("cutouts", "patches")
MOVERS = ROOT / "benchmarks" / "movers.json"  # capture: photo: polygons [[x, y], ...]
DRAWN_RESULTS = ROOT / "benchmarks" / "results" / "movers.md"
DRAWN_METRICS = ("psnr_valid", "mask_iou", "mask_precision", "mask_recall")
DRAWN = {"train": 2, "statue": 2, "reichstag": 4}  # captures of MOVERS: downsampling
METHODS = ("3dgs", "dronesplat", "robustsplat", "refinesplat", "3dgs+truth")
LENGTH = 1000  # iterations
WORLD = 5  # seed of pasted distractors; nothing was tuned on it
# Options of methods that would take whatever pretrained networks lie on this machine; --set replaces them.
HAND_MADE = {"robustsplat": ("features=labhog",), "refinesplat-paper": ("features=labhog", "instances=graph")}


@dataclass(frozen=True)
class Capture:
    """How the photos of a capture are made, and built into a scene."""

    name: str
    factor: int
    dataset: str  # on the board
    make: Callable[[Path], None]  # writes the raw folder

    def build(self, work: Path) -> Path:
        """The scene folder; it is built if it is not there."""
        raw, scene = work / "raw" / self.name, work / "scenes" / self.name
        if not (scene / "scene.json").is_file():
            print(f"making {self.name}", flush=True)
            if not raw.is_dir():
                self.make(raw)
            aw("build-scene", str(raw), "-o", str(scene), "--factor", str(self.factor))
        if self.name in DRAWN:
            leave_out_polygons(scene)
        return scene


def real_captures(data: Path, large: bool) -> Iterator[Capture]:
    """Composites, and captures in which something moves."""
    scale, suffix = (2, "-large") if large else (1, "")
    for base, factor in BASES.items():
        for kind in KINDS:
            words = ("composite", str(data / base), "--seed", str(WORLD))
            words += ("--cutouts", str(data / "cutouts")) if kind == "cutouts" else ("--patches",)
            make = partial(make_composite, words)
            yield Capture(f"{base}-{kind}", factor // scale, f"composites{suffix}", make)
    for name, factor in DRAWN.items():
        copy = partial(copy_with_polygons, data / name, name)
        yield Capture(name, factor // scale, f"movers{suffix}", copy)


def make_composite(words: Sequence[str], raw: Path) -> None:
    aw(*words, "-o", str(raw))


def copy_with_polygons(photos: Path, name: str, raw: Path) -> None:
    """Copy photos, with what is inside of polygons as truth."""
    polygons = json.loads(MOVERS.read_text(encoding="utf-8"))[name]
    with atomic_dir(raw) as folder:
        for path in sorted((photos / "images").iterdir()):
            shutil.copy(path, folder)
            if path.stem in polygons:
                drawn = np.zeros(read_photo(path)[1].shape[:2], np.uint8)
                cv2.fillPoly(drawn, [np.array(p, np.int32) for p in polygons[path.stem]], 255)
                write_png(folder / "truth" / "distractor" / f"{path.stem}.png", drawn)


def leave_out_polygons(scene: Path) -> None:
    """Make masks of the truth of test photos: which photos test is known once the scene is built."""
    for name in read_list(scene / "test_list.txt"):
        mask = f"{Path(name).stem}.png"
        drawn = scene / "truth" / "distractor" / mask
        if drawn.is_file():
            write_png(scene / "masks" / "test" / mask, 255 - read_gray(drawn))


def suite_scenes(suite: Suite, names: Sequence[str], work: Path) -> dict[str, Path]:
    """The scene folders of some captures of a suite; they are made if they are not there."""
    some = replace(suite, tables={"chosen": list(names)})
    return prepare_simulated(some, work / suite.dataset, say=print).scenes if names else {}


def record_ambiguity(scenes: Mapping[str, Path], work: Path) -> None:
    """Write what `aw ambiguity-report` measures of the suite's scenes beside the suite."""
    known = read_mapping(FACTS) if FACTS.is_file() else {}
    for name, scene in scenes.items():
        report = work / "ambiguity" / name
        if not (report / "ambiguity.json").is_file():
            aw("ambiguity-report", str(scene), "-o", str(report), "--no-record")
        measured = json.loads((report / "ambiguity.json").read_text(encoding="utf-8"))
        colour, look = (measured[key]["value"] for key in (COLOUR_METRIC, semantic_metric("labhog")))
        known[name] = {
            "occlusion": round(measured["occlusion"]["value"], 3),
            **({} if colour is None else {"colour": round(colour, 3), "lookalike": round(look, 3)}),
            "class": measured["class"],
        }
    head = "# What 'aw ambiguity-report' measures of aw-sim; written by benchmarks/publish.py."
    lines = [f"{name}: {json.dumps(known.get(name, {})).replace(chr(34), '')}" for name in SUITE.scenes]
    write_text(FACTS, "\n".join([head, *lines]) + "\n")


def runs_of(scene: Path, args: argparse.Namespace) -> Iterator[Run]:
    """A run for each method and seed."""
    options = [option.partition(".")[::2] for option in args.set]
    for number in args.seeds:
        words = ("--scene", str(scene), "--seed", str(number), "--iterations", str(args.iterations))
        words += ("--device", "cpu", "--threads", "1", "--no-pictures", "-o", str(args.runs))
        for method in args.methods:
            folder = args.runs / scene.name / method / f"seed{number}"
            own = tuple(option for owner, option in options if owner == method)
            given = {option.partition("=")[0] for option in own}
            own += tuple(o for o in HAND_MADE.get(method, ()) if o.partition("=")[0] not in given)
            yield Run(f"{method} on {scene.name}, seed {number}", folder, method, words, own)


def write_drawn(names: Sequence[str], args: argparse.Namespace) -> None:
    """Write the table of captures with polygons: no board takes test photos with distractors."""
    words = [word for metric in DRAWN_METRICS for word in ("--metric", metric)]
    table = aw("table", *(str(args.runs / name) for name in names), *words, "--format", "markdown")
    lines = [line for line in table.splitlines() if not line.startswith("- command: ")]
    size = ["twice the side"] if args.large else []
    title = " ".join([f"{args.iterations} iterations", *size, *args.set])
    write_section(DRAWN_RESULTS, title, "\n".join(lines))


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--work", type=Path, required=True, help="captures, scenes and runs")
    parser.add_argument("--data", type=Path, help="real photos, a folder for each base, and cutouts/")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="captures to make; all by default")
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--set", nargs="+", default=[], metavar="METHOD.OPTION=VALUE")
    parser.add_argument("--seeds", nargs="+", type=seed, default=[0, 1, 2])
    parser.add_argument("--iterations", type=count, default=LENGTH)
    parser.add_argument("--large", action="store_true", help="photos of twice the side")
    parser.add_argument("--jobs", type=count, default=2, help="runs at a time")
    parser.add_argument("--board", type=Path, default=ROOT / "leaderboard")
    args = parser.parse_args(words)
    if args.methods == ["all"]:
        args.methods = [*all_methods()]
    # runs of another length or with other options have their own folder
    length = [] if args.iterations == LENGTH else [str(args.iterations)]
    suite = SUITE
    if args.large:
        suite, args.work = LARGE, args.work / "large"
    args.runs = args.work / "-".join(["runs", *length, *args.set])
    real = {capture.name: capture for capture in real_captures(args.data, args.large)} if args.data else {}
    known = [*suite.scenes, *real]
    if unknown := set(args.only or ()) - {*known}:
        raise AwError(f"--only {min(unknown)}: no such capture; there are {', '.join(known)}")
    # 3dgs+truth, a default, asks for masks of all train photos
    chosen = args.only or [name for name in known if name not in DRAWN]
    if idle := {option.partition(".")[0] for option in args.set} - {*args.methods}:
        raise AwError(f"--set {min(idle)}: --methods does not have it")
    scenes = suite_scenes(suite, [name for name in chosen if name in suite.scenes], args.work)
    if not args.large:
        record_ambiguity(scenes, args.work)
    scenes |= {name: real[name].build(args.work) for name in chosen if name in real}
    failed = run_all([run for scene in scenes.values() for run in runs_of(scene, args)], args.jobs)
    if drawn := [name for name in scenes if name in DRAWN]:
        write_drawn(drawn, args)
    for name in scenes:
        if name in DRAWN:
            continue
        # photos of --data may not be passed on
        dataset, images = (real[name].dataset, "0") if name in real else (suite.dataset, "1")
        add = ("leaderboard", "add", str(args.runs / name), "--board", str(args.board))
        print(aw(*add, "--dataset", dataset, "--images", images, "--overwrite"), end="", flush=True)
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
