"""A cell of the grid: one method on one scene with one seed; its identity, its provenance, its report.

Identities are hashes that anybody can compute again from the files.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

import ambiguous_wild
from ambiguous_wild import __version__
from ambiguous_wild.core import UNMOVED, AwError, Scene
from ambiguous_wild.core.config import config_hash, flatten, to_plain
from ambiguous_wild.harness.choosing import Chosen, mixed_tests, scene_protocol
from ambiguous_wild.harness.measures import ImageRow, records
from ambiguous_wild.harness.result_file import (
    SCHEMA,
    Cost,
    Environment,
    MaskScores,
    Provenance,
    RunConfig,
    RunResult,
    UnusualConfig,
)
from ambiguous_wild.harness.start import StartFile
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.motion_points import FILE as MOTION
from ambiguous_wild.methods.graft import Graft
from ambiguous_wild.methods.references import reference_file
from ambiguous_wild.methods.registry import MethodEntry, all_methods
from ambiguous_wild.splat.pace import TrainConfig

PACKAGES = ("numpy", "numba", "torch", "opencv-contrib-python-headless", "scipy", "gsplat", "transformers")


def environment(device: str) -> Environment:
    """Versions, platform and device as plain values."""
    import torch

    facts: Environment = {
        "ambiguous_wild": __version__,
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "cpu": _cpu_name(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "device": device,
        "packages": {name: installed(name) for name in PACKAGES},
    }
    if device.startswith("cuda"):
        from ambiguous_wild.splat.gsplat_seam import max_alpha

        facts["gpu"] = torch.cuda.get_device_name(device)
        facts["gsplat_max_alpha"] = max_alpha(device)  # differs between its sources
    return facts


def installed(package: str) -> str | None:
    """The version of an installed distribution, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cpu_name() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as f:
            for line in f:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


# Keys of config.yaml that do not decide the result: how often it is saved and probed, what is done about
# values that are not finite (the result says so where there were any), where the scene lies.
IGNORED: dict[str, tuple[str, ...]] = {
    "train": ("checkpoint_every_s", "probes", "on_nonfinite"),
    "scene": ("path",),
    "start": ("path",),
}
# Files of a scene that say how it came to be, versions included, and that nothing is trained or scored on:
# the same photos simulated by a later version are the same scene.
RECORDS = ("truth/capture.json",)


def config_identity(config: Mapping[str, Any]) -> str:
    """sha256 of what decides a run's result.

    Args:
        config: the resolved configuration, as in config.yaml; its own "config_hash" does not count.

    Raises:
        ValueError: it holds a number that is not finite.
        TypeError: it holds what JSON does not.
    """
    known = {k: v for k, v in config.items() if k != "config_hash"}
    for part in IGNORED.keys() & known.keys():
        known[part] = {k: v for k, v in config[part].items() if k not in IGNORED[part]}
    return config_hash(known)


def scene_identity(scene: Scene) -> str:
    """sha256 that stands for the scene: over its files' hashes, its split and the size it is loaded at."""
    files = scene.info.get("files")
    known = (
        {name: entry["sha256"] for name, entry in files.items() if name not in RECORDS}
        if isinstance(files, dict)
        else {}
    )
    split = [(v.name, v.split, v.camera.width, v.camera.height) for v in scene.views]
    if not known:
        known = _of_plain(scene)
    # masks that were put into the folder later are in no list
    for view in scene.views:
        if view.keep_path is not None:
            name = view.keep_path.relative_to(scene.root).as_posix()
            if name not in known:
                known[name] = _digest(view.keep_path)
    if MOTION not in known and (scene.root / MOTION).is_file():
        known[MOTION] = _digest(scene.root / MOTION)
    moved = {} if scene.place == UNMOVED else {"place": [*scene.place.centre, scene.place.scale]}
    return config_hash({"files": known, "split": split, **moved})


def asked_length(train: TrainConfig) -> str:
    """What a run was asked for, "60 s" or "2000 iterations"."""
    return f"{train.iterations} iterations" if train.budget_s is None else f"{train.budget_s:g} s"


def refuse_other_scene(run: Path, scene: Path, now: str, known: str) -> None:
    """Raise AwError if a scene is not in the state that a run saw.

    Args:
        run: its folder.
        scene: the scene's folder.
        now: `scene_identity` of the scene as it is.
        known: that of the scene as the run saw it.
    """
    if now != known:
        raise AwError(
            f"{run} was measured on another state of {scene}: hash {known[:12]}, now {now[:12]}; restore the "
            "scene, or name the folder of the right one"
        )


