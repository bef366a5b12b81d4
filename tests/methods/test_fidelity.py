"""docs/fidelity.md: its options exist, and its values are those of the methods."""

import re
from pathlib import Path

from ambiguous_wild.core.config import flatten, to_plain
from ambiguous_wild.methods import get_method

PAGE = Path(__file__).parents[2] / "docs" / "fidelity.md"
METHODS = ("refinesplat-printed", "refinesplat-paper", "refinesplat")


def rows() -> list[tuple[str, ...]]:
    """Option and its values in METHODS: lines of the two tables, and every `option=value` that all share."""
    replaced_start, page = "## Replaced in", PAGE.read_text(encoding="utf-8")
    found = []
    for number, part in enumerate((page.partition(replaced_start)[0], page.partition(replaced_start)[2])):
        for option, printed, own in re.findall(
            r"^\|[^|]*\| `(.+?)` \| `(.+?)` \| `(.+?)` \|", part, re.MULTILINE
        ):
            assert printed != own, option
            found.append((option, printed, printed if number else own, own))
    shared = page.partition("## Shared by all three")[2].partition("\n## ")[0]
    found += re.findall(r"`(\w+)` is (\S+), (\S+) and (\S+) ", page)
    return found + [(o, v, v, v) for o, v in re.findall(r"`([\w.]+)=([\w.-]+)`", shared)]


def test_every_value_is_true():
    of = {method: flatten(to_plain(get_method(method).options())) for method in METHODS}
    wrong = []
    assert len(rows()) > 55
    for option, *values in rows():
        for method, value in zip(METHODS, values, strict=True):
            if option not in of[method]:
                wrong.append(f"{method} has no option {option}")
            elif str(of[method][option]) != value:
                wrong.append(f"{method}.{option} is {of[method][option]}, not {value}")
    assert wrong == []
