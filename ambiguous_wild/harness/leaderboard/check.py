"""Check a board: first its files, then an audit of its numbers."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.audit.finding import Finding
from ambiguous_wild.harness.audit.run import audit
from ambiguous_wild.harness.audit.table import Number
from ambiguous_wild.harness.leaderboard import pictures
from ambiguous_wild.harness.leaderboard.board import dataset_files, examine, files_of, measured
from ambiguous_wild.harness.leaderboard.entry import Entry
from ambiguous_wild.harness.measures import measure
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.metrics import stats

TRUTH = re.compile(r"(\+truth|@mask=truth)$")  # ends the name of a method that is given exact masks
HASH = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Checked:
    """What a check found."""

    runs: int
    problems: tuple[str, ...]  # wrong: one line each
    findings: tuple[Finding, ...]  # questions, see docs/audit.md


def check(board: Path) -> Checked:
    """Read everything again and compare.

    Raises:
        AwError: no board.
    """
    if not measured(board).is_dir():
        raise AwError(
            f"no leaderboard {board}, it has no folder 'measured': 'aw leaderboard add RUNS --board {board}' "
            "makes one"
        )
    try:
        entries, wrong = examine(board)
    except AwError as error:
        return Checked(0, (str(error),), ())
    problems = wrong or list(_files(board, entries))  # files differ by the rows that were changed
    problems += [*_hashes(entries), *_copies(entries), *_pictures(board, entries)]
    return Checked(len(entries), tuple(problems), tuple(audit(_numbers(entries))))


def _files(board: Path, entries: Sequence[Entry]) -> Iterator[str]:
    """Files that the runs do not give."""
    expected = files_of(board, entries)
    for path, text in expected.items():
        if not path.is_file():
            if entries:
                yield f"{path} is missing: 'aw leaderboard add' of any run writes it again"
        elif path.read_bytes() != text.encode():
            yield f"{path} is not what its runs give, it was changed by hand or half written: restore it"
    for path in dataset_files(board):
        if path not in expected:
            yield f"{path} holds no run: remove it"


def _hashes(entries: Iterable[Entry]) -> Iterator[str]:
    by_config: dict[str, Entry] = {}
    by_scene: dict[tuple[str, str], Entry] = {}
    for e in entries:
        for column in ("config_hash", "scene_hash", "result_hash"):
            if not HASH.fullmatch(getattr(e, column)):
                yield f"{e.name}: {column} {getattr(e, column)[:20]!a} is no sha256: restore the file"
        for column in ("source", "code_hash"):
            if getattr(e, column) and not HASH.fullmatch(getattr(e, column)):
                yield f"{e.name}: {column} {getattr(e, column)[:20]!a} is no sha256: restore the file"
        first = by_config.setdefault(e.config_hash, e)
        if first is not e:
            yield f"{e.name} and {first.name} have the same configuration hash: one is the other's copy"
        other = by_scene.setdefault((e.dataset, e.scene), e)
        if other.scene_hash != e.scene_hash:
            yield f"{e.name} is of another scene of that name than {other.name}: they do not compare"


def _copies(entries: Iterable[Entry]) -> Iterator[str]:
    """Seeds of one method and scene with the same numbers in all digits: a run is there twice."""
    seen: dict[object, Entry] = {}
    for e in entries:
        # Whole runs of noise-free reference rows may agree between methods; between seeds nothing does.
        values = tuple(sorted((k, v) for k, v in e.quality.items() if not k.startswith("mask_")))
        first = seen.setdefault((*e.key[:-1], values), e)
        if values and first is not e:
            yield f"{e.name} and seed {first.seed} have the same numbers in all digits: is it the same run?"


def _pictures(board: Path, entries: Iterable[Entry]) -> Iterator[str]:
    try:
        index = pictures.read_index(board)
    except AwError as error:
        yield str(error)
        return
    folder = pictures.folder_of(board)
    known = {e.key for e in entries}
    for row in index:
        path = folder / row["file"]
        if not path.is_file() or sha256_file(path) != row["sha256"]:
            yield f"picture {path} is missing or changed: restore it, or add its runs again"
        cell = (*(row[k] for k in ("dataset", "scene", "method", "setting", "options")), row["seed"])
        if row["method"] and cell not in {(*k[:5], str(k[5])) for k in known}:
            yield f"picture {path} is of no run on the board: remove it and its row in {pictures.INDEX}"
    listed = {folder / row["file"] for row in index}
    for path in sorted(p for p in folder.rglob("*") if p.suffix in (".jpg", ".png")):
        if path not in listed:
            yield f"picture {path} is not in {pictures.INDEX}: remove it, or add its runs again"


def _without_plain_oracles(entries: Sequence[Entry]) -> list[Entry]:
    """Without exact masks on scenes without distractors: they mask nothing, so the numbers are the host's."""
    hosts: dict[object, Entry] = {(*e.key[:2], e.setting, e.seed, e.method): e for e in entries}
    kept = []
    for e in entries:
        host = hosts.get((*e.key[:2], e.setting, e.seed, TRUTH.sub("", e.method)))
        clean = "mask_recall" not in e.quality and "psnr_covered" not in e.quality
        if host is None or host is e or not clean or not _same(e, host):
            kept.append(e)
    return kept


def _same(a: Entry, b: Entry) -> bool:
    """Whether all metrics of the pictures are equal in all digits."""
    left, right = ({k: v for k, v in e.quality.items() if not k.startswith("mask_")} for e in (a, b))
    return left == right


def _numbers(entries: Sequence[Entry]) -> list[Number]:
    """Means over seeds, as a table would print them: what an audit reads."""
    entries = _without_plain_oracles(entries)
    cells: dict[tuple[str, str, str, str], list[Entry]] = defaultdict(list)
    settings: dict[str, set[tuple[str, str]]] = defaultdict(set)
    for e in entries:
        settings[e.method].add((e.setting, e.options))
    for e in entries:
        # One name an entry: a method with several settings is several to an audit.
        about = ", ".join(filter(None, (e.setting, e.options)))
        name = e.method if len(settings[e.method]) == 1 else f"{e.method} ({about})"
        for metric in e.quality:
            cells[e.dataset, e.scene, name, metric].append(e)
    found = []
    for (dataset, scene, name, metric), runs in sorted(cells.items()):
        value, digits = stats.mean([e.quality[metric] for e in runs]), measure(metric).digits
        if abs(value) != float("inf"):
            where = f"{dataset}: {name} on {scene}"
            rounded = round(value, digits)
            found.append(
                Number(dataset, name, "", dataset, scene, metric, metric, rounded, digits, None, where)
            )
    return found
