"""Agreement between raters: Krippendorff's alpha (NLTK) and the share of equal answers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from ambiguous_wild.core import AwError
from ambiguous_wild.core.extras import install_command


@dataclass(frozen=True)
class Agreement:
    """Agreement over all questions that two or more raters answered."""

    alpha: float | None  # 1 = full agreement, 0 = chance; None = not defined
    equal: float | None  # share of rater pairs with the same answer to a question
    questions: int  # answered by two or more raters
    note: str = ""  # why alpha is not defined


def agreement(
    answers: Iterable[tuple[str, str, Any]],  # (rater, question, answer)
    *,
    ordered: bool,  # answers are numbers with distances: 1 is closer to 2 than to 5
) -> Agreement:
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
        return Agreement(None, None, 0, "no question was answered by two raters")
    equal = _equal(rows)
    if len({answer for _, _, answer in rows}) == 1:
        # alpha is 0/0 if all answers are equal
        return Agreement(None, equal, questions, "all answers are equal, so alpha is not defined")
    task, nominal, interval = _nltk()
    return Agreement(
        float(task(data=rows, distance=interval if ordered else nominal).alpha()), equal, questions
    )


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
