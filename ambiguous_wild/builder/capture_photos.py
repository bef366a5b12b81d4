"""`aw capture`: sharp frames of a video or a camera, or copies of the photos in a folder.

RAW/<stem>.jpg ...   frames, or byte-for-byte copies with their EXIF
RAW/capture.json     origin, time and sharpness of each photo; files left out, and why

The folder appears complete or not at all.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.builder.collect import MIN_PHOTOS, collect
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import CapturedPhoto, CaptureRecord, FrameCounts, LeftOut
from ambiguous_wild.builder.screen import sharpness, without_copies
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.files import atomic_dir, check_output, write_json
from ambiguous_wild.io.photos import UnreadablePhoto, read_photo

QUALITY = 97  # of JPEG; video is compressed harder
RECORD = "capture.json"
_WARM_UP = 10  # frames until a camera's exposure and colour are stable


@dataclass(frozen=True)
class VideoFrame:
    """A frame that was chosen."""

    index: int  # of the frame in the video, or since the camera started
    time_s: float
    sharpness: float
    pixels: np.ndarray  # [H, W, 3] uint8, BGR


def photos_from_folder(folder: Path, out: Path, *, jobs: int = 1, bar: Bar | None = None) -> CaptureRecord:
    """Copy the readable photos of a folder byte for byte, each once.

    Raises:
        AwError: no folder, too few readable photos, or `out` exists.
    """
    check_free(out)
    bar = bar or Bar(False)
    capture = collect(folder, jobs)
    if out.resolve().is_relative_to(capture.root):
        raise AwError(f"{out} lies inside {folder}; choose another -o")
    sources, copies = without_copies(capture)
    left: list[LeftOut] = [{"source": c, "why": f"the same file as {kept}"} for c, kept in copies.items()]
    photos: list[CapturedPhoto] = []
    bar.start("photos", len(sources))
    with atomic_dir(out, replace=False) as folder_:
        for source in sources:
            bar.step()
            try:
                _, pixels = read_photo(source.path)
            except UnreadablePhoto as error:
                left.append({"source": source.relative, "why": error.reason})
                continue
            target = folder_ / (source.side or "") / source.work_name
            target.parent.mkdir(exist_ok=True)
            shutil.copyfile(source.path, target)
            name = target.relative_to(folder_).as_posix()
            photos.append(
                {"photo": name, "source": source.relative, "sharpness": round(sharpness(pixels), 1)}
            )
        bar.finish()
        if len(photos) < MIN_PHOTOS:
            why = f": {left[0]['source']} ({left[0]['why']})" if left else ""
            raise AwError(f"only {len(photos)} photos of {folder} can be used, {MIN_PHOTOS} are needed{why}")
        return _record(folder_, "folder", Path(folder).name, photos, left)


def photos_from_video(video: Path, out: Path, *, frames: int, bar: Bar | None = None) -> CaptureRecord:
    """Save the sharpest frame of each of `frames` equal parts of a video; one frame is in memory at a time.

    A video with fewer frames gives all it has.

    Raises:
        AwError: OpenCV cannot read the video, it has fewer frames than a scene needs, or `out` exists.
    """
    check_free(out)
    bar = bar or Bar(False)
    total, announced = _count(video, bar)
    if total < MIN_PHOTOS:
        raise AwError(f"{video} has {total} frames, a scene needs {MIN_PHOTOS}; give a longer video")
    frames = min(frames, total)
    bar.start("frames", total)
    parts = [round(k * total / frames) for k in range(frames + 1)]
    with atomic_dir(out, replace=False) as folder:
        photos = _write(sharpest(_read(video, bar), parts), folder)
        bar.finish()
        if len(photos) < frames:
            raise AwError(
                f"{video} broke off: {len(photos)} of {frames} frames could be read; repair or convert it"
            )
        counts: FrameCounts = {"frames_read": total, "frames_announced": announced}
        return _record(folder, "video", video.name, photos, [], counts)


def photos_from_camera(
    number: int, out: Path, *, frames: int, every_s: float, bar: Bar | None = None
) -> CaptureRecord:
    """Save `frames` photos of a camera, the sharpest frame of every `every_s` seconds.

    Raises:
        AwError: there is no such camera, it stops, or `out` exists.
    """
    check_free(out)
    bar = bar or Bar(False)
    reader = _open(number)
    if not reader.isOpened():
        raise AwError(
            f"there is no camera {number}, or another program holds it; 'camera:1' is the second one"
        )
    try:
        fps = reader.get(cv2.CAP_PROP_FPS)
        fps = fps if math.isfinite(fps) and 1 <= fps <= 1000 else 30.0
        for _ in range(_WARM_UP):
            reader.grab()
        step = max(round(fps * every_s), 1)
        bar.start("frames", frames * step)
        with atomic_dir(out, replace=False) as folder:
            parts = [k * step for k in range(frames + 1)]
            photos = _write(sharpest(_frames(reader, fps, bar, frames * step), parts), folder)
            bar.finish()
            if len(photos) < frames:
                raise AwError(
                    f"camera {number} stopped after {len(photos)} of {frames} photos; check its cable"
                )
            return _record(folder, "camera", f"camera:{number}", photos, [])
    finally:
        reader.release()


def sharpest(
    frames: Iterator[tuple[int, float, np.ndarray]],  # index, seconds, BGR
    parts: list[int],  # first frame of each part, and the end
) -> Iterator[VideoFrame]:
    """The sharpest frame in the middle half of each part; of equally sharp frames the first.

    So neighbours are never closer than half a part.
    """
    best: VideoFrame | None = None
    k = 0
    for index, time_s, pixels in frames:
        while k + 1 < len(parts) - 1 and index >= parts[k + 1]:
            if best is not None:
                yield best
            best, k = None, k + 1
        first, last = parts[k], parts[k + 1]
        quarter = (last - first) / 4
        if best is not None and not first + quarter <= index < last - quarter:
            continue
        score = sharpness(np.ascontiguousarray(pixels[:, :, ::-1]))
        inside = first + quarter <= index < last - quarter
        was_inside = best is not None and first + quarter <= best.index < last - quarter
        # The first frame of a part is kept until the middle half begins: no part is empty.
        if best is None or (inside and not was_inside) or score > best.sharpness:
            best = VideoFrame(index, time_s, score, pixels.copy())
    if best is not None:
        yield best


def check_free(out: Path) -> None:
    """Check that `out` is free and can be written.

    Raises:
        AwError: it holds something, or cannot be written.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise AwError(f"{out} exists; nothing is overwritten: choose another -o or remove it")
    check_output(out)


