"""map.png: the cameras from above, which photos overlap, and where to take more photos.

What is drawn is decided by functions without pixels: `map_of_model` for a built scene, `map_of_photos` for
photos without poses. `draw_map` draws it.
"""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal, cast

import numpy as np

from ambiguous_wild.builder.growth import Growth
from ambiguous_wild.builder.overlap_graph import Link, best_join, bridges, lay_out, weakly_held
from ambiguous_wild.builder.records import MappingResult, MapResult
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.io.colmap_records import Model
from ambiguous_wild.io.files import atomic_path
from ambiguous_wild.io.palette import CATEGORIES, NEUTRAL, plot_colour

FILE = "map.png"  # in the scene's folder
SIZE_PX, PANEL_PX, TITLE_PX = (1300, 860), 380, 40  # of the picture, its side panel and its title
DPI = 100
MOST_POINTS = 5000  # of the backdrop
STRONGEST = 4  # links drawn of each photo, besides the weak ones
MOST_ADVICE, MOST_LISTED = 7, 8  # sentences at the side
LONGEST_NAME = 14  # characters
DOWN = 0.8  # share of the mean viewing direction along the normal of the cameras' plane: nadir photos
# Cameras lie in a plane if their second axis is longer than this share of the first, and their third shorter
# than this share of the second.
WIDE, THIN = 0.15, 0.4
LEVEL = 0.3  # length of the mean up direction below which up is unknown; shorter headings are not drawn
COMMON = 0.4  # length of the mean heading from which on it is up on the map
ASIDE = 0.12  # of the map's size: distance of a photo without a position from its best partner

Kind = Literal["train", "test", "part", "left out"]


@dataclass(frozen=True)
class MapPhoto:
    """A photo on the map."""

    name: str
    xy: tuple[float, float]  # x right, y up
    kind: Kind = "train"
    heading: tuple[float, float] | None = None  # viewing direction, at most unit length; None: unknown
    provisional: bool = False  # placed with little evidence
    weak: bool = False  # few partners
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


def draw_built(
    folder: Path,
    model: Model,
    mapping: MappingResult,
    sources: Mapping[str, str],
    tests: Collection[str],
) -> MapResult:
    """Write the map of a built scene into a folder; arguments as in `map_of_model`."""
    drawn = map_of_model(model, cast(Mapping[str, Any], mapping), sources, tests)
    write_map(drawn, folder / FILE)
    return {"advice": drawn.advice}


