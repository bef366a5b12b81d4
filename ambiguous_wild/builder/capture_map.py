"""What a map of a capture shows: cameras from above, which photos overlap, and where to take more photos.

`map_of_model` maps a built scene, `map_of_photos` photos without poses; `map_drawing` draws either.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import PurePosixPath
from typing import Literal

import numpy as np

from ambiguous_wild.builder.overlap_graph import (
    GrowthForecast,
    Link,
    best_link_between,
    bridges,
    graph_layout,
    overlap_graph,
    weakly_connected,
)
from ambiguous_wild.builder.records import MappingResult
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.io.colmap_records import ColmapModel

MAX_POINTS = 5000  # of the backdrop
STRONGEST = 4  # links drawn of each photo, besides the weak ones
LONGEST_NAME = 14  # characters
DOWN = 0.8  # share of the mean viewing direction along the normal of a plane from which on cameras face it
# Cameras lie in a plane if their second axis is longer than this share of the first, and their third shorter
# than this share of the second.
WIDE, THIN = 0.15, 0.4
CORE = 80  # percent of the points, the nearest to their median, by which their thinnest axis is measured
AXES_AGREE = 0.9  # length of the mean viewing direction from which on all cameras look the same way
# Length of the mean up direction from which on up is determined. It is 0.34 to 0.67 for nadir strips flown
# back and forth (seneca), 0.96 or more for photos taken by hand (monstree, sceaux, statue, reichstag).
UPRIGHT = 0.7
TALL = 0.3  # of the cameras' extent sideways: extent along up of a path that a view from above would hide
LEVEL = 0.3  # length of the mean up direction below which up is unknown; shorter headings are not drawn
WIDEST = 1.5  # size of the map in sizes of the registered cameras' box: what is farther away is cut off
COMMON = 0.4  # length of the mean heading from which on it is up on the map
ASIDE = 0.12  # of the map's size: distance of a photo without a position from the one that it matches most
ROOM = 0.4  # of this distance: free room around such a photo

Kind = Literal["train", "test", "component", "left out"]


@dataclass(frozen=True)
class MapPhoto:
    """A photo on the map."""

    name: str  # path in the capture
    xy: tuple[float, float]  # x right, y up
    kind: Kind = "train"
    heading: tuple[float, float] | None = None  # viewing direction, at most unit length; None: unknown
    provisional: bool = False  # registered with little evidence
    weak: bool = False  # few covisible photos
    unsure: bool = False  # the position is a guess


@dataclass(frozen=True)
class MapLink:
    """Two photos that overlap."""

    ends: tuple[int, int]  # indices of photos
    matches: int
    kind: Literal["strong", "weak", "left out"] = "strong"


@dataclass(frozen=True)
class CaptureMap:
    """Everything that is drawn."""

    title: str
    photos: list[MapPhoto]
    links: list[MapLink]
    stars: list[tuple[float, float]]  # where to take more photos
    advice: list[str]  # what to take there
    listed: list[str] = field(default_factory=list)  # photos that are not on the map, with the reason
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # [P, 2] backdrop
    colours: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))  # [P, 3] of the points
    posed: bool = True  # positions are those of the cameras
    labels: Mapping[str, str] = field(default_factory=dict)  # name of a photo -> shorter name for the drawing


def map_of_model(
    model: ColmapModel,
    mapping: MappingResult,
    sources: Mapping[str, str],  # name -> path in the capture, in the order of capture
    tests: Collection[str],  # names
) -> CaptureMap:
    """Return the map of a built scene."""
    registered = {image.name: image.cam_from_world() for image in model.images.values()}
    names = [name for name in sources if name in registered]
    poses = np.array([registered[name] for name in names]).reshape(-1, 4, 4)
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    plane = top_view(poses[:, :3, :3], centres, model.points.xyz)
    flat = centres @ plane.T
    size = longer_side(flat)
    shown = {name: printable(source) for name, source in sources.items()}
    provisional = set(mapping["provisional"])
    photos = [
        MapPhoto(
            shown[name],
            as_pair(flat[k]),
            "test" if name in tests else "train",
            as_pair(plane @ poses[k, 2, :3]),
            provisional=name in provisional,
        )
        for k, name in enumerate(names)
    ]
    at = {name: k for k, name in enumerate(names)}
    links = _links(mapping["links"], at)
    other_components = [component for component in mapping["components"] if not at.keys() & set(component)]
    elsewhere = {name for component in other_components for name in component}
    left_out = {name: why for name, why in mapping["left_out"].items() if name in sources.keys() - elsewhere}
    order = {name: k for k, name in enumerate(sources)}
    up = -poses[:, 1, :3].mean(axis=0)
    hidden = np.linalg.norm(up) > UPRIGHT and np.cross(*plane) @ up < np.linalg.norm(up) / 2
    direction = "seen in the viewing direction" if hidden else "seen from above"
    result = CaptureMap(f"{len(names)} of {len(sources)} photos registered, {direction}", photos, [], [], [])
    result = _with_links(result, links)
    for component in other_components:
        members = sorted(order[name] for name in component if name in order)
        if not members:
            continue
        every = list(sources)
        loose = _links(mapping["unregistered_links"], order)
        inside, outside = best_link_between([order[name] for name in names], members, loose)
        pair = (shown[every[inside]], shown[every[outside]])
        named = shortlist([shown[every[k]] for k in members], 3)
        result.listed.append(f"another part, {len(members)} photos: {named}")
        result.advice.insert(0, f"take a photo that shows both {pair[0]} and {pair[1]}, to join the parts")
    result = _with_left_out(result, left_out, mapping, shown, at, plane, size)
    points = model.points.xyz[:: max(1, -(-len(model.points.xyz) // MAX_POINTS))]
    colours = model.points.rgb[:: max(1, -(-len(model.points.xyz) // MAX_POINTS))]
    return replace(
        result, points=points @ plane.T, colours=colours, labels=short_labels(list(shown.values()))
    )


def map_of_photos(
    sources: Sequence[str],  # in the order of capture
    links: Sequence[Link],
    growth: GrowthForecast,
    gaps: Sequence[tuple[int, int]],  # of `component_gaps`
) -> CaptureMap:
    """Return the map of photos without poses: near each other if they overlap much."""
    main = set(growth.components[0]) if growth.components else set()
    in_component = {photo for component in growth.components[1:] for photo in component}
    xy = graph_layout(len(sources), links)
    photos = [
        MapPhoto(
            printable(source),
            as_pair(xy[k]),
            "train" if k in main else "component" if k in in_component else "left out",
        )
        for k, source in enumerate(sources)
    ]
    whole = len(main) == len(sources)
    share = f"all {len(main)}" if whole else f"about {len(main)} of {len(sources)}"
    title = f"{share} photos will be registered; near = much overlap, not positions"
    result = _with_links(CaptureMap(title, photos, [], [], [], posed=False), links)
    matches = {link[:2]: link[2] for link in links}
    bridged = [
        MapLink(pair, matches.get(_sorted(pair), 0), "weak" if _sorted(pair) in matches else "left out")
        for pair in gaps
    ]
    known = {_sorted(pair) for pair in gaps}
    return replace(
        result,
        links=[*(link for link in result.links if _sorted(link.ends) not in known), *bridged],
        stars=list(dict.fromkeys([*(_middle(photos[a], photos[b]) for a, b in gaps), *result.stars])),
        advice=list(dict.fromkeys([*(_between(photos[a], photos[b]) for a, b in gaps), *result.advice])),
        listed=[
            f"another part, {len(component)} photos: {shortlist([photos[k].name for k in component], 3)}"
            for component in growth.components[1:]
        ]
        + ([f"of no part: {shortlist([photos[k].name for k in growth.others])}"] if growth.others else []),
        labels=short_labels([photo.name for photo in photos]),
    )


def component_gaps(growth: GrowthForecast, links: Sequence[Link]) -> list[tuple[int, int]]:
    """Return pairs of photos between which more photos are needed, so that all components become one."""
    if not growth.components:
        return []
    inside, pairs = set(growth.components[0]), []
    others = (*growth.components[1:], *([k] for k in growth.others))
    component_of = {photo: component for component in others for photo in component}
    while component_of:
        pair = best_link_between(inside, component_of.keys(), links)
        pairs.append(pair)
        for photo in component_of[pair[1]].copy():
            inside.add(photo)
            del component_of[photo]
    return pairs


def connection_advice(first: str, second: str) -> str:
    """Return the advice for two photos that hardly overlap."""
    return f"take 2 or 3 photos between {first} and {second}"


def printable(source: str) -> str:
    """Return the name of a photo without control characters."""
    return "".join(c if c.isprintable() else "?" for c in source)


def short_labels(names: Collection[str]) -> dict[str, str]:  # name -> label
    """Return short labels for a drawing, each of one photo.

    A label has no extension, unless two photos differ by nothing else, and no folder that all photos share.
    A long one is the shortest end of the name that no other name has; the end starts at a folder where that
    makes it little longer.
    """
    paths = {name: PurePosixPath(name) for name in names}
    folders = zip(*(path.parent.parts for path in paths.values()))
    shared = len(list(takewhile(lambda level: len(set(level)) == 1, folders)))
    uses = Counter(path.with_suffix("") for path in paths.values())
    whole = {}
    for name, path in paths.items():
        stem = path.with_suffix("")
        whole[name] = "/".join((stem if uses[stem] == 1 else path).parts[shared:])
    labels = {name: text for name, text in whole.items() if len(text) <= LONGEST_NAME}
    length, longest = LONGEST_NAME - 1, max(map(len, whole.values()), default=0)
    while len(labels) < len(whole):
        ends = Counter(text[-length:] for text in whole.values())
        for name in whole.keys() - labels.keys():
            text = whole[name]
            if ends[text[-length:]] > 1 and length < longest:
                continue
            start = max(len(text) - length, 0)
            folder = text.rfind("/", 0, start) + 1
            if length >= LONGEST_NAME and start - folder < LONGEST_NAME:
                start = folder
            labels[name] = f"…{text[start:]}" if start else text
        length += 1
    return labels


def top_view(
    rotations: np.ndarray,  # [N, 3, 3] camera from world
    centres: np.ndarray,  # [N, 3] world
    points: np.ndarray | None = None,  # [P, 3] world, of the model
) -> np.ndarray:  # [2, 3]
    """Return the map's axes, right and up, in the world.

    The map is perpendicular to the cameras' mean up direction. Nadir photos are seen as from behind the
    cameras (`_nadir_axis`). Up on the map is where most photos look, else up in the photos; if both are
    unknown, the longest axis of the path is horizontal and the first photo on the left.
    """
    centred = centres - centres.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2] if len(centres) > 2 else np.eye(3)
    sizes = np.sqrt(((centred @ axes.T) ** 2).mean(axis=0))
    view, up = rotations[:, 2].mean(axis=0), -rotations[:, 1].mean(axis=0)
    flat = bool(sizes[1] > WIDE * sizes[0] and sizes[2] < THIN * sizes[1])
    nadir = _nadir_axis(centred, view, up, axes[2] if flat else None, points)
    if nadir is not None:
        normal = -nadir * np.sign(view @ nadir)
    elif np.linalg.norm(up) > LEVEL:
        normal = up / np.linalg.norm(up)
    else:
        normal = axes[2] * (1 if up @ axes[2] >= 0 else -1)
    ahead = view - (view @ normal) * normal
    if np.linalg.norm(ahead) <= COMMON and np.linalg.norm(up) > UPRIGHT:
        ahead = up - (up @ normal) * normal
    if np.linalg.norm(ahead) > COMMON:
        ahead /= np.linalg.norm(ahead)
        return np.stack([np.cross(ahead, normal), ahead])
    longest = np.linalg.svd(centred - np.outer(centred @ normal, normal), full_matrices=False)[2][0]
    right = longest - (longest @ normal) * normal
    right /= max(float(np.linalg.norm(right)), 1e-12)
    return np.stack([right, np.cross(normal, right)]) * (-1 if centred[0] @ right > 0 else 1)


def _nadir_axis(
    centred: np.ndarray,  # [N, 3] centres less their mean
    view: np.ndarray,  # [3] mean viewing direction
    up: np.ndarray,  # [3] mean up direction
    cameras_axis: np.ndarray | None,  # [3] normal of the plane in which the cameras lie
    points: np.ndarray | None,  # [P, 3]
) -> np.ndarray | None:  # [3] unit length
    """Return the axis along which nadir photos look; None for photos that are seen better from above.

    Photos that all look the same way without a common up direction are nadir photos. With one, a strip flown
    one way and a walk along a facade differ in their path: a strip goes along up in the photos, and a view
    along up would hide it. A strip flown sideways cannot be told from a walk, and is drawn as one.
    """
    agreeing = bool(np.linalg.norm(view) > AXES_AGREE)
    axis = cameras_axis if cameras_axis is not None and abs(view @ cameras_axis) > DOWN else None
    if axis is None and agreeing and points is not None:
        normal = _thin_axis(points)
        if normal is not None and abs(view @ normal) > DOWN * np.linalg.norm(view):
            axis = normal
    if np.linalg.norm(up) <= UPRIGHT:
        return view / np.linalg.norm(view) if axis is None and agreeing else axis
    if axis is None:
        return None
    upwards = up - (up @ axis) * axis
    upwards /= max(float(np.linalg.norm(upwards)), 1e-12)
    directions = np.array([upwards, np.cross(axis, upwards), axis])
    tall, wide, deep = np.sqrt(((centred @ directions.T) ** 2).mean(axis=0))
    return axis if tall > TALL * wide and deep < THIN * tall else None


def _thin_axis(
    points: np.ndarray,  # [P, 3]
) -> np.ndarray | None:  # [3] unit length
    """Return the normal of the plane in which most points lie; None if they lie in no plane."""
    if len(points) < 4:
        return None
    apart = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    core = points[apart <= np.percentile(apart, CORE)]
    values, axes = np.linalg.eigh(np.cov(core.T))  # ascending
    sizes = np.sqrt(np.maximum(values, 0.0))
    return np.asarray(axes[:, 0]) if sizes[0] < THIN * sizes[1] and sizes[1] > WIDE * sizes[2] else None


def _links(rows: Iterable[tuple[str, str, int]], at: Mapping[str, int]) -> list[Link]:
    """Return links between known photos by index."""
    known = [(at[a], at[b], int(m)) for a, b, m in rows if a in at and b in at]
    return [(*_sorted((a, b)), m) for a, b, m in known]


def _with_links(drawn: CaptureMap, links: Sequence[Link]) -> CaptureMap:
    """Add the strongest links of each photo and all weak ones, with advice for these."""
    photos = drawn.photos
    kept = [k for k, photo in enumerate(photos) if photo.kind in ("train", "test")]
    weak_photos = set(weakly_connected(kept, links)) if links else set()
    weak = bridges(overlap_graph(len(photos), links))
    strongest: set[tuple[int, int]] = set()
    of: list[list[Link]] = [[] for _ in photos]
    for link in sorted(links, key=lambda link: (-link[2], link)):
        for end in link[:2]:
            if len(of[end]) < STRONGEST:
                strongest.add(link[:2])
            of[end].append(link)
    # A photo with few covisible ones needs a stronger link: the strongest, where overlap is proven.
    wanted = weak | {of[k][0][:2] for k in weak_photos if of[k]}
    shown = [
        MapLink((a, b), matches, "weak" if (a, b) in wanted else "strong")
        for a, b, matches in links
        if (a, b) in strongest | wanted
    ]
    to_strengthen = sorted((m, a, b) for a, b, m in links if (a, b) in wanted)
    return replace(
        drawn,
        photos=[replace(photo, weak=k in weak_photos) for k, photo in enumerate(photos)],
        links=shown,
        stars=[_middle(photos[a], photos[b]) for _, a, b in to_strengthen],
        advice=[_between(photos[a], photos[b]) for _, a, b in to_strengthen],
    )


def _with_left_out(
    drawn: CaptureMap,
    left_out: Mapping[str, str],  # name -> reason
    mapping: MappingResult,
    shown: Mapping[str, str],  # name -> name on the map
    at: Mapping[str, int],  # name of a registered photo -> its index
    plane: np.ndarray,  # [2, 3]
    size: float,
) -> CaptureMap:
    """Add the photos left out: at their hypothesis, else beside the registered photo that they match most."""
    photos, links, stars = list(drawn.photos), list(drawn.links), list(drawn.stars)
    wanted: dict[str, list[str]] = {}  # registered photo -> photos left out that match it most
    reasons: dict[str, list[str]] = {}
    best: dict[str, tuple[int, str]] = {}
    for a, b, matches in mapping["unregistered_links"]:
        for lost, covisible in ((a, b), (b, a)):
            if lost in left_out and covisible in at and matches > best.get(lost, (0, ""))[0]:
                best[lost] = int(matches), covisible
    middle = np.median([photo.xy for photo in drawn.photos], axis=0)
    low, high = frame_limits(np.array([photo.xy for photo in drawn.photos]))
    likely = {name: plane @ np.array(xyz, float) for name, xyz in mapping["hypotheses"].items()}
    # A hypothesis far from all registered photos is wrong more often than not.
    likely = {name: xy for name, xy in likely.items() if (low <= xy).all() and (xy <= high).all()}
    for name, reason in left_out.items():
        matches, covisible = best.get(name, (0, ""))
        if name in likely:
            xy = likely[name]
        elif covisible:
            xy = _beside(np.array(drawn.photos[at[covisible]].xy), middle, ASIDE * size, photos)
        reasons.setdefault(reason, []).append(shown[name])
        if name not in likely and not covisible:
            continue
        photos.append(MapPhoto(shown[name], as_pair(xy), "left out", unsure=name not in likely))
        if covisible:
            links.append(MapLink((at[covisible], len(photos) - 1), matches, "left out"))
            stars.append(_middle(photos[at[covisible]], photos[-1]))
            wanted.setdefault(shown[covisible], []).append(shown[name])
    return replace(
        drawn,
        photos=photos,
        links=links,
        stars=stars,
        advice=[
            *drawn.advice,
            *(connection_advice(name, shortlist(lost, 3)) for name, lost in wanted.items()),
        ],
        listed=[*drawn.listed, *(f"{shortlist(names, 3)}: {why}" for why, names in reasons.items())],
    )


def frame_limits(
    xy: np.ndarray,  # [N, 2] positions of the registered cameras
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower left and the upper right corner of what the map may show."""
    reach = (WIDEST - 1) / 2 * longer_side(xy)
    return xy.min(axis=0) - reach, xy.max(axis=0) + reach


