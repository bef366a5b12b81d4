"""Transcribe the tables of the RefineSplat paper from its LaTeX source to CSV.

    python leaderboard/transcribe.py paper.tex -o ambiguous_wild/report/reported

Numbers are copied, never corrected. What the table itself does not say (which scene an ablation is on, which
variant of a metric) comes from the text around it, or is "unknown". docs/tables.md describes the columns.
"""

from __future__ import annotations

import argparse
import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

COLUMNS = ("table", "method", "setting", "dataset", "scene", "metric", "variant", "value", "mark", "printed")
PAPER = "RefineSplat, WACV 2027 submission 938"
METHODS = {
    "3D-GS": "3DGS", "HA-NeRF": "Ha-NeRF", "WildGaussian": "WildGaussians",
    "RefineSplat(Ours)": "RefineSplat", "RefineSplat (Ours)": "RefineSplat",
    "Baseline": "RobustSplat", "Baselines": "RobustSplat",
}  # fmt: skip
AW, OTG, PT, DI = "Ambiguous wild", "NeRF On-the-go", "Photo Tourism", "Drone Imagery"
QUALITY = ("psnr", "ssim", "lpips")


@dataclass(frozen=True)
class Layout:
    """How one table is to be read."""

    name: str  # of the table, and of the file without suffix
    dataset: str = "unknown"
    scenes: tuple[str, ...] = ()  # one a group of columns; empty: "unknown"
    datasets: tuple[str, ...] = ()  # one a group, for tables of means
    metrics: tuple[str, ...] = QUALITY  # the columns of a group
    lead: int = 1  # cells before the first group
    extra: tuple[str, ...] = ()  # metrics of cells after the last group, in MB
    rows: tuple[tuple[str, str], ...] = ()  # (method, setting) by row; empty: the first cell names the method
    speed: bool = False  # the second cell is "GPU hours / FPS"


def ours(*settings: str) -> tuple[tuple[str, str], ...]:
    return tuple(("RefineSplat", s) for s in settings)


