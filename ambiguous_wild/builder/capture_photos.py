"""`aw capture`: save sharp frames of videos or of a camera, or copy the photos of folders.

RAW/<stem>.jpg ...   frames, or byte-for-byte copies with their EXIF; in a folder each for several sources
RAW/capture.json     origin, time and sharpness of each photo; files left out, and why

The folder appears complete or not at all.
"""

from __future__ import annotations

import itertools
import math
import os
import shlex
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.builder.collect import (
    MIN_PHOTOS,
    VIDEO_SUFFIXES,
    Capture,
    clean_stem,
    collect,
    videos_in,
)
from ambiguous_wild.builder.panorama import YAWS_DEG, is_panorama, pinhole_views
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import CapturedPhoto, CaptureRecord, FrameCounts, Kind, LeftOut
from ambiguous_wild.builder.screen import sharpness, without_copies
from ambiguous_wild.core.errors import AwError, counted
from ambiguous_wild.io.files import atomic_dir, check_output, write_json
from ambiguous_wild.io.mask_files import NO_PHOTOS
from ambiguous_wild.io.page_parts import jpeg_bytes
from ambiguous_wild.io.photos import UnreadablePhoto, read_photo

QUALITY = 97  # of JPEG; video is compressed harder
RECORD = "capture.json"
_HDR = {16: "PQ", 18: "HLG"}  # transfer characteristics of ITU-T H.273 that no 8-bit photo has
_WARM_UP = 10  # frames until a camera's exposure and colour are stable


@dataclass(frozen=True)
class VideoFrame:
    """A chosen frame of a video or a camera."""

    index: int  # number of the frame in the video, or since the camera started
    time_s: float
    sharpness: float
    pixels: np.ndarray  # [H, W, 3] uint8, BGR


def photos_from(
    sources: Sequence[Path], out: Path, *, frames: int = 60, jobs: int = 1, bar: Bar | None = None
) -> CaptureRecord:
    """Copy the readable photos of folders, each once, and save sharp frames of videos.

    A video is divided by its time stamps into `frames` equally long stretches, and the sharpest frame of each
    is saved; a video with fewer frames gives all it has. Photos of several sources go to a folder each. One
    frame is in memory at a time.

    Args:
        sources: folders and videos; a folder stands for everything in it except videos beside photos.
        out: the folder to create.
        frames: number of frames of each video.
        jobs: threads.
        bar: progress.

    Raises:
        AwError: too few photos that can be read, a video that cannot be read or is HDR, or `out` exists.
    """
    check_output(out, new=True)
    bar = bar or Bar(False)
    folders = [s for s in sources if s.is_dir()]
    if within := next((s for s in folders if out.resolve().is_relative_to(s.resolve())), None):
        raise AwError(f"{out} lies inside {within}; choose another -o")
    videos = [v for s in sources for v in (videos_in(s) if s.is_dir() else [s])]
    capture = collect(folders, jobs, least=0 if videos else MIN_PHOTOS) if folders else None
    for note in capture.notes if capture else ():
        bar.say(note)
    groups = dict.fromkeys(s.folder for s in capture.sources) if capture else {}
    several = len(groups) + len(videos) > 1
    taken_names = {"images", "train", "test", *NO_PHOTOS}  # `collect` gives these names a meaning

    def folder_name(name: str) -> str:
        """Return an unused name of a folder for a source; "" for a single source."""
        number, free = 2, clean_stem(name)
        while free.casefold() in taken_names:
            free, number = f"{clean_stem(name)}_{number}", number + 1
        taken_names.add(free.casefold())
        return free if several else ""

    folder_names = {k: folder_name(k or folders[0].resolve().name) for k in groups}
    photos: list[CapturedPhoto] = []
    left: list[LeftOut] = []
    records: list[FrameCounts] = []
    with atomic_dir(out, replace=False) as folder:
        if capture is not None:
            photos, left = _copy(capture, folder_names, folder, bar)
            stems = {PurePosixPath(s.source).stem.casefold() for s in capture.sources}
            left += [
                {"source": str(name), "why": "a video beside photos: give it as a source"}
                for name in map(PurePosixPath, capture.ignored)
                if name.suffix.lower() in VIDEO_SUFFIXES and name.stem.casefold() not in stems
            ]
        side = "train" if capture and capture.has_sides else ""
        for video in videos:
            prefix = "".join(f"{part}/" for part in (side, folder_name(video.stem)) if part and several)
            taken, counts = _frames_of(video, folder / prefix, frames, bar)
            for photo in taken if several else ():
                photo["photo"], photo["source"] = prefix + photo["photo"], video.name
            photos += taken
            records.append({"source": str(video), **counts})
        if len(photos) < MIN_PHOTOS:
            why = f": {left[0]['source']} ({left[0]['why']})" if left else ""
            named = ", ".join(map(str, sources))
            raise AwError(f"only {len(photos)} photos of {named} can be used, {MIN_PHOTOS} are needed{why}")
        kind: Kind = "folder" if not videos else "several" if several else "video"
        return _record(folder, kind, ", ".join(s.name for s in sources), photos, left, records)


