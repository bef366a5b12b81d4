"""Read Photo Tourism with NeRF-W's split: dense/, a table of names; half of each test photo is fitted."""

from __future__ import annotations

import csv
from pathlib import Path, PurePosixPath

from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.scene import Evaluation, Split
from ambiguous_wild.datasets.foreign import ForeignScene, split_by_lists
from ambiguous_wild.datasets.readers.colmap import (
    has_lists,
    model_names,
    read_lists,
    read_named_model,
)
from ambiguous_wild.io.untrusted import read_text

COLUMNS = ("filename", "id", "split", "dataset")
NERF_W: Evaluation = {
    "protocol": "half",
    "effects": ["appearance"],
    "source": "NeRF-W: colour is fitted on the left half of a test photo, the right half is measured",
}
MIN_SHARE = 0.5  # of the table's photos in the model; below, the table belongs to another scene


def find_table(root: Path) -> Path | None:
    """Find the scene's .tsv, or NerfBaselines' nerfw_split.csv; None without either.

    Raises:
        AwError: there are several tables.
    """
    tables = sorted(root.glob("*.tsv")) or sorted(root.glob("nerfw_split.csv"))
    if len(tables) > 1:
        raise AwError(
            f"{root} has {len(tables)} tables: {shortlist(p.name for p in tables)}; keep the scene's own"
        )
    return tables[0] if tables else None


def read_table(path: Path) -> dict[Split, list[str]]:
    """Read the names by side of rows with an id; the ids themselves are wrong in the published tables.

    Raises:
        AwError: unreadable, without the columns, or with an unknown side.
    """
    try:
        rows = list(csv.DictReader(read_text(path).splitlines(), delimiter="\t"))
    except csv.Error as error:
        raise AwError(f"{path} is no table: {error}") from error
    lacking = [c for c in COLUMNS[:3] if not rows or c not in rows[0]]
    if lacking:
        raise AwError(f"{path} lacks the columns {', '.join(lacking)}; it must have {', '.join(COLUMNS)}")
    names_of: dict[Split, list[str]] = {"train": [], "test": []}
    for number, row in enumerate(rows, start=2):
        side, name = (row["split"] or "").strip(), (row["filename"] or "").strip()
        if not (row["id"] or "").strip():
            continue
        if side not in names_of or not name:
            raise AwError(f"{path}, line {number}: side {side!r} of {name!r} is neither train nor test")
        names_of[side].append(name)
    return names_of


def read_phototourism(root: Path, chosen: str = "") -> ForeignScene:
    """Read dense/images, dense/sparse and <name>.tsv, or the published lists."""
    model, photos = read_named_model(root, chosen)
    names = model_names(model)
    table = find_table(root)
    if table is not None:
        listed = read_table(table)
    elif has_lists(root):
        listed = read_lists(root)
    else:
        raise AwError(
            f"{root} has no split: neither <name>.tsv nor train_list.txt and test_list.txt; copy the .tsv of "
            "NeRF-W's split into it"
        )
    where = table or root
    total = sum(len(v) for v in listed.values())
    bases = {PurePosixPath(n).name for n in names}
    in_model = sum(PurePosixPath(n).name in bases for v in listed.values() for n in v)
    if total and in_model < MIN_SHARE * total and table is not None:
        raise AwError(
            f"{table} names {total} photos, {in_model} of them are in the model of {len(names)}: it is the "
            "table of another scene"
        )
    split, missing = split_by_lists(names, listed, where)
    unlisted = len(names) - len(split)
    notes = (f"{unlisted} photos of the model are in no list: left out",) if unlisted else ()
    name = "Photo Tourism"
    return ForeignScene(
        "photo-tourism", root, model, photos, split, 1, missing, dataset=name, evaluation=NERF_W, notes=notes
    )
