"""Publish a board: one index.html with CSV files and pictures beside it, made from the board's files alone.

The page's scripts read its data: runs, pictures, methods, reported numbers and the findings of the audit.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from urllib.parse import quote

from ambiguous_wild import __version__
from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import Facts
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.harness.chosen_effects import mixed_tests
from ambiguous_wild.harness.labels import shown_names
from ambiguous_wild.harness.measures import measure
from ambiguous_wild.harness.result_file import RESULT, encoded
from ambiguous_wild.harness.trained_models import TrainedModel, find_run_models, open_scene
from ambiguous_wild.io.files import (
    atomic_dir,
    check_output,
    folder_lock,
    list_names,
    refuse_foreign_files,
    sha256_file,
    sweep_siblings,
    write_json,
)
from ambiguous_wild.io.page_parts import fill_page
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.report import board_pictures
from ambiguous_wild.report.audit import audit
from ambiguous_wild.report.audit_numbers import REPORTED, AuditFinding, PrintedNumber, read_tables
from ambiguous_wild.report.board import (
    ALONE,
    FIRST,
    LAST,
    CsvValue,
    Entry,
    board_csv,
    files_of,
    in_order,
    read_board,
    slug,
    to_number,
)
from ambiguous_wild.report.suite import scene_facts
from ambiguous_wild.viewing.page_file import page_text

COSTS = ("reference_s", "train_s", "model_mb", "fps", "gaussians", "peak_rss_mb")
TIMES = ("reference_s", "train_s", "fps")  # comparable only between runs that had the machine alone
MASKS = ("mask_iou", "mask_precision", "mask_recall")
PRINTED_LABELS = {"lpips": "LPIPS", "memory": "memory", "gpu_hours": "GPU h", "fps": "FPS"}
LABELS = {
    "train_s": "training s", "reference_s": "reference s", "model_mb": "model MB",
    "peak_rss_mb": "peak memory MB",
}  # fmt: skip
COLUMNS = (*FIRST, *(k for k in LAST if k != "row_hash"))
# Code of the authors. Papers are linked by the arXiv number in the method's entry, else by PAPERS.
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
HALF = ", half images"  # in the setting of a run, see `board_reproduce.setting`
SOURCE = "reported"
SOURCES = "sources.json"
REPORTED_COLUMNS = (
    "source", "method", "setting", "dataset", "scene", "metric", "variant", "value", "printed", "table",
)  # fmt: skip
GENERATOR = '<meta name="generator" content="aw leaderboard publish">'
OURS = {"index.html", "data", "images", "models"}
MANIFEST = "data/files.json"  # every other file of the page
SCRIPTS = (
    "page_data.js", "page_table.js", "page_matrix.js", "page_runs.js", "page_plot.js", "page_compare.js",
    "page_reported.js", "page_main.js",
)  # fmt: skip
MODELS = "models"


def facts(
    entries: Sequence[Entry],
    index: Iterable[Mapping[str, str]],
    reported: Reported,
    files: list[str],
    models: Mapping[str, str] = MappingProxyType({}),
    shown: Mapping[str, str] = MappingProxyType({}),
) -> Facts:
    """Return the page's data, ready for JSON.

    Args:
        entries: runs of the board.
        index: rows of `board_pictures.read_index`.
        reported: numbers that papers print; may be empty.
        files: names of the CSV files beside the page.
        models: page that shows a run's model, by the hash of its result.
        shown: names of methods on the page; others keep theirs.
    """
    order = in_order({k for e in entries for k in e.quality})
    missing = {k for e in entries for k in e.missing}
    scenes = scene_facts({e.dataset for e in entries})
    measures: dict[str, dict[str, str | int | None]] = {
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
        # metrics that some images or scenes lack
        "partial": [*(k for k in (*order, *sorted(missing)) if measure(k).partial), *MASKS],
        "times": list(TIMES),
        "references": sorted({shown.get(e.method, e.method) for e in entries if knows_truth(e.method)}),
        # name -> summary, paper, links
        "methods": {shown.get(name, name): _method(name) for name in sorted({e.method for e in entries})},
        "measures": measures,
        "scenes": scenes,
        "runs": [_run(e, scenes) | {"method": shown.get(e.method, e.method)} for e in entries],
        "models": dict(models),
        "images": [
            {k: v for k, v in row.items() if k not in ("sha256", "psnr")}
            | {"psnr": encoded(to_number(row["psnr"], "psnr"))}
            | {"method": shown.get(row["method"], row["method"])}
            for row in index
        ],
        **reported.plain(),
        "files": files,
    }


def _run(e: Entry, scenes: Mapping[str, Mapping[str, Facts]]) -> Facts:
    quality = dict(e.quality)
    if "mask_recall" not in quality:  # the scene has no distractors: an IoU of 0 has no meaning
        quality = {k: v for k, v in quality.items() if k not in MASKS}
    alone = e.cost.get(ALONE)
    setting = e.setting
    if scenes.get(e.dataset, {}).get(e.scene, {}).get("half"):
        setting = setting.replace(HALF, "")  # that of the scene, for every method, and so no other setting
    return {k: getattr(e, k) for k in COLUMNS} | {
        "setting": setting,
        "quality": encoded(quality),
        "cost": encoded({k: v for k, v in e.cost.items() if k in COSTS}),
        "alone": None if alone is None else bool(alone),  # None: the load was not recorded
    }


def _method(name: str) -> dict[str, str]:
    """Return summary and links of a method; empty for a method that is not of this package."""
    from ambiguous_wild.methods.registry import BUILTIN

    entry = {entry.name: entry for entry in BUILTIN}.get(name.partition("@")[0])
    if entry is None:
        return {"summary": "", "paper": "", "paper_url": "", "code_url": ""}
    number = re.search(r"arXiv (\d{4}\.\d{4,5})", entry.paper)
    url = f"https://arxiv.org/abs/{number[1]}" if number else PAPERS.get(entry.name, "")
    code = CODE.get(entry.name, "")
    return {"summary": entry.summary, "paper": entry.paper, "paper_url": url, "code_url": code}


@dataclass(frozen=True)
class Reported:
    """Numbers that papers print, their sources, and the findings of `aw audit`."""

    numbers: tuple[PrintedNumber, ...] = ()
    findings: tuple[AuditFinding, ...] = ()
    sources: dict[str, dict[str, str]] = field(default_factory=dict)  # table -> title, venue, url, caption

    def plain(self) -> Facts:
        """Return the data for the page, which finds a number's findings by its place ("where")."""
        return {
            "reported": [
                {column: _plain(n, column) for column in (*REPORTED_COLUMNS[1:], "where")}
                for n in self.numbers
            ],
            "findings": [{"kind": f.kind, "text": f.text, "where": list(f.where)} for f in self.findings],
            "sources": self.sources,
        }


