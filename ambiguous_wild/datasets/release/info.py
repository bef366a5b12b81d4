"""What a person states about a release: licence, consent, who made it. Read from a YAML file."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path

from ambiguous_wild.core.config import from_plain
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.plain_yaml import read_mapping

REQUIRED = ("title", "description", "creators", "license", "consent", "contact")
TEMPLATE = """\
# About the release. The first six must be filled; without them the package says "not for release".
title: ""
description: ""        # what the scenes show and what they are for
creators: []           # [Ada Lovelace, Alan Turing]
license: ""            # of the photos: a URL or an SPDX name, e.g. CC-BY-4.0
consent: ""            # how people in the photos agreed, or that none can be recognised
contact: ""            # e-mail or page for people who want a photo removed
version: "1.0.0"
date: ""               # of publication, YYYY-MM-DD
url: ""                # where the package will lie
cite_as: ""            # BibTeX or a sentence
keywords: []
collection: ""         # devices, places, dates, instructions to whoever took the photos
limitations: ""        # what the data should not be used for
"""


@dataclass(frozen=True)
class ReleaseInfo:
    """Fields of the file; see `TEMPLATE`."""

    title: str = ""
    description: str = ""
    creators: tuple[str, ...] = ()
    license: str = ""
    consent: str = ""
    contact: str = ""
    version: str = "1.0.0"
    date: str = ""
    url: str = ""
    cite_as: str = ""
    keywords: tuple[str, ...] = ()
    collection: str = ""
    limitations: str = ""

    @property
    def lacking(self) -> list[str]:
        """Required fields that are empty."""
        return [name for name in REQUIRED if not getattr(self, name)]

    @property
    def license_url(self) -> str:
        """The licence as a URL where it has one."""
        if self.license.startswith(("http://", "https://")):
            return self.license
        return (
            f"https://spdx.org/licenses/{self.license}.html"
            if re.fullmatch(r"[\w.+-]+", self.license)
            else ""
        )


def read_release_info(path: Path) -> ReleaseInfo:
    """Read the file.

    Raises:
        AwError: unreadable, an unknown key, or a value of another type.
    """
    data = read_mapping(path)
    known = {f.name for f in fields(ReleaseInfo)}
    # YAML reads 2026-11-23 as a date and 1.0 as a number.
    plain = {k: str(v) if k in known and k not in ("creators", "keywords") else v for k, v in data.items()}
    info = from_plain(ReleaseInfo, {k: v for k, v in plain.items() if v != "None"}, str(path))
    if info.date and not re.fullmatch(r"\d{4}-\d{2}-\d{2}", info.date):
        raise AwError(f"{path}: date {info.date!r} must be written YYYY-MM-DD")
    if not re.fullmatch(r"\d+\.\d+\.\d+", info.version):
        raise AwError(f"{path}: version {info.version!r} must be written MAJOR.MINOR.PATCH")
    return info