def _copy(
    capture: Capture, folder_names: dict[str, str], folder: Path, bar: Bar
) -> tuple[list[CapturedPhoto], list[LeftOut]]:
    """Copy each photo byte for byte, once, to the target of its folder."""
    sources, copies = without_copies(capture)
    left: list[LeftOut] = [{"source": c, "why": f"the same file as {kept}"} for c, kept in copies.items()]
    photos: list[CapturedPhoto] = []
    bar.start("photos", len(sources))
    spheres = 0
    for listed in sources:
        bar.step()
        try:
            photo, pixels = read_photo(listed.path, panoramas=True)
        except UnreadablePhoto as error:
            left.append({"source": listed.source, "why": error.reason})
            continue
        if photo.sphere and photo.width != 2 * photo.height:
            left.append({"source": listed.source, "why": "a part of a 360 degree photo, not all of it"})
            continue
        side = listed.side or ("train" if capture.has_sides else "")
        # The stem need not start with the folder's name, as the copy lies in a folder of that name.
        full_name = listed.stem + listed.path.suffix.lower()
        name = full_name.removeprefix(f"{listed.folder}_" if listed.folder else "")
        target = folder / side / folder_names[listed.folder] / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():  # `train_a.jpg` beside train/a.jpg, for example
            target = target.with_name(full_name)
        written = {target: pixels}
        exif = photo.exif
        focal = exif.focal_mm is not None or exif.focal_35mm is not None
        if is_panorama(photo.width, photo.height, photo.sphere, focal):
            spheres += 1
            views = pinhole_views(pixels)
            written = {target.with_name(f"{target.stem}_yaw{yaw:03}.jpg"): view for yaw, view in views}
            for path, view in written.items():
                path.write_bytes(jpeg_bytes(view, 95))
        else:
            shutil.copyfile(listed.path, target)
        for path, shown in written.items():
            relative = path.relative_to(folder).as_posix()
            photos.append(
                {"photo": relative, "source": listed.source, "sharpness": round(sharpness(shown), 1)}
            )
    bar.finish()
    if spheres:
        bar.say(f"{counted(spheres, '360 degree photo')} split into {len(YAWS_DEG)} pinhole views each")
    return photos, left


