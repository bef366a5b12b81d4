"""The page: one index.html with CSVs and pictures beside it, made from the board's CSVs alone."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.audit.table import REPORTED, Number
from ambiguous_wild.harness.leaderboard import pictures
from ambiguous_wild.harness.leaderboard.board import Entry, files_of, read_board, slug
from ambiguous_wild.harness.leaderboard.page_facts import (
    SOURCE,
    Reported,
    facts,
    read_reported,
    reported_csv,
)
from ambiguous_wild.harness.running.result_file import RESULT
from ambiguous_wild.harness.showing.read import Found, find_models, open_scene
from ambiguous_wild.io.atomic import atomic_dir, check_output, list_names, sweep_siblings, write_json
from ambiguous_wild.io.atomic import refuse_foreign_files as refuse_strangers
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.io.lock import folder_lock
from ambiguous_wild.io.page_parts import fill_page
from ambiguous_wild.viewing.page_file import page_text

GENERATOR = '<meta name="generator" content="aw leaderboard publish">'
OURS = {"index.html", "data", "images", "models"}
MANIFEST = "data/files.json"  # every other file of the page
SCRIPTS = (
    "page_data.js", "page_table.js", "page_matrix.js", "page_runs.js", "page_plot.js", "page_compare.js",
    "page_reported.js", "page_main.js",
)  # fmt: skip


@dataclass(frozen=True)
class Published:
    """What the page shows."""

    runs: int
    datasets: int
    images: int
    reported: int
    reported_from: str | None = None  # the folder that was looked into; None: not asked for
    model_pages: int = 0


def publish(
    board: Path,
    out: Path,
    *,
    reported: bool = False,
    reported_from: Path | None = None,
    title: str = "Leaderboard",
    models: Sequence[Path] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Published:
    """Write the page; an earlier page in `out` is replaced once the new one is whole.

    Args:
        board: folder of the leaderboard.
        out: for index.html, data/*.csv and images/.
        reported: show what papers print, too: BOARD/reported/*.csv, else the tables of this package.
        reported_from: show what papers print, too, from this folder.
        title: of the page.
        models: run folders, or folders of them; their models go into pages of `aw view`, OUT/models/*.html.
        say: told which entries have no model there.

    Raises:
        AwError: the board is damaged, or `out` holds something else.
    """
    if not board.is_dir():
        raise AwError(f"no leaderboard {board}: 'aw leaderboard add RUNS --board {board}' makes one")
    if reported_from is not None and not reported_from.is_dir():
        raise AwError(
            f"no folder of reported numbers {reported_from}: give one with *.csv, see docs/audit.md"
        )
    source = reported_from
    if reported and source is None:
        source = board / SOURCE if (board / SOURCE).is_dir() else REPORTED
    check_output(out)
    out = Path(os.path.realpath(out))
    with folder_lock(out, "aw leaderboard publish"):
        _restore(out)
        _check_folder(out)
        sweep_siblings(out)
        entries, index = read_board(board), pictures.read_index(board)
        printed = read_reported(source) if source is not None else Reported()
        with atomic_dir(out) as folder:
            names = _write_data(board, folder / "data", entries, printed.numbers)
            for row in index:
                _copy_picture(
                    pictures.folder_of(board) / row["file"], folder / "images" / row["file"], row["sha256"]
                )
            pages = write_model_pages(entries, models, folder, say) if models else ModelPages({}, 0)
            text = page(title, facts(entries, index, printed, names, pages.links))
            (folder / "index.html").write_text(text, encoding="utf-8")
            write_json(folder / MANIFEST, list_names(folder))
    return Published(
        runs=len(entries),
        datasets=len({e.dataset for e in entries}),
        images=len(index),
        reported=len(printed.numbers),
        reported_from=None if source is None else str(source),
        model_pages=pages.pages,
    )


def _restore(out: Path) -> None:
    """Put the old page back where a killed call had moved it away and not yet the new one in."""
    if out.exists():
        return
    for left in sorted(out.parent.glob(f".{out.name}.old-*")):
        if (left / out.name / "index.html").is_file():
            os.replace(left / out.name, out)
            return


def _check_folder(out: Path) -> None:
    if not out.exists():
        return
    if not out.is_dir():
        raise AwError(f"{out} is a file; choose another -o")
    names = {p.name for p in out.iterdir()}
    page_there = out / "index.html"
    made = (
        page_there.is_file() and GENERATOR in page_there.read_text(encoding="utf-8", errors="replace")[:2000]
    )
    if names and (not made or names - OURS):
        odd = sorted(names - OURS)[0] if names - OURS else "another page"
        raise AwError(f"{out} holds something else than a published board ({odd}); choose another -o")
    known = _published(out)
    if known is not None:
        refuse_strangers(out, known)


def _published(out: Path) -> set[str] | None:
    """What the last publish wrote there; None for a page of before it kept a list."""
    try:
        found = json.loads((out / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return {MANIFEST, *map(str, found)} if isinstance(found, list) else None


def _write_data(board: Path, folder: Path, entries: Sequence[Entry], printed: Sequence[Number]) -> list[str]:
    folder.mkdir()
    files = {path.name: text for path, text in files_of(board, entries).items()}
    if printed:
        files["reported.csv"] = reported_csv(printed)
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


def page(title: str, known: Mapping[str, Any]) -> str:
    """The page; data and title can be anything and stay text."""
    # A picture beside a file:// page is not 'self' in every browser.
    here = Path(__file__).resolve().parent
    return fill_page(here, known, SCRIPTS, title=title, images="'self' file: data:", sort_keys=True)


MODELS = "models"
Say = Callable[[str], None]


@dataclass(frozen=True)
class ModelPages:
    """What was written."""

    links: dict[str, str]  # by the result hash of a run: where its entry is shown, relative to index.html
    pages: int


def write_model_pages(entries: Sequence[Entry], runs: Sequence[Path], out: Path, say: Say) -> ModelPages:
    """Write OUT/models/*.html from run folders whose results are on the board.

    Of an entry (a method with its setting) the lowest seed that is at hand is shown.

    Args:
        entries: of the board.
        runs: run folders, or folders of them.
        out: folder of the published page.
        say: told which entries have no model at hand.

    Raises:
        AwError: no run with a model below `runs`, or a scene that is not where its run says.
    """
    found, notes = find_models(runs)
    for note in notes:
        say(note)
    by_hash = {sha256_file(f.run / RESULT): f for f in found}
    scenes: dict[tuple[str, str], dict[str, list[Entry]]] = {}
    for entry in sorted(entries, key=lambda e: e.key):
        label = f"{entry.method} ({entry.setting})" + (f" {entry.options}" if entry.options else "")
        scenes.setdefault((entry.dataset, entry.scene), {}).setdefault(label, []).append(entry)
    links: dict[str, str] = {}
    names: set[str] = set()
    for (dataset, scene), groups in scenes.items():
        shown: list[tuple[str, Found]] = []
        for label, of_group in groups.items():
            at_hand = [e for e in of_group if e.result_hash in by_hash]
            if not at_hand:
                say(f"no model of {label} on {scene}: its run is not below the folders given")
                continue
            chosen = at_hand[0]
            shown.append((label, by_hash[chosen.result_hash]))
        if not shown:
            continue
        if len({f.scene_hash for _, f in shown}) > 1:
            raise AwError(f"runs on scene {scene!r} of {dataset!r} saw different photos: publish them apart")
        name = _page_name(dataset, scene, names)
        models = [replace(f.model, label=label) for label, f in shown]
        text, _, _ = page_text(open_scene(shown[0][1].run), models, title=f"{dataset}: {scene}")
        (out / MODELS).mkdir(exist_ok=True)
        (out / MODELS / name).write_text(text, encoding="utf-8")
        for label, _ in shown:
            for entry in groups[label]:
                links[entry.result_hash] = f"{MODELS}/{name}#left={quote(label, safe='')}"
    return ModelPages(links, len(names))


def _page_name(dataset: str, scene: str, taken: set[str]) -> str:
    """A file name nobody has yet; names of scenes can be anything."""
    stem = f"{slug(dataset)}-{slug(scene)}".strip("-") or "scene"
    name, number = f"{stem}.html", 1
    while name in taken:
        number += 1
        name = f"{stem}-{number}.html"
    taken.add(name)
    return name