def _beside(
    covisible: np.ndarray,  # [2]
    middle: np.ndarray,  # [2] of the map
    distance: float,
    photos: Sequence[MapPhoto],
) -> np.ndarray:
    """Return a free position at a distance from a photo, away from the middle of the map if possible."""
    away = covisible - middle
    turns = np.array([0.5 * (k // 2) * (-1) ** k for k in range(1, 12)])
    angles = np.arctan2(away[1], away[0]) + turns
    places = covisible + distance * np.column_stack([np.cos(angles), np.sin(angles)])
    taken = np.array([photo.xy for photo in photos])
    room = np.linalg.norm(places[:, None] - taken[None], axis=2).min(axis=1)
    free = np.flatnonzero(room > ROOM * distance)
    return np.asarray(places[free[0] if len(free) else int(np.argmax(room))])


def _between(first: MapPhoto, second: MapPhoto) -> str:
    return connection_advice(first.name, second.name)


def _sorted(pair: tuple[int, int]) -> tuple[int, int]:
    return min(pair), max(pair)


def _middle(first: MapPhoto, second: MapPhoto) -> tuple[float, float]:
    return (first.xy[0] + second.xy[0]) / 2, (first.xy[1] + second.xy[1]) / 2


def as_pair(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def longer_side(xy: np.ndarray) -> float:
    """Return the longer side of the box around positions [N, 2]; 1 if there is none."""
    return float(np.ptp(xy, axis=0).max()) or 1.0 if len(xy) else 1.0
