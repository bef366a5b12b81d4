"""Masks of a run for other tools: one for each photo of the capture, of its size and along its edges.

Training sees photos undistorted and reduced. A mask is taken back through the lens, enlarged, and then
follows the edges of the photo by the guided filter (He et al., ECCV 2010).
"""

from __future__ import annotations

import contextlib
import shlex
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from ambiguous_wild.builder.collect import collect, largest_photo
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.screen import read_capture, without_copies
from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.core.machine import photo_threads
from ambiguous_wild.core.names import spelling_key
from ambiguous_wild.harness.store import run_folders
from ambiguous_wild.harness.trained_models import MASKS, finished_result, open_scene
from ambiguous_wild.io.colmap_records import ModelCamera
from ambiguous_wild.io.files import atomic_dir, check_output, sha256_file
from ambiguous_wild.io.images import (
    image_size,
    orientation,
    pillow,
    read_keep_map,
    read_png_rgb,
    upright,
)
from ambiguous_wild.io.lens import Lens, make_lens
from ambiguous_wild.io.mask_files import MASK_FOLDERS, MASK_STYLES, OWN_STYLE, MaskStyle, mask_names
from ambiguous_wild.io.original_photos import AGAIN, OriginalPhoto, capture_folder, is_built, original_photos
from ambiguous_wild.io.photos import is_photo, read_photo
from ambiguous_wild.io.scene_folder import without_suffix
from ambiguous_wild.report.inpainting import Inpainting

RADIUS = 3.0  # of the filter, in pixels of the mask
EDGE = 1e-3  # variance of colours in [0, 1] that the filter takes for an edge
_STRIP = 2_000_000  # px that are filtered at a time
UNTRAINED = "not among the train photos"
_BACK = {6: 8, 8: 6}  # EXIF orientations that another one undoes; the others undo themselves
_ORIENTATION = 0x0112  # EXIF
_QUALITY = 95  # of JPEGs
_JPEG = (".jpg", ".jpeg", ".jpe", ".jfif")


@dataclass(frozen=True)
class FullSizeMasks:
    """What was written, and the photos for which there is less."""

    folder: Path
    style: MaskStyle
    masks: int
    white: dict[str, str]  # photo in which nothing is masked -> why
    unread: dict[str, str]  # photo without a mask -> why
    inpainted: int
    copied: int  # photos in which nothing is masked, copied to the inpainted ones
    left_out: dict[str, str]  # photo that was not inpainted -> why
    note: str = ""  # which photos the masks fit, where these are not the originals

    def lines(self) -> list[str]:
        """Return the note, and a line for each reason why photos have less than a mask of their own."""
        lines = [self.note] if self.note else []
        for photos, what in (
            (self.white, "nothing is masked in"),
            (self.unread, "no mask of"),
            (self.left_out, "not inpainted:"),
        ):
            reasons = grouped(photos, photos.__getitem__)
            lines += [f"{what} {shortlist(names)}: {why}" for why, names in reasons.items()]
        return lines


@dataclass(frozen=True)
class _Opened:
    """A photo as the model sees it, and how its file is turned."""

    pixels: np.ndarray  # [H, W, 3] uint8
    turned: int = 1  # EXIF orientation that was applied to it
    tag: int = 1  # EXIF orientation of the file

    def stored(self, image: np.ndarray) -> np.ndarray:
        """Turn an image [H, W] or [H, W, 3] back to the pixels of the file."""
        return np.ascontiguousarray(upright(image, _BACK.get(self.turned, self.turned)))


@dataclass
class _CapturePhotos:
    """The photos that masks are made for."""

    root: Path
    photos: Sequence[OriginalPhoto]
    original: bool = True  # False: the files in an imported scene
    note: str = ""

    def open(self, photo: OriginalPhoto) -> _Opened:
        path = self.root / photo.source
        if not self.original:
            return _Opened(read_png_rgb(path), tag=orientation(path))
        opened, pixels = read_photo(path)
        return _Opened(pixels, opened.orientation, opened.orientation)

    def check_unchanged(self) -> None:
        """Raise AwError where files are gone, or differ from those that the scene was built from."""
        gone = [photo.source for photo in self.photos if not (self.root / photo.source).is_file()]
        if gone:
            raise AwError(
                f"{len(gone)} of {len(self.photos)} photos of the scene are gone from {self.root}: "
                f"{shortlist(gone, 3)}; restore them"
            )
        wrong = [p.source for p in self.photos if p.sha256 and sha256_file(self.root / p.source) != p.sha256]
        if wrong:
            raise AwError(
                f"{len(wrong)} of {len(self.photos)} photos in {self.root} have changed since the scene was "
                f"built: {shortlist(wrong, 3)}; restore them, or build and train again"
            )


