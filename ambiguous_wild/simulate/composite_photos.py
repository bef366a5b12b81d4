"""Add distractors to plain photos, before structure from motion: write a raw capture with the truth.

RAW/train/<stem>.jpg                quality 95, upright; some with distractors
RAW/test/<stem>.jpg                 every sixth photo, without distractors that move
RAW/truth/distractor/<stem>.png     of changed photos and train photos: 255 where a distractor is, else 0
RAW/truth/clean/<stem>.png          the original of these photos
RAW/truth/composite.json            config, cut-outs with sha256; per photo source, pieces and coverage
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.config import Facts, to_plain
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.srgb import srgb_to_linear
from ambiguous_wild.io.files import atomic_dir, natural_key, sha256_file, write_json
from ambiguous_wild.io.images import header_size, write_png
from ambiguous_wild.io.photos import PHOTO_SUFFIXES, Exif, UnreadablePhoto, read_photo
from ambiguous_wild.io.progress_bar import Progress
from ambiguous_wild.simulate.composite_scene import check_request
from ambiguous_wild.simulate.cutouts import (
    TRUTH_COVER,
    Cutout,
    CutoutPlacement,
    blend_layer,
    blobs,
    cut_patch,
    draw_layer,
    layer_mask,
    read_cutouts,
)
from ambiguous_wild.simulate.fixed_things import alpha_over, overlay_layer
from ambiguous_wild.simulate.placement import (
    LONGEST,
    PREVIEW_PX,
    CompositeConfig,
    bisect_scale,
    covered_share,
    longest_side,
    natural_heights,
)
from ambiguous_wild.simulate.spec import FixedThing
from ambiguous_wild.simulate.truth_records import summary

_TEST_EVERY = 6  # every sixth photo is a test photo; also the smallest number of photos
_MAX_PIECES = 3  # largest number of pieces in a photo
_SPREAD = (0.5, 1.5)  # range of a photo's coverage, relative to the mean
_MAX_COVER = 0.6  # largest mean coverage of photos with distractors
_MIDDLE = (0.15, 0.85)  # range of a piece's middle, relative to the photo's sides
_CROSSING = (14.0, 28.0)  # photos that a group of pieces takes to cross the picture, with `path`
_FASTER = (0.5, 0.9)  # range of the time of faster pieces of the group, relative to that of the slowest
_GROWTH = (0.8, 1.25)  # factor on a piece's size where it enters and where it leaves
_DRIFT = 0.1  # greatest way up or down while it crosses, relative to the photo's height

_Drawn = tuple[Cutout, str, bool]  # piece, photo that it was cut from (empty for cut-outs), mirrored or not


def is_photo_folder(path: Path | str) -> bool:
    """Tell whether the folder holds neither scene.json nor a COLMAP model."""
    root = Path(path)
    return root.is_dir() and not any((root / part).exists() for part in ("scene.json", "sparse", "colmap"))


def composite_photos(
    source: Path | str,
    output: Path | str,
    config: CompositeConfig,
    cutouts: Path | str | None = None,
    progress: Progress = iter,
) -> Facts:
    """Make the capture, and return truth/composite.json.

    Args:
        source: folder of at least six photos without distractors; every sixth becomes a test photo.
        output: the folder to write; it appears complete or not at all.
        config: only coverage, presence (share of train photos with distractors), patches, path, fixed and
            seed are used. With ``path`` the photos are a sequence in the order of their names.
        cutouts: folder of PNG files with alpha; may be None with ``config.patches`` or ``config.fixed``.
        progress: wraps the photos, for a bar.

    Raises:
        AwError: too few or unreadable photos, bad cut-outs or settings, or an output that exists.
    """
    root, target = Path(source), Path(output)
    check_request(root, target, config, cutouts)
    mean = config.coverage / config.presence  # mean coverage of photos with distractors
    if mean > _MAX_COVER:
        raise AwError(
            f"--coverage {config.coverage:g} with --presence {config.presence:g} covers {mean:.2f} of a "
            f"photo, more than {_MAX_COVER:g}; lower --coverage or raise --presence"
        )
    shapes = [] if cutouts is None else read_cutouts(cutouts)
    paths, base = _list_photos(root), _base(root)
    if config.path:
        paths.sort(key=lambda path: natural_key(path.relative_to(base).as_posix()))
    is_test = [i % _TEST_EVERY == _TEST_EVERY // 2 for i in range(len(paths))]
    train = [path for path, test in zip(paths, is_test, strict=True) if not test]
    choice_seed, *seeds = np.random.SeedSequence(config.seed).spawn(1 + len(paths))
    order = np.random.default_rng(choice_seed).permutation(len(train))
    chosen = {train[i] for i in order[: max(1, round(config.presence * len(train)))]}
    if cutouts is None and not config.patches:
        chosen = set()
    tracks: list[_Track] = []
    if config.path:
        numbers = [i for i, test in enumerate(is_test) if not test]
        tracks = _tracks(shapes, paths, numbers, config, np.random.default_rng(choice_seed))
    photos: dict[str, Facts] = {}
    shares: list[float] = []
    with atomic_dir(target, replace=False) as folder:
        for part in ("train", "test"):
            (folder / part).mkdir()
        for number, (path, test, seed) in enumerate(zip(progress(paths), is_test, seeds, strict=True)):
            (clean, exif), own = _read(path), path.relative_to(base).with_suffix(".png")
            name = own.with_suffix(".jpg").as_posix()
            if test and config.fixed is None:
                _write_jpeg(folder / "test" / name, clean, exif)
                continue
            over, pieces = np.zeros((*clean.shape[:2], 4), np.float32), list[Facts]()
            if tracks:
                now, middles, heights = _active_tracks(tracks, number, clean.shape)
                over, pieces = _pasted([tracks[k].piece for k in now], middles, heights, clean.shape)
                pieces = [{**piece, "track": k} for piece, k in zip(pieces, now, strict=True)]
            elif path in chosen:
                rng = np.random.default_rng(seed)
                cover = float(mean * rng.uniform(*_SPREAD))
                others = [p for p in train if p != path]
                area = cover * clean.shape[0] * clean.shape[1]
                count = int(rng.integers(1, _MAX_PIECES + 1))
                drawn = _draw(shapes, others, area, count, config.patches, rng)
                over, pieces = _layer(drawn, clean.shape, cover, rng)
            if config.fixed is not None:
                over = _with_fixed(config.fixed, clean, over, number, config.seed)
            changed, mask = blend_layer(clean, over), layer_mask(over)
            _write_jpeg(folder / ("test" if test else "train") / name, changed, exif)
            write_png(folder / "truth" / "clean" / own, clean)
            write_png(folder / "truth" / "distractor" / own, mask)
            if test:
                continue
            shares.append(round(float((mask > 0).mean()), 6))
            photos[name] = {
                "source": path.relative_to(base).as_posix(),
                "sha256": sha256_file(path),  # of the source
                "occlusion": shares[-1],
                "distractors": pieces,
            }
        facts: Facts = {
            "schema": 1,
            "version": __version__,
            "source": {"name": root.resolve().name, "photos": len(paths)},
            "config": {k: v for k, v in to_plain(config).items() if k not in ("pose", "shadow")},
            "mask": "255 where a distractor covers at least a quarter of the pixel; no others change",
            "cutouts": [{"name": c.name, "sha256": c.source} for c in shapes],
            "occlusion": summary(shares),
            "photos": photos,
        }
        write_json(folder / "truth" / "composite.json", facts)
    return facts


def _with_fixed(
    thing: FixedThing,
    photo: np.ndarray,  # [H, W, 3] uint8, sRGB
    moving: np.ndarray,  # [H, W, 4] float32, the photo's other distractors
    number: int,
    seed: int,
) -> np.ndarray:
    """Lay what is fixed to the camera over the other distractors."""
    light = srgb_to_linear(blend_layer(photo, moving).astype(np.float32) / 255)
    top = overlay_layer(thing, light, number, seed)
    top[top[..., 3] < TRUTH_COVER] = 0  # as of the others
    return alpha_over(top, moving)


def _base(root: Path) -> Path:
    """Return the folder images/ if it holds the photos, else the folder itself."""
    direct = any(p.suffix.lower() in PHOTO_SUFFIXES for p in root.iterdir())
    return root / "images" if not direct and (root / "images").is_dir() else root


def _list_photos(root: Path) -> list[Path]:
    """List the photos of the folder itself, else of all folders in it."""
    base = _base(root)
    for files in (base.iterdir(), base.rglob("*")):
        paths = sorted(p for p in files if p.suffix.lower() in PHOTO_SUFFIXES)
        paths = [p for p in paths if not any(_hidden(part) for part in p.relative_to(base).parts)]
        if paths:
            break
    if len(paths) < _TEST_EVERY:
        raise AwError(
            f"{root} is no scene and holds {len(paths)} photos itself, at least {_TEST_EVERY} are needed for "
            "train and test; give a folder with more photos in it, or a scene of 'aw build-scene'"
        )
    stems = [str(p.with_suffix("")).casefold() for p in paths]
    twice = [p.name for p, stem in zip(paths, stems, strict=True) if stems.count(stem) > 1]
    if twice:
        raise AwError(f"{root}: photos have the same name: {shortlist(twice)}; rename or remove one of each")
    return paths


def _hidden(part: str) -> bool:
    return part.startswith(".") or part in ("masks", "truth")


def _read(path: Path) -> tuple[np.ndarray, Exif]:
    try:
        photo, pixels = read_photo(path)
    except UnreadablePhoto as error:
        raise AwError(f"cannot read photo {path}: {error.reason}; replace or remove it") from error
    return pixels, photo.exif


def _write_jpeg(path: Path, pixels: np.ndarray, exif: Exif) -> None:
    """Write a JPEG of quality 95 without chroma subsampling, with the camera settings of a source photo.

    Args:
        path: the file.
        pixels: [H, W, 3] uint8, upright.
        exif: EXIF of the source photo; its orientation and position are left out.
    """
    from PIL import Image, TiffImagePlugin

    def rational(value: float) -> Any:
        fraction = Fraction(value).limit_denominator(100_000)
        return TiffImagePlugin.IFDRational(fraction.numerator, fraction.denominator)

    tags = Image.Exif()
    fields = tags.get_ifd(0x8769)
    texts = {0x010F: exif.make, 0x0110: exif.model, 0x0132: exif.taken_at}
    tags.update({tag: value for tag, value in texts.items() if value is not None})
    rationals = {0x829A: exif.exposure_s, 0x829D: exif.f_number, 0x920A: exif.focal_mm}
    whole = {0x8827: exif.iso, 0xA403: exif.white_balance, 0xA405: exif.focal_35mm}
    fields.update({tag: rational(value) for tag, value in rationals.items() if value is not None})
    fields.update({tag: round(value) for tag, value in whole.items() if value is not None})
    if exif.taken_at is not None:
        fields[0x9003] = exif.taken_at
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, quality=95, subsampling=0, exif=tags)


def _draw(
    shapes: list[Cutout], others: list[Path], area: float, count: int, patches: bool, rng: np.random.Generator
) -> list[_Drawn]:
    """Draw pieces that fill `area` px: cut-out, photo that it was cut from, mirrored or not."""
    shown = [shapes[int(rng.integers(len(shapes)))] for _ in range(count)] if shapes else blobs(rng)[:count]
    drawn = []
    for cutout in shown:
        origin = ""
        if patches:
            path = others[int(rng.integers(len(others)))]
            photo, origin = _read(path)[0], path.name
            cutout, _ = cut_patch(cutout, photo, area / count, rng)  # as large as it will appear
        mirrored = bool(rng.random() < 0.5)
        light = np.ascontiguousarray(cutout.light[:, ::-1]) if mirrored else cutout.light
        drawn.append((replace(cutout, light=light), origin, mirrored))
    return drawn


def _layer(
    drawn: list[_Drawn], size: tuple[int, ...], cover: float, rng: np.random.Generator
) -> tuple[np.ndarray, list[Facts]]:
    """Draw the pieces at random places as a layer, at the size at which they cover `cover`."""
    cutouts, (height, width) = [cutout for cutout, _, _ in drawn], size[:2]
    middles = rng.uniform(*_MIDDLE, (len(drawn), 2))  # x and y over width and height
    placements = _placements(middles, size)
    natural, small = natural_heights(cutouts, rng), [c.reduced(PREVIEW_PX) for c in cutouts]
    preview = _camera(width, height, PREVIEW_PX / max(width, height))
    high = LONGEST * max(1.0, width / height) / longest_side(natural, cutouts)
    scale = bisect_scale(
        lambda scale: covered_share(small, natural * scale, placements, preview), high, cover
    )
    return _pasted(drawn, middles, natural * scale, size)


def _placements(middles: np.ndarray, size: tuple[int, ...]) -> list[CutoutPlacement]:
    """Place pieces by their middles [K, 2], x and y over width and height."""
    places = enumerate(middles * [size[1] / size[0], 1.0])
    return [CutoutPlacement(k, (float(x), float(y), 1.0), 0.0, False) for k, (x, y) in places]


def _pasted(
    drawn: list[_Drawn],
    middles: np.ndarray,  # [K, 2] x and y over width and height
    heights: np.ndarray,  # [K] over the photo's height
    size: tuple[int, ...],
) -> tuple[np.ndarray, list[Facts]]:
    """Draw the pieces at their places as a layer, with their records."""
    camera = _camera(size[1], size[0], 1.0)
    over = draw_layer([c for c, _, _ in drawn], list(heights), _placements(middles, size), camera)
    over[over[..., 3] < TRUTH_COVER] = 0  # pixels that the mask leaves out keep their bytes
    pieces: list[Facts] = [
        {
            "cutout": c.name,
            "photo": p,  # that the piece was cut from; empty for cut-outs
            "mirrored": m,
            "x": float(x),  # of its middle, over the photo's width
            "y": float(y),  # of its middle, over the photo's height
            "height": float(tall),  # over the photo's height
        }
        for (c, p, m), (x, y), tall in zip(drawn, middles, heights, strict=True)
    ]
    return over, pieces


@dataclass(frozen=True)
class _Track:
    """A piece that crosses the picture at constant speed: it enters at one side and leaves at the other."""

    piece: _Drawn
    start: float  # number of the photo that it enters after
    photos: float  # that it takes to cross
    leftwards: bool
    y: tuple[float, float]  # middle where it enters and leaves, over the photo's height
    height: tuple[float, float]  # where it enters and leaves, over the photo's height


def _tracks(
    shapes: list[Cutout],
    paths: list[Path],
    train: list[int],
    config: CompositeConfig,
    rng: np.random.Generator,
) -> list[_Track]:
    """Draw groups of pieces that cross one after another, at the size that gives the configured coverage.

    Args:
        shapes: cut-outs; none: rounded shapes.
        paths: photos of the sequence.
        train: numbers of the train photos.
        config: coverage, presence, patches.
        rng: source of randomness.

    Raises:
        AwError: even the largest pieces cover less, or the photos are of several sizes.
    """
    sizes = {header_size(path): path.name for path in paths}
    if len(sizes) > 1:
        raise AwError(
            f"--path needs photos of one size: {shortlist(sizes.values())} differ; crop or leave out"
        )
    size = _read(paths[train[0]])[0].shape
    area = config.coverage / config.presence * size[0] * size[1]
    tracks: list[_Track] = []
    begin, lasts = 0.0, rng.uniform(*_CROSSING)  # of a group, in photos
    begin -= lasts * rng.random()  # the first is under way, so that a short sequence shows distractors, too
    while begin < len(paths):
        others = [paths[n] for n in train if not begin < n < begin + lasts] or [paths[n] for n in train]
        drawn = _draw(shapes, others, area, _MAX_PIECES, config.patches, rng)
        for k, (piece, tall) in enumerate(zip(drawn, natural_heights([c for c, _, _ in drawn], rng))):
            photos = lasts * (rng.uniform(*_FASTER) if k else 1.0)
            y = rng.uniform(*_MIDDLE)
            ends = (y, float(np.clip(y + rng.uniform(-_DRIFT, _DRIFT), *_MIDDLE)))
            first, last = tall * rng.uniform(*_GROWTH, 2)
            start, leftwards = begin + (lasts - photos) * rng.random(), bool(rng.random() < 0.5)
            tracks.append(_Track(piece, start, photos, leftwards, ends, (first, last)))
        begin += lasts / config.presence
        lasts = rng.uniform(*_CROSSING)
    preview = _camera(size[1], size[0], PREVIEW_PX / max(size[:2]))
    small = [replace(t, piece=(t.piece[0].reduced(PREVIEW_PX), *t.piece[1:])) for t in tracks]

    def share(scale: float) -> float:
        shares = []
        scaled = _scaled(small, scale, size)
        for number in train:
            now, middles, heights = _active_tracks(scaled, number, size)
            shown, placements = [small[k].piece[0] for k in now], _placements(middles, size)
            shares.append(covered_share(shown, heights, placements, preview))
        return float(np.mean(shares))

    high = LONGEST * max(1.0, size[1] / size[0]) / min(min(t.height) for t in tracks)
    if share(high) < config.coverage:
        raise AwError(
            f"--coverage {config.coverage:g} is more than --path can cover ({share(high):.2f} with the "
            "largest pieces); lower it or raise --presence"
        )
    return _scaled(tracks, bisect_scale(share, high, config.coverage), size)


def _scaled(tracks: Sequence[_Track], scale: float, size: tuple[int, ...]) -> list[_Track]:
    """Scale the pieces, none of them beyond the largest size."""
    longest = LONGEST * max(1.0, size[1] / size[0])
    limits = [longest / max(1.0, t.piece[0].aspect) for t in tracks]
    return [
        replace(t, height=(min(scale * t.height[0], limit), min(scale * t.height[1], limit)))
        for t, limit in zip(tracks, limits, strict=True)
    ]


def _active_tracks(
    tracks: Sequence[_Track], number: int, size: tuple[int, ...]
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Return indices [K] of the tracks in a photo, middles [K, 2] over its sides, and heights [K]."""
    now = [k for k, t in enumerate(tracks) if t.start < number < t.start + t.photos]
    middles, heights = np.zeros((len(now), 2)), np.zeros(len(now))
    for k, track in enumerate(tracks[i] for i in now):
        s = (number - track.start) / track.photos
        heights[k] = np.interp(s, (0, 1), track.height)
        half = heights[k] * track.piece[0].aspect / 2 * size[0] / size[1]
        x = s * (1 + 2 * half) - half
        middles[k] = 1 - x if track.leftwards else x, np.interp(s, (0, 1), track.y)
    return now, middles, heights


def _camera(width: int, height: int, scale: float) -> Camera:
    """Make a camera at the origin in units of the photo's height: (x, y, 1) is a place in the photo."""
    w, h = max(1, round(width * scale)), max(1, round(height * scale))
    return Camera(w, h, w * height / width, float(h), 0.0, 0.0, np.eye(4))
