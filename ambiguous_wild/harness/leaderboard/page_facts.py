"""What the page's scripts read: runs, pictures, methods, reported numbers with what the audit found."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ambiguous_wild import __version__
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.audit.checks import audit
from ambiguous_wild.harness.audit.table import Finding, Number, read_tables
from ambiguous_wild.harness.leaderboard.board import ALONE, CsvValue, Entry, board_csv, in_order, to_number
from ambiguous_wild.harness.measures import measure
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
        "date": datetime.now(UTC).date().isoformat(),
        "version": __version__,
        "order": order,
        "partial": [*(k for k in (*order, *sorted(missing)) if measure(k).partial), *MASKS],
        "times": list(TIMES),
        "references": sorted({e.method for e in entries if knows_truth(e.method)}),
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


SOURCE = "reported"
SOURCES = "sources.json"
REPORTED_COLUMNS = (
    "source",
    "method",
    "setting",
    "dataset",
    "scene",
    "metric",
    "variant",
    "value",
    "printed",
    "table",
)


@dataclass(frozen=True)
class Reported:
    """What papers print, where it stands, and what `aw audit` found in it."""

    numbers: tuple[Number, ...] = ()
    findings: tuple[Finding, ...] = ()
    sources: dict[str, dict[str, str]] = field(default_factory=dict)  # table -> title, venue, url, caption

    def plain(self) -> dict[str, Any]:
        """For the page: findings are looked up by the place of a number."""
        return {
            "reported": [
                {column: _plain(n, column) for column in (*REPORTED_COLUMNS[1:], "where")}
                for n in self.numbers
            ],
            "findings": [{"kind": f.kind, "text": f.text, "where": list(f.where)} for f in self.findings],
            "sources": self.sources,
        }


def read_reported(folder: Path) -> Reported:
    """Every number of FOLDER/*.csv that says method and scene, in order; none without the folder.

    Raises:
        AwError: a file that is unreadable or malformed.
    """
    if not folder.is_dir() or not any(folder.glob("*.csv")):
        return Reported()
    numbers = read_tables([folder])
    # of no method: what the text says of the photos
    found = [n for n in numbers if n.known and n.method != "dataset"]
    found.sort(key=lambda n: (n.dataset, n.method, n.setting, n.scene, n.table, n.metric, n.variant))
    return Reported(tuple(found), tuple(audit(numbers)), read_sources(folder / SOURCES))


def read_sources(path: Path) -> dict[str, dict[str, str]]:
    """Table -> title of its paper, link and caption, from the sources.json beside reported tables.

    Raises:
        AwError: it is there and not of that form.
    """
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        papers, tables = found["papers"], found["tables"]
        return {
            str(name): {
                "caption": str(about.get("caption", "")),
                "title": str(papers[about["paper"]].get("title", "")),
                "venue": str(papers[about["paper"]].get("venue", "")),
                "url": _link(papers[about["paper"]].get("url", "")),
            }
            for name, about in tables.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise AwError(
            f'{path} is malformed: write {{"papers": {{ID: {{"title", "venue", "url"}}}}, '
            '"tables": {TABLE: {"paper": ID, "caption"}}}'
        ) from None


def _link(url: object) -> str:
    """An address that a page may link to; empty for anything else, such as javascript:."""
    text = str(url or "")
    return text if re.fullmatch(r"https?://[^\s\"'<>]+", text) else ""


def reported_csv(numbers: Sequence[Number]) -> str:
    """One number a row, each marked as reported; beside the value how it is printed."""
    rows = ([SOURCE, *(_plain(n, column) for column in REPORTED_COLUMNS[1:])] for n in numbers)
    return board_csv(REPORTED_COLUMNS, rows)


def _plain(number: Number, column: str) -> CsvValue:
    value: CsvValue = getattr(number, "text" if column == "printed" else column)
    return value
