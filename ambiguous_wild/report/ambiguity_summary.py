"""Summarise measured photos: the scene's scores, its class, and the sentences that describe them."""

from __future__ import annotations

import math
import re
from typing import Any

from ambiguous_wild.metrics import ambiguity as am
from ambiguous_wild.metrics import semantic as sem
from ambiguous_wild.metrics.stats import Interval
from ambiguous_wild.report.ambiguity_measure import (
    KINDS,
    MeasuredScene,
    PhotoMeasures,
    feature_family,
    weight_free,
)

LOOKS = (
    "weight-free features compare looks, not meaning: a distractor with the texture of a static object "
    "counts as similar to it, and a red statue as different from a stone statue; --objects names the static "
    "objects to compare with, --features dinov2-small compares kinds of objects"
)
NAMED = "weight-free features compare looks, not meaning; compared with named objects"
NO_DISTRACTORS = "no distractors"  # the class of a scene whose masks are empty
REAL = "raw cosine, as in the paper"


# Number of distractors, of those that a kind of evidence reveals (None = not available), and of the others.
EvidenceCounts = dict[str, int | None]
# The content of ambiguity.json, and its parts; two keys are names of metrics, which a type cannot list.
Summary = dict[str, Any]
PhotoRow = dict[str, str | float | None]  # a row of photos.csv, by column


def semantic_metric(features: str) -> str:
    """Return the score's name with its variant: semantic_cosine_dinov2_small, semantic_lookalike_labhog."""
    kind = "lookalike" if weight_free(features) else "cosine"
    return f"semantic_{kind}_{_family(features)}"


def cosine_column(features: str) -> str:
    """Return the column's name for the cosine of a photo's most similar distractor."""
    return f"semantic_cosine_{_family(features)}"


