"""The leaderboard as CSV files: its rows, the hashes that protect them, reading and writing.

Texts are escaped so that spreadsheets do not calculate them, and read back unchanged.
"""

from __future__ import annotations

import hashlib
import math
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.core.names import plain
from ambiguous_wild.harness.measures import MEASURES
from ambiguous_wild.io.files import write_text
from ambiguous_wild.report import plain_formats
from ambiguous_wild.report.plain_formats import shortest

FORMULA = ("=", "+", "-", "@")
LARGEST = 200_000_000  # bytes
LONGEST = 200  # characters of a name
CsvValue = str | int | float | None
FIRST = ("dataset", "scene", "method", "setting", "options", "seed", "images")
LAST = (
    "missing", "device", "hardware", "version", "source", "code_hash", "config_hash", "scene_hash",
    "result_hash", "checked", "reproduce", "row_hash",
)  # fmt: skip
FUNCTIONS = "metric_functions"  # a column of boards with users' metrics, absent from others
NO_TEXT = ("seed", "images", "missing", "checked", "row_hash")  # columns that are not plain text
COST = "cost_"  # prefix of columns with costs; all other columns with numbers are qualities
ALONE = "alone"  # the cost that is 1 if the run had the machine alone, else 0
TIDY = (
    "dataset", "scene", "method", "setting", "options", "seed", "kind", "metric", "value", "device",
    "version", "source", "config_hash", "scene_hash", "checked",
)  # fmt: skip
CHECKED: tuple[Checked, ...] = ("files", "psnr", "photos")  # from weak to strong
ALL = "all"


def guard(text: str) -> str:
    """Return the text, with an apostrophe in front if a spreadsheet would calculate it.

    A text that begins with an apostrophe gets a second one, so that `unguard` can remove the first.
    """
    begins = text.lstrip()[:1]
    return "'" + text if begins in FORMULA or text[:1] in ("'", "\t", "\r", "\n") else text


def unguard(cell: str) -> str:
    """Return the text that `guard` was given."""
    return cell.removeprefix("'")


def number(value: float | None) -> str:
    """Return the fewest digits that read back as the same number; empty if it is missing."""
    if value is None or math.isnan(value):
        return ""
    return str(value) if isinstance(value, int) else shortest(value)


def board_csv(head: Sequence[str], rows: Iterable[Sequence[CsvValue]]) -> str:
    """Return CSV with texts guarded, numbers as numbers, and empty cells for None."""
    return plain_formats.to_csv(head, rows, text=guard, number=shortest)


def read_csv(path: Path, required: Sequence[str]) -> tuple[list[str], list[dict[str, str]]]:
    """Read (columns, rows) of a file that `board_csv` wrote; cells are unchanged, see `unguard`.

    Raises:
        AwError: the file is unreadable or malformed, or lacks a required column.
    """
    advice = "it is no file of a leaderboard, or was changed by hand: restore it from your version control"
    head, rows = plain_formats.read_csv(path, required, LARGEST, advice)
    return head, [cells for _, cells in rows]


def to_count(text: str, where: str) -> int:
    """Return the whole number from 0 on in a cell.

    Raises:
        AwError: the cell holds no such number, or one of more than 18 digits.
    """
    if not (text.isascii() and text.isdigit()) or len(text) > 18:
        raise AwError(f"{where} {text[:40]!a} is no count; restore the file")
    return int(text)


def to_number(cell: str, where: str) -> float:
    """Return the number in a cell; NaN for an empty cell.

    Raises:
        AwError: the cell holds no number.
    """
    if not cell:
        return math.nan
    if not re.fullmatch(r"-?(inf|\d+(\.\d+)?([eE][+-]?\d+)?)", cell):
        raise AwError(f"{where}: {cell[:40]!a} is no number; restore the file")
    return float(cell)


def hidden_in(text: str) -> str | None:
    """Return the first invisible character; None without any."""
    return next((c for c in text if plain(c) != c), None)


def check_text(kind: str, text: str) -> str:
    """Return the text if it is fit for a table: names may hold everything that can be printed.

    Raises:
        AwError: it is empty, too long, or has control characters or text-direction marks.
    """
    hidden = hidden_in(text)
    if not text.strip() or len(text) > LONGEST or hidden is not None:
        shown = text if len(text) <= 40 else text[:37] + "..."
        why = "is empty" if not text.strip() else f"holds {hidden!a}" if hidden else "is too long"
        raise AwError(f"the {kind} {shown!a} {why}; give it 1 to {LONGEST} characters that can be printed")
    return text


