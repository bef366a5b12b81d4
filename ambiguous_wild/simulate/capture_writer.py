"""Simulate a capture: a folder of photos with EXIF, as from a phone, and the exact truth.

RAW/train/IMG_0001.jpg ...        with distractors
RAW/test/IMG_0101.jpg ...         other viewpoints, no distractors
RAW/truth/cameras.json            name -> size, fx, fy, cx, cy, cam_from_world (OpenCV axes, metres)
RAW/truth/distractor/<stem>.png   255 where any part of the pixel shows a distractor, else 0
RAW/truth/instances/<stem>.png    number of the distractor in the spec, from 1; 255: fixed to the camera
RAW/truth/clean/<stem>.png        the train photo without distractors, same effects, before JPEG
RAW/truth/shadow/<stem>.png       with moving shadows or panes of glass: 255 where a shadow, or what a pane
                                  reflects, changes the static scene
RAW/truth/objects/<stem>.png      number of the static object (statue, car, poster) in the pixel's middle,
                                  as if no distractor were there
RAW/truth/depth/<stem>.png        optional: z of the static surface, 16 bit, millimetres
RAW/truth/capture.json            spec, seed, versions, label; per photo occlusion, placed distractors and
                                  drawn effects; sha256 of every file

The cameras of a capture, with pose and focal length of every photo, are planned here too.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, replace
from importlib.metadata import version
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.config import config_hash, to_plain
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.files import atomic_dir, refuse_foreign_files, sha256_file, write_json
from ambiguous_wild.io.progress_bar import Progress
from ambiguous_wild.simulate.courtyard import courtyard
from ambiguous_wild.simulate.distractors import place_distractors
from ambiguous_wild.simulate.image_effects import PhotoRandom
from ambiguous_wild.simulate.photo_render import (
    PlannedPhoto,
    PreparedPhoto,
    RenderedPhoto,
    depth_m,
    finish_photo,
    prepare_photo,
    static_object_names,
    trace_photo,
)
from ambiguous_wild.simulate.room import room
from ambiguous_wild.simulate.spec import FULL_FRAME_DIAGONAL_MM, VIDEO_WALKS, CaptureSpec, WorldSpec
from ambiguous_wild.simulate.spec_file import plain_spec
from ambiguous_wild.simulate.tracer import TracedPhoto
from ambiguous_wild.simulate.truth_records import (
    CaptureTruth,
    DrawnEffects,
    PhotoTruth,
    PlacedDistractor,
    SimulatedCapture,
    summary,
)
from ambiguous_wild.simulate.world import World
from ambiguous_wild.simulate.yard import yard

_NEAREST_WALL_M = 0.1
_AHEAD_M = 4.0  # distance to the point that an outward camera looks at
_ALONG_DEG, _ALONG_M = 45.0, 1.25  # angle to the point of the arc that a camera along it looks at; its height
_VIDEO_SHAKE = 0.05  # of a hand that films, relative to that of single photos
_SHEET = "truth/sheet.jpg"  # written by the command line, of the finished capture
_LENS_MM = 4.2  # focal length without zoom
_ISO = 64
_DATE = "2025:06:14 15:{:02d}:{:02d}"
_PLACES = {"courtyard": courtyard, "room": room, "yard": yard}


def focal_px(spec: CaptureSpec) -> float:
    """Convert the 35 mm equivalent to a focal length in px: same angle over the diagonal (CIPA)."""
    return spec.focal_35mm / FULL_FRAME_DIAGONAL_MM * float(np.hypot(spec.width, spec.height))


def look_at(eye: np.ndarray, target: np.ndarray, roll_deg: float) -> np.ndarray:
    """Return cam_from_world [4, 4] of a camera at `eye` that looks at `target`; z is up in the world."""
    # no BLAS: its last digits depend on the processor, and with them pixels of the capture
    forward = (target - eye) / np.linalg.norm(target - eye, axis=-1)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right, axis=-1)
    down = np.cross(forward, right)
    c, s = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    rotation = np.stack([c * right + s * down, c * down - s * right, forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -(rotation * eye).sum(-1)
    return pose


def plan_cameras(
    spec: CaptureSpec, world: World, rng: np.random.Generator
) -> tuple[list[Camera], list[Camera]]:
    """Plan train cameras along an arc with varying distance and height, and test cameras within their range.

    Test viewpoints have other angles than the train photos, and distances and heights between those of train
    photos. An outward walk goes around the hub and looks away from it; a walk along the arc looks where it
    goes. Train cameras of a video have equal steps and hardly shake.

    Raises:
        AwError: the walk leads into a wall.
    """
    half = np.deg2rad(spec.arc_deg / 2)
    phase = rng.uniform(0, 2 * np.pi, 2)
    outward, along, video = spec.walk == "outward", spec.walk == "along", spec.walk in VIDEO_WALKS
    plan = world.plan

    def camera(azimuth: float, sway: float, rise: float, shake: float) -> Camera:
        radius = np.interp(sway, (-1, 1), spec.radius_m)
        height = np.interp(rise, (-1, 1), spec.eye_m)
        center = np.array([world.hub[0], world.hub[1] - (0.0 if outward or along else 0.3)])
        direction = np.array([np.sin(azimuth), -np.cos(azimuth)])
        eye = np.array([*(center + radius * direction), height])
        behind = "wall_front" in plan.walls and eye[1] < plan.y_m[0] + _NEAREST_WALL_M
        if (
            not plan.x_m[0] + _NEAREST_WALL_M <= eye[0] <= plan.x_m[1] - _NEAREST_WALL_M
            or eye[1] > plan.y_m[1] - _NEAREST_WALL_M
            or behind
        ):
            raise AwError(
                f"arc_deg {spec.arc_deg:g} and radius_m {spec.radius_m[0]:g} to {spec.radius_m[1]:g} lead "
                f"the camera into a wall of the {spec.world.place}; lower one of them"
            )
        target = np.array([*center, 1.25])
        if outward:  # straight away from the hub
            target = np.array([*(eye[:2] + _AHEAD_M * direction), height + 0.1])
        if along:
            later = azimuth + np.deg2rad(_ALONG_DEG)
            target = np.array([*(center + radius * np.array([np.sin(later), -np.cos(later)])), _ALONG_M])
        target = target + rng.normal(0, 0.16, 3) * shake
        f = focal_px(spec)
        pose = look_at(eye, target, float(rng.normal(0, 1.2)) * shake)
        return Camera(spec.width, spec.height, f, f, spec.width / 2, spec.height / 2, pose)

    turn_round = spec.arc_deg >= 360  # the last photo stands beside the first one
    step = 2 * half / (spec.train_views - (0 if turn_round else 1))
    jitter = 0.0 if video else 0.25
    train = []
    for k in range(spec.train_views):
        azimuth = -half + step * (k + (rng.uniform(-jitter, jitter) if 0 < k < spec.train_views - 1 else 0))
        turn = 2 * np.pi * 3 * k / spec.train_views
        sway, rise = np.sin(turn + phase[0]), np.sin(1.7 * turn + phase[1])
        train.append(camera(azimuth, float(sway), float(rise), _VIDEO_SHAKE if video else 1.0))
    test = []
    for k in range(spec.test_views):
        gap = round((k + 0.5) / spec.test_views * (spec.train_views - 1) - 0.5)
        azimuth = -half + step * (gap + rng.uniform(0.35, 0.65))
        test.append(camera(azimuth, rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), 0.7))
    return _zoomed(train, spec, 0.0), _zoomed(test, spec, 0.35)


def _zoomed(cameras: list[Camera], spec: CaptureSpec, shift: float) -> list[Camera]:
    """Return the cameras with focal lengths spread over ``spec.zoom``, evenly in their logarithm."""
    low, high = spec.zoom
    if low == high == 1.0:
        return cameras
    zoomed = []
    for k, camera in enumerate(cameras):
        share = (k * 0.6180339887 + shift) % 1.0  # multiples of the golden ratio are even but unordered
        factor = low * (high / low) ** share
        zoomed.append(replace(camera, fx=camera.fx * factor, fy=camera.fy * factor))
    return zoomed


def build_world(rng: np.random.Generator, detail_px_per_m: float, samples: int, what: WorldSpec) -> World:
    """Build the place of the spec; positions and textures vary with the generator.

    Objects that are left out still use up their random numbers, so the others do not change.

    Args:
        rng: source of randomness.
        detail_px_per_m: resolution of the textures, px per m.
        samples: rays a pixel, a square number.
        what: the place and its objects.
    """
    return _PLACES[what.place](rng, detail_px_per_m, samples, what)


def plan_capture(spec: CaptureSpec, seed: int) -> tuple[World, list[PlannedPhoto]]:
    """Plan the world and every photo to render; world, walk and layout have independent random streams."""
    paint, walk, layout = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3))
    world = build_world(paint, spec.detail_px_per_m, spec.samples, spec.world)
    train, test = plan_cameras(spec, world, walk)
    layouts = place_distractors(spec, train, world, layout)
    first_test = 100 * (spec.train_views // 100 + 1) + 1
    planned = [
        PlannedPhoto(f"IMG_{k + 1:04d}.jpg", "train", c, p) for k, (c, p) in enumerate(zip(train, layouts))
    ]
    planned += [PlannedPhoto(f"IMG_{first_test + k:04d}.jpg", "test", c, ()) for k, c in enumerate(test)]
    return world, planned


def simulate(
    spec: CaptureSpec,
    out: Path,
    seed: int = 0,
    depth: bool = False,
    overwrite: bool = False,
    progress: Progress = iter,
) -> SimulatedCapture:
    """Make the capture, or reuse an identical one, and return truth/capture.json.

    Args:
        spec: spec of the capture.
        out: the folder; it appears complete or not at all.
        seed: seed of world, walk, layout and effects.
        depth: also write the depth of the static surface.
        overwrite: replace an earlier capture; a folder that is no capture is never replaced.
        progress: wraps the list of photos, for a bar.

    Raises:
        AwError: `out` holds something else.
    """
    identity = config_hash({"spec": to_plain(spec), "seed": seed, "depth": depth, "code": _code_hash()})
    earlier = _earlier(out, identity, overwrite)
    if earlier is not None:
        return {**earlier, "reused": True}
    world, planned = plan_capture(spec, seed)
    with atomic_dir(out) as folder:
        shadow = ["truth/shadow"] if spec.has_shadows else []
        optional = [*shadow, *(["truth/depth"] if depth else [])]
        for part in (
            "train",
            "test",
            "truth/distractor",
            "truth/instances",
            "truth/clean",
            "truth/objects",
            *optional,
        ):
            (folder / part).mkdir(parents=True)
        photos = _render(spec, world, planned, seed, folder, depth, progress)
        write_json(folder / "truth" / "cameras.json", {s.name: _camera_json(spec, s.camera) for s in planned})
        files = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
        facts = _facts(spec, seed, identity, photos, static_object_names(world))
        facts["files"] = {name: sha256_file(folder / name) for name in files}
        write_json(folder / "truth" / "capture.json", facts)
    return {**facts, "reused": False}


def _render(
    spec: CaptureSpec,
    world: World,
    planned: list[PlannedPhoto],
    seed: int,
    folder: Path,
    depth: bool,
    progress: Progress,
) -> dict[str, PhotoTruth]:
    photos: dict[str, PhotoTruth] = {}
    randoms = [PhotoRandom(seed, k, k / max(spec.train_views - 1, 1)) for k in range(len(planned))]

    def complete(
        number: int, prepared: PreparedPhoto, traced: TracedPhoto, metres: np.ndarray | None
    ) -> None:
        photo = planned[number]
        rendered = finish_photo(photo, randoms[number], prepared, traced)
        _write_photo(
            folder / photo.split / photo.name, rendered.photo, spec, photo.camera, number, rendered.effects
        )
        for part, pixels in _truth(photo, rendered, metres):
            _write_png(folder / "truth" / part / f"{Path(photo.name).stem}.png", pixels)
        if photo.split == "train":
            photos[photo.name] = _photo_facts(spec, photo, rendered)

    # Lens, noise and encoders of one photo run while the rays of others are traced. Each photo has random
    # numbers of its own, so the order of the work does not matter.
    with ThreadPoolExecutor(2) as workers:
        ahead: deque[Future[PreparedPhoto]] = deque()
        pending: deque[Future[None]] = deque()
        waiting = iter(range(len(planned)))
        for number, photo in enumerate(progress(planned)):
            for k in islice(waiting, 2 - len(ahead)):
                ahead.append(workers.submit(prepare_photo, spec, world, planned[k], randoms[k]))
            prepared = ahead.popleft().result()
            traced = trace_photo(world, prepared)
            metres = depth_m(world, photo.camera) if depth else None
            pending.append(workers.submit(complete, number, prepared, traced, metres))
            while len(pending) > 2:
                pending.popleft().result()
        for task in pending:
            task.result()
    return {photo.name: photos[photo.name] for photo in planned if photo.name in photos}


def _write_png(path: Path, pixels: np.ndarray) -> None:
    """Write pixels [H, W] or [H, W, 3], uint8 or uint16."""
    from PIL import Image

    Image.fromarray(pixels).save(path, compress_level=3)


def _write_photo(
    path: Path, pixels: np.ndarray, spec: CaptureSpec, camera: Camera, number: int, drawn: DrawnEffects
) -> None:
    """Write a JPEG of quality 95 without chroma subsampling, with the EXIF of a phone.

    Args:
        path: the file.
        pixels: [H, W, 3] uint8.
        spec: spec of the capture.
        camera: the photo's camera, which gives the focal length.
        number: the photo's number, which gives the time: one photo every four seconds; not of a video.
        drawn: the photo's effects, which give exposure, ISO and white balance.
    """
    from PIL import Image

    Image.fromarray(pixels).save(path, quality=95, subsampling=0, exif=_exif(spec, camera, number, drawn))


def _exif(spec: CaptureSpec, camera: Camera, number: int, drawn: DrawnEffects) -> Any:
    from PIL import Image, TiffImagePlugin

    def rational(value: float) -> Any:
        return TiffImagePlugin.IFDRational(round(value * 10000), 10000)

    zoom = camera.fx / focal_px(spec)
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "ambiguous_wild", "simulated phone"
    exif[0x0131] = f"ambiguous_wild {__version__}"
    fields = exif.get_ifd(0x8769)
    if spec.walk not in VIDEO_WALKS:
        exif[0x0132] = fields[0x9003] = fields[0x9004] = _DATE.format(number * 4 // 60 % 60, number * 4 % 60)
    fields[0x829A] = _exposure(drawn, TiffImagePlugin.IFDRational)  # ExposureTime, s
    fields[0x829D] = rational(1.6)  # FNumber
    fields[0x8827] = round(drawn["iso_noise"]["iso"]) if "iso_noise" in drawn else _ISO
    fields[0x920A] = rational(_LENS_MM * zoom)
    fields[0xA402] = 0 if "exposure_drift" in drawn else 1  # exposure: automatic or manual
    fields[0xA403] = 0 if "white_balance" in drawn else 1  # white balance: automatic or manual
    fields[0xA002], fields[0xA003] = spec.width, spec.height
    per_inch = 25.4 * focal_px(spec) / _LENS_MM
    fields[0xA20E] = fields[0xA20F] = rational(per_inch)  # FocalPlaneX/YResolution
    fields[0xA210] = 2  # in inches
    fields[0xA405] = round(spec.focal_35mm * zoom)  # FocalLengthIn35mmFilm
    return exif


def _exposure(drawn: DrawnEffects, rational: Any) -> Any:
    """Return the exposure time, s: that of motion blur, else 1/250, times 2^stops of exposure drift."""
    blur, drift = drawn.get("motion_blur"), drawn.get("exposure_drift")
    seconds = 1 / 250 if blur is None else blur["exposure_s"]
    seconds *= 2.0 ** (0.0 if drift is None else drift["stops"])
    whole = round(1 / seconds)
    if abs(1 / seconds - whole) < 1e-9 * whole:
        return rational(1, whole)
    return rational(round(seconds * 10**6), 10**6)


def _truth(
    photo: PlannedPhoto, rendered: RenderedPhoto, metres: np.ndarray | None
) -> Iterable[tuple[str, np.ndarray]]:
    """Yield folder and pixels of every truth image of the photo."""
    if photo.split == "train":
        yield "distractor", np.where(rendered.owner > 0, 255, 0).astype(np.uint8)
        yield "instances", rendered.owner
        yield "clean", rendered.clean
        yield "objects", rendered.things
        if rendered.shadow is not None:
            yield "shadow", np.where(rendered.shadow, 255, 0).astype(np.uint8)
    if metres is not None:
        millimetres = np.round(1000 * metres)
        yield "depth", np.clip(millimetres, 0, 65535).astype(np.uint16)


def _photo_facts(spec: CaptureSpec, photo: PlannedPhoto, rendered: RenderedPhoto) -> PhotoTruth:
    shares = np.bincount(rendered.owner.ravel(), minlength=len(spec.distractors) + 1) / rendered.owner.size
    placed: list[PlacedDistractor] = []
    for p in photo.placements:
        name, share = spec.distractors[p.which].name, round(float(shares[p.which + 1]), 6)
        row = {"distractor": name, "occlusion": share, **asdict(p)}
        placed.append(cast(PlacedDistractor, row))
    facts: PhotoTruth = {"occlusion": round(float(shares[1:].sum()), 6), "distractors": placed}
    if rendered.shadow is not None:
        facts["shadow"] = round(float(rendered.shadow.mean()), 6)
    if rendered.effects:
        facts["effects"] = rendered.effects
    return facts


def _facts(
    spec: CaptureSpec, seed: int, identity: str, photos: dict[str, PhotoTruth], objects: list[str]
) -> CaptureTruth:
    shares = [p["occlusion"] for p in photos.values()]
    facts: CaptureTruth = {
        "schema": 1,
        "preset": spec.name,
        "seed": seed,
        "identity": identity,
        "version": {"ambiguous_wild": __version__, "scikit-image": version("scikit-image")},
        "spec": plain_spec(spec),
        "designed": to_plain(spec.designed),
        "mask": "255 where any part of a pixel shows a distractor, also in a mirror; their shadows, if "
        "they cast any, and reflections in glass are in truth/shadow",
        "clean": "same camera, same effects, no distractors and no moving shadow, before JPEG",
        "test": "no distractors; of the effects only specular and lens_distortion",
        "occlusion": summary(shares),
        "objects": objects,
        "photos": photos,
        "licence": "CC0; textures from photographs in scikit-image that are CC0 or in the public domain",
    }
    if spec.effects.changes_colours:
        # Test photos have neutral colours, which the train photos do not tell.
        facts["evaluation"] = {"protocol": "half"}
    return facts


def _code_hash() -> str:
    """Hash the simulator's source, so that a capture of another version is not reused."""
    package = Path(__file__).parent
    sources = sorted([*package.glob("*.py"), *package.glob("*.yaml")])
    return config_hash([__version__, *(sha256_file(p) for p in sources)])


