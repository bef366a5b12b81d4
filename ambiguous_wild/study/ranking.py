"""The scores as they are written to scores.json; agreement of raters and Bradley-Terry ranking."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, TypedDict

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.extras import install_command


class Counted(TypedDict):
    """Number of answers and two 95 % intervals of a share; None = not defined."""

    n: int
    low: float | None  # Wilson's interval: answers are independent
    high: float | None
    raters_low: float | None  # bootstrap over raters
    raters_high: float | None


class Share(Counted):
    """Share of decided answers; ties are not counted."""

    share: float | None


class MethodShare(Share):
    """How often raters preferred a method."""

    method: str
    ties: int


class SceneShare(MethodShare):
    """The same on one scene."""

    scene: str


class PairShare(MethodShare):
    """The same against one other method."""

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
    """One rater."""

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
    """Krippendorff's alpha, nominal or (`ordered`) interval, over questions with two or more answers.

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
    task, nominal, interval = _nltk()
    return _score(float(task(data=rows, distance=interval if ordered else nominal).alpha()), equal, questions)


def _score(alpha: float | None, equal: float | None, questions: int, note: str = "") -> AgreementScore:
    return {"alpha": alpha, "equal": equal, "questions": questions, "note": note}


def _equal(rows: list[tuple[str, str, Any]]) -> float:
    by_question: dict[str, Counter[Any]] = {}
    for _, question, answer in rows:
        by_question.setdefault(question, Counter())[answer] += 1
    same = sum(n * (n - 1) for counts in by_question.values() for n in counts.values())
    pairs = sum(c.total() * (c.total() - 1) for c in by_question.values())
    return same / pairs


def _nltk() -> tuple[Callable[..., Any], Callable[..., float], Callable[..., float]]:
    try:
        from nltk.metrics.agreement import AnnotationTask
        from nltk.metrics.distance import binary_distance, interval_distance
    except ImportError as error:
        raise AwError(
            f"scoring a study needs NLTK ({error}); install it with: {install_command('study')}"
        ) from None
    return AnnotationTask, binary_distance, interval_distance


# Regularisation, as if each pair had this fraction of one more answer for each side. It keeps the strength of
# a method that won every answer finite, and changes others by less than the printed digits.
PRIOR = 0.1


def bradley_terry(
    methods: list[str],
    wins: np.ndarray,  # [raters, methods, methods], wins[r, i, j]: r preferred i to j; a tie is 0.5 each
) -> tuple[list[Ranked], str]:
    """Maximum-likelihood strengths (choix); intervals by leaving out one rater at a time.

    Raters are resampled, because answers of one rater are correlated (jackknife, Student's t with raters - 1
    degrees of freedom).

    Returns:
        The methods from best to worst, and a note ("" = none). No strengths if some groups of methods were
        never compared.

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
    try:
        import choix
    except ImportError as error:
        raise AwError(
            f"ranking a study needs choix ({error}); install it with: {install_command('study')}"
        ) from None
    theta = choix.ilsr_pairwise_dense(wins, alpha=PRIOR, max_iter=1000)
    return theta - theta.mean()