def _of_plain(scene: Scene) -> dict[str, Any]:
    """What stands for a plain COLMAP scene, which lists no hashes: cameras, points and photos."""
    cameras = [v.camera for v in scene.views]
    lenses = [(c.fx, c.fy, c.cx, c.cy) for c in cameras]
    return {
        "poses": np.concatenate([c.cam_from_world.ravel() for c in cameras]).round(9).tolist(),
        "lenses": np.array(lenses).round(9).tolist(),
        "points": hashlib.sha256(
            scene.points.xyz.round(9).astype("<f8").tobytes() + scene.points.rgb.tobytes()
        ).hexdigest(),
        "photos": [_digest(v.image_path) for v in scene.views],
    }


def _digest(path: Path) -> str:
    """sha256 of a file, computed once for each state of it."""
    state = path.stat()
    return _digest_of(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=16_384)
def _digest_of(path: Path, size: int, mtime_ns: int) -> str:
    return sha256_file(path)


Overwrite = Literal["never", "missing", "changed", "always"]
Protocol = Literal["full", "half"]
Outcome = Literal["trained", "kept", "skipped", "failed"]


@dataclass(frozen=True)
class Cell:
    """One run to be made. Two cells of the same identity give the same result on the same machine."""

    method: MethodEntry
    options: Any  # the method's frozen dataclass
    scene: Scene
    scene_id: str  # sha256 of what the scene was built from, see `scene_identity`
    train: TrainConfig
    device: str = "cpu"
    chosen: Chosen = field(default_factory=Chosen)  # optional effects, and why
    protocol: Protocol = "full"  # "half": measured on the right half, colour effects fitted on the left
    start: StartFile | None = None  # what it starts from instead of the scene's points
    group: str = ""  # folder below the output, where one output takes several lengths or effects

    @property
    def config(self) -> RunConfig:
        """The resolved configuration, as written to config.yaml."""
        # Keys at their usual value are left out: runs from before these keys existed keep their identity.
        unusual: UnusualConfig = {}
        if self.chosen.effects:
            unusual["effects"] = list(self.chosen.effects)
        if self.protocol != "full":
            unusual["protocol"] = self.protocol
        if self.start is not None:
            unusual["start"] = {"sha256": self.start.sha256, "path": str(self.start.path)}
        return {
            **unusual,
            "method": self.method.name,
            "source": self.method.source_hash,
            "options": to_plain(self.options),
            "train": to_plain(self.train),
            "scene": {
                "name": self.scene.name,
                "sha256": self.scene_id,
                "factor": self.scene.info.get("loaded_factor"),
                "path": str(self.scene.root.resolve()),
            },
            "device": self.device,
            "version": __version__,
        }

    @property
    def identity(self) -> str:
        """Hash of all settings that decide the result."""
        return config_identity(self.config)

    def result(
        self,
        *,
        error: str | None = None,
        per_image: Sequence[ImageRow] = (),
        missing: Mapping[str, str] | None = None,
        masks: MaskScores | None = None,
        facts: Mapping[str, Any] | None = None,
        cost: Cost | None = None,
    ) -> RunResult:
        """The result of this cell, whoever made it: a training, a program, or, with an error, a failure.

        Args:
            error: why it failed; None = it was trained and measured.
            per_image: metrics of each test image.
            missing: why a metric is missing, by metric.
            masks: scores of the predicted masks, None without exact ones.
            facts: of the method, its effects and the watchdog.
            cost: what it took.
        """
        known: dict[str, Any] = {**(facts or {}), "length": asked_length(self.train)}
        if mixed := mixed_tests(self.scene):
            known["test_photos"] = mixed
        if self.start is not None:
            known["start"] = f"{self.start.path.name} ({self.start.sha256[:8]})"
        return {
            "schema": SCHEMA,
            "method": self.method.name,
            "scene": self.scene.name,
            "seed": self.train.seed,
            "status": "ok" if error is None else "failed",
            "error": error,
            "options": to_plain(self.options),
            "per_image": list(per_image),
            "metrics": records({key for row in per_image for key in row}),
            "missing": dict(missing or {}),
            "masks": masks,
            "facts": known,
            "cost": cost or {},
            "config_hash": self.identity,
            "scene_hash": self.scene_id,
            "version": __version__,
        }


