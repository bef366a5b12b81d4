"""From a spec to a folder that looks like a phone's: photos with EXIF, and beside them the exact truth.

RAW/train/IMG_0001.jpg ...        with distractors
RAW/test/IMG_0101.jpg ...         other viewpoints, nobody there
RAW/truth/cameras.json            name -> size, fx, fy, cx, cy, cam_from_world (OpenCV axes, metres)
RAW/truth/distractor/<stem>.png   255 where any sample of the pixel hit a distractor, else 0
RAW/truth/clean/<stem>.png        the train photo with nobody there, before JPEG
RAW/truth/depth/<stem>.png        optional: z of the static surface, 16 bit, millimetres
RAW/truth/capture.json            spec, seed, versions, occlusion per photo, who stands where, sha256
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.config import config_hash, to_plain
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.atomic import atomic_dir, write_json
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.simulate.atlas import linear_to_srgb
from ambiguous_wild.simulate.distractors import Placement, lay_out, movers
from ambiguous_wild.simulate.presets import CaptureSpec
from ambiguous_wild.simulate.tracer import trace
from ambiguous_wild.simulate.world import World, courtyard

_FULL_FRAME_DIAGONAL_MM = 43.2666  # of 36 x 24 mm
_LENS_MM = 4.2  # what the simulated phone states as its focal length
_DATE = "2025:06:14 15:{:02d}:{:02d}"


@dataclass(frozen=True)
class Shot:
    """One photo to take."""

    name: str  # IMG_0001.jpg
    split: str  # train or test
    camera: Camera
    placements: tuple[Placement, ...]


Progress = Callable[[list[Shot]], Iterable[Shot]]


def focal_px(spec: CaptureSpec) -> float:
    """Focal length in px of the stated 35 mm equivalent: the same angle over the diagonal (CIPA)."""
    return spec.focal_35mm / _FULL_FRAME_DIAGONAL_MM * float(np.hypot(spec.width, spec.height))


def look_at(eye: np.ndarray, target: np.ndarray, roll_deg: float) -> np.ndarray:
    """cam_from_world [4, 4] of a camera at `eye` that looks at `target`; z is up in the world."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    rotation = np.stack([c * right + s * down, c * down - s * right, forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return pose


def plan_cameras(
    spec: CaptureSpec, world: World, rng: np.random.Generator
) -> tuple[list[Camera], list[Camera]]:
    """The walk: train cameras along an arc that sways near and far, high and low; test cameras inside it.

    Test viewpoints lie at other angles than any train photo, between the near and the far, the high and
    the low of the walk, so that they are new but not beyond what was seen.
    """
    half = np.deg2rad(spec.arc_deg / 2)
    phase = rng.uniform(0, 2 * np.pi, 2)

    def camera(azimuth: float, sway: float, rise: float, shake: float) -> Camera:
        radius = np.interp(sway, (-1, 1), spec.radius_m)
        height = np.interp(rise, (-1, 1), spec.eye_m)
        center = np.array([world.statue[0], world.statue[1] - 0.3])
        eye = np.array([*(center + radius * np.array([np.sin(azimuth), -np.cos(azimuth)])), height])
        target = np.array([*center, 1.25]) + rng.normal(0, 0.16, 3) * shake
        f = focal_px(spec)
        pose = look_at(eye, target, float(rng.normal(0, 1.2)) * shake)
        return Camera(spec.width, spec.height, f, f, spec.width / 2, spec.height / 2, pose)

    step = 2 * half / (spec.train_views - 1)
    train = []
    for k in range(spec.train_views):
        azimuth = -half + step * (k + (rng.uniform(-0.25, 0.25) if 0 < k < spec.train_views - 1 else 0))
        turn = 2 * np.pi * 3 * k / spec.train_views
        sway, rise = np.sin(turn + phase[0]), np.sin(1.7 * turn + phase[1])
        train.append(camera(azimuth, float(sway), float(rise), 1.0))
    test = []
    for k in range(spec.test_views):
        gap = round((k + 0.5) / spec.test_views * (spec.train_views - 1) - 0.5)
        azimuth = -half + step * (gap + rng.uniform(0.35, 0.65))
        test.append(camera(azimuth, rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), 0.7))
    return train, test