def read_reported(folder: Path) -> Reported:
    """Read every number of FOLDER/*.csv that names method and scene, in order; none without the folder.

    Raises:
        AwError: a file is unreadable or malformed.
    """
    if not folder.is_dir() or not any(folder.glob("*.csv")):
        return Reported()
    numbers = read_tables([folder])
    # the method "dataset" stands for facts about the photos themselves
    shown = [n for n in numbers if n.known and n.method != "dataset"]
    shown.sort(key=lambda n: (n.dataset, n.method, n.setting, n.scene, n.table, n.metric, n.variant))
    return Reported(tuple(shown), tuple(audit(numbers)), read_sources(folder / SOURCES))


def read_sources(path: Path) -> dict[str, dict[str, str]]:
    """Read title of the paper, link and caption of each table, from sources.json beside reported tables.

    Raises:
        AwError: the file is malformed.
    """
    if not path.is_file():
        return {}
    try:
        sources = json.loads(path.read_text(encoding="utf-8"))
        read = {}
        for name, about in sources["tables"].items():
            paper = sources["papers"][about["paper"]]
            read[str(name)] = {
                "caption": str(about.get("caption", "")),
                "title": str(paper.get("title", "")),
                "venue": str(paper.get("venue", "")),
                "url": _link(paper.get("url", "")),
            }
        return read
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise AwError(
            f'{path} is malformed: write {{"papers": {{ID: {{"title", "venue", "url"}}}}, '
            '"tables": {TABLE: {"paper": ID, "caption"}}}'
        ) from None


