"""From a spec to a folder that looks like a phone's: photos with EXIF, and beside them the exact truth.

RAW/train/IMG_0001.jpg ...        with distractors
RAW/test/IMG_0101.jpg ...         other viewpoints, nobody there
RAW/truth/cameras.json            name -> size, fx, fy, cx, cy, cam_from_world (OpenCV axes, metres)
RAW/truth/distractor/<stem>.png   255 where any part of the pixel shows a distractor, else 0
RAW/truth/clean/<stem>.png        the train photo with nobody there, same effects, before JPEG
RAW/truth/shadow/<stem>.png       with moving shadows: 255 where one darkens the static scene
RAW/truth/depth/<stem>.png        optional: z of the static surface, 16 bit, millimetres
RAW/truth/capture.json            spec, seed, versions, what it was designed as; per photo occlusion, who
                                  stands where, what the effects drew; sha256 of every file
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from importlib.metadata import version
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.config import config_hash, to_plain
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.atomic import atomic_dir, write_json
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.io.strangers import refuse_strangers
from ambiguous_wild.simulate.develop import Developed, Exposure, Shot, depth_m, expose, finish, prepare
from ambiguous_wild.simulate.distractors import lay_out
from ambiguous_wild.simulate.effects.moment import Moment
from ambiguous_wild.simulate.phone import write_photo, write_png
from ambiguous_wild.simulate.spec import CaptureSpec
from ambiguous_wild.simulate.spec_file import plain_spec
from ambiguous_wild.simulate.tracer import Traced
from ambiguous_wild.simulate.walk import plan_cameras
from ambiguous_wild.simulate.world import World, courtyard

Progress = Callable[[list[Shot]], Iterable[Shot]]


def plan(spec: CaptureSpec, seed: int) -> tuple[World, list[Shot]]:
    """Build the world and decide every shot; world, walk and layout draw from independent streams."""
    paint, walk, stand = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3))
    world = courtyard(paint, spec.detail_px_per_m, spec.samples, spec.world)
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
        shadow = ["truth/shadow"] if spec.effects.moving_shadow is not None else []
        optional = [*shadow, *(["truth/depth"] if depth else [])]
        for part in ("train", "test", "truth/distractor", "truth/clean", *optional):
            (folder / part).mkdir(parents=True)
        photos = _render(spec, world, shots, seed, folder, depth, progress)
        write_json(folder / "truth" / "cameras.json", {s.name: _camera_json(spec, s.camera) for s in shots})
        files = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
        facts = _facts(spec, seed, identity, photos)
        facts["files"] = {name: sha256_file(folder / name) for name in files}
        write_json(folder / "truth" / "capture.json", facts)
    return {**facts, "reused": False}


def _render(
    spec: CaptureSpec,
    world: World,
    shots: list[Shot],
    seed: int,
    folder: Path,
    depth: bool,
    progress: Progress,
) -> dict[str, Any]:
    photos: dict[str, Any] = {}
    moments = [Moment(seed, k, k / max(spec.train_views - 1, 1)) for k in range(len(shots))]

    def complete(number: int, exposure: Exposure, seen: Traced, metres: np.ndarray | None) -> None:
        shot = shots[number]
        made = finish(shot, moments[number], exposure, seen)
        write_photo(folder / shot.split / shot.name, made.photo, spec, shot.camera, number, made.effects)
        for part, pixels in _truth(shot, made, metres):
            write_png(folder / "truth" / part / f"{Path(shot.name).stem}.png", pixels)
        if shot.split == "train":
            photos[shot.name] = _photo_facts(spec, shot, made)

    # Lens, noise and encoders run beside the rays of the photos before and after; each photo draws from a
    # moment of its own, so who is first changes nothing.
    with ThreadPoolExecutor(2) as beside:
        ahead: deque[Future[Exposure]] = deque()
        pending: deque[Future[None]] = deque()
        waiting = iter(range(len(shots)))
        for number, shot in enumerate(progress(shots)):
            for k in islice(waiting, 2 - len(ahead)):
                ahead.append(beside.submit(prepare, spec, world, shots[k], moments[k]))
            exposure = ahead.popleft().result()
            seen = expose(world, exposure)
            metres = depth_m(world, shot.camera) if depth else None
            pending.append(beside.submit(complete, number, exposure, seen, metres))
            while len(pending) > 2:
                pending.popleft().result()
        for task in pending:
            task.result()
    return {shot.name: photos[shot.name] for shot in shots if shot.name in photos}


def _truth(shot: Shot, made: Developed, metres: np.ndarray | None) -> Iterable[tuple[str, np.ndarray]]:
    """The folder and the pixels of every truth picture of the shot."""
    if shot.split == "train":
        yield "distractor", np.where(made.owner > 0, 255, 0).astype(np.uint8)
        yield "clean", made.clean
        if made.shadow is not None:
            yield "shadow", np.where(made.shadow, 255, 0).astype(np.uint8)
    if metres is not None:
        millimetres = np.round(1000 * metres)
        yield "depth", np.clip(millimetres, 0, 65535).astype(np.uint16)


def _photo_facts(spec: CaptureSpec, shot: Shot, made: Developed) -> dict[str, Any]:
    shares = np.bincount(made.owner.ravel(), minlength=len(spec.distractors) + 1) / made.owner.size
    standing = []
    for place in shot.placements:
        what, share = spec.distractors[place.which], round(float(shares[place.which + 1]), 6)
        standing.append({"distractor": what.name, "occlusion": share, **asdict(place)})
    facts = {"occlusion": round(float(shares[1:].sum()), 6), "distractors": standing}
    if made.shadow is not None:
        facts["shadow"] = round(float(made.shadow.mean()), 6)
    if made.effects:
        facts["effects"] = made.effects
    return facts


def _facts(spec: CaptureSpec, seed: int, identity: str, photos: dict[str, Any]) -> dict[str, Any]:
    shares = [p["occlusion"] for p in photos.values()]
    return {
        "schema": 1,
        "preset": spec.name,
        "seed": seed,
        "identity": identity,
        "version": {"ambiguous_wild": __version__, "scikit-image": version("scikit-image")},
        "spec": plain_spec(spec),
        "designed": to_plain(spec.designed),
        "mask": "255 where any part of a pixel shows a distractor; distractors throw no shadow on the scene",
        "clean": "same camera, same effects, nobody there nor anybody's shadow, before JPEG",
        "test": "nobody there; of the effects only specular and lens_distortion",
        "occlusion": {"mean": float(np.mean(shares)), "min": min(shares), "max": max(shares)},
        "photos": photos,
        "licence": "CC0; textures from photographs in scikit-image that are CC0 or in the public domain",
    }


def _code_hash() -> str:
    """What the simulator is, so that a capture of an older one is not taken for this one's."""
    here = Path(__file__).parent
    sources = sorted([*here.glob("*.py"), *here.glob("effects/*.py")])
    return config_hash([__version__, *(sha256_file(p) for p in sources)])


def _camera_json(spec: CaptureSpec, camera: Camera) -> dict[str, Any]:
    keys = ("width", "height", "fx", "fy", "cx", "cy")
    facts = {**{k: getattr(camera, k) for k in keys}, "cam_from_world": camera.cam_from_world.tolist()}
    lens = spec.effects.lens_distortion
    return facts if lens is None else {**facts, "distortion": {"k1": lens.k1, "k2": lens.k2}}


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
        files = {str(n): h for n, h in facts["files"].items()}
        if any(PurePosixPath(n).is_absolute() or ".." in PurePosixPath(n).parts for n in files):
            raise ValueError("a file outside the capture")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        facts, same, made, files = {}, False, "an unreadable truth/capture.json", {}
    if same and all((out / n).is_file() and sha256_file(out / n) == h for n, h in files.items()):
        return dict(facts)
    if overwrite:
        if files:
            refuse_strangers(out, {record.relative_to(out).as_posix(), *files})
        return None
    why = "with files changed since" if same else "of other settings or another version"
    raise AwError(f"{out} holds a capture ({made}) {why}; add --overwrite to replace it or choose another -o")
