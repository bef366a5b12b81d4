"""Compute the scores of a study from answers and key, as they are written to scores.json.

They are shares of preference, a Bradley-Terry ranking, ratings, and the agreement of raters.
"""

from __future__ import annotations

import importlib
import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import combinations
from statistics import median
from typing import Any, TypedDict

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import install_command
from ambiguous_wild.metrics.ambiguity import ratio_interval
from ambiguous_wild.study.answers import KIND_PAIR, KIND_PHOTO, TOO_FAST_S, Answer, Key, Rater

# Regularisation, like this fraction of an extra answer for each side of every pair. It keeps the strength of
# a method that won every answer finite, and changes others by less than the printed digits.
PRIOR = 0.1
HARD = 4  # of 5: a photo rated this or more is hard


class Counted(TypedDict):
    """Number of answers and two 95 % intervals of a share; None = not defined."""

    n: int
    low: float | None  # Wilson's interval: answers are independent
    high: float | None
    raters_low: float | None  # bootstrap over raters
    raters_high: float | None


class Share(Counted):
    """A share of decided answers, without ties."""

    share: float | None


class MethodShare(Share):
    """How often raters preferred a method."""

    method: str
    ties: int


class SceneShare(MethodShare):
    """How often raters preferred a method on one scene."""

    scene: str


class PairShare(MethodShare):
    """How often raters preferred a method to one other method."""

    against: str


class Ranked(TypedDict):
    """One method of the ranking."""

    method: str
    strength: float  # log odds against an average method; the mean over methods is 0
    low: float | None  # 95 % over raters; None for a single rater
    high: float | None
    rank: int  # 1 = best
    rank_low: int  # best possible rank: 1 + number of significantly better methods
    rank_high: int  # worst possible rank


class AgreementScore(TypedDict):
    """Agreement over all questions that two or more raters answered."""

    alpha: float | None  # 1 = full agreement, 0 = chance; None = not defined
    equal: float | None  # share of rater pairs with the same answer to a question
    questions: int  # answered by two or more raters
    note: str  # why alpha is not defined


class Preference(TypedDict):
    """Scores of the questions about pairs of renders."""

    questions: int
    answers: int
    methods: list[MethodShare]
    scenes: list[SceneShare]
    pairs: list[PairShare]
    ranking: list[Ranked]
    ranking_note: str
    left: Share  # how often the left image was preferred
    agreement: AgreementScore


class Ratings(Counted):
    """Ratings from 1 (easy to see) to 5; intervals and n are those of `hard`."""

    mean: float | None
    mean_low: float | None
    mean_high: float | None
    hard: float | None  # share rated `scores.HARD` or more
    none: int  # answers "see nothing move"
    outlined: int  # answers given after the distractor's outline was shown


class SceneRatings(Ratings):
    """Ratings of all photos of one scene."""

    scene: str


class PhotoRatings(SceneRatings):
    """Ratings of one photo."""

    view: str


class Ambiguity(TypedDict):
    """Scores of the questions about photos."""

    questions: int
    answers: int
    scenes: list[SceneRatings]
    photos: list[PhotoRatings]
    agreement: AgreementScore


class RaterSummary(TypedDict):
    """The numbers of one rater."""

    rater: str
    name: str
    answers: int
    asked: int
    too_fast: int  # of the answers; left out of the scores
    outlined: int  # answers given after the distractor's outline was shown
    median_s: float
    file: str


class Scores(TypedDict):
    """All scores of a study; None where the study has no such questions."""

    study: str
    title: str
    seed: int
    too_fast_s: dict[str, float]  # kind -> seconds below which an answer is left out
    raters: list[RaterSummary]
    preference: Preference | None
    ambiguity: Ambiguity | None


def agreement(
    answers: Iterable[tuple[str, str, Any]],  # (rater, question, answer)
    *,
    ordered: bool,  # answers are numbers with distances: 1 is closer to 2 than to 5
) -> AgreementScore:
    """Compute Krippendorff's alpha, nominal or (`ordered`) interval, over questions with several answers.

    Source: Krippendorff, Computing Krippendorff's Alpha-Reliability (2011); computed by NLTK.

    Raises:
        AwError: NLTK is not installed.
    """
    rows = list(answers)
    per_question = Counter(question for _, question, _ in rows)
    rows = [row for row in rows if per_question[row[1]] > 1]
    questions = sum(n > 1 for n in per_question.values())
    if not rows:
        return _score(None, None, 0, "no question was answered by two raters")
    equal = _equal(rows)
    if len({answer for _, _, answer in rows}) == 1:
        # alpha is 0/0 if all answers are equal
        return _score(None, equal, questions, "all answers are equal, so alpha is not defined")
    nltk, distances = (
        _needed(f"nltk.metrics.{m}", "scoring a study needs NLTK") for m in ("agreement", "distance")
    )
    distance = distances.interval_distance if ordered else distances.binary_distance
    return _score(float(nltk.AnnotationTask(data=rows, distance=distance).alpha()), equal, questions)


