"""docs/fidelity.md: its files and options exist, and its values are those of the methods."""

import re
from itertools import takewhile
from pathlib import Path

import ambiguous_wild
from ambiguous_wild.core.config import flatten, to_plain
from ambiguous_wild.methods import get_method

PACKAGE = Path(ambiguous_wild.__file__).parent
PAGE = PACKAGE.parent / "docs" / "fidelity.md"
METHODS = ("refinesplat-printed", "refinesplat-paper", "refinesplat")
VERDICTS = ("as printed", "repaired", "replaced", "not stated")


def rows() -> list[list[str]]:
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("| paper | code |"))
    table = takewhile(lambda line: line.startswith("|"), lines[start + 2 :])  # below the rule
    return [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in table]


def quoted(cell: str) -> str:
    found = re.match(r"`([^`]+)`", cell)
    return found[1] if found else ""


def test_every_row_is_true():
    of = {method: flatten(to_plain(get_method(method).options())) for method in METHODS}
    wrong = []
    for row in rows():
        assert len(row) == 8, row
        if not (PACKAGE / quoted(row[1])).is_file():
            wrong.append(f"no file {row[1]}")
        option = quoted(row[2])
        for method, cell in zip(METHODS, row[3:6], strict=True) if option else ():
            if option not in of[method]:
                wrong.append(f"{method} has no option {option}")
            elif quoted(cell):  # the networks depend on the machine
                if str(of[method][option]) != quoted(cell):
                    wrong.append(f"{method}.{option} is {of[method][option]}, not {quoted(cell)}")
                if cell.rpartition("`")[2].strip() not in VERDICTS:
                    wrong.append(cell)
    assert wrong == []