def map_of_model(
    model: Model,  # named by work names
    mapping: Mapping[str, Any],  # `MappingResult`; what it lacks is not drawn
    sources: Mapping[str, str],  # work name -> path in the capture, in the order of capture
    tests: Collection[str],  # work names
) -> CaptureMap:
    """Return the map of a built scene."""
    placed = {image.name: image.cam_from_world() for image in model.images.values()}
    names = [name for name in sources if name in placed]
    poses = np.array([placed[name] for name in names]).reshape(-1, 4, 4)
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    plane = top_view(poses[:, :3, :3], centres)
    flat = centres @ plane.T
    size = _size(flat)
    labels = {name: photo_label(source) for name, source in sources.items()}
    provisional = set(mapping.get("provisional", ()))
    photos = [
        MapPhoto(
            labels[name],
            _pair(flat[k]),
            "test" if name in tests else "train",
            _pair(plane @ poses[k, 2, :3]),
            provisional=name in provisional,
        )
        for k, name in enumerate(names)
    ]
    at = {name: k for k, name in enumerate(names)}
    links = _links(mapping.get("links", ()), at)
    other_parts = [part for part in mapping.get("parts", ()) if not at.keys() & set(part)]
    elsewhere = {name for part in other_parts for name in part}
    left_out = {name: why for name, why in mapping["left_out"].items() if name in sources.keys() - elsewhere}
    order = {name: k for k, name in enumerate(sources)}
    result = CaptureMap(f"{len(names)} of {len(sources)} photos placed, seen from above", photos, [], [], [])
    result = _with_links(result, links)
    for part in other_parts:
        members = sorted(order[name] for name in part if name in order)
        if not members:
            continue
        every = list(sources)
        loose = _links(mapping.get("unplaced_links", ()), order)
        inside, outside = best_join([order[name] for name in names], members, loose)
        pair = (labels[every[inside]], labels[every[outside]])
        named = shortlist([labels[every[k]] for k in members], 3)
        result.listed.append(f"another part, {len(members)} photos: {named}")
        result.advice.insert(0, f"take a photo that shows both {pair[0]} and {pair[1]}, to join the parts")
    result = _with_left_out(result, left_out, mapping, labels, at, plane, size)
    points = model.points.xyz[:: max(1, -(-len(model.points.xyz) // MOST_POINTS))]
    colours = model.points.rgb[:: max(1, -(-len(model.points.xyz) // MOST_POINTS))]
    return replace(result, points=points @ plane.T, colours=colours)


def map_of_photos(
    sources: Sequence[str],  # in the order of capture
    links: Sequence[Link],
    growth: Growth,
) -> CaptureMap:
    """Return the map of photos without poses: near each other if they overlap much."""
    main = set(growth.parts[0]) if growth.parts else set()
    in_part = {photo for part in growth.parts[1:] for photo in part}
    xy = lay_out(len(sources), links)
    photos = [
        MapPhoto(
            photo_label(source),
            _pair(xy[k]),
            "train" if k in main else "part" if k in in_part else "left out",
        )
        for k, source in enumerate(sources)
    ]
    title = f"about {len(main)} of {len(sources)} photos will be placed; near = much overlap, not positions"
    result = _with_links(CaptureMap(title, photos, [], [], [], posed=False), links)
    gaps = joins(growth, links)
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
            f"another part, {len(part)} photos: {shortlist([photos[k].name for k in part], 3)}"
            for part in growth.parts[1:]
        ]
        + ([f"of no part: {shortlist([photos[k].name for k in growth.others])}"] if growth.others else []),
    )


def joins(growth: Growth, links: Sequence[Link]) -> list[tuple[int, int]]:
    """Return pairs of photos between which more photos are needed, so that all parts join the first."""
    if not growth.parts:
        return []
    inside, pairs = set(growth.parts[0]), []
    left = [*growth.parts[1:], *([k] for k in growth.others)]
    while left:
        pair = best_join(inside, [photo for part in left for photo in part], links)
        pairs.append(pair)
        (joined,) = (part for part in left if pair[1] in part)
        inside |= set(joined)
        left.remove(joined)
    return pairs


def between(first: str, second: str) -> str:
    """Return the advice for two photos that hardly overlap."""
    return f"take 2 or 3 photos between {first} and {second}"


def photo_label(source: str) -> str:
    """Return the name of a photo for the map: without extension, its beginning left out if it is long."""
    text = "".join(c if c.isprintable() else "?" for c in str(PurePosixPath(source).with_suffix("")))
    return text if len(text) <= LONGEST_NAME else f"…{text[1 - LONGEST_NAME :]}"


def top_view(
    rotations: np.ndarray,  # [N, 3, 3] camera from world
    centres: np.ndarray,  # [N, 3] world
) -> np.ndarray:  # [2, 3]
    """Return the map's axes, right and up, in the world.

    The map is perpendicular to the cameras' mean up direction. Nadir photos have no common one: they are seen
    as from behind the cameras, on the plane in which these lie. Up on the map is where most photos look; if
    they look all round, the longest axis of the path is horizontal and the first photo on the left.
    """
    spread = centres - centres.mean(axis=0)
    axes = np.linalg.svd(spread, full_matrices=False)[2] if len(centres) > 2 else np.eye(3)
    sizes = np.sqrt(((spread @ axes.T) ** 2).mean(axis=0))
    view, up = rotations[:, 2].mean(axis=0), -rotations[:, 1].mean(axis=0)
    plane = sizes[1] > WIDE * sizes[0] and sizes[2] < THIN * sizes[1]
    if plane and abs(view @ axes[2]) > DOWN:
        normal = -axes[2] * np.sign(view @ axes[2])
    elif np.linalg.norm(up) > LEVEL:
        normal = up / np.linalg.norm(up)
    else:
        normal = axes[2] * (1 if up @ axes[2] >= 0 else -1)
    ahead = view - (view @ normal) * normal
    if np.linalg.norm(ahead) > COMMON:
        ahead /= np.linalg.norm(ahead)
        return np.stack([np.cross(ahead, normal), ahead])
    longest = np.linalg.svd(spread - np.outer(spread @ normal, normal), full_matrices=False)[2][0]
    right = longest - (longest @ normal) * normal
    right /= max(float(np.linalg.norm(right)), 1e-12)
    return np.stack([right, np.cross(normal, right)]) * (-1 if spread[0] @ right > 0 else 1)


def _links(rows: Sequence[Sequence[Any]], at: Mapping[str, int]) -> list[Link]:
    """Return links between known photos by index."""
    known = [(at[a], at[b], int(m)) for a, b, m in rows if a in at and b in at]
    return [(*_sorted((a, b)), m) for a, b, m in known]


def _with_links(drawn: CaptureMap, links: Sequence[Link]) -> CaptureMap:
    """Add the strongest links of each photo and all weak ones, with advice for these."""
    photos = drawn.photos
    kept = [k for k, photo in enumerate(photos) if photo.kind in ("train", "test")]
    weak_photos = set(weakly_held(kept, links)) if links else set()
    weak = bridges(len(photos), links)
    strongest: set[tuple[int, int]] = set()
    of: list[list[Link]] = [[] for _ in photos]
    for link in sorted(links, key=lambda link: (-link[2], link)):
        for end in link[:2]:
            if len(of[end]) < STRONGEST:
                strongest.add(link[:2])
            of[end].append(link)
    # A photo with few partners needs one of its links strengthened: the strongest, where overlap is proven.
    wanted = weak | {of[k][0][:2] for k in weak_photos if of[k]}
    shown = [
        MapLink((a, b), matches, "weak" if (a, b) in wanted else "strong")
        for a, b, matches in links
        if (a, b) in strongest | wanted
    ]
    asked = sorted((m, a, b) for a, b, m in links if (a, b) in wanted)
    return replace(
        drawn,
        photos=[replace(photo, weak=k in weak_photos) for k, photo in enumerate(photos)],
        links=shown,
        stars=[_middle(photos[a], photos[b]) for _, a, b in asked],
        advice=[_between(photos[a], photos[b]) for _, a, b in asked],
    )


def _with_left_out(
    drawn: CaptureMap,
    left_out: Mapping[str, str],  # work name -> reason
    mapping: Mapping[str, Any],
    labels: Mapping[str, str],
    at: Mapping[str, int],  # work name of a placed photo -> its index
    plane: np.ndarray,  # [2, 3]
    size: float,
) -> CaptureMap:
    """Add the photos left out: at their hypothesis, else beside the placed photo that they match most."""
    photos, links, stars = list(drawn.photos), list(drawn.links), list(drawn.stars)
    wanted: dict[str, list[str]] = {}  # placed photo -> photos left out that match it most
    reasons: dict[str, list[str]] = {}
    best: dict[str, tuple[int, str]] = {}
    for a, b, matches in mapping.get("unplaced_links", ()):
        for lost, partner in ((a, b), (b, a)):
            if lost in left_out and partner in at and matches > best.get(lost, (0, ""))[0]:
                best[lost] = int(matches), partner
    hypotheses = mapping.get("hypotheses", {})
    middle = np.median([photo.xy for photo in drawn.photos], axis=0)
    beside: dict[str, int] = {}  # partner -> photos drawn beside it
    for name, reason in left_out.items():
        matches, partner = best.get(name, (0, ""))
        if name in hypotheses:
            xy = plane @ np.array(hypotheses[name], float)
        elif partner:
            number = beside[partner] = beside.get(partner, 0) + 1
            away = np.array(drawn.photos[at[partner]].xy) - middle
            angle = np.arctan2(away[1], away[0]) + 0.6 * (number // 2) * (-1) ** number
            xy = drawn.photos[at[partner]].xy + ASIDE * size * np.array([np.cos(angle), np.sin(angle)])
        reasons.setdefault(reason, []).append(labels[name])
        if name not in hypotheses and not partner:
            continue
        photos.append(MapPhoto(labels[name], _pair(xy), "left out", unsure=name not in hypotheses))
        if partner:
            links.append(MapLink((at[partner], len(photos) - 1), matches, "left out"))
            stars.append(_middle(photos[at[partner]], photos[-1]))
            wanted.setdefault(labels[partner], []).append(labels[name])
    return replace(
        drawn,
        photos=photos,
        links=links,
        stars=stars,
        advice=[*drawn.advice, *(between(name, shortlist(lost, 3)) for name, lost in wanted.items())],
        listed=[*drawn.listed, *(f"{shortlist(names, 3)}: {why}" for why, names in reasons.items())],
    )


def _between(first: MapPhoto, second: MapPhoto) -> str:
    return between(first.name, second.name)


def _sorted(pair: tuple[int, int]) -> tuple[int, int]:
    return min(pair), max(pair)


def _middle(first: MapPhoto, second: MapPhoto) -> tuple[float, float]:
    return (first.xy[0] + second.xy[0]) / 2, (first.xy[1] + second.xy[1]) / 2


def _pair(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _size(xy: np.ndarray) -> float:
    """Return the longer side of the box around positions [N, 2]; 1 if there is none."""
    return float(np.ptp(xy, axis=0).max()) or 1.0 if len(xy) else 1.0


WIDEST = 1.5  # size of the map in sizes of the cameras' box: far points are cut off
CORE = (10, 90)  # percentiles of the backdrop's positions that are shown if they fit
MARGIN = 0.08  # of the map's size
FONT_PX, NAME_PX = 12.0, 11.0
CHARACTER, DIGIT = 0.56, 0.66  # mean width of a character of a sentence and of a name, of the font's size
CAMERA_PX, OPENING_DEG = 8.0, 50.0  # diameter of a camera's dot, and angle of its wedge
SHORT_PX, WEDGE_PX = 12.0, 24.0  # length of a wedge where cameras are close together, and elsewhere
BULGE = 0.2  # of a link, of its length: links along a straight path would hide each other
# Positions of a name around its camera, in the order in which they are tried.
AROUND = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
WEAK_COLOUR, STAR_COLOUR, LINK_COLOUR = (200, 20, 110), CATEGORIES[4], (120, 130, 150)
COLOURS: dict[Kind, tuple[int, int, int]] = {
    "train": CATEGORIES[0],
    "test": CATEGORIES[1],
    "part": CATEGORIES[2],
    "left out": NEUTRAL,
}


def frame(drawn: CaptureMap) -> tuple[tuple[float, float], float]:
    """Return the middle of the map, and the map's units per px."""
    xy = np.array([photo.xy for photo in drawn.photos])
    low, high = xy.min(axis=0), xy.max(axis=0)
    if len(drawn.points):
        core = np.percentile(drawn.points, CORE, axis=0)
        reach = (WIDEST - 1) / 2 * _size(xy)
        low, high = (
            np.minimum(low, np.maximum(core[0], low - reach)),
            np.maximum(high, np.minimum(core[1], high + reach)),
        )
    room = np.array([SIZE_PX[0] - PANEL_PX, SIZE_PX[1] - TITLE_PX]) * (1 - 2 * MARGIN)
    unit = float(((high - low) / room).max()) or 1.0 / room.max()
    return _pair((low + high) / 2), unit


def place_names(
    xy: np.ndarray,  # [N or more, 2] px, positions of the cameras, then of other symbols, y up
    names: Sequence[str],
    order: Sequence[int],  # photos in the order in which they get room
    size: tuple[float, float],  # width and height of the map, px
) -> dict[int, tuple[float, float]]:  # photo -> lower left corner of its name, px
    """Place the names so that none covers a camera or another name; those without room are missing."""
    half = CAMERA_PX / 2
    taken = [np.column_stack([xy - half, xy + half])]  # left, bottom, right, top
    placed: dict[int, tuple[float, float]] = {}
    for photo in order:
        wide, high = DIGIT * NAME_PX * len(names[photo]), NAME_PX
        for right, up in AROUND:
            middle = xy[photo] + [right * (half + 3 + wide / 2), up * (half + 3 + high / 2)]
            half_size = np.array([wide, high]) / 2
            box = np.concatenate([middle - half_size, middle + half_size])
            if box[0] < 0 or box[1] < 0 or box[2] > size[0] or box[3] > size[1]:
                continue
            others = np.concatenate(taken)
            if not ((others[:, :2] < box[2:]) & (others[:, 2:] > box[:2])).all(axis=1).any():
                taken.append(box[None])
                placed[photo] = _pair(box[:2])
                break
    return placed


def write_map(drawn: CaptureMap, path: Path) -> None:
    """Draw the map as PNG; equal maps give equal bytes."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(matplotlib.rcParamsDefault), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # of names in other scripts
        figure = Figure(figsize=(SIZE_PX[0] / DPI, SIZE_PX[1] / DPI), dpi=DPI, facecolor="white")
        FigureCanvasAgg(figure)
        size = (SIZE_PX[0] - PANEL_PX, SIZE_PX[1] - TITLE_PX)
        axes = figure.add_axes((0, 0, size[0] / SIZE_PX[0], size[1] / SIZE_PX[1]))
        axes.set(xlim=(0, size[0]), ylim=(0, size[1]))
        axes.set_axis_off()
        _draw_map(axes, drawn, size)
        side = figure.add_axes((size[0] / SIZE_PX[0], 0, PANEL_PX / SIZE_PX[0], 1))
        side.set(xlim=(0, PANEL_PX), ylim=(0, SIZE_PX[1]))
        side.set_axis_off()
        _draw_panel(side, drawn)
        figure.text(
            16 / SIZE_PX[0], 1 - 26 / SIZE_PX[1], drawn.title, fontsize=_points(15), weight="bold",
            parse_math=False,
        )  # fmt: skip
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})


def _points(px: float) -> float:
    return px * 72 / DPI


def _draw_map(axes: Any, drawn: CaptureMap, size: tuple[int, int]) -> None:
    middle, unit = frame(drawn)
    half = np.array(size) / 2

    def to_px(xy: Any) -> np.ndarray:
        return np.asarray((np.asarray(xy, float).reshape(-1, 2) - middle) / unit + half)

    if len(drawn.points):
        faded = 1 - 0.45 * (1 - drawn.colours / 255)
        axes.scatter(*to_px(drawn.points).T, s=2.5, c=faded, linewidths=0, zorder=0)
    xy = to_px([photo.xy for photo in drawn.photos])
    most = max((link.matches for link in drawn.links), default=1)
    half_way, wedge_px = np.median(xy, axis=0), wedge_length(xy)
    for link in drawn.links:
        width = wedge_px / WEDGE_PX * (0.6 + 3.4 * np.sqrt(link.matches / max(most, 1)))
        _draw_link(axes, link.kind, xy[list(link.ends)], half_way, width)
    for photo, at in zip(drawn.photos, xy):
        _draw_camera(axes, photo, at, wedge_px)
    if drawn.stars:
        axes.scatter(
            *to_px(drawn.stars).T, s=110, marker="*", color=plot_colour(STAR_COLOUR), edgecolors="black",
            linewidths=0.7, zorder=5,
        )  # fmt: skip
    _draw_names(axes, drawn, xy, to_px(drawn.stars), size)


def _draw_link(axes: Any, kind: str, ends: np.ndarray, middle: np.ndarray, width: float) -> None:
    """Draw a link between two positions [2, 2] in px, a strong one as an arc towards the middle [2]."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Curve

    if kind == "strong":
        along = ends[1] - ends[0]
        aside = BULGE * np.array([-along[1], along[0]])
        start = ends.mean(axis=0)
        top = start + aside * (1 if (middle - start) @ aside >= 0 else -1)
        curve = Curve([ends[0], top, ends[1]], [Curve.MOVETO, Curve.CURVE3, Curve.CURVE3])
        faint = (*plot_colour(LINK_COLOUR), 0.4)
        axes.add_patch(PathPatch(curve, facecolor="none", edgecolor=faint, lw=width, zorder=1))
        return
    colour, dash = (WEAK_COLOUR, "-") if kind == "weak" else (NEUTRAL, "--")
    axes.plot(*ends.T, dash, color=plot_colour(colour), lw=max(width, 1.5), zorder=2)


def wedge_length(
    xy: np.ndarray,  # [N, 2] px
) -> float:
    """Return the length in px of the cameras' wedges: short where cameras are close together."""
    if len(xy) < 2:
        return WEDGE_PX
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return float(np.clip(1.2 * np.median(apart.min(axis=1)), SHORT_PX, WEDGE_PX))


def _draw_camera(axes: Any, photo: MapPhoto, at: np.ndarray, wedge_px: float) -> None:
    """Draw a dot, with a wedge in the viewing direction unless that is nearly along the map's normal."""
    from matplotlib.patches import Circle, Wedge

    colour = plot_colour(COLOURS[photo.kind])
    if photo.unsure:
        axes.text(
            *at, "?", color=colour, fontsize=_points(18), ha="center", va="center", weight="bold", zorder=4
        )
        return
    length = float(np.hypot(*photo.heading)) if photo.heading else 0.0
    if photo.heading and length > LEVEL:
        middle = float(np.degrees(np.arctan2(photo.heading[1], photo.heading[0])))
        ends = (middle - OPENING_DEG / 2, middle + OPENING_DEG / 2)
        axes.add_patch(
            Wedge(
                _pair(at),
                wedge_px * length,
                *ends,
                facecolor=(*colour, 0.3),
                edgecolor=colour,
                lw=0.7,
                zorder=3,
            )
        )
    hollow = photo.provisional or photo.kind == "left out"
    edge = plot_colour(WEAK_COLOUR) if photo.weak else colour
    axes.add_patch(
        Circle(
            _pair(at),
            CAMERA_PX / 2,
            facecolor="white" if hollow else colour,
            edgecolor=edge,
            lw=2.0,
            zorder=4,
        )
    )


def _draw_names(
    axes: Any, drawn: CaptureMap, xy: np.ndarray, stars: np.ndarray, size: tuple[int, int]
) -> None:
    from matplotlib.patheffects import withStroke

    named = {word for text in drawn.advice[:MOST_ADVICE] for word in text.split()}
    photos = drawn.photos

    def urgency(k: int) -> tuple[bool, bool, bool, int]:
        photo = photos[k]
        return photo.name not in named, not photo.weak, photo.kind == "train", k

    order = sorted(range(len(photos)), key=urgency)
    # Names may cover wedges, but not the half next to a camera.
    ahead = np.array([photo.heading or (0.0, 0.0) for photo in photos])
    dots = np.concatenate([xy, stars, xy + 0.4 * wedge_length(xy) * ahead])
    names = [photo.name for photo in photos]
    for k, corner in place_names(dots, names, order, size).items():
        axes.text(
            *corner, names[k], fontsize=_points(NAME_PX), va="bottom", zorder=6, parse_math=False,
            color=plot_colour(COLOURS[photos[k].kind]),
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )  # fmt: skip


def _draw_panel(axes: Any, drawn: CaptureMap) -> None:
    """Draw the legend, the advice and the list of photos that are left out."""
    line = FONT_PX * 1.35
    top = float(SIZE_PX[1] - TITLE_PX)
    for kind, text in _legend(drawn):
        _draw_sample(axes, kind, (22, top - line / 2))
        axes.text(46, top, text, fontsize=_points(FONT_PX), va="top")
        top -= 1.25 * line
    for heading, sentences, most in (
        ("Take more photos (star)", drawn.advice, MOST_ADVICE),
        ("Not placed", drawn.listed, MOST_LISTED),
    ):
        if not sentences:
            continue
        top -= line
        axes.text(12, top, heading, fontsize=_points(FONT_PX + 1), va="top", weight="bold")
        top -= 1.3 * line
        more = [f"and {len(sentences) - most} more"] if len(sentences) > most else []
        for text in [*sentences[:most], *more]:
            rows = textwrap.wrap(text, int((PANEL_PX - 30) / (CHARACTER * FONT_PX))) or [""]
            axes.text(
                12, top, "\n".join(rows), fontsize=_points(FONT_PX), va="top", linespacing=1.2,
                parse_math=False,
            )  # fmt: skip
            top -= len(rows) * line + 5


def _legend(drawn: CaptureMap) -> Iterator[tuple[str, str]]:
    """Yield what the map holds: kind of a symbol, and its meaning."""
    kinds = {photo.kind for photo in drawn.photos}
    if "train" in kinds:
        yield "train", "train photo" if drawn.posed else "will be placed"
    if "test" in kinds:
        yield "test", "test photo"
    if any(photo.heading for photo in drawn.photos):
        yield "wedge", "viewing direction"
    if "part" in kinds:
        yield "part", "another part"
    if any(photo.provisional for photo in drawn.photos):
        yield "provisional", "placed with little evidence"
    if any(photo.kind == "left out" and not photo.unsure for photo in drawn.photos):
        yield "left out", "not placed" if drawn.posed else "will not be placed"
    if any(photo.unsure for photo in drawn.photos):
        yield "?", "not placed, drawn beside its best match"
    if any(photo.weak for photo in drawn.photos):
        yield "weak photo", "overlaps with one or two photos only"
    if any(link.kind == "strong" for link in drawn.links):
        yield "strong", "overlap (thicker: more matches)"
    if any(link.kind == "weak" for link in drawn.links):
        yield "weak", "weak link"


def _draw_sample(axes: Any, kind: str, at: tuple[float, float]) -> None:
    if kind in ("strong", "weak"):
        colour = LINK_COLOUR if kind == "strong" else WEAK_COLOUR
        axes.plot([at[0] - 10, at[0] + 10], [at[1], at[1]], color=plot_colour(colour), lw=2.5)
        return
    photo = {
        "wedge": MapPhoto("", at, heading=(1.0, 0.0)),
        "provisional": MapPhoto("", at, provisional=True),
        "?": MapPhoto("", at, "left out", unsure=True),
        "weak photo": MapPhoto("", at, weak=True),
    }.get(kind, MapPhoto("", at, cast(Kind, kind)))
    _draw_camera(axes, photo, np.array(at), WEDGE_PX / 1.5)
