"""map.png: draw a map of a capture."""

from __future__ import annotations

import re
import textwrap
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.builder.capture_map import (
    LEVEL,
    CaptureMap,
    Kind,
    MapPhoto,
    as_pair,
    frame_limits,
    map_of_model,
)
from ambiguous_wild.builder.records import MappingResult, MapResult
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.colmap_records import ColmapModel
from ambiguous_wild.io.files import atomic_path, check_output
from ambiguous_wild.io.palette import CATEGORIES, NEUTRAL, plot_colour
from ambiguous_wild.io.scene_folder import MAP

SOFTWARE = "ambiguous_wild"  # text chunk `Software` of the file, followed by the version
SIZE_PX, PANEL_PX, TITLE_PX = (1300, 860), 380, 40  # of the picture, its side panel and its title
DPI = 100
MAX_ADVICE, MAX_LISTED = 7, 8  # sentences at the side
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
    "component": CATEGORIES[2],
    "left out": NEUTRAL,
}


def draw_scene_map(
    folder: Path,
    model: ColmapModel,
    mapping: MappingResult,
    sources: Mapping[str, str],
    tests: Collection[str],
) -> MapResult:
    """Write the map of a built scene into a folder; arguments as in `map_of_model`."""
    drawn = map_of_model(model, mapping, sources, tests)
    write_map(drawn, folder / MAP)
    return {"advice": drawn.advice}


def frame(drawn: CaptureMap) -> tuple[tuple[float, float], float]:
    """Return the middle of the map, and the map's units per px."""
    xy = np.array([photo.xy for photo in drawn.photos])
    placed = np.array([not drawn.posed or photo.kind in ("train", "test") for photo in drawn.photos])
    least, most = frame_limits(xy[placed] if placed.any() else xy)
    shown = np.clip(xy, least, most)
    low, high = shown.min(axis=0), shown.max(axis=0)
    if len(drawn.points):
        core = np.clip(np.percentile(drawn.points, CORE, axis=0), least, most)
        low, high = np.minimum(low, core[0]), np.maximum(high, core[1])
    room = np.array([SIZE_PX[0] - PANEL_PX, SIZE_PX[1] - TITLE_PX]) * (1 - 2 * MARGIN)
    unit = float(((high - low) / room).max()) or 1.0 / room.max()
    return as_pair((low + high) / 2), unit


def place_labels(
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
                placed[photo] = as_pair(box[:2])
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
            figure.savefig(temporary, format="png", metadata={"Software": f"{SOFTWARE} {__version__}"})


def check_target(path: Path, raw: Sequence[Path]) -> None:
    """Check, before long work, that a map can be written to `path` without a loss.

    Raises:
        AwError: `path` lies in a folder of the capture, is no .png, or holds anything but a map.
    """
    target = path.resolve()
    for folder in raw:
        if target.is_relative_to(folder.resolve()):
            raise AwError(
                f"{path} lies in the capture {folder}, where it would be taken for a photo: "
                "choose an -o outside it"
            )
    if target.suffix.lower() != ".png":
        raise AwError(f"{path} is no .png: the map is a PNG; choose an -o such as map.png")
    if target.exists() and not target.is_file():
        raise AwError(f"{path} is no regular file; choose another -o")
    if target.exists() and not is_map(target):
        raise AwError(f"{path} exists and is no map that aw drew: move it away, or choose another -o")
    check_output(path)


def is_map(path: Path) -> bool:
    """Tell whether a file is a map of `write_map`, by its text chunk (PNG specification, 11.3.3.3)."""
    try:
        with open(path, "rb") as file:
            if file.read(8) != b"\x89PNG\r\n\x1a\n":
                return False
            while len(head := file.read(8)) == 8 and head[4:] not in (b"IDAT", b"IEND"):
                length = int.from_bytes(head[:4], "big")
                if head[4:] == b"tEXt" and length < 1000:
                    if file.read(length).startswith(f"Software\0{SOFTWARE} ".encode()):
                        return True
                    length = 0
                file.seek(length + 4, 1)  # the checksum is 4 bytes
    except OSError as error:
        raise AwError(f"cannot read {path}: {error.strerror or error}; choose another -o") from error
    return False


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
                as_pair(at),
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
            as_pair(at),
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

    photos, advice = drawn.photos, drawn.advice[:MAX_ADVICE]
    named = {name for text in advice for name in _names_in(drawn, text)}

    def urgency(k: int) -> tuple[bool, bool, bool, int]:
        photo = photos[k]
        return photo.name not in named, not photo.weak, photo.kind == "train", k

    order = sorted(range(len(photos)), key=urgency)
    # Names may cover wedges, but not the half next to a camera.
    ahead = np.array([photo.heading or (0.0, 0.0) for photo in photos])
    dots = np.concatenate([xy, stars, xy + 0.4 * wedge_length(xy) * ahead])
    names = [drawn.labels.get(photo.name, photo.name) for photo in photos]
    for k, corner in place_labels(dots, names, order, size).items():
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
        ("Take more photos (star)" if drawn.stars else "Take more photos", drawn.advice, MAX_ADVICE),
        ("Not registered", drawn.listed, MAX_LISTED),
    ):
        if not sentences:
            continue
        top -= line
        axes.text(12, top, heading, fontsize=_points(FONT_PX + 1), va="top", weight="bold")
        top -= 1.3 * line
        more = [f"and {len(sentences) - most} more"] if len(sentences) > most else []
        for text in [*(with_labels(drawn, text) for text in sentences[:most]), *more]:
            rows = textwrap.wrap(text, int((PANEL_PX - 30) / (CHARACTER * FONT_PX))) or [""]
            axes.text(
                12, top, "\n".join(rows), fontsize=_points(FONT_PX), va="top", linespacing=1.2,
                parse_math=False,
            )  # fmt: skip
            top -= len(rows) * line + 5


def with_labels(drawn: CaptureMap, text: str) -> str:
    """Return a sentence with the names of photos as they stand on the map."""
    if not drawn.labels:
        return text
    return _any_name(drawn).sub(lambda match: drawn.labels[match[0]], text)


def _names_in(drawn: CaptureMap, text: str) -> list[str]:
    return _any_name(drawn).findall(text) if drawn.labels else []


def _any_name(drawn: CaptureMap) -> re.Pattern[str]:
    """Return a pattern of the names of photos, the longest first: a name may be a part of another."""
    names = sorted(drawn.labels, key=lambda name: (-len(name), name))
    return re.compile(rf"(?<!\w)(?:{'|'.join(map(re.escape, names))})(?!\w)")


def _legend(drawn: CaptureMap) -> Iterator[tuple[str, str]]:
    """Yield what the map holds: kind of a symbol, and its meaning."""
    kinds = {photo.kind for photo in drawn.photos}
    if "train" in kinds:
        yield "train", "train photo" if drawn.posed else "will be registered"
    if "test" in kinds:
        yield "test", "test photo"
    if any(photo.heading for photo in drawn.photos):
        yield "wedge", "viewing direction"
    if "component" in kinds:
        yield "component", "another part"
    if any(photo.provisional for photo in drawn.photos):
        yield "provisional", "registered with little evidence"
    if any(photo.kind == "left out" and not photo.unsure for photo in drawn.photos):
        yield "left out", "not registered" if drawn.posed else "will not be registered"
    if any(photo.unsure for photo in drawn.photos):
        yield "?", "not registered, drawn beside its best match"
    if any(photo.weak for photo in drawn.photos):
        yield "weak photo", "overlaps with fewer than three photos"
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
