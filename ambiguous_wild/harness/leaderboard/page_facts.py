"""What the page's scripts read: runs, pictures, methods, reported numbers with what the audit found."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from ambiguous_wild.harness.leaderboard.entry import ALONE, Entry, in_order
from ambiguous_wild.harness.leaderboard.reported import Reported
from ambiguous_wild.harness.leaderboard.sheet import to_number
from ambiguous_wild.harness.measures import PARTIAL, measure
from ambiguous_wild.methods.registry import knows_truth

COSTS = ("reference_s", "train_s", "model_mb", "fps", "gaussians", "peak_rss_mb")
TIMES = ("reference_s", "train_s", "fps")  # compare only between runs that had the machine alone
MASKS = ("mask_iou", "mask_precision", "mask_recall")
PRINTED_LABELS = {"lpips": "LPIPS", "memory": "memory", "gpu_hours": "GPU h", "fps": "FPS"}
LABELS = {
    "train_s": "training s", "reference_s": "reference s", "model_mb": "model MB",
    "peak_rss_mb": "peak memory MB",
}  # fmt: skip
COLUMNS = (
    "dataset", "scene", "method", "setting", "options", "seed", "images", "missing", "device", "hardware",
    "version", "source", "code_hash", "config_hash", "scene_hash", "result_hash", "checked", "reproduce",
)  # fmt: skip
# Code of the authors; papers are linked by the arXiv number that the method's entry names.
CODE = {
    "3dgs": "https://github.com/graphdeco-inria/gaussian-splatting",
    "absgs": "https://github.com/TY424/AbsGS",
    "desplat": "https://github.com/AaltoML/desplat",
    "dronesplat": "https://github.com/BITyia/DroneSplat",
    "mcmc": "https://github.com/ubc-vision/3dgs-mcmc",
    "pup-3dgs": "https://github.com/j-alex-hanson/gaussian-splatting-pup",
    "robustsplat": "https://github.com/fcyycf/RobustSplat",
    "wildgaussians": "https://github.com/jkulhanek/wild-gaussians",
}
PAPERS = {
    "3dgs": "https://arxiv.org/abs/2308.04079",
    "absgs": "https://arxiv.org/abs/2404.10484",
    "mcmc": "https://arxiv.org/abs/2404.09591",
    "pup-3dgs": "https://arxiv.org/abs/2406.10219",
}


def facts(
    entries: Sequence[Entry],
    index: Iterable[Mapping[str, str]],
    reported: Reported,
    files: list[str],
    models: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Any]:
    """The page's data, ready for JSON.

    Args:
        entries: runs of the board.
        index: rows of `pictures.read_index`.
        reported: numbers that papers print; may be empty.
        files: names of the CSVs beside the page.
        models: page that shows a run's model, by hash of its result.
    """
    order = in_order({k for e in entries for k in e.quality})
    missing = {k for e in entries for k in e.missing}
    measures = {
        k: {"label": LABELS.get(k, m.label), "better": m.better, "digits": m.digits}
        for k in (*order, *sorted(missing), *COSTS, "lpips_alex")
        for m in (measure(k),)
    }
    for n in reported.numbers:
        m = measure(n.metric)
        label = PRINTED_LABELS.get(n.metric, m.label)
        measures.setdefault(n.metric, {"label": label, "better": m.better, "digits": 3})
    return {
        "order": order,
        "partial": [*PARTIAL, *MASKS],
        "times": list(TIMES),
        "oracles": sorted({e.method for e in entries if knows_truth(e.method)}),
        "methods": {name: _method(name) for name in sorted({e.method for e in entries})},
        "measures": measures,
        "runs": [_run(e) for e in entries],
        "models": dict(models),
        "images": [
            {k: v for k, v in row.items() if k not in ("sha256", "psnr")}
            | {"psnr": _number(to_number(row["psnr"], "psnr"))}
            for row in index
        ],
        **reported.plain(),
        "files": files,
    }


def _run(e: Entry) -> dict[str, Any]:
    quality = dict(e.quality)
    if "mask_recall" not in quality:  # no distractor to find: an IoU of 0 says nothing
        quality = {k: v for k, v in quality.items() if k not in MASKS}
    alone = e.cost.get(ALONE)
    return {k: getattr(e, k) for k in COLUMNS} | {
        "quality": _numbers(quality),
        "cost": _numbers({k: v for k, v in e.cost.items() if k in COSTS}),
        "alone": None if alone is None else bool(alone),  # None: the load was not recorded
    }


def _method(name: str) -> dict[str, str]:
    """What a method is, with links; a name that this package does not know has none."""
    from ambiguous_wild.methods.registry import BUILTIN

    known = {entry.name: entry for entry in BUILTIN}
    entry = known.get(re.split("[@]", name)[0])
    if entry is None:
        return {"summary": "", "paper": "", "paper_url": "", "code_url": ""}
    number = re.search(r"arXiv (\d{4}\.\d{4,5})", entry.paper)
    url = f"https://arxiv.org/abs/{number[1]}" if number else PAPERS.get(entry.name, "")
    return {
        "summary": entry.summary, "paper": entry.paper, "paper_url": url,
        "code_url": CODE.get(entry.name, ""),
    }  # fmt: skip


def _numbers(values: Mapping[str, float]) -> dict[str, Any]:
    return {k: _number(v) for k, v in values.items()}


def _number(value: float) -> float | str | None:
    """As JSON has it: no NaN, no infinity."""
    if math.isfinite(value):
        return value
    return None if math.isnan(value) else str(value)
