"""Write the scores as Markdown, CSV and JSON."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import counted
from ambiguous_wild.io.files import atomic_dir, write_json, write_text
from ambiguous_wild.report import plain_formats
from ambiguous_wild.report.plain_formats import markdown_text
from ambiguous_wild.report.table_layout import text_table
from ambiguous_wild.study.answers import KIND_PAIR, KIND_PHOTO
from ambiguous_wild.study.scores import (
    HARD,
    AgreementScore,
    Ambiguity,
    Counted,
    Preference,
    Ranked,
    Ratings,
    Scores,
    Share,
)

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


def write_scores(scores: Scores, out: Path) -> None:
    """Write scores.json, scores.csv and scores.md into the folder `out`, which is replaced."""
    with atomic_dir(out) as folder:
        write_json(folder / "scores.json", scores)
        write_text(folder / "scores.md", markdown_of(scores))
        rows = ([row.get(column) for column in COLUMNS] for row in _rows(scores))
        write_text(folder / "scores.csv", plain_formats.to_csv(COLUMNS, rows))


def markdown_of(scores: Scores) -> str:
    """Return the scores as Markdown; names of methods, scenes and raters are escaped."""
    raters = scores["raters"]
    answers = sum(r["answers"] for r in raters)
    parts = [f"# {markdown_text(scores['title'])}", ""]
    parts.append(f"Study {scores['study']}, {counted(len(raters), 'rater')}, {counted(answers, 'answer')}.")
    if scores[KIND_PAIR] is not None:
        parts += _preference(scores[KIND_PAIR])
    if scores[KIND_PHOTO] is not None:
        parts += _ambiguity(scores[KIND_PHOTO])
    head = ("rater", "name", "answers", "too fast", "outline shown", "median s")
    rows = [
        (
            r["rater"],
            r["name"],
            f"{r['answers']} of {r['asked']}",
            r["too_fast"],
            r["outlined"],
            r["median_s"],
        )
        for r in raters
    ]
    parts += ["", "## Raters", "", *_table(head, rows), ""]
    fast = sum(r["too_fast"] for r in raters)
    limits = scores["too_fast_s"]
    parts += [
        f"{fast} of {counted(answers, 'answer')} took less than {limits[KIND_PHOTO]:g} s (photos) or "
        f"{limits[KIND_PAIR]:g} s (renders), too short to look, and are left out of the scores.",
        "",
    ]
    parts.append(
        "Intervals are 95 %: [a, b] is Wilson's, for independent answers; {a, b} is a bootstrap over "
        f"raters, seed {scores['seed']}; intervals of strengths are a jackknife over raters."
    )
    return "\n".join(parts) + "\n"


def _preference(scores: Preference) -> list[str]:
    parts = [
        "",
        "## Which render is better",
        "",
        f"{scores['questions']} questions, {scores['answers']} answers.",
        "",
    ]
    if scores["ranking"]:
        rows = [
            (r["rank"], r["method"], _with(r["strength"], r["low"], r["high"], 2), _ranks(r))
            for r in scores["ranking"]
        ]
        parts += _table(("rank", "method", "Bradley-Terry strength (log odds)", "possible ranks"), rows)
    parts += ["", scores["ranking_note"].capitalize() + "."] if scores["ranking_note"] else []
    shares = [(m["method"], _share(m["share"], m), m["n"], m["ties"]) for m in scores["methods"]]
    parts += ["", "Share of the decided answers that prefer the method:", ""]
    parts += _table(("method", "share", "decided", "ties"), shares)
    pairs = [(p["method"], p["against"], _share(p["share"], p), p["n"], p["ties"]) for p in scores["pairs"]]
    parts += ["", *_table(("method", "against", "share", "decided", "ties"), pairs)]
    if len({s["scene"] for s in scores["scenes"]}) > 1:
        by_scene = [
            (s["scene"], s["method"], _share(s["share"], s), s["n"], s["ties"]) for s in scores["scenes"]
        ]
        parts += ["", *_table(("scene", "method", "share", "decided", "ties"), by_scene)]
    left = scores["left"]
    parts += ["", f"Agreement: {_agreement(scores['agreement'], 'nominal')}."]
    parts += [f"The left image was preferred in {_share(left['share'], left)} of the decided answers."]
    return parts


def _ambiguity(scores: Ambiguity) -> list[str]:
    rows = [
        (s["scene"], _with(s["mean"], s["mean_low"], s["mean_high"], 2, "{}"),
         _share(s["hard"], s), s["n"], s["none"], s["outlined"])
        for s in scores["scenes"]
    ]  # fmt: skip
    head = ("scene", "mean", f"share rated {HARD} or 5", "ratings", "no moving object seen", "outline shown")
    return [
        "", "## How hard the distractor is to see", "",
        f"{scores['questions']} questions, {scores['answers']} answers; 1: easy to see, 5: like the scene.",
        "",
        *_table(head, rows),
        "", f"Agreement: {_agreement(scores['agreement'], 'interval metric')}.",
    ]  # fmt: skip


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    texts = ([str(value) for value in row] for row in rows)
    return plain_formats.to_markdown([text_table("", head, texts, words=head)]).splitlines()


def _share(share: float | None, cell: Counted) -> str:
    """Return a share in percent with the intervals of its cell."""
    text = _with(_percent(share), _percent(cell["low"]), _percent(cell["high"]), 1, unit=" %")
    low, high = _percent(cell["raters_low"]), _percent(cell["raters_high"])
    return text if share is None or low is None else f"{text} {{{low:.1f}, {high:.1f}}}"


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share


def _with(
    value: float | None, low: float | None, high: float | None, digits: int, marks: str = "[]", unit: str = ""
) -> str:
    if value is None:
        return "—"
    text = f"{value:.{digits}f}{unit}"
    return text if low is None else f"{text} {marks[0]}{low:.{digits}f}, {high:.{digits}f}{marks[1]}"


def _ranks(row: Ranked) -> str:
    return (
        str(row["rank_low"])
        if row["rank_low"] == row["rank_high"]
        else f"{row['rank_low']}-{row['rank_high']}"
    )


def _agreement(score: AgreementScore, kind: str) -> str:
    if score["alpha"] is None or score["equal"] is None:
        return f"Krippendorff's alpha is missing: {score['note']}"
    return (
        f"Krippendorff's alpha {score['alpha']:.3f} ({kind}), {100 * score['equal']:.0f} % of pairs of "
        f"answers equal, over {score['questions']} questions with two or more raters"
    )


ScoreRow = dict[str, str | float | None]  # by `COLUMNS`


def _rows(scores: Scores) -> Iterable[ScoreRow]:
    """Yield one row for each number; names are escaped for spreadsheets."""
    pairs, photos = scores[KIND_PAIR], scores[KIND_PHOTO]
    if pairs is not None:
        for one in pairs["ranking"]:
            yield _row(
                KIND_PAIR, "strength", one["method"], value=one["strength"], low=one["low"], high=one["high"]
            )
        for m in pairs["methods"]:
            yield _share_row("methods", m["method"], "", m, m["ties"])
        for p in pairs["pairs"]:
            yield _share_row("pairs", p["method"], p["against"], p, p["ties"])
        for s in pairs["scenes"]:
            yield _share_row("scenes", s["scene"], s["method"], s, s["ties"])
        yield _row(KIND_PAIR, "alpha", value=pairs["agreement"]["alpha"])
    if photos is not None:
        for r in photos["scenes"]:
            yield from _rating_rows("scenes", r["scene"], "", r)
        for photo in photos["photos"]:
            yield from _rating_rows("photos", photo["view"], photo["scene"], photo)
        yield _row(KIND_PHOTO, "alpha", value=photos["agreement"]["alpha"])


def _share_row(level: str, name: str, against: str, share: Share, ties: int) -> ScoreRow:
    return _row(KIND_PAIR, level, name, against, value=share["share"], **_intervals(share), ties=ties)


def _rating_rows(level: str, name: str, scene: str, ratings: Ratings) -> Iterable[ScoreRow]:
    means = {"raters_low": ratings["mean_low"], "raters_high": ratings["mean_high"]}
    yield _row(KIND_PHOTO, f"{level} mean", name, scene, value=ratings["mean"], n=ratings["n"], **means)
    yield _row(KIND_PHOTO, f"{level} hard", name, scene, value=ratings["hard"], **_intervals(ratings))


def _intervals(score: Counted) -> dict[str, float | None]:
    return {
        "n": score["n"],
        "low": score["low"],
        "high": score["high"],
        "raters_low": score["raters_low"],
        "raters_high": score["raters_high"],
    }


def _row(kind: str, level: str, name: str = "", against: str = "", **numbers: float | None) -> ScoreRow:
    return {"kind": kind, "level": level, "name": name, "against": against, **numbers}
