"""Write one HTML file with models, photos, masks and the program that draws them; it loads nothing else."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import repeat
from pathlib import Path
from typing import TypeVar

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, Camera, Scene, View
from ambiguous_wild.core.machine import in_order, photo_threads
from ambiguous_wild.core.scene import NO_PHOTO
from ambiguous_wild.io.files import check_output, refuse_file
from ambiguous_wild.io.images import header_size, read_gray, read_png_rgb
from ambiguous_wild.io.mask_reasons import WIDTH as REASONS_WIDTH
from ambiguous_wild.io.mask_reasons import read_reasons, regions_uri
from ambiguous_wild.io.motion_points import MotionPoints, read_motion_points
from ambiguous_wild.io.page_parts import data_uri, fill_page, jpeg_bytes, narrowed
from ambiguous_wild.io.scene_folder import MAP
from ambiguous_wild.io.splat_arrays import finite, sigmoid
from ambiguous_wild.io.splat_files import FORMATS, drawable
from ambiguous_wild.metrics.image import psnr
from ambiguous_wild.viewing.model import Renderer, ViewedModel, space_of

PAGE = "index.html"
GENERATOR = '<meta name="generator" content="aw view">'
MAX_GAUSSIANS = 150_000  # default size of a model: about 6 MB, which a phone still turns smoothly
MAX_PHOTO_BYTES = 1_000_000  # text of all photos and of the map
MAX_MAP_BYTES = 200_000
MAX_POINTS = 20_000  # moving and static features of all photos
MAX_MASK_BYTES = 300_000  # text of the masks of all models
MAX_REASON_BYTES = 200_000  # text of the maps of reasons of all models that have any
_SPZ = FORMATS["spz"]  # the format that the page's renderer reads
SCRIPTS = ("page_data.js", "page_camera.js", "page_panes.js", "page_masks.js", "page_main.js")
_HERE = Path(__file__).resolve().parent / "page"
WIDTHS = (640, 480, 360, 240, 160, 96, 64)  # px, tried from the largest
MAP_WIDTHS = (1300, 1000, 800)  # px
_QUALITY = 78
_MASK_WIDTH = 480  # px; largest width of masks
PHOTO = "photo"  # in place of the index of a model
_PREFERRED = "refinesplat"  # shown first among methods with masks
_MOST_REMOVED = 0.5  # larger shares of a photo are no distractor, but a mask gone wrong
# Least number in a masked region, above that of static ones: a distractor in each of 35 photos has 40 to 97,
# regions of static captures have none.
_MOVING_FEATURES = 3
_PIXELS_A_FEATURE = 25  # of a map of optical flow, that count as much as a feature
_NEAR = 0.01  # nearest depth, as in training
_MARGIN = 0.15  # share of the picture beyond each side that is still counted

Source = TypeVar("Source")


@dataclass(frozen=True)
class Page:
    """The written page."""

    path: Path
    bytes: int
    models_bytes: int  # text of the models, part of `bytes`


def check_page_folder(folder: Path) -> None:
    """Check, before anything is drawn, that the page can be written to a folder.

    Raises:
        AwError: the path is a file, cannot be written, or holds a page of another program.
    """
    refuse_file(folder)
    path = folder / PAGE
    check_output(path)
    if path.exists():
        head = path.read_text(encoding="utf-8", errors="replace")[:2000] if path.is_file() else ""
        if GENERATOR not in head:
            raise AwError(f"{path} is no page of 'aw view'; choose another -o")


def page_text(
    scene: Scene,
    models: Sequence[ViewedModel],
    *,
    title: str,
    most_gaussians: int = MAX_GAUSSIANS,
    notes: Sequence[str] = (),
    mixed: str = "",
    next_steps: Sequence[str] = (),
    training: str = "",
    reload_s: float = 0.0,
    say: Callable[[str], None] = lambda text: None,
) -> tuple[str, int]:
    """Return the page's text, and the bytes of models in it.

    A page that is written again and again while a run trains costs little: photos are encoded once.

    Args:
        scene: scene of all the models.
        models: at least one.
        title: title of the page; any text.
        most_gaussians: a larger model is reduced to this number, with a note.
        notes: lines below the models.
        mixed: why test photos may hold distractors; "" = they are clean. Their PSNR then decides nothing.
        next_steps: lines of the panel "What next"; text between two ` is a command or a path.
        training: how far the training is, if it goes on, as a sentence; "" = it has ended.
        reload_s: seconds after which the page loads itself again, counted from when its models are drawn;
            0 = never. It waits while somebody moves the camera or has something that is not saved, and stops
            after ten times in which `training` did not change.
        say: called with a line for each model.

    Raises:
        AwError: no model, or one that cannot be read.
    """
    if not models:
        raise AwError("no model to show")
    views = (*scene.test, *scene.train)
    page_notes, elements, facts = list(notes), [], []
    if mixed:
        page_notes.insert(0, f"* PSNR here rewards ghosts: {mixed}")
    explained = sum(model.reasons is not None for model in models)
    shares = MAX_MASK_BYTES // len(models), MAX_REASON_BYTES // max(explained, 1)
    for number, model in enumerate(models):
        say(f"{model.label}: {model.count:,} Gaussians")
        gaussians = model.read()
        cameras = [view.camera for view in views]
        fewer = reduced(gaussians, cameras, most_gaussians)
        given, shown = len(gaussians["means"]), len(fewer["means"])
        if shown < min(given, most_gaussians):
            page_notes.append(
                f"{model.label}: {given - shown:,} Gaussians with values that are not finite left out"
            )
        elif shown < given:
            page_notes.append(
                f"{model.label}: reduced from {given:,} to {shown:,} Gaussians for this page; "
                "its PSNR is that of the whole model"
            )
        packed = b"".join(_SPZ.encode(drawable(_SPZ, fewer), UNMOVED, model.render_settings.antialias))
        page_notes += [cost] if (cost := _rounding_cost(model, fewer, packed, cameras[0])) else []
        element = f"model-{number}"
        elements.append(
            f'<script id="{element}" type="text/plain">{base64.b64encode(packed).decode("ascii")}</script>'
        )
        facts.append(_model_facts(model, element, views, scene.train, shares))
        facts[-1]["whole"] = shown == given
    for line in page_notes:
        say(line.removeprefix("* "))  # the page marks figures with it
    space = space_of(scene)
    capture_map = map_uri(scene.root / MAP)
    if views[0].image_path == NO_PHOTO:
        drawn = Renderer(models[0].read(), models[0].render_settings)
        uris = [data_uri("jpeg", jpeg_bytes(narrowed(drawn(v.camera), WIDTHS[1]), _QUALITY)) for v in views]
    else:
        files = tuple((v.image_path, _changed_ns(v.image_path)) for v in views)
        uris = _encoded_photos(files, MAX_PHOTO_BYTES - len(capture_map))
    data = {
        "scene": scene.name,
        "mixed": bool(mixed),
        "opening": opening(models, scene, mixed=bool(mixed)),
        "up": space.up.tolist(),
        "middle": space.middle.tolist(),
        "extent": space.extent,
        "frustum": 0.08 * space.extent,
        "centre": scene.transform.centre,  # converts saved paths to the coordinates of the scene's files
        "scale": scene.transform.scale,
        "views": [_view_facts(v, uri, points) for v, uri, points in zip(views, uris, _points(scene, views))],
        "map": capture_map,
        "models": facts,
        "notes": page_notes,
        "next": list(next_steps),
        "training": training,
        "reload_s": reload_s,
    }
    return _fill(title, data, "\n".join(elements)), sum(map(len, elements))


def _rounding_cost(
    model: ViewedModel, gaussians: Mapping[str, np.ndarray], packed: bytes, camera: Camera
) -> str:
    """Return a note on the loss of a model with sizes that the page's format cannot hold; else ""."""
    sizes = np.exp(gaussians["log_scales"].max(axis=1, initial=-np.inf).astype(np.float64))
    stored = _SPZ.decode(packed, model.ply).gaussians
    held = np.exp(stored["log_scales"].max(axis=1, initial=-np.inf).astype(np.float64))
    if not len(sizes) or (sizes.max() < 1.1 * held.max() and np.median(sizes) > 0.9 * np.median(held)):
        return ""
    pictures = [Renderer(arrays, model.render_settings)(camera) for arrays in (gaussians, stored)]
    return (
        f"{model.label}: some of its Gaussians are larger or smaller than the page's format (SPZ) holds: the "
        f"first photo's view is {psnr(*pictures):.1f} dB to the model; 'aw export --format gltf' holds them"
    )


def _model_facts(
    model: ViewedModel,
    element: str,
    views: Sequence[View],
    train: Sequence[View],
    most_bytes: tuple[int, int],
) -> dict[str, object]:
    psnr = {v.name: model.psnr[v.name] for v in views if np.isfinite(model.psnr.get(v.name, np.nan))}
    return {
        "label": model.label,
        "reference": model.reference,
        "element": element,
        "antialias": model.render_settings.antialias,
        "blur": model.render_settings.blur,
        "background": list(model.render_settings.background),
        "psnr": psnr,
        "mean": sum(psnr.values()) / len(psnr) if psnr else None,
        "masks": {} if model.masks is None else mask_uris(model.masks, train, most_bytes[0]),
        "reasons": {} if model.reasons is None else _reason_facts(model.reasons, train, most_bytes[1]),
        "retrain": model.retrain,
    }


def _reason_facts(path: Path, train: Sequence[View], most_bytes: int) -> dict[str, object]:
    read = read_reasons(path)
    shown = {view.name: read[view.name] for view in train if view.name in read}
    maps = [reasons.regions for reasons in shown.values()]
    widths = [width for width in WIDTHS if width <= REASONS_WIDTH]
    uris = _as_wide_as_fits(regions_uri, maps, widths, most_bytes)
    return {
        name: {"regions": uri, "sentences": reasons.sentences}
        for (name, reasons), uri in zip(shown.items(), uris)
    }


def opening(models: Sequence[ViewedModel], scene: Scene, *, mixed: bool) -> dict[str, object]:
    """Choose what the page opens with: where a method masks what moves, if it does anywhere.

    Methods also mask what they cannot learn, such as leaves in front of the sky. On real captures neither
    areas nor colours of other photos told that from distractors; features that move do. In a scene without
    them (motion.npz) it opens where most is masked, and claims nothing.

    Returns:
        `left` and `right`, indices of models or "photo"; `view`, an index among test and train views;
        `place`, x and y of the upper edge of what moves as shares of the photo, or None.
    """
    masking = [n for n, model in enumerate(models) if model.masks is not None and not model.reference]
    masking.sort(key=lambda n: not models[n].label.startswith(_PREFERRED))
    points = read_motion_points(scene.root)
    places = {view.name: number for number, view in enumerate((*scene.test, *scene.train))}
    for right in masking:
        masks = models[right].masks
        assert masks is not None
        regions = [
            (*_surest_region(~keep, points.get(name)), places[name])
            for name, keep in _keep_maps(masks, scene.train)
            if 1.0 - _MOST_REMOVED <= keep.mean() < 1.0 and (name in points or not points)
        ]
        evidence, top, view = max(regions, default=(0.0, [], 0))
        if evidence >= _MOVING_FEATURES or (regions and not points):
            left = min(
                set(range(len(models))) - {right},
                key=lambda n: (models[n].reference, n in masking, n),
                default=PHOTO,
            )
            return {"left": left, "right": right, "view": view, "place": top if points else None}
    means = [_mean_psnr(model) if not mixed else 0.0 for model in models]
    masked = masking[:1] if mixed else []  # PSNR would choose the model that shows distractors
    best = max(range(len(models)), key=lambda n: (not models[n].reference, n in masked, means[n]))
    # the test photo that the best model knows best, else one that photos on both sides support
    known = {view.name: max(m.psnr.get(view.name, -np.inf) for m in models) for view in scene.test}
    view = max(range(len(scene.test)), key=lambda n: known[scene.test[n].name], default=0)
    view = (len(scene.test) - 1) // 2 if mixed and scene.test else view
    left = next((n for n in range(len(models)) if n != best), PHOTO)
    if left == PHOTO and best not in masking:
        return {"left": best, "right": PHOTO, "view": view, "place": None}
    return {"left": left, "right": best, "view": view, "place": None}


def _mean_psnr(model: ViewedModel) -> float:
    finite_values = [value for value in model.psnr.values() if np.isfinite(value)]
    return float(np.mean(finite_values)) if finite_values else -100.0


def _surest_region(masked: np.ndarray, points: MotionPoints | None) -> tuple[float, list[float]]:
    """Find the masked region [H, W] bool with the strongest evidence that it moves.

    Returns:
        its features, and areas by optical flow, that move minus those that are static; without `points`, its
        share of the photo.
        x and y of the middle of its upper edge, as shares of the photo.
    """
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(masked.astype(np.uint8))
    evidence: np.ndarray = stats[:, cv2.CC_STAT_AREA] / masked.size
    if points is not None:
        column, row = (points.xy * masked.shape[::-1]).astype(int).T
        inside = labels[np.minimum(row, masked.shape[0] - 1), np.minimum(column, masked.shape[1] - 1)]
        evidence = np.bincount(inside, np.where(points.moves, 1.0, -1.0), minlength=len(stats)).astype(float)
        if points.flow is not None:
            stays, moves = points.flow.astype(np.float64)
            at = cv2.resize(labels, moves.shape[::-1], interpolation=cv2.INTER_NEAREST)
            excess = np.sign(moves - stays) / _PIXELS_A_FEATURE
            evidence += np.bincount(at.ravel(), excess.ravel(), minlength=len(stats))
    surest = 1 + int(np.argmax(evidence[1:]))
    left, top, width = stats[surest, :3].tolist()
    return float(evidence[surest]), [(left + width / 2) / masked.shape[1], top / masked.shape[0]]


def _points(scene: Scene, views: Sequence[View]) -> list[list[int]]:
    """Return for each view a flat list of x, y in thousandths of the photo and 1 if the feature moves.

    Each photo has the same largest number of features; moving ones come first.
    """
    motion_points, most = read_motion_points(scene.root), MAX_POINTS // max(len(views), 1)
    rows: list[list[int]] = []
    for view in views:
        points = motion_points.get(view.name)
        if points is None:
            rows.append([])
            continue
        chosen = np.argsort(~points.moves, kind="stable")[:most]
        xy = (points.xy[chosen] * 999).astype(int)
        rows.append(np.column_stack([xy, points.moves[chosen]]).ravel().tolist())
    return rows


def _view_facts(view: View, photo: str, points: list[int]) -> dict[str, object]:
    camera = view.camera
    return {
        "name": view.name,
        "split": view.split if view.image_path != NO_PHOTO else "",
        **{field: getattr(camera, field) for field in ("width", "height", "fx", "fy", "cx", "cy")},
        "cam_from_world": camera.cam_from_world.ravel().tolist(),
        "photo": photo,
        "points": points,
    }


def _fill(title: str, data: Mapping[str, object], models: str) -> str:
    licences = html.escape((_HERE / "licences.txt").read_text(encoding="utf-8"), quote=False)
    return fill_page(
        _HERE,
        data,
        SCRIPTS,
        title=title,
        # Spark compiles WebAssembly from bytes and starts workers from blobs; nothing else may be loaded.
        images="data: blob:",
        more_sources="worker-src blob:; ",
        more_scripts=" blob: 'wasm-unsafe-eval'",
        parts={
            "MODELS": models,
            "RENDERER": base64.b64encode((_HERE / "renderer.js.gz").read_bytes()).decode("ascii"),
            "LICENCES": licences.replace("--", "—"),  # "--" would end the comment that holds them
        },
    )


def photo_uris(paths: Sequence[Path], most_bytes: int) -> list[str]:
    """Return a data: address of each photo as JPEG, at the largest width at which all fit `most_bytes`.

    1000 photos or more can exceed it at the smallest width. A few photos are in memory at a time.
    """
    sizes = [math.prod(header_size(path) or (0, 0)) for path in paths]
    return _as_wide_as_fits(_photo, paths, WIDTHS, most_bytes, photo_threads(max(sizes, default=0)))


def _changed_ns(path: Path) -> int:
    return path.stat().st_mtime_ns if path.is_file() else 0


@lru_cache(maxsize=1)
def _encoded_photos(files: tuple[tuple[Path, int], ...], most_bytes: int) -> list[str]:
    """Return `photo_uris` of files and their times of change, from memory for the last page's photos."""
    return photo_uris([path for path, _ in files], most_bytes)


def map_uri(path: Path) -> str:
    """Return a data: address of the scene's map as JPEG, "" without one."""
    return _as_wide_as_fits(_photo, [path], MAP_WIDTHS, MAX_MAP_BYTES)[0] if path.is_file() else ""


def mask_uris(
    masks: Path | Mapping[str, np.ndarray], views: Sequence[View], most_bytes: int
) -> dict[str, str]:
    """Return a data: address of each keep map as black-and-white PNG, by view name.

    They have the largest width at which all fit `most_bytes` of text.

    Args:
        masks: folder of the maps, or the maps by name of the view; see `ViewedModel.masks`.
        views: views whose maps are wanted, where there are any.
        most_bytes: limit of all addresses together.
    """
    sources = _mask_sources(masks, views)
    widths = [width for width in WIDTHS if width <= _MASK_WIDTH]
    return dict(zip(sources, _as_wide_as_fits(_mask, list(sources.values()), widths, most_bytes)))


def _mask_sources(
    masks: Path | Mapping[str, np.ndarray], views: Sequence[View]
) -> dict[str, Path | np.ndarray]:
    if not isinstance(masks, Path):
        return {view.name: masks[view.name] for view in views if view.name in masks}
    paths = {view.name: masks / Path(view.name).with_suffix(".png") for view in views}
    return {name: path for name, path in paths.items() if path.is_file()}


def _keep_maps(
    masks: Path | Mapping[str, np.ndarray], views: Sequence[View]
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and keep map [H, W] bool of the views that have one."""
    for name, keep in _mask_sources(masks, views).items():
        yield name, (read_gray(keep) if isinstance(keep, Path) else keep * np.uint8(255)) > 127


def _as_wide_as_fits(
    uri: Callable[[Source, int], str],
    sources: Sequence[Source],
    widths: Sequence[int],
    most_bytes: int,
    threads: int = 1,
) -> list[str]:
    """Return the addresses at the first width at which they fit, else at the last one."""
    uris: list[str] = []
    for width in widths:
        uris, size = [], 0
        for address in in_order(lambda pair: uri(*pair), zip(sources, repeat(width)), threads):
            uris.append(address)
            size += len(address)
            if size > most_bytes and width != widths[-1]:
                break
        else:
            return uris
    return uris


def _photo(path: Path, width: int) -> str:
    return data_uri("jpeg", jpeg_bytes(narrowed(read_png_rgb(path), width), _QUALITY))


def _mask(keep: Path | np.ndarray, width: int) -> str:
    import cv2

    gray = read_gray(keep) if isinstance(keep, Path) else keep.astype(np.uint8) * 255
    black_and_white = ((narrowed(gray, width) > 127) * 255).astype(np.uint8)
    options = [cv2.IMWRITE_PNG_BILEVEL, 1]
    return data_uri("png", bytes(cv2.imencode(".png", black_and_white, options)[1]))


def reduced(
    gaussians: Mapping[str, np.ndarray], cameras: Sequence[Camera], most: int
) -> dict[str, np.ndarray]:
    """Keep at most `most` Gaussians, with the largest opacity times projected area, summed over cameras.

    A Gaussian's area in one camera counts up to a hundredth of the picture, so that a few large ones in the
    background do not displace all detail. Order is kept.

    Args:
        gaussians: raw parameters.
        cameras: cameras of the photos.
        most: largest number of Gaussians.
    """
    kept = finite(gaussians)
    if len(kept["means"]) <= most:
        return kept
    score = importance(kept, cameras)
    rows = np.sort(np.argsort(-score, kind="stable")[:most])
    return {name: value[rows] for name, value in kept.items()}


def importance(gaussians: Mapping[str, np.ndarray], cameras: Sequence[Camera]) -> np.ndarray:
    """Return opacity times projected area in px, summed over cameras; [N] float64."""
    means = gaussians["means"].astype(np.float64)
    scales = np.sort(np.exp(gaussians["log_scales"].astype(np.float64)), axis=1)
    area = np.pi * scales[:, 1] * scales[:, 2]  # ellipse of the two longest axes, world units squared
    total = np.zeros(len(means))
    for camera in cameras:
        seen = camera.to_camera(means)
        depth = np.where(seen[:, 2] > _NEAR, seen[:, 2], np.inf)
        u, v = camera.fx * seen[:, 0] / depth + camera.cx, camera.fy * seen[:, 1] / depth + camera.cy
        inside = (np.abs(u / camera.width - 0.5) < 0.5 + _MARGIN) & (
            np.abs(v / camera.height - 0.5) < 0.5 + _MARGIN
        )
        covered = area * camera.fx * camera.fy / depth**2
        total += np.where(inside, np.minimum(covered, 0.01 * camera.width * camera.height), 0.0)
    return total * sigmoid(gaussians["opacity_logits"])
