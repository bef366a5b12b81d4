"""Write the tables of README and docs from the board, or check that they agree.

    python benchmarks/figures.py            write them
    python benchmarks/figures.py --check    print which differ; exit code 1 if one does

`publish.py` fills the board. A table follows `<!-- figures: NAME -->` and ends at the next empty line.
"""

from __future__ import annotations

import argparse
import csv
import difflib
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mean

import numpy as np
from scipy.stats import kendalltau

from ambiguous_wild.datasets.suites import get_suite, measured_ambiguity
from ambiguous_wild.simulate.presets import preset

ROOT = Path(__file__).parents[1]
RANKED = ("3dgs", "dronesplat", "robustsplat", "refinesplat")
METHODS = (*RANKED, "3dgs+truth")
CEILING = "refinesplat@mask=truth"  # exact masks in the trainer of refinesplat
REFERENCES = ("3dgs+truth", "3dgs-clean", CEILING)
LENGTH = 1000  # iterations of the tables
LONGER = (1000, 3000, 7000, 30000)  # of the table of lengths
RANKED_ON = ("aw-sim", "composites")
SIZES = {240: ("aw-sim",), 480: ("aw-sim-large",)}  # longer side of the photos, px: datasets
SUITE = get_suite("aw-sim").tables
PASTED = ("cutouts", "patches")
GROUPS = {
    "six simulated captures, ambiguous in colour": SUITE["colour"],
    "six, ambiguous in meaning": SUITE["meaning"],
    "six, ambiguous in both": SUITE["both"],
    "one without distractors": SUITE["control"],
    "composites on 40 drone photos": [f"seneca-{kind}" for kind in PASTED],
    "composites on 23 phone photos of a tree": [f"monstree-{kind}" for kind in PASTED],
    "composites on 11 photos of a facade": [f"sceaux-{kind}" for kind in PASTED],
    "composites on 12 drone photos": [f"tiny_aerial-{kind}" for kind in PASTED],
}
REAL = "monstree-cutouts"  # composite on which every method has run
LIGHT = ("coats", "bonnet", "noon")  # of the suite: exposure, white balance or time of day changes
HAND_MADE = ("features=labhog", "instances=graph")  # without pretrained networks; rows need not name them
Board = Mapping[str, Mapping[str, Mapping[str, float]]]  # scene: method: metric, the mean over seeds


