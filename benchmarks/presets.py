"""Every preset from spec to trained model: photos registered, ambiguity class, decisions of the plan.

    python benchmarks/presets.py --work DIR [--presets NAME ...] [--width 480] [--factor 2] [--iterations 600]

For each preset: `aw simulate`, `aw build-scene`, `aw ambiguity-report`, `aw plan` and a short `aw bench` of
3dgs, as on the command line. Writes benchmarks/results/presets.md: photos registered, measured and
designed ambiguity class, each decision of the plan against the preset's design, and the confusion table. A
finished preset (DIR/<preset>.json) is kept.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from job_queue import aw, exit_code

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.result_file import RESULT, read_result
from ambiguous_wild.io.files import write_json, write_text
from ambiguous_wild.metrics import stats
from ambiguous_wild.simulate.presets import PRESETS

RESULTS = Path(__file__).parent / "results" / "presets.md"
# per question: what a preset is designed for, and the lines of the plan, any of which answers it
QUESTIONS = {
    "masks": ("masks", ("masks",)),
    "colour per photo": ("appearance", ("exposure", "appearance")),
    "antialiasing": ("antialiasing", ("antialias",)),
}


def timed(*words: str) -> tuple[str, float]:
    """Standard output and seconds of one command.

    Raises:
        AwError: it failed.
    """
    begin = time.perf_counter()
    return aw(*words), time.perf_counter() - begin


def measure(preset: str, args: argparse.Namespace) -> dict[str, Any]:
    """All there is to say of one preset.

    Raises:
        AwError: a command failed.
    """
    raw, scene, runs = args.work / "raw" / preset, args.work / "scenes" / preset, args.work / "runs"
    seconds: dict[str, float] = {}
    if not (raw / "truth" / "capture.json").is_file():
        _, seconds["simulate"] = timed("simulate", preset, "-o", str(raw), "--width", str(args.width))
    size = ("--factor", str(args.factor))
    _, seconds["build-scene"] = timed("build-scene", str(raw), "-o", str(scene), "--name", preset, *size)
    info = json.loads((scene / "scene.json").read_text(encoding="utf-8"))
    row: dict[str, Any] = {
        "preset": preset,
        "photos": info["counts"]["photos"],
        "registered": info["counts"]["registered"],
        "designed": PRESETS[preset].designed.ambiguity,
        "wanted": list(PRESETS[preset].designed.effects),
    }
    if PRESETS[preset].distractors:
        text, seconds["ambiguity-report"] = timed("ambiguity-report", str(scene), "--no-record", "--json")
        row["report"] = scores(json.loads(text))
    text, seconds["plan"] = timed("plan", str(scene), "--json")
    plan = json.loads(text)
    row["plan"] = {d["effect"]: [d["value"], d["decision"]] for d in plan["decisions"]}
    words = ("--method", "3dgs", "--iterations", str(args.iterations), "--effects", "none", "--no-pictures")
    _, seconds["bench"] = timed("bench", *words, "--scene", str(scene), "-o", str(runs))
    row["psnr_3dgs"] = mean_psnr(read_result(runs / preset / "3dgs" / "seed0" / RESULT))
    return row | {"seconds": {name: round(s, 1) for name, s in seconds.items()}}


def mean_psnr(result: dict[str, Any]) -> float:
    """Mean PSNR of a run's test photos."""
    return stats.mean([image["psnr"] for image in result["per_image"]])


def check_presets(parser: argparse.ArgumentParser, names: Sequence[str]) -> None:
    """End with a usage error if a name is no preset."""
    if unknown := set(names) - set(PRESETS):
        parser.error(f"no preset {', '.join(sorted(unknown))}; 'aw simulate --list' names them")


def scores(facts: dict[str, Any]) -> dict[str, Any]:
    """Class and the three scores of an ambiguity report."""
    found: dict[str, Any] = {"class": facts["class"]}
    for name, value in facts.items():
        if isinstance(value, dict) and "value" in value:
            found[name] = value["value"]
    return found


