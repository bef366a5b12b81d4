"""Write the tables of README and docs from the result files, or check that they agree.

    python benchmarks/figures.py            write them
    python benchmarks/figures.py --check    print which differ; exit code 1 if one does

A table follows the line `<!-- figures: NAME -->` and ends at the next empty line.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import mean

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
RANKED = ("3dgs", "dronesplat", "robustsplat", "refinesplat")
Sections = dict[str, dict[str, dict[str, str]]]  # capture: method: column: cell


def sections(name: str) -> Sections:
    """The tables of a report of `captures_report.py`, by capture and method."""
    found: Sections = {}
    rows: dict[str, dict[str, str]] = {}
    columns: list[str] = []
    for line in (RESULTS / name).read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("## "):
            rows = found.setdefault(line[3:].split(" (")[0], {})
        elif line.startswith("| method"):
            columns = cells
        elif line.startswith("| ") and not line.startswith("| ---"):
            rows[cells[0]] = dict(zip(columns, cells, strict=True))
    return {capture: rows for capture, rows in found.items() if rows}


def value(cell: str) -> float:
    return float(cell.split()[0].replace(",", ""))


def bold(cells: list[str], values: list[float], ranked: Iterable[int]) -> list[str]:
    """The cells, with the largest values among those ranked in bold, as they are printed."""
    best = max(values[k] for k in ranked)
    return [f"**{cell}**" if k in ranked and values[k] == best else cell for k, cell in enumerate(cells)]


def line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def means() -> list[str]:
    board: dict[tuple[str, str], list[float]] = defaultdict(list)
    for name in ("simulated", "composites"):
        with (ROOT / "leaderboard" / "measured" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                board[row["scene"], row["method"]].append(float(row["psnr"]))
    by_hand = json.loads((RESULTS / "published.json").read_text(encoding="utf-8"))["means"]

    def of_board(prefix: str) -> dict[str, float]:
        scenes = sorted({scene for scene, _ in board if scene.startswith(prefix)})
        return {m: mean(mean(board[scene, m]) for scene in scenes) for m in (*RANKED, "3dgs+truth")}

    def of_report(name: str) -> dict[str, float]:
        captures = sections(name).values()
        methods = set.intersection(*(set(rows) for rows in captures))
        return {method: mean(value(rows[method]["PSNR dB"]) for rows in captures) for method in methods}

    rows: list[tuple[str, dict[str, float]]] = [
        ("seven simulated captures, 2000 iterations", of_report("captures.md")),
        ("the same, 1000 iterations", of_board("courtyard-")),
        (
            "drone photos with patches of their own texture pasted in, 1000 iterations",
            of_board("seneca-patches"),
        ),
        ("tree with cut-outs pasted in, 1000 iterations", of_board("monstree-cutouts")),
        *by_hand.items(),
        ("20 composites on four real captures, 1500 iterations, skybox", of_report("composites.md")),
    ]
    return [_means(label, found) for label, found in rows]


def _means(label: str, found: dict[str, float]) -> str:
    numbers = [round(found.get(method, float("-inf")), 1) for method in (*RANKED, "3dgs+truth")]
    cells = [f"{x:.1f}" if x > float("-inf") else "-" for x in numbers]
    return line([label, *bold(cells, numbers, range(len(RANKED)))])


def captures() -> list[str]:
    labels = {
        "plain": "plain, distinct colours", "colour": "colour of the background",
        "twin": "twin, copies of a static object", "thin": "thin", "sparse": "sparse", "crowd": "crowd",
        "clean": "clean, no distractors",
    }  # fmt: skip
    methods = ("3dgs", "robustsplat", "dronesplat", "refinesplat", "3dgs+truth", "3dgs-clean")
    masks = range(1, 4)
    found = sections("captures.md")
    shares = dict(
        re.findall(r"^## courtyard-(\w+) .* (\S+) % dis", (RESULTS / "captures.md").read_text(), re.M)
    )
    lines, psnr = [], []
    for name, label in labels.items():
        rows = found[f"courtyard-{name}"]
        psnr.append([value(rows[method]["PSNR dB"]) for method in methods])
        cells = bold([f"{x:.2f}" for x in psnr[-1]], psnr[-1], range(4))
        for k in masks:
            row = rows[methods[k]]
            if name == "clean":
                cells[k] += f", {value(row['masked %']):.1f} % masked"
            else:
                iou = [round(value(rows[methods[j]]["IoU"]), 2) for j in masks]
                own = iou[k - 1]
                cells[k] += f" / **{own:.2f}**" if own == max(iou) else f" / {own:.2f}"
        lines.append(line([label, f"{float(shares[name]):.0f} %", *cells]))
    average = [f"{mean(column):.2f}" for column in zip(*psnr, strict=True)]
    return [*lines, "| mean | | " + " | ".join(average) + " |"]


def composites() -> list[str]:
    labels = {
        "seneca": "seneca, drone | 240", "monstree": "monstree, phone | 179",
        "sceaux": "sceaux, 11 photos | 240", "skull": "skull, dark, flash | 239",
    }  # fmt: skip
    methods, columns = ("3dgs", "robustsplat", "refinesplat"), ("PSNR dB", "supported dB")
    found = sections("composites.md")
    lines = []
    for base, label in labels.items():
        chosen = [rows for capture, rows in found.items() if capture.startswith(base)]
        halves, first = [], []
        for column in columns:
            each = [[value(rows[method][column]) for method in methods] for rows in chosen]
            average = [round(mean(x), 2) for x in zip(*each, strict=True)]
            halves.append(bold([f"{x:.2f}" for x in average], average, range(3)))
            first.append(sum(row[2] > max(row[:2]) for row in each))
        cells = [f"{a} / {b}".replace("** / **", " / ") for a, b in zip(*halves, strict=True)]
        lines.append(line([label, *cells, f"{first[0]} / {first[1]} of {len(chosen)}"]))
    return lines


TABLES: dict[str, dict[str, Callable[[], list[str]]]] = {
    "README.md": {"means": means},
    "docs/refinesplat.md": {"captures": captures, "composites": composites},
}


def written(page: str, text: str) -> str:
    """The page's text with its tables as the result files say."""
    for name, rows in TABLES[page].items():
        pattern = re.compile(rf"(<!-- figures: {name} -->\n\|[^\n]*\n\|[^\n]*\n)(\|[^\n]*\n)+")
        text, count = pattern.subn(lambda m, rows=rows: m[1] + "\n".join(rows()) + "\n", text)
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
        for old, new in zip(before.splitlines(), after.splitlines(), strict=False):
            if old != new:
                differ = True
                print(f"{page}:\n- {old}\n+ {new}")
        if not check:
            path.write_text(after, encoding="utf-8")
    sys.exit(1 if check and differ else 0)


if __name__ == "__main__":
    main()
