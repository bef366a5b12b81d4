"""What phones add to a capture: one photo in two formats, bursts, videos of live photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from ambiguous_wild.builder.collect import Capture
from ambiguous_wild.builder.records import PhotoRecord
from ambiguous_wild.core.errors import shortlist

SAME = 0.995  # correlation of 32 x 32 thumbnails, as for near-duplicates
VIDEOS = (".mov", ".mp4")


def format_twins(facts: Sequence[PhotoRecord], thumbnails: np.ndarray | None) -> dict[str, str]:
    """Photos that are there in another format too: source -> the source that is kept.

    Phones save or export IMG_1.HEIC and IMG_1.JPG. The larger one is kept, of equal ones the first by name.

    Args:
        facts: photos that can be read.
        thumbnails: [N, 1024], of `screen.thumbnail`; None = no photo.
    """
    groups: dict[str, list[int]] = {}
    for index, fact in enumerate(facts):
        groups.setdefault(str(PurePosixPath(fact["source"]).with_suffix("")).casefold(), []).append(index)
    found = {}
    for members in groups.values():
        if len(members) < 2 or thumbnails is None:
            continue
        first = max(members, key=lambda i: (facts[i]["width"] * facts[i]["height"], -i))
        for other in members:
            suffixes = {PurePosixPath(facts[i]["source"]).suffix.lower() for i in (first, other)}
            if other != first and len(suffixes) == 2 and float(thumbnails[first] @ thumbnails[other]) > SAME:
                found[facts[other]["source"]] = facts[first]["source"]
    return found


def burst_warnings(facts: Sequence[PhotoRecord], thumbnails: np.ndarray) -> list[str]:
    """Runs of near-identical photos of one camera, taken within the same second."""
    groups: dict[tuple[str | None, str], list[int]] = {}
    for index, fact in enumerate(facts):
        taken = fact["exif"].get("taken_at")
        if taken is not None:
            groups.setdefault((fact["camera"], taken), []).append(index)
    bursts = []
    for members in groups.values():
        alike = [i for i in members[1:] if float(thumbnails[members[0]] @ thumbnails[i]) > SAME]
        if alike:
            bursts.append(f"{facts[members[0]]['source']} and {len(alike)} more")
    if not bursts:
        return []
    return [
        f"{len(bursts)} bursts of near-identical photos of one second: {shortlist(bursts, 3)}; keep "
        "the sharpest "
        "of each: where every 8th photo tests, its neighbours of the burst train"
    ]


def live_photo_warnings(capture: Capture) -> list[str]:
    """Videos that belong to photos of the same name."""
    stems = {PurePosixPath(s.relative).stem.casefold() for s in capture.sources}
    videos = [
        name
        for name in capture.ignored
        if PurePosixPath(name).suffix.lower() in VIDEOS and PurePosixPath(name).stem.casefold() in stems
    ]
    return [f"{len(videos)} videos of live photos are left out: {shortlist(videos, 3)}"] if videos else []