def decided(row: dict[str, Any]) -> dict[str, tuple[bool, str]]:
    """Per question: whether the preset was designed for it, and "on", "off" or "unknown"."""
    table = {}
    for name, (effect, lines) in QUESTIONS.items():
        answers = [row["plan"][line][1] for line in lines if line in row["plan"]]
        told = "on" if "on" in answers else "unknown" if "unknown" in answers else "off"
        table[name] = (effect in row["wanted"], told)
    return table


def to_markdown(data: dict[str, Any]) -> str:
    """The results as Markdown."""
    rows = data["presets"]
    lines = [
        "# Presets: built, told apart, planned",
        "",
        f"{data['width']} px wide, images_{data['factor']}, 3dgs {data['iterations']} iterations, seed 0; "
        f"`{data['command']}`",
        "",
        "| preset | placed | 3dgs, dB | designed | reported | colour | look-alike | covers "
        "| plan: on | wrong |",
        "|---|---:|---:|---|---|---:|---:|---:|---|---|",
    ]
    confusion = {name: {"has, on": 0, "has, off": 0, "lacks, on": 0, "lacks, off": 0} for name in QUESTIONS}
    for row in rows:
        if "error" in row:
            lines.append(f"| {row['preset']} | {row['error']} |" + " |" * 8)
            continue
        answers = decided(row)
        for name, (has, told) in answers.items():
            confusion[name][f"{'has' if has else 'lacks'}, {'on' if told == 'on' else 'off'}"] += 1
        wrong = [name for name, (has, told) in answers.items() if has != (told == "on")]
        on = [name for name, (_, told) in answers.items() if told == "on"]
        report = row.get("report", {})
        shown = {k: ("—" if v is None else f"{v:.2f}") for k, v in report.items() if k != "class"}
        colour = next((v for k, v in shown.items() if k.startswith("colour")), "—")
        cosine = next((v for k, v in shown.items() if k.startswith("semantic")), "—")
        lines.append(
            f"| {row['preset']} | {row['registered']} of {row['photos']} | {row['psnr_3dgs']:.2f} "
            f"| {row['designed']} | {report.get('class', 'no distractors')} | {colour} | {cosine} "
            f"| {shown.get('occlusion', '—')} | {', '.join(on) or '—'} | {', '.join(wrong) or '—'} |"
        )
    lines += [
        "",
        "| effect | has it, on | has it, off | lacks it, on | lacks it, off |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, cells in confusion.items():
        lines.append(f"| {name} | " + " | ".join(str(n) for n in cells.values()) + " |")
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, required=True, metavar="DIR")
    parser.add_argument("--presets", nargs="+", default=[n for n in PRESETS if n != "tiny"])
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--factor", type=int, default=2, help="what is looked at and trained is 1/N of that")
    parser.add_argument("--iterations", type=int, default=600)
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args(argv)
    check_presets(parser, args.presets)
    rows = []
    for k, preset in enumerate(args.presets, 1):
        kept = args.work / f"{preset}.json"
        if kept.is_file():
            rows.append(json.loads(kept.read_text(encoding="utf-8")))
            continue
        try:
            row = measure(preset, args)
            write_json(kept, row)
        except AwError as error:
            row = {"preset": preset, "error": str(error)}
        rows.append(row)
        shown = row.get("error") or f"{row['registered']} of {row['photos']}, {row['seconds']}"
        print(f"[{k}/{len(args.presets)}] {preset}: {shown}", flush=True)
    command = "python benchmarks/presets.py --work DIR"
    command += f" --width {args.width} --factor {args.factor} --iterations {args.iterations}"
    data = {
        "command": command,
        "width": args.width,
        "factor": args.factor,
        "iterations": args.iterations,
        "presets": rows,
    }
    write_text(args.results, to_markdown(data))
    print(to_markdown(data))
    return 1 if any("error" in row for row in rows) else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
