"""README.md of a package: the data card."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.datasets.release.croissant import NOT_FOR_RELEASE
from ambiguous_wild.datasets.release.info import ReleaseInfo
from ambiguous_wild.datasets.release.people import HOW_WEAK


def ambiguity_line(name: str, scores: Mapping[str, Any] | None) -> str:
    """The scene's measured ambiguity with 95 % intervals, as one sentence."""
    if not scores:
        return f"{name}: ambiguity was not measured ('aw ambiguity-report' does)."
    parts = []
    for key, score in scores.items():
        if isinstance(score, dict) and isinstance(score.get("value"), (int, float)):
            span = [score.get("low"), score.get("high")]
            known = all(isinstance(v, (int, float)) for v in span)
            parts.append(
                f"{key} {score['value']:.3f}" + (f" [{span[0]:.3f}, {span[1]:.3f}]" if known else "")
            )
    return f"{name}: {scores.get('class', 'no class')}; {', '.join(parts) or 'no score'}."


def card(
    info: ReleaseInfo,
    scenes: Sequence[Mapping[str, Any]],
    people: Sequence[str] | None,
    stripped: int,
    keep_metadata: bool,
) -> str:
    """Markdown.

    Args:
        info: as a person stated it.
        scenes: name, license, counts, factor, ambiguity, split of each.
        people: photos in which a person may be seen; None = nobody looked.
        stripped: photos that lost metadata.
        keep_metadata: metadata was asked for.
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
    """Plain text in Markdown: one line, no HTML, no table columns."""
    flat = " ".join(str(value).split())
    return flat.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace("|", "\\|")