@dataclass(frozen=True)
class RunOptions:
    """How runs are made and kept; nothing of this changes a result."""

    cache_dir: Path  # for features and instance masks shared between runs
    # "missing" keeps a finished run and resumes a stopped one, "changed" also replaces one whose method's
    # file has changed, "always" starts anew, "never" leaves a folder that exists as it is
    overwrite: Overwrite = "missing"
    pictures: bool = True  # draw what the method saw into pictures/


@dataclass
class CellReport:
    """What became of a cell's run."""

    folder: Path
    outcome: Outcome
    error: str = ""
    result: RunResult | None = None  # of a run that was trained now


def provenance(cell: Cell) -> Provenance:
    """Where and how the result of a cell is made."""
    return {
        "environment": environment(cell.device),
        "code_hash": code_hash(),
        "reproduce": reproduce(cell),
    }


@cache
def code_hash() -> str:
    """sha256 over the package's Python files: two runs with the same one ran the same code.

    A plugin is not part of it: its own hash is in config.yaml under `source`.
    """
    root = Path(ambiguous_wild.__file__).parent
    sources = sorted(p for p in root.rglob("*.py") if "__pycache__" not in p.parts)
    return config_hash([[p.relative_to(root).as_posix(), sha256_file(p)] for p in sources])


def reproduce(cell: Cell) -> str:
    """The command that makes this result again, whatever the defaults of a later version are."""
    method, train = cell.method, cell.train
    name = _base(method).name
    given = method.given_as or name
    words = ["aw", "bench", "--method", given, "--scene", str(cell.scene.root.resolve())]
    words += ["--seed", str(train.seed), *_length(train), "--device", cell.device.partition(":")[0]]
    words += ["--resolution", train.resolution, "--effects", ",".join(cell.chosen.effects) or "none"]
    factor = cell.scene.info.get("loaded_factor")
    words += ["--factor", str(factor)] if factor else []
    words += ["--start", str(cell.start.path)] if cell.start is not None else []
    words += ["--max-gaussians", str(train.max_gaussians)] if train.max_gaussians is not None else []
    words += ["--protocol", cell.protocol] if cell.protocol != scene_protocol(cell.scene) else []
    for setting in _settings(method, name, cell.options):
        words += ["--set", setting]
    for plugin in _plugins(method):
        words += ["--plugin", str(plugin)]
    return shlex.join(words)


def _length(train: TrainConfig) -> list[str]:
    if train.budget_s is None:
        return ["--iterations", str(train.iterations)]
    return ["--budget", f"{train.budget_s:.6f}".rstrip("0").rstrip(".") + "s"]


def _base(method: MethodEntry) -> MethodEntry:
    """The method that a variant of an ablation is one of: same recipe, another name."""
    if isinstance(method.recipe, Graft):
        return replace(method, name=method.recipe.name)
    known = all_methods()
    if method.name in known:
        return method
    same = (
        entry for entry in known.values() if (entry.recipe, entry.config) == (method.recipe, method.config)
    )
    return next(same, method)


def _settings(method: MethodEntry, name: str, options: Any) -> list[str]:
    """METHOD.KEY=VALUE of every option that is not at its default."""
    now, default = flatten(to_plain(options)), flatten(to_plain(method.options()))
    changed = {key: value for key, value in now.items() if default.get(key, ...) != value}
    found = []
    for key, value in changed.items():
        owner, rest = name, key
        if method.places:  # of a graft: the setting is named after whose place it is
            place, _, rest = key.partition(".")
            owner = dict(method.places)[place]
        found.append(f"{owner}.{rest}={_text(value)}")
    return list(dict.fromkeys(found))


def _text(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return ",".join(map(_text, value))
    return "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _plugins(method: MethodEntry) -> list[Path]:
    """The files given as --plugin, for a method that came from one, or a graft of such methods."""
    known = all_methods()
    members = [known[name] for _, name in method.places if name in known] or [method]
    # a reference is no plugin: its file need not call register
    found = [file_of(member) for member in members if not member.given_as]
    return [path for path in dict.fromkeys(found) if path is not None]


def file_of(method: MethodEntry) -> Path | None:
    """The file of a method of one's own."""
    if method.given_as:
        return reference_file(method.given_as)
    module = sys.modules.get(getattr(method.recipe, "__module__", "") or "")
    if module is None or not module.__name__.startswith("aw_plugin_") or module.__file__ is None:
        return None
    return Path(module.__file__).resolve()