def _open(source: Path | int) -> cv2.VideoCapture:
    # Errors are ours, in one line: OpenCV and FFmpeg would print several.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return (
        cv2.VideoCapture(source) if isinstance(source, int) else cv2.VideoCapture(str(source), cv2.CAP_FFMPEG)
    )


def _opened(video: Path) -> cv2.VideoCapture:
    if video.stat().st_size == 0:
        raise AwError(f"{video} is empty (0 bytes); copy it again")
    # OpenCV opens "http:x" as an address and "%d.png" as a pattern: refused, or made absolute.
    if "%" in video.name:
        raise AwError(
            f"{str(video)!a} has a '%' in its name, which video readers take for a pattern; rename it"
        )
    reader = _open(video.resolve())
    if not reader.isOpened():
        raise AwError(f"{video} is no video that can be read; give a video, a folder of photos, or 'camera'")
    return reader


def _count(video: Path, bar: Bar) -> tuple[int, int | None]:
    """Number of frames that can be decoded, and the number in the header, which is often wrong."""
    reader = _opened(video)
    announced = reader.get(cv2.CAP_PROP_FRAME_COUNT)
    bar.start("counting frames", None)
    count = 0
    while reader.grab():
        count += 1
        bar.step()
    reader.release()
    bar.finish()
    if count == 0:
        raise AwError(f"{video} is no video that can be read (no frame in it)")
    return count, round(announced) if math.isfinite(announced) and 0 < announced < 1e9 else None


def _read(video: Path, bar: Bar) -> Iterator[tuple[int, float, np.ndarray]]:
    reader = _opened(video)
    fps = reader.get(cv2.CAP_PROP_FPS)
    yield from _frames(reader, fps if math.isfinite(fps) and fps > 0 else 30.0, bar, None)
    reader.release()


def _frames(
    reader: cv2.VideoCapture, fps: float, bar: Bar, most: int | None
) -> Iterator[tuple[int, float, np.ndarray]]:
    index = 0
    while most is None or index < most:
        there, pixels = reader.read()
        if not there:
            return
        yield index, index / fps, pixels
        index += 1
        bar.step()


def _write(frames: Iterator[VideoFrame], folder: Path) -> list[CapturedPhoto]:
    photos: list[CapturedPhoto] = []
    for number, frame in enumerate(frames, start=1):
        name = f"frame_{number:05d}.jpg"
        done, data = cv2.imencode(".jpg", frame.pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        if not done:
            raise OSError(f"{name}: the frame could not be encoded")
        (folder / name).write_bytes(data.tobytes())
        photos.append(
            {
                "photo": name,
                "frame": frame.index,
                "time_s": round(frame.time_s, 3),
                "sharpness": round(frame.sharpness, 1),
            }
        )
    return photos


def _record(
    folder: Path,
    kind: Literal["folder", "video", "camera"],
    source: str,
    photos: list[CapturedPhoto],
    left_out: list[LeftOut],
    frames: FrameCounts | None = None,  # of a video
) -> CaptureRecord:
    record: CaptureRecord = {
        "version": __version__,
        "kind": kind,
        "source": source,
        **(frames or FrameCounts()),
        "photos": photos,
        "left_out": left_out,
    }
    write_json(folder / RECORD, record)
    return record
