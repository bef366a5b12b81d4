"""Bradley-Terry strengths from paired comparisons, with intervals over raters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.extras import install_command

# Regularisation, as if each pair had this fraction of one more answer for each side. It keeps the strength of
# a method that won every answer finite, and changes others by less than the printed digits.
PRIOR = 0.1


@dataclass(frozen=True)
class Strength:
    """One method of the ranking."""

    method: str
    strength: float  # log odds against an average method; the mean over methods is 0
    low: float  # 95 % over raters; NaN for a single rater
    high: float
    rank: int  # 1 = best
    rank_low: int  # best possible rank: 1 + number of significantly better methods
    rank_high: int  # worst possible rank


def bradley_terry(
    methods: list[str],
    wins: np.ndarray,  # [raters, methods, methods], wins[r, i, j]: r preferred i to j; a tie is 0.5 each
) -> tuple[list[Strength], str]:
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
    ranked = [
        Strength(
            methods[i],
            float(theta[i]),
            float(theta[i] - own[i]),
            float(theta[i] + own[i]),
            place,
            1 + int(better[:, i].sum()),
            len(methods) - int(better[i].sum()),
        )
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
