"""A short training of a method: it repeats and resumes to the same bits, and leaves its inputs unchanged."""

from __future__ import annotations

import copy
import inspect
import operator
import random
import tempfile
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera, Scene, SparsePoints, View
from ambiguous_wild.core.config import State
from ambiguous_wild.core.scene import NO_PHOTO
from ambiguous_wild.methods.entry import MethodEntry
from ambiguous_wild.methods.references import error_location
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.stress.case import Case, CaseResult

ITERATIONS = 120  # density control acts before and after the middle
_WIDTH, _HEIGHT, _FOCAL, _WALL_M = 64, 48, 60.0, 4.0
_TRAIN, _TEST = 6, 2
_CLOCKS = ("elapsed_s", "setup_s", "parts_s", "cpu_s", "timeline")  # differ from run to run


def case_of(entry: MethodEntry) -> Case:
    """Return the case of a method, which trains 2.5 times for `ITERATIONS` on a CPU.

    Raises:
        AwError: an external program trains the method, it reads the truth, or an option has no default.
    """
    if entry.program is not None:
        raise AwError(f"--method {entry.name}: another program trains it; name a method that we train")
    if knows_truth(entry.name):
        raise AwError(
            f"--method {entry.name}: it reads exact masks, which the check has not; name another method"
        )
    entry.options()

    def measure(device: str) -> CaseResult:
        try:
            with tempfile.TemporaryDirectory(prefix="aw-stress-") as folder:
                wrong = _faults(entry, Path(folder), torch.device(device))
        except Exception as error:
            if isinstance(error, AwError) or not error_location(error):
                raise
            why = " ".join(f"{type(error).__name__}: {error}".split())
            raise AwError(why + error_location(error)) from error
        return CaseResult(
            float(len(wrong)), 0.0, "; ".join(wrong) or "exact", "same bits when repeated, resumed"
        )

    return Case(11, entry.name, measure, ("cpu",))


def _faults(entry: MethodEntry, folder: Path, device: torch.device) -> list[str]:
    """Return what is wrong with the method, the first fault alone: others may follow from it."""
    data, untouched = _data(folder, device), _data(folder, device)

    def trainer(name: str) -> Trainer:
        config = TrainConfig(iterations=ITERATIONS, probes=0)
        return Trainer(data, entry.build(entry.options()), config, folder=folder / name)

    def train(one: Trainer, until: int) -> State:
        while one.iteration < until:
            one.step()
        one.check_parameters()
        return _state(one)

    middle = ITERATIONS // 2
    first = trainer("first")
    before = train(first, middle)
    for name in ("photos", "cameras", "scene.points"):
        if differ(*map(operator.attrgetter(name), (data, untouched))):
            return [f"it changes data.{name} in place: change a copy"]
    again = trainer("again")
    if changed := differing(before, train(again, middle)):
        return [
            f"two trainings of one seed differ in {changed}: seed every random generator from data.seed, and "
            "keep no state in a module or class"
        ]
    step = again.make_step(middle, 0)
    again.hooks.mask.predict(step)
    again.hooks.mask.panels(step)
    if changed := differing(before, _state(again)):
        return [f"predict(step) or panels(step) changes {changed}: they must learn and store nothing"]
    resumed = trainer("first")
    resumed.resume()
    lost = [
        f"{type(part).__name__}.{name}"
        for part, other in zip(_parts(first), _parts(resumed), strict=True)
        for name in differing(vars(part), vars(other)).split(", ")
        if name
    ]
    lost = [name for name in lost if "._" not in name] or lost  # private ones are often caches
    if changed := differing(train(first, ITERATIONS), train(resumed, ITERATIONS)):
        return [
            f"stopped and resumed, it differs in {changed}; not restored: {', '.join(lost) or 'unknown'}: "
            "return it from state_dict() and set it in load_state_dict(state)"
        ]
    return []


def _parts(trainer: Trainer) -> list[Any]:
    effects = trainer.effects.effects
    fields = () if trainer.hooks.fields is None else (trainer.hooks.fields,)
    return [trainer.hooks.mask, trainer.density, *effects, *fields]


def _state(trainer: Trainer) -> State:
    """Save the run; return what it holds, without times."""
    trainer.save()
    held = checkpoint.load(trainer.checkpoint_path)
    facts = copy.deepcopy(trainer.hooks.mask.facts())
    return {name: value for name, value in held.items() if name not in _CLOCKS} | {"facts": facts}


def differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Return the keys whose values differ, separated by commas."""
    return ", ".join(key for key in {**one, **other} if differ(one.get(key), other.get(key)))


def differ(one: Any, other: Any, outer: frozenset[int] = frozenset()) -> bool:
    """Whether two values differ in a bit; objects are compared by their attributes, `outer` ends circles."""
    if one is other or inspect.isroutine(one) or isinstance(one, (type, TrainData)):
        return False
    if type(one).__qualname__ != type(other).__qualname__:
        return True
    one, other = _inside(one), _inside(other)
    if id(one) in outer:
        return False
    outer |= {id(one)}
    if isinstance(one, Mapping):
        return one.keys() != other.keys() or any(differ(one[key], other[key], outer) for key in one)
    if isinstance(one, (list, tuple, deque)):
        return len(one) != len(other) or any(differ(a, b, outer) for a, b in zip(one, other))
    return bool(one != other) and not bool(one != one)  # NaN


def _inside(value: Any) -> Any:
    """Return what an object holds: a mapping, a list or a plain value."""
    if isinstance(value, Tensor):
        flat = value.detach().cpu().reshape(-1).view(torch.uint8)
        return [str(value.dtype), tuple(value.shape), flat.numpy().tobytes()]
    if isinstance(value, np.ndarray):
        return [str(value.dtype), value.shape, value.tobytes()]
    if isinstance(value, torch.Generator):
        return [value.get_state()]
    if isinstance(value, np.random.Generator):
        return value.bit_generator.state
    if isinstance(value, random.Random):
        return value.getstate()
    if isinstance(value, torch.optim.Optimizer):
        return value.state_dict()
    return vars(value) if hasattr(value, "__dict__") else value


def _data(folder: Path, device: torch.device) -> TrainData:
    """Return six photos of a coloured wall, with a red square in another place of each, and its points."""
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-2.2, 3.4, 400), rng.uniform(-1.7, 1.7, 400), np.full(400, _WALL_M)])
    across = np.array([0.25 * k for k in range(_TRAIN)] + [0.3 + 0.5 * k for k in range(_TEST)])
    views = tuple(
        View(f"{k}.png", NO_PHOTO, _camera(x), "train" if k < _TRAIN else "test")
        for k, x in enumerate(across)
    )
    xy = _FOCAL / _WALL_M * (xyz[:, None, :2] - np.stack([across, 0 * across], axis=1))
    xy += (_WIDTH / 2, _HEIGHT / 2)  # [points, views, 2]
    seen = ((xy >= 0) & (xy < (_WIDTH, _HEIGHT))).all(axis=2)
    points = SparsePoints(
        xyz=xyz,
        rgb=(255 * _wall(xyz[:, 0], xyz[:, 1])).astype(np.uint8),
        error_px=np.full(len(xyz), 0.5),
        track_offsets=np.concatenate([[0], np.cumsum(seen.sum(axis=1))]),
        track_views=np.nonzero(seen)[1].astype(np.int32),
        track_xy=xy[seen].astype(np.float32),
    )
    columns, rows = np.meshgrid(np.arange(_WIDTH) + 0.5, np.arange(_HEIGHT) + 0.5)
    photos = []
    for k, x in enumerate(across[:_TRAIN]):
        scale = _WALL_M / _FOCAL
        photo = _wall(x + (columns - _WIDTH / 2) * scale, (rows - _HEIGHT / 2) * scale)
        photo[14:26, 14 + 4 * k : 26 + 4 * k] = (0.98, 0.08, 0.08)
        photos.append(torch.from_numpy(photo.astype(np.float32)).to(device))
    scene = Scene(folder, "wall", views, points)
    cameras = [view.camera for view in scene.train]
    return TrainData(scene, photos, cameras, [None] * _TRAIN, device, 0, folder / "cache")


def _camera(x: float) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(_WIDTH, _HEIGHT, _FOCAL, _FOCAL, _WIDTH / 2, _HEIGHT / 2, pose)


def _wall(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return smooth colours in [0.1, 0.9] at places of the wall, [..., 3]."""
    waves = [np.sin(2.1 * x + 0.3) * np.cos(1.7 * y), np.sin(1.3 * y - 1.0 + x), np.cos(2.4 * x - y)]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)