def _camera_json(spec: CaptureSpec, camera: Camera) -> dict[str, object]:
    record = asdict(camera) | {"cam_from_world": camera.cam_from_world.tolist()}
    lens = spec.effects.lens_distortion
    if lens is not None:
        record["distortion"] = {"k1": lens.k1, "k2": lens.k2}
    return record


def _earlier(out: Path, identity: str, overwrite: bool) -> CaptureTruth | None:
    """Return capture.json of an identical and complete capture; None if a new one may be written.

    Raises:
        AwError: the folder holds something else and may not be replaced.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return None
    record = out / "truth" / "capture.json"
    if not record.is_file():
        raise AwError(f"{out} exists and is not a simulated capture; choose another folder with -o")
    try:
        facts = json.loads(record.read_text(encoding="utf-8"))
        same = facts["identity"] == identity
        kind = f"preset {facts['preset']!r}, seed {facts['seed']}"
        files = {str(n): h for n, h in facts["files"].items()}
        if any(PurePosixPath(n).is_absolute() or ".." in PurePosixPath(n).parts for n in files):
            raise ValueError("a file outside the capture")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        facts, same, kind, files = {}, False, "an unreadable truth/capture.json", {}
    if same and all((out / n).is_file() and sha256_file(out / n) == h for n, h in files.items()):
        return cast(CaptureTruth, facts)
    if overwrite:
        if files:
            refuse_foreign_files(out, {record.relative_to(out).as_posix(), _SHEET, *files})
        return None
    why = "with files changed since" if same else "of other settings or another version"
    raise AwError(f"{out} holds a capture ({kind}) {why}; add --overwrite to replace it or choose another -o")
