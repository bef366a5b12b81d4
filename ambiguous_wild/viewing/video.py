"""Film models side by side along one camera path: through cameras, an orbit, or from a file."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import AwError, Camera, Scene, SparsePoints, View
from ambiguous_wild.core.camera import pose_at, rigid
from ambiguous_wild.core.names import ascii_text
from ambiguous_wild.core.scene import NO_PHOTO, centred, without_outliers
from ambiguous_wild.io.files import atomic_path
from ambiguous_wild.io.untrusted import read_json
from ambiguous_wild.viewing.model import Renderer, ViewedModel, space_of

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera axes to OpenCV's, and back
_TILT_DEG = 15.0  # angle of an orbit's cameras above the middle
_WIDTH, _HEIGHT, _VIEWS = 960, 540, 8  # px and number of cameras without a scene
_AWAY = 3.0  # distance of these cameras, relative to the Gaussians' median distance from their middle
_MAX_POINTS = 20_000
_GAP = 4  # px between pictures
_MAX_SIDE = 8192  # px; largest side of a frame
_GIF_COLOURS = 128


def through_views(scene: Scene, frames: int, size: tuple[int, int]) -> list[Camera]:
    """Make a smooth path through the test cameras, or without any the train cameras: each once, nearest next.

    Args:
        scene: scene with at least one view.
        frames: number of cameras, evenly spaced along the path.
        size: width and height, px; the lens is that of the views, fitted to it.
    """
    views = without_outliers(scene.test or scene.train)
    keys = [view.camera for view in views]
    order = _nearest_next(np.array([camera.center for camera in keys]))
    return _smooth([keys[i] for i in order], frames, size)


def orbit(scene: Scene, frames: int, size: tuple[int, int]) -> list[Camera]:
    """Make a circle around the middle of the scene, as far away as the photos were taken."""
    space = space_of(scene)
    first = (scene.test or scene.views)[0].camera
    away = first.center - space.middle
    away -= space.up * (away @ space.up)
    size_of = np.linalg.norm(away)
    x = away / size_of if size_of > 1e-9 else np.cross(space.up, [1.0, 0.3, 0.2])
    x = x / np.linalg.norm(x)
    return [
        fitted(first, size, _look_at(center, space.middle, space.up))
        for center in _circle(space.middle, space.up, x, space.distance, frames)
    ]


def _circle(
    middle: np.ndarray, up: np.ndarray, x: np.ndarray, distance: float, count: int
) -> Iterator[np.ndarray]:
    """Yield positions on a circle above the middle, starting in the direction of `x`."""
    y, tilt = np.cross(up, x), math.radians(_TILT_DEG)
    for k in range(count):
        turn = 2 * math.pi * k / count
        flat = math.cos(turn) * x + math.sin(turn) * y
        yield middle + distance * (math.cos(tilt) * flat + math.sin(tilt) * up)


def scene_around(model: ViewedModel) -> Scene:
    """Make a scene without photos for the model of a splat file, whose cameras look at the model's median.

    Up is the axis of the file that is nearest to -y, which often is up in COLMAP's models.
    """
    transform = model.transform
    xyz = model.read()["means"].astype(np.float64)
    xyz = xyz[:: -(-len(xyz) // _MAX_POINTS)] @ transform.rotation / transform.scale + transform.centre
    middle = np.median(xyz, axis=0)
    size = float(np.median(np.linalg.norm(xyz - middle, axis=1))) or 1.0
    axes = np.concatenate([transform.rotation, -transform.rotation])
    up = axes[(-axes[:, 1]).argmax()]
    first = np.cross(up, axes[(np.abs(axes @ up)).argmin()])
    lens = Camera(_WIDTH, _HEIGHT, _WIDTH, _WIDTH, _WIDTH / 2, _HEIGHT / 2, np.eye(4))
    views = []
    for k, center in enumerate(_circle(middle, up, first, _AWAY * size, _VIEWS)):
        camera = replace(lens, cam_from_world=_look_at(center, middle, up))
        views.append(View(f"render_{k}.png", NO_PHOTO, camera, "test" if k == 0 else "train"))
    points = SparsePoints.without_tracks(xyz)
    return centred(Scene(model.ply.parent, model.label, tuple(views), points))


def from_file(path: Path, scene: Scene, frames: int, size: tuple[int, int]) -> list[Camera]:
    """Read a path that a viewer saved, in the coordinates of the scene's files.

    Formats are those of `aw view` and nerfstudio ({"camera_path": [{"camera_to_world": 16 numbers, "fov":
    degrees}]}, OpenGL axes) and of 3DGS viewers (cameras.json: [{"position", "rotation", "fx", "fy", "width",
    "height"}], OpenCV axes). A path of another length is resampled to `frames`.

    Raises:
        AwError: another format, fewer than two cameras, or an invalid camera.
    """
    data = read_json(path)
    rows = data.get("camera_path") if isinstance(data, dict) else data
    if not isinstance(rows, list) or len(rows) < 2:
        raise AwError(
            f"{path} is no camera path: it needs two cameras or more, as 'aw view' and nerfstudio save them"
        )
    lens = (scene.test or scene.views)[0].camera
    cameras = []
    for number, row in enumerate(rows):
        try:
            cameras.append(scene.transform.inside(_camera(row, lens, size)))
        except (AwError, KeyError, TypeError, ValueError, OverflowError, np.linalg.LinAlgError) as error:
            raise AwError(f"{path}: camera {number} is invalid: {error}") from None
    return cameras if len(cameras) == frames else _smooth(cameras, frames, size)


def _camera(row: Any, lens: Camera, size: tuple[int, int]) -> Camera:
    if "camera_to_world" in row:
        to_world = np.asarray(row["camera_to_world"], np.float64).reshape(4, 4) @ _FLIP
        fov = float(row["fov"]) if row.get("fov") is not None else None
        if fov is not None and not 0.1 <= fov <= 179:
            raise ValueError(f"fov {fov} is no angle between 0.1 and 179 degrees")
        if fov is not None:
            focal = size[1] / 2 / math.tan(math.radians(fov) / 2)
            lens = Camera(size[0], size[1], focal, focal, size[0] / 2, size[1] / 2, np.eye(4))
    else:
        rotation = np.asarray(row["rotation"], np.float64).reshape(3, 3)
        to_world = rigid(rotation, np.asarray(row["position"], np.float64).reshape(3))
        width, height = int(row["width"]), int(row["height"])
        fx, fy = float(row["fx"]), float(row["fy"])
        if not (math.isfinite(fx) and math.isfinite(fy)):
            raise ValueError("fx and fy must be finite")
        lens = Camera(width, height, fx, fy, width / 2, height / 2, np.eye(4))
    rotation = to_world[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not np.isfinite(to_world).all() or off > 0.01 or np.linalg.det(rotation) < 0:
        raise ValueError("its pose is no rotation and position")
    to_world[3] = [0, 0, 0, 1]
    return fitted(lens, size, np.linalg.inv(to_world))


def fitted(lens: Camera, size: tuple[int, int], cam_from_world: np.ndarray) -> Camera:
    """Fit a lens to another size, so that its whole picture is visible."""
    width, height = size
    scale = min(width / lens.width, height / lens.height)
    left, top = (width - scale * lens.width) / 2, (height - scale * lens.height) / 2
    return Camera(
        width,
        height,
        lens.fx * scale,
        lens.fy * scale,
        lens.cx * scale + left,
        lens.cy * scale + top,
        cam_from_world,
    )


def _nearest_next(places: np.ndarray) -> list[int]:
    """Order places from the one furthest from the middle on, the nearest remaining place next."""
    left = set(range(len(places)))
    at = int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmax())
    order = []
    while True:
        order.append(at)
        left.remove(at)
        if not left:
            return order
        at = min(left, key=lambda i: (float(np.linalg.norm(places[i] - places[at])), i))


def _smooth(keys: Sequence[Camera], frames: int, size: tuple[int, int]) -> list[Camera]:
    """Return cameras along a curve through the keys; the lens changes evenly from key to key."""
    from scipy.interpolate import CubicSpline, PchipInterpolator
    from scipy.spatial.transform import Rotation, RotationSpline

    if len(keys) == 1:
        return [fitted(keys[0], size, keys[0].cam_from_world)] * frames
    to_world = np.linalg.inv(np.array([key.cam_from_world for key in keys]))
    steps = np.linalg.norm(np.diff(to_world[:, :3, 3], axis=0), axis=1)
    turns = Rotation.from_matrix(to_world[:, :3, :3])
    angles = (turns[:-1].inv() * turns[1:]).magnitude()
    # No step may have length 0, but keys may differ in direction only, or not at all.
    lengths = steps + angles * max(float(steps.mean()), 1e-6) + 1e-9 + 1e-3 * steps.mean()
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    wanted = np.linspace(0.0, at[-1], frames)
    centers = CubicSpline(at, to_world[:, :3, 3])(wanted)
    rotations = RotationSpline(at, turns)(wanted).as_matrix()
    # A lens changes monotonically between keys, so it cannot overshoot below zero.
    lenses = (fitted(key, size, key.cam_from_world) for key in keys)
    values = PchipInterpolator(at, [[lens.fx, lens.fy, lens.cx, lens.cy] for lens in lenses])(wanted)
    return [
        Camera(size[0], size[1], fx, fy, cx, cy, pose_at(center, rotation.T))
        for center, rotation, (fx, fy, cx, cy) in zip(centers, rotations, values)
    ]


def _look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return cam_from_world of a camera at `center` that looks at `target`, OpenCV axes."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return pose_at(center, np.stack([right, np.cross(forward, right), forward]))


Frame = np.ndarray  # [H, W, 3] uint8
Tick = Callable[[int, int], None]


def draw_frames(
    models: Sequence[ViewedModel],
    cameras: Sequence[Camera],
    *,
    columns: int | None = None,
    tick: Tick = lambda done, total: None,
) -> Iterator[Frame]:
    """Yield a frame for each camera: the renders of all models side by side, with labels.

    Args:
        models: at least one.
        cameras: cameras of one size.
        columns: pictures in a row; None = all in one row up to three, else in two rows or more.
        tick: called with (frames done, frames).

    Raises:
        AwError: a frame would be larger than 8192 px.
    """
    count = len(models)
    across = min(columns or (count if count <= 3 else math.ceil(math.sqrt(count))), count)
    down = -(-count // across)
    width, height = cameras[0].width, cameras[0].height
    size = (down * (height + _GAP) - _GAP, across * (width + _GAP) - _GAP)
    if max(size) > _MAX_SIDE:
        raise AwError(f"a frame would be {size[1]}x{size[0]} px, at most {_MAX_SIDE}; give a smaller --width")
    renderers = [Renderer(model.read(), model.render_settings) for model in models]
    for number, camera in enumerate(cameras):
        frame = np.zeros(
            (size[0] + size[0] % 2, size[1] + size[1] % 2, 3), np.uint8
        )  # encoders need even sizes
        for k, (model, renderer) in enumerate(zip(models, renderers)):
            row, column = divmod(k, across)
            top, left = row * (height + _GAP), column * (width + _GAP)
            frame[top : top + height, left : left + width] = labelled(renderer(camera), model.label)
        tick(number + 1, len(cameras))
        yield frame


def labelled(picture: Frame, label: str) -> Frame:
    """Draw a label in the upper left corner of a picture, see `ascii_text`."""
    import cv2

    out = picture.copy()
    text = ascii_text(label)
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
    """Write frames atomically as VP9 in mp4, through OpenCV's FFmpeg (LGPL), and return their number.

    The encoder has one thread of its own: the next frame is drawn meanwhile.

    Raises:
        AwError: this OpenCV has no such encoder.
        KeyboardInterrupt: it was interrupted; the message says that NAME-part.mp4 has the frames until then.
    """
    import cv2

    with atomic_path(path) as temporary:
        writer, count, interrupted = None, 0, False
        encoder, encoding = ThreadPoolExecutor(1), Future[None]()
        encoding.set_result(None)
        try:
            for frame in frames:
                if writer is None:
                    writer = _open(temporary, path, frame, fps)
                encoding.result()
                encoding = encoder.submit(writer.write, cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
                count += 1
            encoding.result()
        except KeyboardInterrupt:
            interrupted = True
        finally:
            encoder.shutdown()
            if writer is not None:
                writer.release()
        if interrupted:
            part = path.with_name(f"{path.stem}-part{path.suffix}")
            if count:
                shutil.copyfile(temporary, part)
            kept = f"the first {count} frames are in {part}" if count else "no frame was finished"
            raise KeyboardInterrupt(f"interrupted: {kept}")
        if not count or temporary.stat().st_size == 0:
            raise AwError(f"cannot write {path}: the encoder wrote nothing")
    return count


def _open(temporary: Path, path: Path, frame: Frame, fps: float) -> Any:
    import cv2

    # OpenCV chooses bit rate and speed of the encoder; it has no options for them.
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
    """Write frames atomically as a repeating animation with one palette for all frames.

    Raises:
        AwError: no frame.
    """
    if not frames:
        raise AwError(f"cannot write {path}: no frame")
    from PIL import Image

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
