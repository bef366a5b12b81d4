"""Describe a package: facts that a person states, Croissant metadata, and the data card."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TypedDict

from ambiguous_wild.core.config import Facts, from_plain
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.datasets.privacy import HOW_WEAK
from ambiguous_wild.io.plain_yaml import read_mapping

VERSION = "http://mlcommons.org/croissant/1.1"
_OTHER_TERMS: dict[str, str | dict[str, str]] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
    "sc": "https://schema.org/",
}
_TERMS = (
    "@language @vocab arrayShape citeAs column conformsTo containedIn cr rai data dataType dct "
    "description equivalentProperty examples extract field fileProperty fileObject fileSet format "
    "includes isArray isLiveDataset jsonPath key md5 name parentField path recordSet references regex "
    "repeated replace samplingRate sc separator source subField transform"
)
CONTEXT = {term: _OTHER_TERMS.get(term, f"cr:{term}") for term in _TERMS.split()}
NOT_FOR_RELEASE = "NOT FOR RELEASE"
_TYPES = {"bytes": "sc:Integer"}
REQUIRED = ("title", "description", "creators", "license", "consent", "contact")
SIMULATED_LICENSE = "CC0-1.0"  # of what 'aw simulate' makes
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
    """Facts about a release that a person states in a file like `TEMPLATE`."""

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
        """URL of the licence; "" if it is not known."""
        if self.license.startswith(("http://", "https://")):
            return self.license
        return (
            f"https://spdx.org/licenses/{self.license}.html"
            if re.fullmatch(r"[\w.+-]+", self.license)
            else ""
        )


def with_simulated(info: ReleaseInfo, scenes: Mapping[str, Facts]) -> ReleaseInfo:
    """Return the facts with what is known, and not stated otherwise, of scenes that are all simulated.

    Args:
        info: what a person stated.
        scenes: name -> truth/capture.json; empty where a scene is not simulated.
    """
    if not all(simulated_license(capture) for capture in scenes.values()):
        return info
    known = {
        "title": f"Simulated scenes: {shortlist(scenes, 20)}",
        "description": "Ray-cast captures with distractors, clean test photos and exact truth",
        "creators": ("ambiguous-wild",),
        "license": SIMULATED_LICENSE,
        "consent": "not needed: simulated, no recognisable person, no personal data",
        "contact": "not needed: no photo shows a recognisable person",
    }
    return replace(info, **{key: value for key, value in known.items() if not getattr(info, key)})  # type: ignore[arg-type]


def simulated_license(capture: Facts) -> str:
    """Return the licence of a simulated capture, by its truth/capture.json; empty if it is none."""
    stated = capture.get("licence")
    return SIMULATED_LICENSE if isinstance(stated, str) and stated.startswith("CC0") else ""


def read_release_info(path: Path) -> ReleaseInfo:
    """Read the facts of a release.

    Raises:
        AwError: unreadable, an unknown key, or a value of another type.
    """
    data = read_mapping(path)
    names = {f.name for f in fields(ReleaseInfo)}
    # YAML reads 2026-11-23 as a date and 1.0 as a number.
    plain = {k: str(v) if k in names and k not in ("creators", "keywords") else v for k, v in data.items()}
    info = from_plain(ReleaseInfo, {k: v for k, v in plain.items() if v != "None"}, str(path))
    if info.date and not re.fullmatch(r"\d{4}-\d{2}-\d{2}", info.date):
        raise AwError(f"{path}: date {info.date!r} must be written YYYY-MM-DD")
    if not re.fullmatch(r"\d+\.\d+\.\d+", info.version):
        raise AwError(f"{path}: version {info.version!r} must be written MAJOR.MINOR.PATCH")
    return info


class SceneFacts(TypedDict):
    """Facts of one scene for the data card."""

    name: str
    license: str
    counts: dict[str, object]
    factor: int
    ambiguity: dict[str, object] | None  # measured scores by name


@dataclass(frozen=True)
class PackedFile:
    """A file of the package."""

    name: str
    sha256: str
    md5: str
    bytes: int
    kind: str  # MIME type


def croissant(
    info: ReleaseInfo,
    scenes: Sequence[SceneFacts],
    files: Sequence[PackedFile],
    tables: dict[str, tuple[str, ...]],
) -> dict[str, object]:
    """Return the content of croissant.json.

    Args:
        info: facts that a person stated.
        scenes: facts of each scene.
        files: the archives and tables.
        tables: CSV file -> columns; each becomes a record set.
    """
    title = info.title or "Untitled scenes"
    lacking = f"{NOT_FOR_RELEASE}: {', '.join(info.lacking)} not stated. " if info.lacking else ""
    ambiguity = " ".join(ambiguity_line(scene["name"], scene["ambiguity"]) for scene in scenes)
    data: dict[str, object] = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "name": title,
        "description": lacking + (info.description or "Scenes for distractor-free novel view synthesis."),
        "conformsTo": VERSION,
        "license": info.license_url or info.license or NOT_FOR_RELEASE,
        "url": info.url or "https://example.org/not-published-yet",
        "version": info.version,
        "creator": [{"@type": "sc:Person", "name": name} for name in info.creators or ["not stated"]],
        "keywords": [*info.keywords, "novel view synthesis", "distractors"],
        "isLiveDataset": False,
        "rai:dataCollection": info.collection or "not stated",
        "rai:personalSensitiveInformation": f"Consent: {info.consent or 'not stated'}. {HOW_WEAK}",
        "rai:dataLimitations": info.limitations or "not stated",
        "rai:dataUseCases": "Training and measuring novel view synthesis with moving distractors.",
        "rai:dataAnnotationAnalysis": ambiguity or "ambiguity was not measured",
        "distribution": [_file_object(f) for f in files] + [_photos(scene["name"]) for scene in scenes],
        "recordSet": [_record_set(name, columns) for name, columns in tables.items()],
    }
    if info.date:
        data["datePublished"] = info.date
    if info.cite_as:
        data["citeAs"] = info.cite_as
    return data


def _file_object(file: PackedFile) -> dict[str, str]:
    return {
        "@type": "cr:FileObject",
        "@id": file.name,
        "name": file.name,
        "contentUrl": file.name,
        "contentSize": f"{file.bytes} B",
        "encodingFormat": file.kind,
        "sha256": file.sha256,
        "md5": file.md5,
    }


def _photos(scene: str) -> dict[str, object]:
    return {
        "@type": "cr:FileSet",
        "@id": f"{scene}-photos",
        "name": f"{scene}-photos",
        "description": f"Photos of the scene {scene}.",
        "containedIn": {"@id": f"{scene}.zip"},
        "encodingFormat": ["image/png", "image/jpeg"],
        "includes": f"{scene}/images*/**",
    }


def _record_set(table: str, columns: tuple[str, ...]) -> dict[str, object]:
    name = table.removesuffix(".csv")
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": f"The rows of {table}.",
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{column}",
                "name": column,
                "description": column.replace("_", " "),
                "dataType": _TYPES.get(column, "sc:Text"),
                "source": {"fileObject": {"@id": table}, "extract": {"column": column}},
            }
            for column in columns
        ],
    }


def ambiguity_line(name: str, scores: Mapping[str, object] | None) -> str:
    """Return a sentence with the scene's measured ambiguity and its 95 % intervals."""
    if not scores:
        return f"{name}: ambiguity was not measured; 'aw ambiguity-report' measures it."
    parts = []
    for key, score in scores.items():
        if isinstance(score, dict) and isinstance(score.get("value"), (int, float)):
            span = [score.get("low"), score.get("high")]
            has_interval = all(isinstance(v, (int, float)) for v in span)
            parts.append(
                f"{key} {score['value']:.3f}" + (f" [{span[0]:.3f}, {span[1]:.3f}]" if has_interval else "")
            )
    return f"{name}: {scores.get('class', 'no class')}; {', '.join(parts) or 'no score'}."


