"""Records of ablation.json: plain dicts with the keys of the file."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict


class StudyFacts(TypedDict):
    """Facts that two studies must share before one report can hold both."""

    method: str
    settings: list[str]  # on top of the defaults, in every row
    train: dict[str, Any]  # fields of `TrainConfig`; the seed is None
    scenes: list[str]
    seeds: list[int]


class GroupFacts(TypedDict):
    """A group of variants."""

    name: str
    title: str
    source: str  # in the paper; empty without


class Summary(TypedDict):
    """Mean and sample deviation over the runs of a variant; None = missing."""

    mean: float | None
    spread: float | None


class VariantRow(TypedDict):
    """A variant: its values, its differences to the default, its runs."""

    group: str
    variant: str
    settings: list[str]
    text: str
    status: Literal["ok", "failed", "missing"]
    reason: str  # of another status than ok
    same_as: str
    values: dict[str, Summary]  # by key of `plan.METRICS`
    differences: dict[str, Summary]  # by key of `plan.DIFFERENCES`
    runs: list[dict[str, Any]]  # scene, seed, folder, error, and every key of `plan.METRICS`


class StudyReport(StudyFacts):
    """ablation.json."""

    schema: int
    made_by: str  # the command
    note: NotRequired[str]  # what the method says about itself
    groups: list[GroupFacts]
    rows: list[VariantRow]
