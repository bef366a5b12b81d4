"""croissant.json: the package for machines, in Croissant 1.1 with its responsible-AI fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ambiguous_wild.datasets.release.info import ReleaseInfo
from ambiguous_wild.datasets.release.people import HOW_WEAK

VERSION = "http://mlcommons.org/croissant/1.1"
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "arrayShape": "cr:arrayShape",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isArray": "cr:isArray",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "name": {"@container": "@language"},
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
NOT_FOR_RELEASE = "NOT FOR RELEASE"
_TYPES = {"bytes": "sc:Integer"}


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
    scenes: Sequence[str],
    files: Sequence[PackedFile],
    tables: dict[str, tuple[str, ...]],
    ambiguity: Sequence[str],
) -> dict[str, Any]:
    """The file's content.

    Args:
        info: as a person stated it.
        scenes: names.
        files: the archives and tables.
        tables: CSV file -> columns; each becomes a record set.
        ambiguity: a sentence a scene.
    """
    title = info.title or "Untitled scenes"
    lacking = f"{NOT_FOR_RELEASE}: {', '.join(info.lacking)} not stated. " if info.lacking else ""
    data: dict[str, Any] = {
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
        "rai:dataAnnotationAnalysis": " ".join(ambiguity) or "ambiguity was not measured",
        "distribution": [_file_object(f) for f in files] + [_photos(scene) for scene in scenes],
        "recordSet": [_record_set(name, columns) for name, columns in tables.items()],
    }
    if info.date:
        data["datePublished"] = info.date
    if info.cite_as:
        data["citeAs"] = info.cite_as
    return data


def _file_object(file: PackedFile) -> dict[str, Any]:
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


def _photos(scene: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": f"{scene}-photos",
        "name": f"{scene}-photos",
        "description": f"Photos of the scene {scene}.",
        "containedIn": {"@id": f"{scene}.zip"},
        "encodingFormat": ["image/png", "image/jpeg"],
        "includes": f"{scene}/images*/**",
    }


def _record_set(table: str, columns: tuple[str, ...]) -> dict[str, Any]:
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
