"""Scores from answers and key: shares, ranking, ratings, agreement."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import combinations
from statistics import median
from typing import Any

import numpy as np

from ambiguous_wild.metrics.ambiguity import ratio_interval
from ambiguous_wild.study.answers import KIND_PAIR, KIND_PHOTO, TOO_FAST_S, Answer, Key, Rater
from ambiguous_wild.study.ranking import (
    Ambiguity,
    MethodShare,
    PairShare,
    Preference,
    RaterSummary,
    Ratings,
    Scores,
    Share,
    agreement,
    bradley_terry,
)

HARD = 4  # of 5: a photo rated this or more is hard
Counts = np.ndarray  # [raters, 2]: successes, trials


def score(key: Key, raters: list[Rater], seed: int = 0) -> Scores:
    """All scores of a study, as written to scores.json; None = not defined.

    Answers that were too fast are left out of every score and counted in each rater's summary.

    Args:
        key: of the study.
        raters: at least one, from `read_answers`.
        seed: of the bootstrap over raters.
    """
    kept = [replace(r, answers=tuple(a for a in r.answers if not a.too_fast)) for r in raters]
    kept = [r for r in kept if r.answers]  # whoever has none left changes no interval
    return {
        "study": key.study,
        "title": key.title,
        "seed": seed,
        "too_fast_s": TOO_FAST_S,
        "raters": [_rater(r, key) for r in raters],
        KIND_PAIR: _preference(key, kept, seed),
        KIND_PHOTO: _ambiguity(key, kept, seed),
    }


def _rater(rater: Rater, key: Key) -> RaterSummary:
    return {
        "rater": rater.rater,
        "name": rater.name,
        "answers": len(rater.answers),
        "asked": len(key.questions),
        "too_fast": sum(a.too_fast for a in rater.answers),
        "outlined": sum(a.outline is True for a in rater.answers),
        "median_s": round(median(a.seconds for a in rater.answers), 2),
        "file": rater.path.name,
    }


def share(counts: Counts, seed: int) -> Share:
    """A share with two 95 % intervals: Wilson's (independent answers) and a bootstrap over raters.

    Args:
        counts: successes and trials of each rater.
        seed: of the bootstrap.
    """
    from scipy.stats import binomtest

    part, whole = (int(n) for n in counts.sum(axis=0))
    if not whole:
        return {"share": None, "n": 0, "low": None, "high": None, "raters_low": None, "raters_high": None}
    wilson = binomtest(part, whole).proportion_ci(method="wilson")
    raters = ratio_interval(counts[:, 0], counts[:, 1], seed=seed)
    return {
        "share": part / whole,
        "n": whole,
        "low": float(wilson.low),
        "high": float(wilson.high),
        "raters_low": _number(raters.low),
        "raters_high": _number(raters.high),
    }


def _preference(key: Key, raters: list[Rater], seed: int) -> Preference | None:
    entries = {q: e for q, e in key.questions.items() if e["kind"] == KIND_PAIR}
    if not entries:
        return None
    mine = [[a for a in r.answers if a.question in entries] for r in raters]
    methods = sorted({e[side] for e in entries.values() for side in ("x", "y")})
    votes = [[_vote(entries[a.question], a) for a in answers] for answers in mine]
    ranking, note = bradley_terry(methods, _matrix(methods, votes))
    scenes = sorted({e["scene"] for e in entries.values()})
    return {
        "questions": len(entries),
        "answers": sum(map(len, mine)),
        "methods": [_method(m, votes, seed) for m in methods],
        "scenes": [
            {"scene": s, **_method(m, [[v for v in one if v[2] == s] for one in votes], seed)}
            for s in scenes
            for m in methods
        ],
        "pairs": [_pair(a, b, votes, seed) for a, b in combinations(methods, 2)],
        "ranking": ranking,
        "ranking_note": note,
        "left": share(_counts(mine, lambda a: a.answer == a.left, lambda a: a.answer != "tie"), seed),
        "agreement": agreement(
            ((r.rater, a.question, a.answer) for r, one in zip(raters, mine) for a in one), ordered=False
        ),
    }


# (winner, loser, scene, tie); for a tie the methods x and y
Vote = tuple[str, str, str, bool]


def _vote(entry: dict[str, str], answer: Answer) -> Vote:
    other = {"x": "y", "y": "x"}
    won = "x" if answer.answer == "tie" else answer.answer
    return entry[won], entry[other[won]], entry["scene"], answer.answer == "tie"


def _matrix(methods: list[str], votes: list[list[Vote]]) -> np.ndarray:
    index = {m: i for i, m in enumerate(methods)}
    wins = np.zeros((len(votes), len(methods), len(methods)))
    for rater, cast in enumerate(votes):
        for won, lost, _, tie in cast:
            wins[rater, index[won], index[lost]] += 0.5 if tie else 1.0
            wins[rater, index[lost], index[won]] += 0.5 if tie else 0.0
    return wins


def _method(method: str, votes: list[list[Vote]], seed: int) -> MethodShare:
    counts = _counts(votes, lambda v: v[0] == method, lambda v: method in v[:2] and not v[3])
    return {"method": method, "ties": _ties(votes, {method}), **share(counts, seed)}


def _pair(a: str, b: str, votes: list[list[Vote]], seed: int) -> PairShare:
    counts = _counts(votes, lambda v: v[0] == a, lambda v: {a, b} == set(v[:2]) and not v[3])
    return {"method": a, "against": b, "ties": _ties(votes, {a, b}), **share(counts, seed)}


def _ties(votes: list[list[Vote]], methods: set[str]) -> int:
    return sum(v[3] and methods <= set(v[:2]) for one in votes for v in one)


def _ambiguity(key: Key, raters: list[Rater], seed: int) -> Ambiguity | None:
    entries = {q: e for q, e in key.questions.items() if e["kind"] == KIND_PHOTO}
    if not entries:
        return None
    mine = [[a for a in r.answers if a.question in entries] for r in raters]
    rated = [[a for a in one if a.answer != "none"] for one in mine]
    rows = ((r.rater, a.question, int(a.answer)) for r, one in zip(raters, rated) for a in one)
    scenes = sorted({e["scene"] for e in entries.values()})
    of_scene = {s: [[a for a in one if entries[a.question]["scene"] == s] for one in mine] for s in scenes}
    return {
        "questions": len(entries),
        "answers": sum(map(len, mine)),
        "scenes": [{"scene": s, **_ratings(of_scene[s], seed)} for s in scenes],
        "photos": [
            {"scene": e["scene"], "view": e["view"],
             **_ratings([[a for a in one if a.question == q] for one in mine], seed)}
            for q, e in sorted(entries.items(), key=lambda item: (item[1]["scene"], item[1]["view"]))
        ],
        "agreement": agreement(rows, ordered=True),
    }  # fmt: skip


def _ratings(answers: list[list[Answer]], seed: int) -> Ratings:
    rated = [[int(a.answer) for a in one if a.answer != "none"] for one in answers]
    mean = ratio_interval([sum(one) for one in rated], [len(one) for one in rated], seed=seed)
    hard = share(_counts(rated, lambda v: v >= HARD, lambda v: True), seed)
    return {
        "mean": _number(mean.mean),
        "mean_low": _number(mean.low),
        "mean_high": _number(mean.high),
        "hard": hard["share"],
        "n": hard["n"],
        "low": hard["low"],
        "high": hard["high"],
        "raters_low": hard["raters_low"],
        "raters_high": hard["raters_high"],
        "none": sum(a.answer == "none" for one in answers for a in one),
        "outlined": sum(a.outline is True for one in answers for a in one),
    }


def _counts(groups: list[list[Any]], hit: Callable[[Any], bool], of: Callable[[Any], bool]) -> Counts:
    def two(members: Iterable[Any]) -> tuple[int, int]:
        valid = [m for m in members if of(m)]
        return sum(map(hit, valid)), len(valid)

    return np.array([two(one) for one in groups], dtype=int).reshape(-1, 2)


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