def plan(spec: CaptureSpec, seed: int) -> tuple[World, list[Shot]]:
    """Build the world and decide every shot; world, walk and layout draw from independent streams."""
    paint, walk, stand = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3))
    world = courtyard(paint, spec.detail_px_per_m, spec.samples)
    train, test = plan_cameras(spec, world, walk)
    layouts = lay_out(spec, train, world, stand)
    first_test = 100 * (spec.train_views // 100 + 1) + 1
    shots = [Shot(f"IMG_{k + 1:04d}.jpg", "train", c, p) for k, (c, p) in enumerate(zip(train, layouts))]
    shots += [Shot(f"IMG_{first_test + k:04d}.jpg", "test", c, ()) for k, c in enumerate(test)]
    return world, shots


def simulate(
    spec: CaptureSpec,
    out: Path,
    seed: int = 0,
    depth: bool = False,
    overwrite: bool = False,
    progress: Progress = iter,
) -> dict[str, Any]:
    """Make the capture; returns what ``truth/capture.json`` says, and whether it was there (``reused``).

    Args:
        spec: what to make.
        out: the folder; written whole or not at all.
        seed: world, walk and layout follow from it.
        depth: also write the static surface's depth.
        overwrite: replace an earlier capture; a folder that is not a capture is never replaced.
        progress: wraps the list of shots, for a bar.

    Raises:
        AwError: `out` holds something else.
    """
    identity = config_hash({"spec": to_plain(spec), "seed": seed, "depth": depth, "code": _code_hash()})
    earlier = _earlier(out, identity, overwrite)
    if earlier is not None:
        return {**earlier, "reused": True}
    world, shots = plan(spec, seed)
    with atomic_dir(out) as folder:
        for part in ("train", "test", "truth/distractor", "truth/clean", *(["truth/depth"] if depth else [])):
            (folder / part).mkdir(parents=True)
        photos = _render(spec, world, shots, folder, depth, progress)
        write_json(folder / "truth" / "cameras.json", {s.name: _camera_json(s.camera) for s in shots})
        files = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
        facts = _facts(spec, seed, identity, photos)
        facts["files"] = {name: sha256_file(folder / name) for name in files}
        write_json(folder / "truth" / "capture.json", facts)
    return {**facts, "reused": False}


def _render(
    spec: CaptureSpec, world: World, shots: list[Shot], folder: Path, depth: bool, progress: Progress
) -> dict[str, Any]:
    static = world.table()
    photos: dict[str, Any] = {}
    pending: list[Future[None]] = []
    with ThreadPoolExecutor(2) as writers:  # encoders leave the interpreter free: they run beside the rays
        for number, shot in enumerate(progress(shots)):
            seen = trace(shot.camera, static, movers(spec, shot.placements, world), world.atlas, world.light)
            photo = _to_uint8(seen.distracted)
            pending.append(writers.submit(_write_photo, folder / shot.split / shot.name, photo, spec, number))
            truth, stem = folder / "truth", Path(shot.name).stem
            if shot.split == "train":
                mask = np.where(seen.owner > 0, 255, 0).astype(np.uint8)
                pending.append(writers.submit(_write_png, truth / "distractor" / f"{stem}.png", mask))
                clean = _to_uint8(seen.clean)
                pending.append(writers.submit(_write_png, truth / "clean" / f"{stem}.png", clean))
                photos[shot.name] = _photo_facts(spec, shot, seen.owner)
            if depth:
                millimetres = np.clip(np.round(1000 * seen.depth_m), 0, 65535).astype(np.uint16)
                pending.append(writers.submit(_write_png, truth / "depth" / f"{stem}.png", millimetres))
            while len(pending) > 12:
                pending.pop(0).result()
        for task in pending:
            task.result()
    return photos


def _photo_facts(spec: CaptureSpec, shot: Shot, owner: np.ndarray) -> dict[str, Any]:
    shares = np.bincount(owner.ravel(), minlength=len(spec.distractors) + 1) / owner.size
    standing = []
    for place in shot.placements:
        what, share = spec.distractors[place.which], round(float(shares[place.which + 1]), 6)
        standing.append({"distractor": what.name, "occlusion": share, **asdict(place)})
    return {"occlusion": round(float(shares[1:].sum()), 6), "distractors": standing}


def _facts(spec: CaptureSpec, seed: int, identity: str, photos: dict[str, Any]) -> dict[str, Any]:
    shares = [p["occlusion"] for p in photos.values()]
    return {
        "schema": 1,
        "preset": spec.name,
        "seed": seed,
        "identity": identity,
        "version": {"ambiguous_wild": __version__, "scikit-image": version("scikit-image")},
        "spec": to_plain(spec),
        "mask": "255 where any sample of a pixel hit a distractor; distractors throw no shadow on the scene",
        "occlusion": {"mean": float(np.mean(shares)), "min": min(shares), "max": max(shares)},
        "photos": photos,
        "licence": "CC0; textures from photographs in scikit-image that are CC0 or in the public domain",
    }


def _code_hash() -> str:
    """What the simulator is, so that a capture of an older one is not taken for this one's."""
    sources = sorted(Path(__file__).parent.glob("*.py"))
    return config_hash([__version__, *(sha256_file(p) for p in sources)])


def _camera_json(camera: Camera) -> dict[str, Any]:
    keys = ("width", "height", "fx", "fy", "cx", "cy")
    return {**{k: getattr(camera, k) for k in keys}, "cam_from_world": camera.cam_from_world.tolist()}


def _earlier(out: Path, identity: str, overwrite: bool) -> dict[str, Any] | None:
    """The facts of an identical capture that lies there whole; None where a new one may be written."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return None
    record = out / "truth" / "capture.json"
    if not record.is_file():
        raise AwError(f"{out} exists and is not a simulated capture; choose another folder with -o")
    try:
        facts = json.loads(record.read_text(encoding="utf-8"))
        same = facts["identity"] == identity
        made = f"preset {facts['preset']!r}, seed {facts['seed']}"
        files = dict(facts["files"])
    except (ValueError, KeyError, TypeError):
        facts, same, made, files = {}, False, "an unreadable truth/capture.json", {}
    if same and all((out / n).is_file() and sha256_file(out / n) == h for n, h in files.items()):
        return dict(facts)
    if overwrite:
        return None
    why = "with files changed since" if same else "of other settings or another version"
    raise AwError(f"{out} holds a capture ({made}) {why}; add --overwrite to replace it or choose another -o")


def _to_uint8(linear: np.ndarray) -> np.ndarray:
    return np.round(255.0 * linear_to_srgb(linear)).astype(np.uint8)


def _write_png(path: Path, pixels: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(pixels).save(path, compress_level=3)


def _write_photo(path: Path, pixels: np.ndarray, spec: CaptureSpec, number: int) -> None:
    """JPEG at quality 95 without chroma subsampling, with the EXIF of a phone whose settings are locked."""
    from PIL import Image

    Image.fromarray(pixels).save(path, quality=95, subsampling=0, exif=_exif(spec, number))


def _exif(spec: CaptureSpec, number: int) -> Any:
    from PIL import Image, TiffImagePlugin

    def rational(value: float) -> Any:
        return TiffImagePlugin.IFDRational(round(value * 10000), 10000)

    taken = _DATE.format(number * 4 // 60 % 60, number * 4 % 60)
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "ambiguous_wild", "simulated phone"
    exif[0x0131], exif[0x0132] = f"ambiguous_wild {__version__}", taken
    camera = exif.get_ifd(0x8769)
    camera[0x829A] = TiffImagePlugin.IFDRational(1, 250)  # ExposureTime, s
    camera[0x829D] = rational(1.6)  # FNumber
    camera[0x8827] = 64  # ISO
    camera[0x9003] = camera[0x9004] = taken
    camera[0x920A] = rational(_LENS_MM)
    camera[0xA402] = camera[0xA403] = 1  # exposure and white balance: manual
    camera[0xA002], camera[0xA003] = spec.width, spec.height
    per_inch = 25.4 * focal_px(spec) / _LENS_MM
    camera[0xA20E] = camera[0xA20F] = rational(per_inch)  # FocalPlaneX/YResolution
    camera[0xA210] = 2  # in inches
    camera[0xA405] = round(spec.focal_35mm)  # FocalLengthIn35mmFilm
    return exif