def _frames_of(video: Path, folder: Path, frames: int, bar: Bar) -> tuple[list[CapturedPhoto], FrameCounts]:
    """Write the frames of one video into `folder`."""
    if curve := hdr_curve(video):
        raise AwError(
            f"{video} is HDR video ({curve}), whose colours 8 bits do not hold; film without HDR, or "
            f"convert it: ffmpeg -i {shlex.quote(video.name)} -vf zscale=t=linear:npl=100,format=gbrpf32le,"
            "zscale=p=bt709,tonemap=hable:desat=0,zscale=t=bt709:m=bt709:r=tv,format=yuv420p -crf 12 sdr.mp4"
        )
    times, announced = _times(video, bar)
    total = len(times)
    limits = time_intervals(times, frames)
    expected = len(set(np.searchsorted(limits, times, side="right")))
    bar.start("frames", total)
    folder.mkdir(parents=True, exist_ok=True)
    photos = _write(sharpest_frames(_read(video, times, bar), limits), folder)
    bar.finish()
    if len(photos) < expected:
        raise AwError(
            f"{video} broke off: {len(photos)} of {expected} frames could be read; repair or convert it"
        )
    if expected < min(frames, total):
        bar.say(f"{video}: {min(frames, total) - expected} of {frames} equally long stretches hold no frame")
    return photos, {"frames_read": total, "frames_announced": announced}


