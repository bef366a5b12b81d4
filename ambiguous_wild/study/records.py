"""The scores of a study, as they are written to scores.json."""

from __future__ import annotations

from typing import TypedDict


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
    """One method of the ranking, see `ranking.Strength`."""

    method: str
    strength: float
    low: float | None
    high: float | None
    rank: int
    rank_low: int
    rank_high: int


class AgreementScore(TypedDict):
    """Agreement of raters, see `agreement.Agreement`."""

    alpha: float | None
    equal: float | None
    questions: int
    note: str


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
