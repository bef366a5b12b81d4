"""The registry of public datasets: `public.yaml`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.io.plain_yaml import read_mapping

FILE = Path(__file__).with_name("public.yaml")


@dataclass(frozen=True)
class PublicData:
    """One archive, or a page that leads to one."""

    name: str
    page: str
    license: str
    note: str
    url: str = ""  # empty: only a page
    layout: str = ""
    size_mb: str = ""  # as stated; empty = not stated
    sha256: str = ""  # empty = the publisher states none


@cache
def public_data() -> dict[str, PublicData]:
    """By name, in the order of the file."""
    data: dict[str, Any] = read_mapping(FILE)
    rows = [*data["datasets"], *data["pages"]]
    return {row["name"]: PublicData(**{k: str(v) for k, v in row.items()}) for row in rows}


def find_public(name: str) -> PublicData:
    """The dataset of that name.

    Raises:
        AwError: there is none, or it has no archive to download.
    """
    known = public_data()
    if name not in known:
        raise unknown("dataset", name, known, "'aw fetch --list' lists them")
    if not known[name].url:
        raise AwError(
            f"{name} has no fixed archive: download it from {known[name].page}, then 'aw import' it"
        )
    return known[name]