def _family(features: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", feature_family(features).lower())


def summarise(measured: MeasuredScene) -> Summary:
    """Compute the scene's scores with 95 % intervals over photos; undefined scores are None."""
    counts = [m.counts for m in measured.photos]
    colour, semantic = _colour(counts), _semantic(measured)
    covered = am.ratio_interval([c.distractor for c in counts], [c.pixels for c in counts])
    shares = [c.occlusion for c in counts]  # of a train photo that distractors cover
    return {
        "scene": measured.scene.name,
        "photos": len(counts),
        "masks": measured.masks.source,
        "background": measured.background.source,
        "features": measured.features,
        "seed": 0,  # of the intervals
        "class": classify(colour["ambiguous"], semantic["ambiguous"]) if covered.mean else NO_DISTRACTORS,
        "doubts": _doubts(measured.masks.source, colour, semantic),
        "occlusion": {**_interval(covered), "min": min(shares), "max": max(shares)},
        am.COLOUR_METRIC: colour,
        semantic_metric(measured.features): semantic,
        "told": _count_evidence(measured.photos),
    }


def _doubts(masks: str, colour: Summary, semantic: Summary) -> list[str]:
    """Return why the class may be wrong."""
    found = ["the masks are a run's guesses"] if masks == "run" else []
    if _crosses(colour) or _crosses(semantic):
        found.append("an interval crosses its limit")
    if 2 * colour["unknown_px"] > colour["distractor_px"]:
        found.append("most of the background is unknown")
    return found


def doubts(summary: Summary) -> str:
    """Return what to write behind the class: why it may be wrong, in brackets, or nothing."""
    found = summary.get("doubts")  # absent from older reports
    return f" (uncertain: {'; '.join(found)})" if found else ""


def classify(colour: bool | None, semantic: bool | None) -> str:
    """Return colour, semantic, both or neither; with a missing verdict also "unknown"."""
    if colour is None or semantic is None:
        name = "colour" if colour else "semantic" if semantic else ""
        return f"{name}, rest unknown" if name else "unknown"
    if colour and semantic:
        return "both"
    return "colour" if colour else "semantic" if semantic else "neither"


def _colour(counts: list[am.ColourCounts]) -> Summary:
    """Return the share of the distractor pixels whose colour is close to their background."""
    total = am.pooled(counts)
    share = am.ratio_interval([c.close for c in counts], [c.known for c in counts])
    return {
        **_interval(share),
        "threshold": am.COLOUR_THRESHOLD,
        "ambiguous_above": am.COLOUR_AMBIGUOUS_ABOVE,
        "ambiguous": am.verdict(share.mean, am.COLOUR_AMBIGUOUS_ABOVE),  # None = no verdict
        "mean_residual": _number(total.mean_residual),
        "distractor_px": total.distractor,
        "unknown_px": total.unknown,  # with an unknown background
    }


def _semantic(measured: MeasuredScene) -> Summary:
    """Return the similarity of distractors to the static scene."""
    photos = [m.matches for m in measured.photos if m.matches]
    # a mean as a ratio to the number of photos, so that it is missing, and no error, without any
    best = am.ratio_interval([sem.photo_cosine(p) for p in photos], [1.0] * len(photos))
    score, limit = best, sem.AMBIGUOUS_ABOVE
    if measured.whitened:
        alike = [sum(m.pixels for m in p if m.cosine >= measured.usual) for p in photos]
        pixels = [sum(m.pixels for m in p) for p in photos] if not math.isnan(measured.usual) else []
        score, limit = am.ratio_interval(alike[: len(pixels)], pixels), sem.LOOKALIKE_ABOVE
    anchors = measured.anchors
    return {
        **_interval(score),
        "ambiguous_above": limit,
        "ambiguous": am.verdict(score.mean, limit),  # None = no verdict
        "compared_with": "objects" if measured.objects else "static segments",
        "cosine_most_similar": _number(best.mean),
        "cosine_mean": _number(sem.mean_cosine([m for p in photos for m in p])),
        "usual_match": _number(measured.usual),
        "same_surface": _number(anchors.same),
        "unrelated": _number(anchors.different),
        "calibrated": _number(anchors.calibrated(best.mean)),
        "photos": len(photos),
        "note": REAL if not measured.whitened else NAMED if measured.objects else LOOKS,
    }


def _count_evidence(photos: list[PhotoMeasures]) -> EvidenceCounts:
    every = [d for m in photos for d in m.distractors]

    def count(kind: str) -> int | None:
        answers = [answer for d in every if (answer := getattr(d, kind)) is not None]
        return sum(answers) if answers else None

    nothing = sum(not d.told_by for d in every)
    return {"distractors": len(every), **{kind: count(kind) for kind in KINDS}, "nothing": nothing}


def _evidence_line(counts: EvidenceCounts) -> str:
    known = {kind: counts[kind] for kind in KINDS if counts[kind] is not None}
    parts = ", ".join(f"{kind} reveals {count}" for kind, count in known.items())
    text = f"distractors: {counts['distractors']}; {parts or 'no evidence is available'}; "
    text += f"no evidence reveals {counts['nothing']}"
    return text if counts["motion"] is not None else f"{text} (the scene has no points that move)"


def row(m: PhotoMeasures, metric: str) -> PhotoRow:
    """Return one row of the table of photos."""
    return {
        "photo": m.name,
        "occlusion": _number(m.counts.occlusion),
        am.COLOUR_METRIC: _number(m.counts.close_share),
        "mean_residual": _number(m.counts.mean_residual),
        metric: _number(sem.photo_cosine(m.matches)),
        "distractor_px": m.counts.distractor,
        "unknown_px": m.counts.unknown,
        "regions": len(m.matches),
        "told_by": "; ".join(" ".join(d.told_by) or "nothing" for d in m.distractors),
    }


def describe(summary: Summary) -> list[str]:
    """Return the scores as sentences, for the terminal and the page."""
    colour, covered = summary[am.COLOUR_METRIC], summary["occlusion"]
    if summary["class"] == NO_DISTRACTORS:
        return [
            f"the masks of all {summary['photos']} photos are empty: without distractors nothing is ambiguous"
        ]
    look = summary[semantic_metric(summary["features"])]
    lines = [
        f"occlusion: {_percent(covered)} of a train photo, from {100 * covered['min']:.1f} to "
        f"{100 * covered['max']:.1f} %",
        _colour_line(colour),
        _semantic_line(look, weight_free(summary["features"])),
    ]
    if look["same_surface"] is not None:
        lines.append(
            f"with {summary['features']}, a static region scores {look['same_surface']:.2f} against other "
            f"photos of itself and {look['unrelated']:.2f} against unrelated ones; {look['note']}"
        )
    counts: EvidenceCounts | None = summary.get("told")  # absent from older reports
    if counts and counts["distractors"]:
        lines.append(_evidence_line(counts))
    if colour["unknown_px"]:
        share = 100 * colour["unknown_px"] / colour["distractor_px"]
        lines.append(
            f"the background of {share:.0f} % of the distractor pixels is unknown; the colour score leaves "
            "them out"
        )
    return lines


def _colour_line(colour: Summary) -> str:
    if colour["value"] is None:
        return "colour: no verdict, because no background of a distractor is known"
    return (
        f"colour: {_percent(colour)} of the distractor pixels are within {am.COLOUR_THRESHOLD} of their "
        f"background: {_word(colour)} (limit {100 * am.COLOUR_AMBIGUOUS_ABOVE:.0f} %)"
    )


def _semantic_line(look: Summary, lookalike: bool) -> str:
    if look["value"] is None:
        return f"semantic: no verdict, because no distractor is comparable with the {look['compared_with']}"
    if lookalike:
        one = "named object" if look["compared_with"] == "objects" else "static region"
        return (
            f"semantic: {_percent(look)} of the distractor pixels lie in regions that resemble a {one} of "
            f"another photo as closely as static regions resemble each other: {_word(look)} "
            f"(limit {100 * sem.LOOKALIKE_ABOVE:.0f} %)"
        )
    return (
        f"semantic: cosine {_with_interval(look, 1, 3, '')} of a photo's most similar distractor to the "
        f"{look['compared_with']}: {_word(look)} (limit {sem.AMBIGUOUS_ABOVE})"
    )


def _percent(score: Summary) -> str:
    return _with_interval(score, 100, 1, " %")


def _with_interval(score: Summary, times: int, digits: int, unit: str) -> str:
    """Return the score as text, behind it its interval, both multiplied by `times`."""
    value, low, high = (
        None if x is None else f"{times * x:.{digits}f}"
        for x in (score["value"], score["low"], score["high"])
    )
    if value is None:
        return "missing"
    return value + unit + ("" if low is None or high is None else f" [{low}, {high}]")


def _word(score: Summary) -> str:
    word = {None: "no verdict", True: "AMBIGUOUS", False: "not ambiguous"}[score["ambiguous"]]
    return f"{word}, but the interval crosses the limit" if _crosses(score) else word


def _crosses(score: Summary) -> bool:
    low, high = score["low"], score["high"]
    return low is not None and high is not None and low <= score["ambiguous_above"] <= high


def _interval(interval: Interval) -> Summary:
    return {"value": _number(interval.mean), "low": _number(interval.low), "high": _number(interval.high)}


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(float(value), 6)