def check_before_training(
    photos: Path, work: Path, output: Path, *, tool: str | None, inpaint: Path | None, jobs: int
) -> None:
    """Raise AwError where the masks of a capture could not be written after a scene is built and trained.

    Args:
        photos: folder of the capture.
        work: folder that the scene and the run are to lie in.
        output, tool, inpaint: as in `write_full_size_masks`.
        jobs: threads.
    """
    capture = collect(photos, jobs)
    _check_places(output, inpaint, {f"the scene and the run {work}": work}, capture.root)
    style = OWN_STYLE if tool is None else MASK_STYLES[tool]
    names = [photo.source for photo in capture.sources]
    try:
        mask_names(names, style)
    except AwError:
        # Of a photo in two formats the builder uses one, which only the pixels tell.
        threads = min(jobs, photo_threads(largest_photo(capture)))
        read = read_capture(capture, lambda *_: None, strict=False, jobs=threads, bar=Bar())
        unused = {row["source"] for row in read.skipped} - without_copies(capture)[1].keys()
        mask_names([name for name in names if name not in unused], style)


def write_full_size_masks(
    folder: Path,
    output: Path,
    *,
    tool: str | None = None,
    inpaint: Path | None = None,
    tick: Callable[[int, int], None] = lambda done, total: None,
) -> FullSizeMasks:
    """Write a mask for each photo that the scene of a run was built from, in the pixels of its file.

    A photo that the run was not trained on gets a mask that leaves nothing out, as most tools need a mask for
    every photo.

    Args:
        folder: a run, or a folder with one.
        output: folder of the masks; it must not exist, or be empty.
        tool: key of `MASK_STYLES`; None = white is static, named after the photo.
        inpaint: folder for the photos with the model's render in place of what is masked; None: not made.
        tick: called with (photos done, photos).

    Raises:
        AwError: no run or several, a run without masks, photos that are gone or have changed, or an output
            that exists.
    """
    style = OWN_STYLE if tool is None else MASK_STYLES[tool]
    run, scene, paths = masks_of_run(folder)
    there = _photos_of(scene)
    _check_places(output, inpaint, {f"the run {run}": run, f"the scene {scene.root}": scene.root}, there.root)
    keeps = {name: read_keep_map(path) for name, path in paths.items()}
    there.check_unchanged()
    names = mask_names([photo.source for photo in there.photos if photo.size != (0, 0)], style)
    views = {view.name: view for view in scene.train}
    fill = Inpainting(run, scene, keeps) if inpaint else None
    files = inpainted_names(photo.source for photo in there.photos)
    done = FullSizeMasks(output, style, len(names), {}, {}, 0, 0, {}, there.note)
    drawn = copied = 0
    with atomic_dir(output, replace=False) as masks, _folder(inpaint) as pictures:
        for number, photo in enumerate(there.photos, 1):
            view, path = views.get(photo.name), there.root / photo.source
            if photo.size == (0, 0):
                done.unread[photo.source] = photo.why
                continue
            opened, lens = there.open(photo), _lens(photo.camera)
            keep = np.ones(opened.pixels.shape[:2], bool)
            if view is None:
                done.white[photo.source] = photo.why or UNTRAINED
            else:
                keep = full_size(keeps[view.name], opened.pixels, lens)
            _write_mask(masks / names[photo.source], opened, keep, style)
            if fill is not None and pictures is not None:
                why = done.white.get(photo.source, "") if view is None else fill.why_not(view.name)
                if view is None or why:
                    done.left_out[photo.source] = why
                elif keep.all():
                    (pictures / photo.source).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(path, pictures / photo.source)
                    copied += 1
                else:
                    pixels = fill.draw(view, opened.pixels, keep, lens)
                    _write_photo(pictures / files[photo.source], path, opened, pixels)
                    drawn += 1
            tick(number, len(there.photos))
    return replace(done, inpainted=drawn, copied=copied)