def time_intervals(times: Sequence[float], frames: int) -> list[float]:
    """Return the limits in seconds of equally long stretches of a video; few frames get a stretch each.

    Args:
        times: time stamps of its frames, seconds, ascending.
        frames: number of stretches.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    first, end = times[0] - step / 2, times[-1] + step / 2
    if frames >= len(times):
        return [first, *((a + b) / 2 for a, b in itertools.pairwise(times)), end]
    return [first + k * (end - first) / frames for k in range(frames + 1)]


def hdr_curve(video: Path) -> str | None:
    """Return "PQ" or "HLG" where the container (MP4, MOV, Matroska) states it, without reading picture data.

    OpenCV reduces such frames to 8 bits without their transfer curve, which makes them flat and pale.
    """
    with open(video, "rb") as f:
        head = f.read(1 << 20)
        if head[:4] == b"\x1aE\xdf\xa3":  # Matroska: before the first cluster
            at = head.partition(b"\x1fC\xb6u")[0].rpartition(b"\x55\xba\x81")[2][:1]
            return _HDR.get(at[0]) if at and b"\x55\xba\x81" in head else None
        f.seek(0)
        while len(box := f.read(8)) == 8:  # of MP4: size, kind
            size = int.from_bytes(box[:4], "big")
            header = 8
            if size == 1:
                size, header = int.from_bytes(f.read(8), "big"), 16
            if box[4:] == b"moov":
                inner = f.read(min(size - header, 1 << 26)) if size else f.read(1 << 26)
                box_start = inner.find(b"colrncl")  # nclx, in MOV nclc: primaries, transfer, matrix
                curve = int.from_bytes(inner[box_start + 10 : box_start + 12], "big")
                return _HDR.get(curve) if box_start >= 0 else None
            if size < header:
                return None
            f.seek(size - header, os.SEEK_CUR)
    return None


def photos_from_camera(
    number: int, out: Path, *, frames: int, every_s: float, bar: Bar | None = None
) -> CaptureRecord:
    """Save `frames` photos of a camera: the sharpest frame of every `every_s` seconds.

    Raises:
        AwError: there is no such camera, it stops, or `out` exists.
    """
    check_output(out, new=True)
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
            limits = [k * step / fps for k in range(frames + 1)]
            taken = (i / fps for i in range(frames * step))
            photos = _write(sharpest_frames(_frames(reader, taken, bar), limits), folder)
            bar.finish()
            if len(photos) < frames:
                raise AwError(
                    f"camera {number} stopped after {len(photos)} of {frames} photos; check its cable"
                )
            return _record(folder, "camera", f"camera:{number}", photos, [])
    finally:
        reader.release()


def sharpest_frames(
    frames: Iterator[tuple[int, float, np.ndarray]],  # index, seconds, BGR
    limits: Sequence[float],  # seconds: where each part begins, and the end
) -> Iterator[VideoFrame]:
    """Yield the sharpest frame in the middle half of each part, the first of equally sharp ones.

    The middle half keeps neighbours at least half a part apart. A part without a frame is skipped.
    """
    best: VideoFrame | None = None
    k = 0
    for index, time_s, pixels in frames:
        while k + 1 < len(limits) - 1 and time_s >= limits[k + 1]:
            if best is not None:
                yield best
            best, k = None, k + 1
        first, last = limits[k], limits[k + 1]
        quarter = (last - first) / 4
        if best is not None and not first + quarter <= time_s < last - quarter:
            continue
        score = sharpness(np.ascontiguousarray(pixels[:, :, ::-1]))
        inside = first + quarter <= time_s < last - quarter
        was_inside = best is not None and first + quarter <= best.time_s < last - quarter
        # The first frame of a part is kept until the middle half begins: no part is empty.
        if best is None or (inside and not was_inside) or score > best.sharpness:
            best = VideoFrame(index, time_s, score, pixels.copy())
    if best is not None:
        yield best


def _open(source: Path | int) -> cv2.VideoCapture:
    # We report an error in one line, so the several lines of OpenCV and FFmpeg are silenced.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return (
        cv2.VideoCapture(source) if isinstance(source, int) else cv2.VideoCapture(str(source), cv2.CAP_FFMPEG)
    )


def _open_video(video: Path) -> cv2.VideoCapture:
    if video.stat().st_size == 0:
        raise AwError(f"{video} is empty (0 bytes); copy it again")
    # OpenCV takes "%d.png" for a pattern, which is refused, and "http:x" for an address: hence resolve().
    if "%" in video.name:
        raise AwError(
            f"{str(video)!a} has a '%' in its name, which video readers take for a pattern; rename it"
        )
    reader = _open(video.resolve())
    if not reader.isOpened():
        raise AwError(f"{video} is no video that can be read; give a video, a folder of photos, or 'camera'")
    return reader


def _times(video: Path, bar: Bar) -> tuple[list[float], int | None]:
    """Return the time of each decodable frame, seconds from the first, and the header's number of frames."""
    reader = _open_video(video)
    announced, fps = reader.get(cv2.CAP_PROP_FRAME_COUNT), reader.get(cv2.CAP_PROP_FPS)
    bar.start("counting frames", None)
    stamps = []
    while reader.grab():
        stamps.append(reader.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        bar.step()
    reader.release()
    bar.finish()
    if not stamps:
        raise AwError(f"{video} is no video that can be read (no frame in it)")
    times = [stamp - stamps[0] for stamp in stamps]
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():  # a stream without time stamps
        fps = fps if math.isfinite(fps) and fps > 0 else 30.0
        times = [index / fps for index in range(len(times))]
    return times, round(announced) if math.isfinite(announced) and 0 < announced < 1e9 else None


def _read(video: Path, times: Sequence[float], bar: Bar) -> Iterator[tuple[int, float, np.ndarray]]:
    reader = _open_video(video)
    yield from _frames(reader, times, bar)
    reader.release()


def _frames(
    reader: cv2.VideoCapture, times: Iterable[float], bar: Bar
) -> Iterator[tuple[int, float, np.ndarray]]:
    for index, time_s in enumerate(times):
        there, pixels = reader.read()
        if not there:
            return
        yield index, time_s, pixels
        bar.step()


def _write(frames: Iterator[VideoFrame], folder: Path) -> list[CapturedPhoto]:
    photos: list[CapturedPhoto] = []
    for number, frame in enumerate(frames, start=1):
        name = f"frame_{number:05d}.jpg"
        (folder / name).write_bytes(jpeg_bytes(frame.pixels[:, :, ::-1], QUALITY))
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
    kind: Kind,
    source: str,
    photos: list[CapturedPhoto],
    left_out: list[LeftOut],
    videos: Sequence[FrameCounts] = (),
) -> CaptureRecord:
    record: CaptureRecord = {
        "version": __version__,
        "kind": kind,
        "source": source,
        "photos": photos,
        "left_out": left_out,
    }
    if kind == "several":
        record["videos"] = list(videos)
    elif videos:
        record["frames_read"] = videos[0]["frames_read"]
        record["frames_announced"] = videos[0]["frames_announced"]
    write_json(folder / RECORD, record)
    return record