_MAIN = ("Humanoid", "Porter", "Lounge", "Bust", "Jockey", "Statuette")
_AMB1 = ("Artwork", "Benches", "Bookstore", "Jewel", "Monster", "Wood")
_AMB2 = ("Room", "Rose", "Turtle", "Siedentopf", "Stone", "Straw")
_OTG = ("Mountain", "Fountain", "Corner", "Patio", "Spot", "Patio-High")
_PT = ("Brandenburg Gate", "Sacre Coeur", "Trevi-Fountain")
_MEM1 = ("Porter", "Humanoid", "Jockey", "Lounge", "Monster", "Artwork", "Benches", "Bust", "Statuette")
_MEM2 = ("Bookstore", "Room", "Rose", "Turtle", "Siedentopf", "Wood", "Stone", "Straw", "Jewel")
_PLUG = ("M_final off, T_hard", "M_final, T_hard", "M_final, T_statistics", "M_final, T_ent")
_ROBUST = ("RobustSplat", "")
# A row of an ablation that switches on everything the table varies, or takes the value the text settles on,
# claims to be the method as published: its setting is empty.
LAYOUTS = {
    "tab:ambi_quanti": Layout("ambiguous-wild-main", AW, _MAIN),
    "tab:sota_diverse": Layout("means", scenes=("mean",) * 4, datasets=(OTG, PT, DI, "all")),
    "tab:entropy-aware_plug": Layout("ablation-threshold-plug", AW, ("Humanoid",), lead=5, rows=(
        ("GS-W", ""), *(("GS-W", s) for s in _PLUG[1:]),
        ("WildGaussians", ""), *(("WildGaussians", s) for s in _PLUG[1:]))),
    "tab:mask_complement": Layout("ablation-mask", AW, ("Humanoid",), lead=3,
                                  rows=(_ROBUST, *ours("M_local", "M_global", ""))),
    "tab:density_control": Layout("ablation-density", AW, ("Jewel",), lead=3, extra=("memory",),
                                  rows=(_ROBUST, *ours("entropy", "merging", ""))),
    "tab:density_sota": Layout("ablation-density-strategies", lead=4, extra=("memory",),
                               scenes=("unknown",), rows=ours("PUP", "UAD", "")),
    "tab:treshold_glb_mask": Layout("ablation-global-threshold", OTG, ("Patio",), lead=2,
                                    rows=ours("T_hard", "T_glb")),
    "main_tab:sensitive_cr": Layout("sensitivity-alpha1", scenes=("unknown",),
                                      rows=ours("alpha_1 0.1", "", "alpha_1 0.3")),
    "tab:impact_of_module": Layout("ablation-modules", scenes=("mean", "mean"), datasets=(AW, OTG), lead=4,
                                   rows=(_ROBUST, *ours("EAM", "EAM + CR", "EAM + EDC", ""))),
    "tab:dino_patch_size": Layout("sensitivity-patch", OTG, ("Patio",), rows=ours("", "patch 16")),
    "tab:dino_variant": Layout("sensitivity-dino", OTG, ("Patio",), rows=ours("DINOv1", "")),
    "tab:dilated_filter": Layout("sensitivity-dilation", scenes=("unknown",),
                                      rows=ours("dilation 3", "", "dilation 7")),
    "rebuttal_tab:treshold": Layout("sensitivity-merge-colour", scenes=("unknown",),
                                      rows=ours("colour 0.10", "", "colour 0.20")),
    "sub_tab:ambi_quan_1": Layout("ambiguous-wild-1", AW, _AMB1, lead=2, speed=True),
    "sub_tab:ambi_quan_2": Layout("ambiguous-wild-2", AW, _AMB2, lead=2, speed=True),
    "sub_tab:onthego_quan": Layout("on-the-go", OTG, _OTG, lead=2, speed=True),
    "sub_tab:photo_quan": Layout("photo-tourism", PT, _PT, lead=2, speed=True),
    "sub_tab:supple_Drone_quan": Layout("drone-imagery", DI, ("SimingShan", "Sculpture"), lead=2, speed=True),
    "sub_tab:memory_amb1": Layout("memory-ambiguous-wild-1", AW, _MEM1, metrics=("memory",)),
    "sub_tab:memory_amb2": Layout("memory-ambiguous-wild-2", AW, _MEM2, metrics=("memory",)),
    "sub_tab:memory_onthego1": Layout("memory-on-the-go", OTG, _OTG, metrics=("memory",)),
    "sub_tab:memory_photo_drone_1": Layout("memory-photo-tourism", PT, _PT, metrics=("memory",)),
}  # fmt: skip
MEMORY_MAIN = "tab:memory_size"  # two scenes beside each other, three rows each: a layout of its own
# Figures that the text states, by the file's section they stand in.
TEXT = (
    ("text: discussion", "occlusion_max_percent", "60", "over 60\\%"),
    ("text: supplement, dataset acquisition", "occlusion_max_percent", "45", "5\\% to 45\\%"),
    ("text: discussion", "occlusion_min_percent", "5", "from 5\\%"),
    ("text: supplement, dataset acquisition", "occlusion_min_percent", "5", "5\\% to 45\\%"),
)


def plain(cell: str) -> tuple[str, str]:
    """(text without markup, rank it is coloured as) of a cell."""
    mark = re.search(r"\\metrictable(first|second|third)\{", cell)
    text = re.sub(r"\\cite\{[^}]*\}", "", cell)
    text = re.sub(
        r"\\multirow\{[^}]*\}\{[^}]*\}|\\multicolumn\{[^}]*\}\{(?:[^{}]|\{[^}]*\})*\}|\\raisebox\{[^}]*\}",
        "",
        text,
    )
    text = re.sub(r"\\shortstack\{([^{}]*)\}", r"\1", text).replace(r"\\", " ")
    text = re.sub(r"\\[a-zA-Z]+|\\[;,!]|[{}$~]", " ", text)
    text = re.sub(r"\s+", " ", text).strip()
    rank = {"first": "1", "second": "2", "third": "3"}[mark[1]] if mark else ""
    return text, rank