def _link(url: object) -> str:
    """Return an address that a page may link to; empty for anything else, such as javascript:."""
    text = str(url or "")
    return text if re.fullmatch(r"https?://[^\s\"'<>]+", text) else ""


def _plain(number: PrintedNumber, column: str) -> CsvValue:
    value: CsvValue = getattr(number, "text" if column == "printed" else column)
    return value


@dataclass(frozen=True)
class Published:
    """The numbers of things that the page shows."""

    runs: int
    datasets: int
    images: int
    reported: int
    reported_from: str | None = None  # the folder of reported numbers; None: not asked for
    model_pages: int = 0


def publish(
    board: Path,
    out: Path,
    *,
    reported: Path | bool | None = None,
    title: str = "Leaderboard",
    models: Sequence[Path] = (),
    labels: Sequence[str] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Published:
    """Write the page; an earlier page in `out` is replaced once the new one is complete.

    Args:
        board: folder of the leaderboard.
        out: folder for index.html, data/*.csv and images/.
        reported: also show numbers that papers print, from this folder; True = BOARD/reported, else the
            tables of this package.
        title: title of the page.
        models: run folders, or folders of them; their models are shown on OUT/models/*.html, as by `aw view`.
        labels: names of methods on the page, see `labels.shown_names`; CSV files and commands keep theirs.
        say: gets a line for each entry without a model there.

    Raises:
        AwError: the board is damaged, a label is wrong, or `out` holds something else.
    """
    if not board.is_dir():
        raise AwError(f"no leaderboard {board}: 'aw leaderboard add RUNS --board {board}' makes one")
    source = reported if isinstance(reported, Path) else None
    if source is not None and not source.is_dir():
        raise AwError(f"no folder of reported numbers {source}: give one with *.csv, see docs/tables.md")
    if reported is True:
        source = board / SOURCE if (board / SOURCE).is_dir() else REPORTED
    check_output(out)
    out = Path(os.path.realpath(out))
    with folder_lock(out, "aw leaderboard publish"):
        sweep_siblings(out)  # puts the old page back if a call was killed while it replaced it
        _check_folder(out)
        entries, index = read_board(board), board_pictures.read_index(board)
        shown = shown_names(labels, [e.method for e in entries])
        named = [replace(e, method=shown[e.method]) for e in entries]
        printed = read_reported(source) if source is not None else Reported()
        with atomic_dir(out) as folder:
            names = _write_data(board, folder / "data", entries, printed.numbers)
            for row in index:
                _copy_picture(
                    board_pictures.folder_of(board) / row["file"],
                    folder / "images" / row["file"],
                    row["sha256"],
                )
            links, pages = write_model_pages(named, models, folder, say) if models else ({}, 0)
            text = page(title, facts(entries, index, printed, names, links, shown))
            (folder / "index.html").write_text(text, encoding="utf-8")
            write_json(folder / MANIFEST, list_names(folder))
    return Published(
        runs=len(entries),
        datasets=len({e.dataset for e in entries}),
        images=len(index),
        reported=len(printed.numbers),
        reported_from=None if source is None else str(source),
        model_pages=pages,
    )


def _check_folder(out: Path) -> None:
    """Check that the folder is absent, empty, or holds nothing but an earlier page."""
    if not out.exists():
        return
    if not out.is_dir():
        raise AwError(f"{out} is a file; choose another -o")
    names, earlier = {p.name for p in out.iterdir()}, out / "index.html"
    head = earlier.read_text(encoding="utf-8", errors="replace")[:2000] if earlier.is_file() else ""
    if names and (GENERATOR not in head or names - OURS):
        odd = sorted(names - OURS)[0] if names - OURS else "another page"
        raise AwError(f"{out} holds other files than a published board ({odd}); choose another -o")
    try:
        written = json.loads((out / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return  # a page of an early version
    if isinstance(written, list):
        refuse_foreign_files(out, {MANIFEST, *map(str, written)})


def _write_data(
    board: Path, folder: Path, entries: Sequence[Entry], printed: Sequence[PrintedNumber]
) -> list[str]:
    folder.mkdir()
    files = {path.name: text for path, text in files_of(board, entries).items()}
    if printed:
        rows = ([SOURCE, *(_plain(n, column) for column in REPORTED_COLUMNS[1:])] for n in printed)
        files["reported.csv"] = board_csv(REPORTED_COLUMNS, rows)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return list(files)


def _copy_picture(source: Path, target: Path, digest: str) -> None:
    if not source.is_file() or sha256_file(source) != digest:
        raise AwError(
            f"picture {source} is missing or changed: restore it, or add its runs again with "
            "'aw leaderboard add'"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def page(title: str, data: Facts) -> str:
    """Return the page; data and title remain text, whatever they hold."""
    # a picture beside a file:// page is not 'self' in every browser
    template = Path(__file__).resolve().parent / "page"
    return fill_page(template, data, SCRIPTS, title=title, images="'self' file: data:", sort_keys=True)


Say = Callable[[str], None]


def write_model_pages(
    entries: Sequence[Entry], runs: Sequence[Path], out: Path, say: Say
) -> tuple[dict[str, str], int]:
    """Write OUT/models/*.html from run folders whose results are on the board.

    A method with its setting is shown by the lowest seed that has a model below `runs`.

    Args:
        entries: runs of the board.
        runs: run folders, or folders of them.
        out: folder of the published page.
        say: gets a line for each method without a model.

    Returns:
        The link to each run's entry, relative to index.html, by the hash of its result; and how many pages.

    Raises:
        AwError: no run with a model below `runs`, or a scene is not where its run says.
    """
    trained, notes = find_run_models(runs)
    for note in notes:
        say(note)
    by_hash = {sha256_file(t.run / RESULT): t for t in trained}
    links: dict[str, str] = {}
    names: set[str] = set()
    in_scene = grouped(sorted(entries, key=lambda e: e.key), lambda e: (e.dataset, e.scene))
    for (dataset, scene), of_scene in in_scene.items():
        groups = grouped(of_scene, _label)
        shown: list[tuple[str, TrainedModel]] = []
        for label, of_group in groups.items():
            at_hand = [by_hash[e.result_hash] for e in of_group if e.result_hash in by_hash]
            shown += [(label, at_hand[0])] if at_hand else []
            if not at_hand:
                say(f"no model of {label} on {scene}: its run is not below the given folders")
        if not shown:
            continue
        # a page shows one state of the scene: another machine may have estimated other poses
        for of_state in grouped(shown, lambda pair: pair[1].scene_hash).values():
            name = _page_name(dataset, scene, names)
            # readers of the board have not the runs that a command would train on
            models = [replace(f.model, label=label, retrain="") for label, f in of_state]
            opened = open_scene(of_state[0][1].run)
            text, _ = page_text(opened, models, title=f"{dataset}: {scene}", mixed=mixed_tests(opened))
            (out / MODELS).mkdir(exist_ok=True)
            (out / MODELS / name).write_text(text, encoding="utf-8")
            for label, _ in of_state:
                for entry in groups[label]:
                    links[entry.result_hash] = f"{MODELS}/{name}#left={quote(label, safe='')}"
    return links, len(names)


def _label(entry: Entry) -> str:
    return f"{entry.method} ({entry.setting})" + (f" {entry.options}" if entry.options else "")


def _page_name(dataset: str, scene: str, taken: set[str]) -> str:
    """Return a file name that is not taken; names of scenes may hold any characters."""
    stem = f"{slug(dataset)}-{slug(scene)}".strip("-") or "scene"
    name, number = f"{stem}.html", 1
    while name in taken:
        number += 1
        name = f"{stem}-{number}.html"
    taken.add(name)
    return name