def inpainted_names(photos: Iterable[str]) -> dict[str, str]:
    """Return the path of each photo once it is inpainted: what is neither JPEG nor PNG becomes PNG.

    a.tif becomes a.png, or a.tif.png where another photo has that name.
    """
    names = {photo: photo for photo in photos}
    taken = {spelling_key(photo) for photo in names}
    for photo in names:
        pure = PurePosixPath(photo)
        if pure.suffix.lower() in (*_JPEG, ".png"):
            continue
        names[photo], longer = str(pure.with_suffix(".png")), photo
        while spelling_key(names[photo]) in taken:
            names[photo] = longer = f"{longer}.png"
        taken.add(spelling_key(names[photo]))
    return names


def full_size(
    keep: np.ndarray,  # [h, w] in {0, 1}, 1 = static, of the undistorted and reduced photo
    photo: np.ndarray,  # [H, W, 3] uint8, as it was taken
    lens: Lens | None,  # None: the photo was not undistorted
) -> np.ndarray:  # [H, W] bool
    """Return the mask of a photo at its own size, along its edges."""
    size = photo.shape[1], photo.shape[0]
    soft = np.asarray(keep, np.float32)
    large = cv2.resize(soft, size, interpolation=cv2.INTER_LINEAR) if lens is None else lens.distort(soft)
    if keep.min() == keep.max():
        return large >= 0.5
    radius = max(1, round(RADIUS * max(size) / max(keep.shape)))
    guided, rows = np.empty_like(large), max(1, _STRIP // size[0])
    for top in range(0, size[1], rows):  # strips, as a photo of 12 megapixels would need 1 GB
        first, last = max(0, top - 2 * radius), min(size[1], top + rows + 2 * radius)
        strip = _guided(photo[first:last].astype(np.float32) / 255, large[first:last], radius)
        guided[top : top + rows] = strip[top - first : top - first + rows]
    return guided >= 0.5


def _guided(guide: np.ndarray, values: np.ndarray, radius: int) -> np.ndarray:
    """Filter values [H, W] so that they follow the colours of a guide [H, W, 3].

    OpenCV's colour version gives up where colours hardly vary, which moves rims in front of plain walls.
    """

    def mean(image: np.ndarray) -> np.ndarray:
        return cv2.blur(image, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_REFLECT)

    bands = [np.ascontiguousarray(guide[..., k]) for k in range(3)]
    means, middle = [mean(band) for band in bands], mean(values)
    c0, c1, c2 = (mean(band * values) - m * middle for band, m in zip(bands, means))
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    rr, rg, rb, gg, gb, bb = (
        mean(bands[i] * bands[j]) - means[i] * means[j] + (EDGE if i == j else 0) for i, j in pairs
    )
    # slopes = inverse of the covariance of the colours, by cofactors, times their covariance with the values
    i00, i01, i02 = gg * bb - gb * gb, gb * rb - rg * bb, rg * gb - gg * rb
    i11, i12, i22 = rr * bb - rb * rb, rb * rg - rr * gb, rr * gg - rg * rg
    determinant = i00 * rr + i01 * rg + i02 * rb
    slopes = [
        (a * c0 + b * c1 + c * c2) / determinant
        for a, b, c in ((i00, i01, i02), (i01, i11, i12), (i02, i12, i22))
    ]
    offset = middle - sum(slope * m for slope, m in zip(slopes, means))
    return sum(mean(slope) * band for slope, band in zip(slopes, bands)) + mean(offset)


def masks_of_run(folder: Path, scene_folder: Path | None = None) -> tuple[Path, Scene, dict[str, Path]]:
    """Find the masks of a finished run.

    Args:
        folder: the run, or a folder with no other.
        scene_folder: where its scene lies; None = where the run says.

    Returns:
        The run, its scene, and the mask of each train view by its name, at the size of the photo in training.

    Raises:
        AwError: no run or several, a run without masks, or another scene.
    """
    run, method = _finished_run(folder)
    scene = open_scene(run, scene_folder)
    paths = {view.name: run / MASKS / Path(view.name).with_suffix(".png") for view in scene.train}
    absent = [name for name, path in paths.items() if not path.is_file()]
    if len(absent) == len(paths):
        raise AwError(
            f"{run} has no masks: {method} makes none, or they had not begun when the run ended; train "
            f"refinesplat: aw bench --method refinesplat --scene {shlex.quote(str(scene.root))} -o runs"
        )
    if absent:
        raise AwError(f"{run} lacks the masks of {shortlist(absent, 3)}: restore them, or train again")
    for view in scene.train:
        _check_size(paths[view.name], view)
    return run, scene, paths


def _finished_run(folder: Path) -> tuple[Path, str]:
    """Return the only run at or below a folder, and its method."""
    runs = list(run_folders(folder))
    if len(runs) != 1:
        several = f"{len(runs)} runs, give one of them: {shortlist(map(str, runs), 3)}"
        raise AwError(f"{folder} holds {several if runs else 'no run'}")
    run = runs[0]
    return run, finished_result(run)["method"]


def _check_size(path: Path, view: View) -> None:
    width, height = image_size(path)
    if (width, height) != (view.camera.width, view.camera.height):
        raise AwError(
            f"{path} is {width}x{height} px, its photo {view.camera.width}x{view.camera.height}: restore it, "
            "or train again"
        )


def _photos_of(scene: Scene) -> _CapturePhotos:
    """Return the capture's photos, or those in the scene's folder where it was not built from a capture."""
    photos = original_photos(scene.info)
    if photos is not None:
        return _CapturePhotos(capture_folder(scene.root, scene.info), photos)
    if is_built(scene.info):
        raise AwError(
            f"{scene.root} does not say by which lenses it was undistorted: {AGAIN}, and train again"
        )
    folder = "images"
    if not (scene.root / folder).is_dir():
        folder = f"images_{scene.info['loaded_factor']}"
    files = (path for path in sorted((scene.root / folder).rglob("*")) if path.is_file() and is_photo(path))
    by_name = {path.relative_to(scene.root / folder).as_posix(): path for path in files}
    by_stem = {without_suffix(name): path for name, path in by_name.items()}
    inside = []
    for view in scene.views:  # at another factor the file may have another suffix
        path = by_name.get(view.name) or by_stem.get(without_suffix(view.name))
        if path is None:
            raise AwError(f"{scene.root / folder} has no photo {view.name}: restore it")
        name = path.relative_to(scene.root / folder).as_posix()
        inside.append(OriginalPhoto(name, "", view.name, image_size(path)))
    return _CapturePhotos(
        scene.root / folder,
        inside,
        original=False,
        note=f"{scene.root} was not built from photos here: the masks fit those in its folder {folder}",
    )


def _check_places(output: Path, inpaint: Path | None, outside: dict[str, Path], photos: Path) -> None:
    for place in (output, *([inpaint] if inpaint else [])):
        # A folder called masks is never taken for photos, and tools look for it beside them.
        among = {} if place.name.lower() in MASK_FOLDERS else {f"the photos {photos}": photos}
        check_output(place, outside=outside | among, new=True)
    if inpaint:
        one, other = output.resolve(), inpaint.resolve()
        if one.is_relative_to(other) or other.is_relative_to(one):
            raise AwError(
                f"--inpaint {inpaint} is, holds or lies in the folder of the masks: give another one"
            )


@contextlib.contextmanager
def _folder(path: Path | None) -> Iterator[Path | None]:
    if path is None:
        yield None
        return
    with atomic_dir(path, replace=False) as temporary:
        yield temporary


@lru_cache(maxsize=2)  # a map of a photo of 12 megapixels takes 98 MB
def _lens(camera: ModelCamera | None) -> Lens | None:
    return None if camera is None else make_lens(camera)


def _write_mask(path: Path, opened: _Opened, keep: np.ndarray, style: MaskStyle) -> None:
    image = np.where(opened.stored(keep), 255 - style.left_out, style.left_out).astype(np.uint8)
    _save(path, image, _tagged(opened.tag))


def _write_photo(path: Path, source: Path, opened: _Opened, image: np.ndarray) -> None:
    """Write an inpainted photo, as JPEG with the EXIF of the original."""
    exif = _tagged(opened.tag)
    if source.suffix.lower() in _JPEG:
        # damaged EXIF is left out
        with contextlib.suppress(Exception), pillow().open(source, formats=("JPEG",)) as file:
            exif = file.getexif()
    _save(path, opened.stored(image), exif)


def _tagged(turn: int) -> object | None:
    """Return EXIF with an orientation; None for the usual one."""
    if turn == 1:
        return None
    exif = pillow().Exif()
    exif[_ORIENTATION] = turn
    return exif


def _save(path: Path, image: np.ndarray, exif: object | None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    more = {} if exif is None else {"exif": exif}
    if path.suffix.lower() != ".png":
        more |= {"format": "JPEG", "quality": _QUALITY, "subsampling": 0}
    pillow().fromarray(image).save(path, **more)