def slug(text: str) -> str:
    """Return a file name for any text: lower case, digits and '-', never a path."""
    ascii_text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9]+", "-", ascii_text).strip("-")[:48].strip("-")


def unique_slug(*texts: str) -> str:
    """Return a different file name for every tuple of texts."""
    digest = hashlib.sha256("\0".join(texts).encode("utf-8", "surrogatepass")).hexdigest()[:8]
    return "-".join(filter(None, (slug(texts[0]), digest)))


# What was computed again from renders and photos: every metric of pictures, PSNR only, or nothing.
Checked = Literal["photos", "psnr", "files"]
Key = tuple[str, str, str, str, str, int]


@dataclass(frozen=True)
class Entry:
    """A run on the board; its values are means over the test images."""

    dataset: str
    scene: str
    method: str
    setting: str  # the settings as text: "2000 iterations, effects exposure"
    options: str  # first 8 hex digits of the hash of the method's options; empty without options
    seed: int
    images: int  # test images behind the values
    quality: Mapping[str, float]  # metric variant -> value
    cost: Mapping[str, float]  # as in the result file, numbers only
    missing: tuple[str, ...]  # metrics without a value
    device: str
    hardware: str  # GPU, or processor and threads
    version: str  # of this package
    source: str  # sha256 of the method's own file; empty for the methods of this package
    code_hash: str  # sha256 over this package's files; empty in results of early versions
    config_hash: str
    scene_hash: str
    result_hash: str  # sha256 of metrics.json
    checked: Checked
    reproduce: str  # the command
    metric_functions: str = ""  # "KEY HASH BETTER" of each user's metric, in order, separated by ", "

    @property
    def key(self) -> Key:
        """The cell of the grid that the run fills."""
        return (self.dataset, self.scene, self.method, self.setting, self.options, self.seed)

    @property
    def name(self) -> str:
        return f"{self.method} on {self.scene} with seed {self.seed} ({self.setting})"

    @property
    def row_hash(self) -> str:
        """sha256 over the cells of the row, which reveals changes by hand or by a spreadsheet."""
        cells = {k: getattr(self, k) for k in (*FIRST, *LAST) if k != "row_hash"}
        cells |= {FUNCTIONS: self.metric_functions} if self.metric_functions else {}
        values = {k: {m: number(v) for m, v in getattr(self, k).items()} for k in ("quality", "cost")}
        return config_hash(cells | values)


def in_order(names: Iterable[str]) -> list[str]:
    """Return metrics in the order of tables, then unknown ones by name."""
    order = list(MEASURES)
    return sorted(names, key=lambda n: (order.index(n) if n in order else len(order), n))


def wide(entries: Sequence[Entry]) -> tuple[list[str], list[list[CsvValue]]]:
    """Return the head and one row for each run."""
    quality = in_order({k for e in entries for k in e.quality})
    cost = in_order({k for e in entries for k in e.cost})
    last = (*LAST, FUNCTIONS) if any(e.metric_functions for e in entries) else LAST
    head = [*FIRST, *quality, *(COST + k for k in cost), *last]
    rows: list[list[CsvValue]] = []
    for e in sorted(entries, key=lambda e: e.key):
        cells = vars(e) | {"missing": " ".join(e.missing), "row_hash": e.row_hash}
        numbers = [*(e.quality.get(k) for k in quality), *(e.cost.get(k) for k in cost)]
        rows.append([*(cells[k] for k in FIRST), *numbers, *(cells[k] for k in last)])
    return head, rows


def from_wide(head: Sequence[str], row: Mapping[str, str], where: str) -> Entry:
    """Return the entry of a row.

    Raises:
        AwError: a cell has an invalid value.
    """
    text = {k: unguard(row.get(k, "")) for k in (*FIRST, *LAST, FUNCTIONS)}
    numbers = {k: to_number(row[k], f"{where}, {k}") for k in head if k not in text}
    numbers = {k: value for k, value in numbers.items() if not math.isnan(value)}
    seed, images = (to_count(text[column], f"{where}: {column}") for column in ("seed", "images"))
    checked = next((c for c in CHECKED if c == text["checked"]), None)
    if checked is None:
        raise AwError(
            f"{where}: checked is {text['checked'][:40]!a}, none of {', '.join(CHECKED)}; restore it"
        )
    return Entry(
        **{k: cell for k, cell in text.items() if k not in NO_TEXT},
        seed=seed,
        images=images,
        quality={k: v for k, v in numbers.items() if not k.startswith(COST)},
        cost={k.removeprefix(COST): v for k, v in numbers.items() if k.startswith(COST)},
        missing=tuple(text["missing"].split()),
        checked=checked,
    )


