"""What ablation.json holds, and the columns of its tables: read without the code that plans and trains."""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict

from ambiguous_wild.core.config import Facts
from ambiguous_wild.harness.measures import MASK_LABELS, Measure, measure
from ambiguous_wild.harness.result_file import TrainRecord

REPORT = "ablation.json"
# The columns of the tables; keys as in ablation.json.
METRICS = (
    *map(measure, ("psnr", "ssim", "lpips_alex")),
    *(Measure(key, f"mask {label}", "higher", 3) for key, label in MASK_LABELS.items()),
    *map(measure, ("gaussians", "model_mb", "ms_per_iteration", "setup_s")),
    Measure("total_s", "total s", "lower", 1, per_image=False, timed=True),
)
DIFFERENCES = tuple(m for m in METRICS if m.key in ("psnr", "iou", "ms_per_iteration"))


class StudyFacts(TypedDict):
    """Facts in which two studies must agree before one report can hold both."""

    method: str
    settings: list[str]  # that replace defaults in every row
    train: TrainRecord
    scenes: list[str]
    seeds: list[int]


class GroupFacts(TypedDict):
    """A group of variants."""

    name: str
    title: str
    source: str  # table or section of the paper; empty if there is none


class SummaryRecord(TypedDict):
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
    reason: str  # why the status is not ok
    same_as: str  # the row that has the same runs; empty if there is none
    values: dict[str, SummaryRecord]  # by the keys of `METRICS`
    differences: dict[str, SummaryRecord]  # by the keys of `DIFFERENCES`
    runs: list[Facts]  # scene, seed, folder, error, untimed (why times are not ranked), and `METRICS`


class StudyReport(StudyFacts):
    """The content of ablation.json."""

    schema: int
    made_by: str  # the command
    note: NotRequired[str]  # of the method, about itself
    groups: list[GroupFacts]
    rows: list[VariantRow]