def card(
    info: ReleaseInfo,
    scenes: Sequence[SceneFacts],
    people: Sequence[str] | None,
    stripped: int,
    keep_metadata: bool,
) -> str:
    """Return the data card in Markdown.

    Args:
        info: facts that a person stated.
        scenes: facts of each scene.
        people: photos in which a person may be seen; None = the detectors were not run.
        stripped: number of photos that lost metadata.
        keep_metadata: metadata was kept on request.
    """
    lines = [f"# {_text(info.title or 'Untitled scenes')}", ""]
    if info.lacking:
        lines += [f"**{NOT_FOR_RELEASE}**: not stated: {', '.join(info.lacking)}.", ""]
    lines += [_text(info.description), ""] if info.description else []
    for label, value in (
        ("Creators", ", ".join(info.creators)),
        ("Licence", info.license),
        ("Consent", info.consent),
        ("Contact", info.contact),
        ("Version", info.version),
        ("Date", info.date),
        ("Collection", info.collection),
        ("Limitations", info.limitations),
        ("Cite as", info.cite_as),
    ):
        lines.append(f"- {label}: {_text(value) or 'not stated'}")
    lines += [
        "",
        "## Scenes",
        "",
        "| scene | train | test | points | factor | licence of the photos |",
        "|---|--:|--:|--:|--:|---|",
    ]
    for scene in scenes:
        counts = scene["counts"]
        lines.append(
            f"| {_text(scene['name'])} | {counts.get('train', '')} | {counts.get('test', '')} | "
            f"{counts.get('points', '')} | {scene['factor']} | {_text(scene['license'])} |"
        )
    lines += [
        "",
        "Splits are train_list.txt and test_list.txt of each scene. Masks: white = keep.",
        "",
        "## Ambiguity",
        "",
    ]
    lines += [f"- {_text(ambiguity_line(s['name'], s['ambiguity']))}" for s in scenes]
    lines += ["", "Intervals: 95 %, bootstrap over photos.", "", "## Privacy", ""]
    if keep_metadata:
        lines.append("Metadata of the photos was kept on request: it may hold places and serial numbers.")
    else:
        lines.append(
            f"Metadata (GPS, serial numbers, previews) was taken out of {stripped} photos; pixels are "
            "unchanged."
        )
    lines += [
        "",
        "Before release, look for faces and number plates in every photo, and cover them. " + HOW_WEAK,
        "",
    ]
    if people is None:
        lines.append("The detectors were not run.")
    else:
        lines.append(
            f"A person may be seen in {len(people)} photos: {_text(shortlist(people, 50)) or 'none'}."
        )
    lines += [
        "",
        "## Files",
        "",
        "- `files.csv`: every file with its sha256; `photos.csv`: what was done to each photo",
        "- `croissant.json`: Croissant 1.1; `checksums.sha256`, `checksums.md5`: of the archives and tables",
        "- check all of it: `aw verify .`",
    ]
    return "\n".join(lines) + "\n"


def _text(value: str) -> str:
    """Turn a value into plain text for Markdown: one line, no HTML, no table columns."""
    flat = " ".join(str(value).split())
    return flat.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace("|", "\\|")