def tidy(entries: Iterable[Entry]) -> Iterator[list[CsvValue]]:
    """Yield rows for `TIDY`, one for each run and metric; a missing metric has a row without a value."""
    for e in sorted(entries, key=lambda e: e.key):
        qualities = {**dict.fromkeys(e.missing, math.nan), **e.quality}
        for kind, values in (("quality", qualities), ("cost", e.cost)):
            for metric in in_order(values):
                cells = vars(e) | {"kind": kind, "metric": metric, "value": values[metric]}
                yield [cells[k] for k in TIDY]


def measured(board: Path) -> Path:
    """Return the folder of the measured numbers."""
    return board / "measured"


def dataset_file(board: Path, dataset: str) -> Path:
    """Return the file with the runs of a dataset.

    Raises:
        AwError: the dataset's name gives no file name.
    """
    name = slug(dataset)
    if not name or name == ALL:
        raise AwError(f"dataset {dataset!a} cannot name a file: use letters or digits, and not 'all'")
    return measured(board) / f"{name}.csv"


def dataset_files(board: Path) -> list[Path]:
    """Return the CSV files of a board, one for each dataset."""
    return sorted(p for p in measured(board).glob("*.csv") if p.stem != ALL and not p.name.startswith("."))


def read_board(board: Path) -> list[Entry]:
    """Read every run on the board, in order; empty if there is no board yet.

    Publishing and writing use this, so that changes by hand never pass as measurements.

    Raises:
        AwError: a file is damaged or was changed by hand, or a run is listed twice.
    """
    entries, wrong = examine(board)
    if wrong:
        raise AwError(wrong[0])
    return entries


def examine(board: Path) -> tuple[list[Entry], list[str]]:
    """Read (runs as in the files, a line for each row and file that was changed by hand).

    Raises:
        AwError: a file is damaged, or a run is listed twice.
    """
    entries: list[Entry] = []
    wrong: list[str] = []
    for path in dataset_files(board):
        head, rows = read_csv(path, (*FIRST, *LAST))
        in_file = [from_wide(head, row, f"{path} row {at}") for at, row in enumerate(rows, 2)]
        for e in in_file:
            if dataset_file(board, e.dataset) != path:
                raise AwError(f"{path} holds a run of dataset {e.dataset!a}: restore the file")
        wrong += [
            f"{path} row {at} ({e.name}) was changed by hand, its cells do not match its row_hash: restore "
            "the file from your version control, or remove it and all.csv and add its runs again"
            for at, (row, e) in enumerate(zip(rows, in_file), 2)
            if row["row_hash"] != e.row_hash
        ]
        entries += in_file
    for e, *copies in grouped(entries, lambda e: e.key).values():
        if copies:
            raise AwError(f"{e.name} is twice in {dataset_file(board, e.dataset)}: restore the file")
    entries.sort(key=lambda e: e.key)
    # if a row was changed, all.csv differs too, which is no second problem
    return entries, wrong or _other_files(board, entries)


def _other_files(board: Path, entries: Sequence[Entry]) -> list[str]:
    """Return a line for each file that differs from what the runs give; an absent file is no problem."""
    return [
        f"{path} does not match the runs of {path.parent}: rows were changed, added or removed by hand, "
        "or a write was interrupted; restore the files from your version control. If only "
        f"{ALL}.csv is wrong, remove it: 'aw leaderboard add' of any run writes it again"
        for path, text in files_of(board, entries).items()
        if path.is_file() and path.read_bytes() != text.encode()
    ]


def files_of(board: Path, entries: Sequence[Entry]) -> dict[Path, str]:
    """Return path and content of every CSV file of a board with these runs.

    Raises:
        AwError: the names of two datasets differ only in case or blanks.
    """
    by_file = grouped(entries, lambda e: dataset_file(board, e.dataset))
    for path, rows in by_file.items():
        names = sorted({e.dataset for e in rows})
        if len(names) > 1:
            raise AwError(f"datasets {names[0]!a} and {names[1]!a} would share {path.name}: spell them alike")
    files = {path: board_csv(*wide(rows)) for path, rows in sorted(by_file.items())}
    return files | {measured(board) / f"{ALL}.csv": board_csv(TIDY, tidy(entries))}


def write_board(board: Path, entries: Sequence[Entry]) -> None:
    """Write the changed files; all.csv comes last, because it can be made again from the others."""
    files = files_of(board, entries)
    for path in dataset_files(board):
        if path not in files:
            path.unlink()  # the last run of this dataset was removed
    for path, text in files.items():
        if not path.is_file() or path.read_bytes() != text.encode():
            write_text(path, text)