def _score(alpha: float | None, equal: float | None, questions: int, note: str = "") -> AgreementScore:
    return {"alpha": alpha, "equal": equal, "questions": questions, "note": note}


def _equal(rows: list[tuple[str, str, Any]]) -> float:
    by_question: dict[str, Counter[Any]] = {}
    for _, question, answer in rows:
        by_question.setdefault(question, Counter())[answer] += 1
    same = sum(n * (n - 1) for counts in by_question.values() for n in counts.values())
    pairs = sum(c.total() * (c.total() - 1) for c in by_question.values())
    return same / pairs


def _needed(module: str, why: str) -> Any:
    """Import a module of the extra [study]; raise AwError with `why` if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise AwError(f"{why} ({error}); install it with: {install_command('study')}") from None


def bradley_terry(
    methods: list[str],
    wins: np.ndarray,  # [raters, methods, methods], wins[r, i, j]: r preferred i to j; a tie is 0.5 each
) -> tuple[list[Ranked], str]:
    """Compute maximum-likelihood strengths (choix), with intervals by leaving out one rater at a time.

    Raters are left out, not answers, because the answers of one rater are correlated (jackknife, Student's t
    with raters - 1 degrees of freedom).

    Returns:
        The methods from best to worst, and a note ("" = none). There are no strengths if some groups of
        methods were never compared with each other.

    Raises:
        AwError: choix is not installed.
    """
    from scipy.sparse.csgraph import connected_components
    from scipy.stats import t as student

    total = wins.sum(axis=0)
    parts, _ = connected_components(total > 0, directed=True, connection="weak")
    if parts > 1:
        return [], f"no ranking: no answer compares the methods of {parts} groups with each other"
    strong, _ = connected_components(total > 0, directed=True, connection="strong")
    theta = _fit(total)
    count = len(wins)
    spread = np.full((len(methods), len(methods)), np.nan)
    own = np.full(len(methods), np.nan)
    if count > 1:
        left_out = np.array([_fit(total - one) for one in wins])
        factor = student.ppf(0.975, count - 1) * np.sqrt((count - 1) / count)
        own = factor * np.sqrt(((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0))
        differences = left_out[:, :, None] - left_out[:, None, :]
        spread = factor * np.sqrt(((differences - differences.mean(axis=0)) ** 2).sum(axis=0))
    better = (theta[:, None] - theta[None, :]) > spread  # [i, j]: i is better than j; False where NaN
    order = np.argsort(-theta, kind="stable")
    ranked: list[Ranked] = [
        {
            "method": methods[i],
            "strength": float(theta[i]),
            "low": None if count < 2 else float(theta[i] - own[i]),
            "high": None if count < 2 else float(theta[i] + own[i]),
            "rank": place,
            "rank_low": 1 + int(better[:, i].sum()),
            "rank_high": len(methods) - int(better[i].sum()),
        }
        for place, i in enumerate(order, start=1)
    ]
    notes = []
    if strong > 1:
        notes.append("some methods won every answer against others: their distance is a lower bound")
    if count < 2:
        notes.append("no intervals, because there is only one rater")
    return ranked, "; ".join(notes)


def _fit(wins: np.ndarray) -> np.ndarray:
    choix = _needed("choix", "ranking a study needs choix")
    theta = choix.ilsr_pairwise_dense(wins, alpha=PRIOR, max_iter=1000)
    return theta - theta.mean()


Counts = np.ndarray  # [raters, 2]: successes, trials


def score(key: Key, raters: list[Rater], seed: int = 0) -> Scores:
    """Compute all scores of a study, as written to scores.json; None = not defined.

    Answers that were too fast are left out of every score, and counted in each rater's summary.

    Args:
        key: key of the study.
        raters: at least one, from `read_answers`.
        seed: seed of the bootstrap over raters.
    """
    kept = [replace(r, answers=tuple(a for a in r.answers if not a.too_fast)) for r in raters]
    kept = [r for r in kept if r.answers]  # a rater without answers must not change intervals
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
    """Compute a share with two 95 % intervals: Wilson's (independent answers), and a bootstrap over raters.

    Args:
        counts: successes and trials of each rater.
        seed: seed of the bootstrap.
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


Vote = tuple[str, str, str, bool]  # (winner, loser, scene, tie); for a tie the methods x and y


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