def rows(*datasets: str) -> Iterator[Mapping[str, str]]:
    """The rows of some tables of the board."""
    for name in datasets:
        with (ROOT / "leaderboard" / "measured" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            yield from csv.DictReader(file)


def board(*datasets: str, only: str = "", iterations: int = LENGTH) -> Board:
    """The metrics of some tables of the board at one length, of one seed or as means over all."""
    seeds: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for row in rows(*datasets):
        if row["cost_iterations"] != str(iterations) or only not in ("", row["seed"]):
            continue
        for metric in ("psnr", "mask_iou"):
            if row[metric]:
                seeds[row["scene"], label(row), metric].append(float(row[metric]))
    found: dict[str, dict[str, dict[str, float]]] = defaultdict(lambda: defaultdict(dict))
    for (scene, method, metric), values in seeds.items():
        found[scene][method][metric] = mean(values)
    return found


def label(row: Mapping[str, str]) -> str:
    """A row's method with its options; pretrained features by their name alone."""
    options = [word.partition(".")[2] for word in re.findall(r"--set (\S+)", row["reproduce"])]
    named = [re.sub("^(features|instances)=", "", option) for option in options if option not in HAND_MADE]
    return ", ".join(dict.fromkeys([row["method"], *named]))


def cells_of(psnr: Mapping[str, float], digits: int) -> list[str]:
    """PSNR of methods as printed, the best of the ranked in bold."""
    cells = {name: f"{x:.{digits}f}" for name, x in psnr.items()}
    ranked = [float(cell) for name, cell in cells.items() if name in RANKED]
    best = max(ranked) if len(ranked) > 1 else None
    return [f"**{c}**" if name in RANKED and float(c) == best else c for name, c in cells.items()]


def line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def means() -> list[str]:
    """Mean PSNR by group of scenes."""
    found, lines = board(*RANKED_ON), []
    for group, scenes in GROUPS.items():
        psnr = {name: mean(found[scene][name]["psnr"] for scene in scenes) for name in METHODS}
        lines.append(line([group, *cells_of(psnr, 1)]))
    return lines


def scenes() -> list[str]:
    """PSNR and mask IoU by scene."""
    found = board(*RANKED_ON)
    return [line([name, *scores(found[name], METHODS)]) for group in GROUPS.values() for name in group]


def scores(found: Mapping[str, Mapping[str, float]], methods: Sequence[str]) -> list[str]:
    """PSNR and mask IoU of methods on a scene, empty where one has no run."""
    there = [name for name in methods if name in found]
    cells = dict(zip(there, cells_of({name: found[name]["psnr"] for name in there}, 2)))
    for name in RANKED:
        if "mask_iou" in found.get(name, {}):
            cells[name] += f" / {found[name]['mask_iou']:.2f}"
    return [cells.get(name, "") for name in methods]


def lengths() -> list[str]:
    """PSNR and mask IoU by length, of the captures that were trained longer."""
    found = {n: board(*RANKED_ON, only="0", iterations=n) for n in LONGER}
    return [
        line([name, str(n), *scores(of[name], (*METHODS, CEILING))])
        for name in found[LONGER[-2]]
        for n, of in found.items()
        if name in of
    ]


def sizes() -> list[str]:
    """PSNR and mask IoU by size of the photos, of the captures that were trained on large ones."""
    lines = []
    for n in LONGER:
        found = {side: board(*datasets, only="0", iterations=n) for side, datasets in SIZES.items()}
        for name in found[max(SIZES)]:
            lines += [
                line([name, str(n), str(side), *scores(of[name], (*METHODS, CEILING))])
                for side, of in found.items()
                if name in of
            ]
    return lines


def suite() -> list[str]:
    """What the suite's captures show, and how ambiguous they are."""
    measured, lines = measured_ambiguity(), []
    for kind, scenes in SUITE.items():
        for name in scenes:
            spec, facts = preset(name), measured[name]
            shares = [
                f"{100 * facts[key]:.0f} %" if key in facts else ""
                for key in ("occlusion", "colour", "lookalike")
            ]
            lines.append(line([name, spec.world.place, kind, *shares, str(spec.train_views), spec.summary]))
    return lines


def baselines() -> list[str]:
    """Mean PSNR by kind of capture of every method that has run on the whole suite, the best first."""
    found = board(*RANKED_ON, only="0")
    columns = [*SUITE.values(), LIGHT, (REAL,)]
    psnr = {
        name: [
            mean(found[s][name]["psnr"] for s in scenes) if name in found[scenes[0]] else None
            for scenes in columns
        ]
        for name in on_whole_suite(found)
    }
    best = sorted(psnr, key=lambda name: -sum(x for x in psnr[name][:3] if x is not None))
    return [line([f"`{name}`", *("" if x is None else f"{x:.2f}" for x in psnr[name])]) for name in best]


def on_whole_suite(found: Board) -> list[str]:
    """Methods with a run on every capture of the suite."""
    scenes = [scene for of in SUITE.values() for scene in of]
    return [name for name in found[scenes[0]] if all(name in found[scene] for scene in scenes)]


def agreement() -> list[str]:
    """Kendall's tau of the order of methods on the suite and on composites, by kind of ambiguity."""
    simulated, pasted = board("aw-sim", only="0"), board("composites", only="0")
    lines = []
    for kind, scenes in {
        **SUITE,
        "all": [s for k, of in SUITE.items() if k != "control" for s in of],
    }.items():
        for label_, wanted in (
            ("all composites", sorted(pasted)),
            ("monstree-cutouts", ["monstree-cutouts"]),
        ):
            names = [
                name
                for name in simulated[scenes[0]]
                if name not in REFERENCES
                and all(name in simulated[s] for s in scenes)
                and all(name in pasted[s] for s in wanted)
            ]
            ours = np.array([[simulated[s][name]["psnr"] for s in scenes] for name in names])
            theirs = np.array([[pasted[s][name]["psnr"] for s in wanted] for name in names])
            tau, low, high = tau_interval(ours, theirs)
            lines.append(line([kind, label_, str(len(names)), f"{tau:.2f}", f"{low:.2f} to {high:.2f}"]))
    return lines


def tau_interval(first: np.ndarray, second: np.ndarray, draws: int = 2000) -> tuple[float, float, float]:
    """Kendall's tau-b of the mean values of methods, and its 95 % bootstrap interval over scenes of both.

    Args:
        first, second: [methods, scenes].
        draws: resamples.
    """
    rng = np.random.default_rng(0)

    def tau(a: np.ndarray, b: np.ndarray) -> float:
        return float(kendalltau(a.mean(1), b.mean(1)).statistic)

    def resampled(values: np.ndarray) -> np.ndarray:
        return values[:, rng.integers(values.shape[1], size=values.shape[1])]

    low, high = np.nanquantile(
        [tau(resampled(first), resampled(second)) for _ in range(draws)], (0.025, 0.975)
    )
    return tau(first, second), float(low), float(high)


TABLES: dict[str, dict[str, Callable[[], list[str]]]] = {
    "README.md": {"means": means},
    "docs/datasets.md": {"suite": suite},
    "docs/refinesplat.md": {"scenes": scenes},
    "docs/training.md": {"lengths": lengths, "sizes": sizes},
    "docs/baselines.md": {"baselines": baselines},
    "docs/leaderboard.md": {"agreement": agreement},
}


def written(page: str, text: str) -> str:
    """The page's text with its tables as the board says."""
    for name, lines in TABLES[page].items():
        pattern = re.compile(rf"(<!-- figures: {name} -->\n\|[^\n]*\n\|[^\n]*\n)(\|[^\n]*\n)+")
        text, count = pattern.subn(lambda m, lines=lines: m[1] + "\n".join(lines()) + "\n", text)
        if count != 1:
            raise SystemExit(f"{page} has {count} tables after '<!-- figures: {name} -->', not one")
    return text


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if a table differs")
    check = parser.parse_args().check
    differ = False
    for page in TABLES:
        path = ROOT / page
        before = path.read_text(encoding="utf-8")
        after = written(page, before)
        changes = list(
            difflib.unified_diff(before.splitlines(), after.splitlines(), page, page, n=0, lineterm="")
        )
        print(*changes, sep="\n", end="\n" * bool(changes))
        differ = differ or bool(changes)
        if not check:
            path.write_text(after, encoding="utf-8")
    sys.exit(1 if check and differ else 0)


if __name__ == "__main__":
    main()
