"""docs/foundation-models.md names every back end, and none that does not exist."""

import re
from pathlib import Path

from ambiguous_wild.vision.backends import FEATURES, INSTANCES, parse
from ambiguous_wild.vision.weights import KNOWN, OTHER_SIZES, get_command

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "foundation-models.md").read_text(encoding="utf-8")


def table(heading: str) -> str:
    """The rows under the heading cell."""
    rows = TEXT.partition(f"| {heading} |")[2].partition("\n\n")[0]
    assert rows.count("\n") >= 3
    return rows


def test_the_tables_name_what_there_is() -> None:
    for heading, names in (("features", FEATURES), ("instances", INSTANCES)):
        cells = [row.split("|")[1] for row in table(heading).splitlines()[2:]]
        written = {parse(word).name for cell in cells for word in re.findall(r"`([^`]+)`", cell)}
        assert written <= set(names)
        left = set(names) - written
        assert all(name.endswith("-video") for name in left), left  # the row ends in an ellipsis


def test_the_weights_it_names_exist() -> None:
    known = {w.name for w in KNOWN + OTHER_SIZES}
    for heading in ("features", "instances"):
        for row in table(heading).splitlines()[2:]:
            assert set(re.findall(r"`([^`]+)`", row.split("|")[2])) <= known


def test_the_command_it_shows_is_the_one_the_program_gives() -> None:
    assert f"{get_command('lpips', 'efficientnet-lite0')}\n" in TEXT
