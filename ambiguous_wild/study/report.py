"""Scores as Markdown, CSV and JSON."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import counted
from ambiguous_wild.harness.render_tables import csv_text, markdown_text
from ambiguous_wild.io.atomic import atomic_dir, write_json, write_text
from ambiguous_wild.study.key import KIND_PAIR, KIND_PHOTO
from ambiguous_wild.study.scores import HARD

SCORE_FILES = ("scores.json", "scores.csv", "scores.md")
COLUMNS = (
    "kind",
    "level",
    "name",
    "against",
    "value",
    "low",
    "high",
    "raters_low",
    "raters_high",
    "n",
    "ties",
)


def write_scores(scores: dict[str, Any], out: Path) -> None:
    """Write scores.json, scores.csv and scores.md into the folder `out`, replacing what was there."""
    with atomic_dir(out) as folder:
        write_json(folder / "scores.json", scores)
        write_text(folder / "scores.md", to_markdown(scores))
        with open(folder / "scores.csv", "w", newline="", encoding="utf-8") as f:
            writer = csv.DictWriter(f, COLUMNS, lineterminator="\n", restval="")
            writer.writeheader()
            writer.writerows(_rows(scores))


def to_markdown(scores: dict[str, Any]) -> str:
    """The scores for people: names of methods, scenes and raters stay text."""
    raters = scores["raters"]
    answers = sum(r["answers"] for r in raters)
    parts = [f"# {markdown_text(scores['title'])}", ""]
    parts.append(f"Study {scores['study']}, {counted(len(raters), 'rater')}, {counted(answers, 'answer')}.")
    if scores[KIND_PAIR] is not None:
        parts += _preference(scores[KIND_PAIR])
    if scores[KIND_PHOTO] is not None:
        parts += _ambiguity(scores[KIND_PHOTO])
    head = ("rater", "name", "answers", "median s")
    rows = [(r["rater"], r["name"], f"{r['answers']} of {r['asked']}", r["median_s"]) for r in raters]
    parts += ["", "## Raters", "", *_table(head, rows), ""]
    parts.append(
        "Intervals are 95 %: [a, b] Wilson's, as if answers were independent; {a, b} a bootstrap over "
        f"raters, seed {scores['seed']}; of strengths a jackknife over raters."
    )
    return "\n".join(parts) + "\n"


def _preference(found: dict[str, Any]) -> list[str]:
    parts = ["", "## Which is better", "", f"{found['questions']} questions, {found['answers']} answers.", ""]
    if found["ranking"]:
        rows = [
            (r["rank"], r["method"], _with(r["strength"], r["low"], r["high"], 2), _places(r))
            for r in found["ranking"]
        ]
        parts += _table(("rank", "method", "Bradley-Terry strength (log odds)", "possible ranks"), rows)
    parts += ["", found["ranking_note"].capitalize() + "."] if found["ranking_note"] else []
    shares = [(m["method"], _share(m), m["n"], m["ties"]) for m in found["methods"]]
    parts += ["", "Preferred in what share of the decided answers:", ""]
    parts += _table(("method", "share", "decided", "ties"), shares)
    pairs = [(p["method"], p["against"], _share(p), p["n"], p["ties"]) for p in found["pairs"]]
    parts += ["", *_table(("method", "against", "share", "decided", "ties"), pairs)]
    if len({s["scene"] for s in found["scenes"]}) > 1:
        by_scene = [(s["scene"], s["method"], _share(s), s["n"], s["ties"]) for s in found["scenes"]]
        parts += ["", *_table(("scene", "method", "share", "decided", "ties"), by_scene)]
    parts += ["", f"Agreement: {_agreement(found['agreement'], 'nominal')}.",
              f"The left one was preferred in {_share(found['left'])} of the decided answers."]  # fmt: skip
    return parts


def _ambiguity(found: dict[str, Any]) -> list[str]:
    rows = [
        (s["scene"], _with(s["mean"], s["mean_low"], s["mean_high"], 2, "{}"),
         _share({**s, "share": s["hard"]}), s["n"], s["none"])
        for s in found["scenes"]
    ]  # fmt: skip
    return [
        "", "## How hard to tell apart", "",
        f"{found['questions']} questions, {found['answers']} answers; 1 stands out, 5 looks like the scene.",
        "",
        *_table(("scene", "mean", f"share rated {HARD} or 5", "ratings", "saw nothing move"), rows),
        "", f"Agreement: {_agreement(found['agreement'], 'interval metric')}.",
    ]  # fmt: skip


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return lines + ["| " + " | ".join(_cell(str(c)) for c in row) + " |" for row in rows]


def _cell(text: str) -> str:
    """Numbers as they are, intervals and all; names escaped."""
    return text if re.fullmatch(r"[-\d.,%\[\]{}— ]*", text) else markdown_text(text)


def _share(cell: dict[str, Any]) -> str:
    if cell["share"] is None:
        return "—"
    text = _with(100 * cell["share"], 100 * cell["low"], 100 * cell["high"], 1, unit=" %")
    if cell["raters_low"] is None:
        return text
    return f"{text} {{{100 * cell['raters_low']:.1f}, {100 * cell['raters_high']:.1f}}}"


def _with(
    value: float | None, low: float | None, high: float | None, digits: int, marks: str = "[]", unit: str = ""
) -> str:
    if value is None:
        return "—"
    text = f"{value:.{digits}f}{unit}"
    return text if low is None else f"{text} {marks[0]}{low:.{digits}f}, {high:.{digits}f}{marks[1]}"


def _places(row: dict[str, Any]) -> str:
    return (
        str(row["rank_low"])
        if row["rank_low"] == row["rank_high"]
        else f"{row['rank_low']}-{row['rank_high']}"
    )


def _agreement(found: dict[str, Any], kind: str) -> str:
    if found["alpha"] is None:
        return f"Krippendorff's alpha is missing: {found['note']}"
    return (
        f"Krippendorff's alpha {found['alpha']:.3f} ({kind}), {100 * found['equal']:.0f} % of pairs of "
        f"answers equal, over {found['questions']} questions that two raters or more answered"
    )


def _rows(scores: dict[str, Any]) -> Iterable[dict[str, Any]]:
    """One row a number, names guarded against spreadsheets."""
    pairs, photos = scores[KIND_PAIR], scores[KIND_PHOTO]
    keep = ("low", "high", "raters_low", "raters_high", "n", "ties")
    if pairs is not None:
        for r in pairs["ranking"]:
            yield _row(KIND_PAIR, "strength", r["method"], value=r["strength"], low=r["low"], high=r["high"])
        for level, key in (("methods", "method"), ("pairs", "method"), ("scenes", "scene")):
            for m in pairs[level]:
                other = m["method"] if level == "scenes" else m.get("against", "")
                yield _row(KIND_PAIR, level, m[key], other, value=m["share"], **{k: m[k] for k in keep})
        yield _row(KIND_PAIR, "alpha", value=pairs["agreement"]["alpha"])
    if photos is not None:
        for level, name in (("scenes", "scene"), ("photos", "view")):
            for s in photos[level]:
                where = s["scene"] if level == "photos" else ""
                yield _row(KIND_PHOTO, f"{level} mean", s[name], where, value=s["mean"], n=s["n"],
                           raters_low=s["mean_low"], raters_high=s["mean_high"])  # fmt: skip
                yield _row(
                    KIND_PHOTO,
                    f"{level} hard",
                    s[name],
                    where,
                    value=s["hard"],
                    **{k: s[k] for k in keep[:-1]},
                )
        yield _row(KIND_PHOTO, "alpha", value=photos["agreement"]["alpha"])


def _row(kind: str, level: str, name: str = "", against: str = "", **numbers: Any) -> dict[str, Any]:
    shown = {k: "" if v is None else v for k, v in numbers.items()}
    return {"kind": kind, "level": level, "name": csv_text(name), "against": csv_text(against), **shown}
