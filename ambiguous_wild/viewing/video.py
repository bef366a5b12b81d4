"""Videos of models side by side along one camera path: mp4 (VP9) and GIF."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.io.atomic import atomic_path
from ambiguous_wild.viewing.model import Model, Renderer

_GAP = 4  # px between pictures
_MOST_SIDE = 8192  # px of a frame
_GIF_COLOURS = 128

Frame = np.ndarray  # [H, W, 3] uint8
Tick = Callable[[int, int], None]


def draw_frames(
    models: Sequence[Model],
    cameras: Sequence[Camera],
    *,
    columns: int | None = None,
    tick: Tick = lambda done, total: None,
) -> Iterator[Frame]:
    """Each camera's picture of every model, side by side with labels.

    Args:
        models: at least one.
        cameras: of one size.
        columns: pictures in a row; None = all in one row up to three, else two rows or more.
        tick: called with (frames done, frames).

    Raises:
        AwError: a frame would be larger than 8192 px.
    """
    count = len(models)
    across = min(columns or (count if count <= 3 else math.ceil(math.sqrt(count))), count)
    down = -(-count // across)
    width, height = cameras[0].width, cameras[0].height
    size = (down * (height + _GAP) - _GAP, across * (width + _GAP) - _GAP)
    if max(size) > _MOST_SIDE:
        raise AwError(
            f"a frame would be {size[1]}x{size[0]} px, at most {_MOST_SIDE}; give a smaller --width"
        )
    renderers = [Renderer(model.read(), model.look) for model in models]
    for number, camera in enumerate(cameras):
        frame = np.zeros(
            (size[0] + size[0] % 2, size[1] + size[1] % 2, 3), np.uint8
        )  # encoders want even sizes
        for k, (model, renderer) in enumerate(zip(models, renderers)):
            row, column = divmod(k, across)
            top, left = row * (height + _GAP), column * (width + _GAP)
            frame[top : top + height, left : left + width] = labelled(renderer(camera), model.label)
        tick(number + 1, len(cameras))
        yield frame


def labelled(picture: Frame, label: str) -> Frame:
    """The picture with a label in its upper left corner; what the font lacks becomes '?'."""
    import cv2

    out = picture.copy()
    text = "".join(c if " " <= c <= "~" else "?" for c in label)
    scale = max(0.4, picture.shape[0] / 560)
    thick = max(1, round(scale * 1.6))
    (wide, high), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    fits = max(0.25, min(1.0, (picture.shape[1] - 12) / max(wide, 1)))
    wide, high, below = (round(v * fits) for v in (wide, high, below))
    box = out[: high + below + 8, : wide + 12]
    box[:] = box // 3
    cv2.putText(
        out, text, (6, high + 5), cv2.FONT_HERSHEY_SIMPLEX, scale * fits, (255, 255, 255), thick, cv2.LINE_AA
    )
    return out


def write_mp4(path: Path, frames: Iterator[Frame], fps: float) -> int:
    """Write frames atomically as VP9 in an mp4 file, through OpenCV's own FFmpeg (LGPL). Returns how many.

    Raises:
        AwError: OpenCV has no such encoder here.
    """
    import cv2

    with atomic_path(path) as temporary:
        writer, count = None, 0
        try:
            for frame in frames:
                if writer is None:
                    writer = _open(temporary, path, frame, fps)
                writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
                count += 1
        finally:
            if writer is not None:
                writer.release()
        if not count or temporary.stat().st_size == 0:
            raise AwError(f"cannot write {path}: the encoder wrote nothing")
    return count


def _open(temporary: Path, path: Path, frame: Frame, fps: float) -> Any:
    import cv2

    # OpenCV chooses bit rate and speed of the encoder, and reads no options for them.
    writer = cv2.VideoWriter(
        str(temporary),
        cv2.CAP_FFMPEG,
        cv2.VideoWriter.fourcc(*"vp09"),
        fps,
        (frame.shape[1], frame.shape[0]),
    )
    if not writer.isOpened():
        raise AwError(
            f"cannot write {path}: this OpenCV has no VP9 encoder: "
            "python -m pip install --force-reinstall opencv-contrib-python-headless"
        )
    return writer


def write_gif(path: Path, frames: Sequence[Frame], fps: float) -> None:
    """Write frames atomically as an animation that repeats, with one palette for all frames.

    Raises:
        AwError: no frame, or Pillow is missing.
    """
    if not frames:
        raise AwError(f"cannot write {path}: no frame")
    try:
        from PIL import Image
    except ImportError:
        raise AwError(f"cannot write {path}: Pillow is missing: python -m pip install pillow") from None
    sample = Image.fromarray(np.concatenate(frames[:: max(1, len(frames) // 8)]))
    palette = sample.quantize(_GIF_COLOURS, method=Image.Quantize.MEDIANCUT)
    pictures = [Image.fromarray(f).quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    with atomic_path(path) as temporary:
        pictures[0].save(
            temporary,
            save_all=True,
            append_images=pictures[1:],
            duration=max(20, round(100 / fps) * 10),  # ms; GIF counts hundredths of a second
            loop=0,
            optimize=True,
        )


def narrowed(frame: Frame, width: int) -> Frame:
    """The frame, not wider than so many px."""
    import cv2

    if frame.shape[1] <= width:
        return frame
    height = max(2, round(frame.shape[0] * width / frame.shape[1]))
    return cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