def bodies(source: str) -> Iterator[tuple[str, list[list[str]]]]:
    """(label, rows of raw cells below the head) of every tabular."""
    for found in re.finditer(
        r"\\begin\{tabular\*?\}(.*?)\\end\{tabular\*?\}(.*?)\\label\{([^}]*)\}", source, re.S
    ):
        body = re.sub(r"(?<!\\)%.*", "", found[1])
        body = body.split(r"\midrule", 1)[-1]
        body = re.sub(r"\\(midrule|bottomrule|hline|toprule)", "", body)
        # A row ends with \\ outside of braces: \shortstack{Sacre\\Coeur} is one cell.
        body = re.sub(r"\{([^{}]*)\\\\([^{}]*)\}", r"{\1 \2}", body)
        rows = [[c.strip() for c in row.split("&")] for row in body.split(r"\\")]
        yield found[3], [r for r in rows if len(r) > 2]


def number(text: str) -> str:
    return text if re.fullmatch(r"\d+(\.\d+)?", text) else ""


def records(label: str, layout: Layout, rows: list[list[str]]) -> Iterator[tuple[str, ...]]:
    groups = layout.scenes or ("unknown",)
    if layout.rows and len(layout.rows) != len(rows):
        raise SystemExit(f"{label}: {len(rows)} rows, the layout has {len(layout.rows)}")
    for number_of_row, row in enumerate(rows):
        name = plain(row[0])[0]
        method, setting = layout.rows[number_of_row] if layout.rows else (METHODS.get(name, name), "")
        # "Baselines" spans cells that the other rows have.
        lead = len(row) - len(groups) * len(layout.metrics) - len(layout.extra)
        if not layout.rows and lead != layout.lead:
            raise SystemExit(f"{label}: row {name!r} has {len(row)} cells")
        if layout.speed:
            hours, fps = (part.strip() for part in plain(row[1])[0].split("/"))
            covered = "+".join(layout.scenes)
            yield (
                label,
                method,
                setting,
                layout.dataset,
                covered,
                "gpu_hours",
                "unknown",
                number(hours),
                "",
                hours,
            )
            yield (label, method, setting, layout.dataset, covered, "fps", "unknown", number(fps), "", fps)
        cells = iter(row[lead:])
        for i, scene in enumerate(groups):
            dataset = layout.datasets[i] if layout.datasets else layout.dataset
            for metric in layout.metrics:
                text, rank = plain(next(cells))
                yield (label, method, setting, dataset, scene, metric, "unknown", number(text), rank, text)
        for metric in layout.extra:
            text, rank = plain(next(cells))
            yield (label, method, setting, layout.dataset, groups[0], metric, "MB", number(text), rank, text)


def memory_main(rows: list[list[str]]) -> Iterator[tuple[str, ...]]:
    datasets = {"Humanoid": AW, "Patio": OTG, "Spot": OTG, "Sacre Coeur": PT}
    current = ["", ""]
    for row in rows:
        for side in (0, 1):
            scene, method, value = (plain(c)[0] for c in row[3 * side : 3 * side + 3])
            current[side] = scene or current[side]
            what = (METHODS.get(method, method), "", datasets[current[side]], current[side])
            yield (MEMORY_MAIN, *what, "memory", "unknown", number(value), "", value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    source = options.source.read_text(encoding="utf-8")
    written, lost = {}, []
    for label, rows in bodies(source):
        if label == MEMORY_MAIN:
            written["memory-main"] = list(memory_main(rows))
        elif label in LAYOUTS:
            written[LAYOUTS[label].name] = list(records(label, LAYOUTS[label], rows))
        else:
            lost.append(label)
    for *_, printed in TEXT:
        if printed not in source:
            raise SystemExit(f"the text no longer says {printed!r}")
    written["text"] = [(t, "dataset", "", AW, "all", k, "percent", v, "", p) for t, k, v, p in TEXT]
    for name, lines in written.items():
        with open(options.out / f"{name}.csv", "w", newline="", encoding="utf-8") as f:
            writer = csv.writer(f, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows(lines)
    count = sum(map(len, written.values()))
    print(f"{PAPER}: {len(written)} files, {count} numbers; left out: {', '.join(lost)}")
    absent = sorted(set(LAYOUTS) - {label for label, _ in bodies(source)})
    if absent:
        raise SystemExit(f"not found: {', '.join(absent)}")


if __name__ == "__main__":
    main()
