"""A cell of the grid is one method on one scene with one seed: its identity, provenance and report.

Identities are hashes that anybody can compute again from the files.
"""

from __future__ import annotations

import hashlib
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
from ambiguous_wild.core import UNMOVED, Scene
from ambiguous_wild.core.config import config_hash, flatten, to_plain
from ambiguous_wild.core.errors import installed
from ambiguous_wild.core.machine import usable_cores
from ambiguous_wild.core.processes import own_commit
from ambiguous_wild.harness.chosen_effects import ChosenEffects, mixed_tests, scene_protocol
from ambiguous_wild.harness.command_lines import bench_command, length_options, length_text, option_text
from ambiguous_wild.harness.measures import ImageRow, records
from ambiguous_wild.harness.result_file import (
    NOT_BEGUN,
    SCHEMA,
    Continued,
    Cost,
    Environment,
    MaskScores,
    Provenance,
    RunConfig,
    RunFacts,
    RunResult,
    SceneConfig,
    UnusualConfig,
    config_identity,
)
from ambiguous_wild.harness.start import StartFile
from ambiguous_wild.io.corrections import CorrectionsFile
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.motion_points import FILE as MOTION
from ambiguous_wild.methods.entry import second_pass_name
from ambiguous_wild.methods.graft import Graft
from ambiguous_wild.methods.references import reference_file
from ambiguous_wild.methods.registry import MethodEntry, all_methods
from ambiguous_wild.splat.train_config import TrainConfig

Overwrite = Literal["never", "missing", "longer", "changed", "always"]
Protocol = Literal["full", "half"]
Outcome = Literal["trained", "kept", "skipped", "failed"]
PACKAGES = ("numpy", "numba", "torch", "opencv-contrib-python-headless", "scipy", "gsplat", "transformers")
# Files that record how a scene was made, versions included. Nothing is trained or scored on them: the same
# photos simulated by a later version are the same scene.
RECORDS = ("truth/capture.json",)
MEASURED_WITH = (
    "truth/clean",
    "truth/distractor",
    "truth/shadow",
    "masks/test",
)  # folders that scores and references read


def environment(device: str) -> Environment:
    """Return versions, platform and device as plain values."""
    import torch

    facts: Environment = {
        "ambiguous_wild": __version__,
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "cpu": _cpu_name(),
        "cores": usable_cores(),
        "device": device,
        "packages": {name: installed(name) for name in PACKAGES},
    }
    if revision := package_commit():
        facts["commit"] = revision
    if device.startswith("cuda"):
        from ambiguous_wild.splat.gsplat_calls import max_alpha

        facts["gpu"] = torch.cuda.get_device_name(device)
        facts["gsplat_max_alpha"] = max_alpha(device)  # differs between its sources
    return facts


def _cpu_name() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as f:
            for line in f:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def scene_identity(scene: Scene) -> str:
    """Return the sha256 of a scene: over its files' hashes, its split and the size it is loaded at."""
    listed = scene.info.get("files")
    hashes: dict[str, object] = (
        {name: entry["sha256"] for name, entry in listed.items() if name not in RECORDS}
        if isinstance(listed, dict)
        else {}
    )
    split = [(v.name, v.split, v.camera.width, v.camera.height) for v in scene.views]
    # what was put into the folder later is in no list
    later = [view.keep_path for view in scene.views if view.keep_path is not None]
    if hashes:
        later += [*(view.image_path for view in scene.views), *sorted((scene.root / "sparse/0").glob("*"))]
    else:
        hashes = _contents(scene)
    later += [scene.root / MOTION, *(p for f in MEASURED_WITH for p in sorted((scene.root / f).rglob("*")))]
    for path in later:
        name = path.relative_to(scene.root).as_posix()
        if name not in hashes and path.is_file():
            hashes[name] = _digest(path)
    moved = {} if scene.transform == UNMOVED else {"place": [*scene.transform.centre, scene.transform.scale]}
    behind = {"background": scene.background} if any(scene.background) else {}
    return config_hash({"files": hashes, "split": split, **moved, **behind})


def _contents(scene: Scene) -> dict[str, object]:
    """Return cameras, points and photos of a plain COLMAP scene, which lists no hashes of its files."""
    cameras = [v.camera for v in scene.views]
    lenses = [(c.fx, c.fy, c.cx, c.cy) for c in cameras]
    points = scene.points
    content = points.xyz.round(9).astype("<f8").tobytes() + points.rgb.tobytes()
    if len(points.track_views):  # scenes without tracks keep the identity that they had
        content += points.track_offsets.astype("<i8").tobytes() + points.track_views.astype("<i4").tobytes()
        content += points.track_xy.astype("<f4").tobytes()
    return {
        "poses": np.concatenate([c.cam_from_world.ravel() for c in cameras]).round(9).tolist(),
        "lenses": np.array(lenses).round(9).tolist(),
        "points": hashlib.sha256(content).hexdigest(),
        "photos": [_digest(v.image_path) for v in scene.views],
    }


def _digest(path: Path) -> str:
    """Return the sha256 of a file, computed again only when the file has changed."""
    state = path.stat()
    return _digest_of(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=16_384)
def _digest_of(path: Path, size: int, mtime_ns: int) -> str:
    return sha256_file(path)


@dataclass(frozen=True)
class Cell:
    """A run to be made. Two cells of the same identity give the same result on the same machine."""

    method: MethodEntry
    options: Any  # the method's frozen dataclass
    scene: Scene
    scene_id: str  # sha256 of what the scene was built from, see `scene_identity`
    train: TrainConfig
    device: str = "cpu"
    chosen: ChosenEffects = field(default_factory=ChosenEffects)  # optional effects, and the reasons for them
    protocol: Protocol = "full"  # "half": measured on the right half, colour effects fitted on the left
    start: StartFile | None = None  # what it starts from instead of the scene's points
    corrections: CorrectionsFile | None = None  # masks corrected by hand
    continued: tuple[Continued, ...] = ()  # the shorter runs that it goes on from
    group: str = ""  # folder below the output, where one output takes several lengths or effects

    @property
    def config(self) -> RunConfig:
        """The resolved configuration, as written to config.yaml."""
        # Keys with the usual value are left out, so that runs from before these keys keep their identity.
        unusual: UnusualConfig = {}
        if self.chosen.effects:
            unusual["effects"] = list(self.chosen.effects)
        if self.protocol != "full":
            unusual["protocol"] = self.protocol
        if self.start is not None:
            unusual["start"] = {"sha256": self.start.sha256, "path": str(self.start.path)}
        if self.corrections is not None:
            unusual["corrections"] = self.corrections.record()
        if self.continued:
            unusual["continued"] = list(self.continued)
        return {
            **unusual,
            "method": self.method.name,
            "source": self.method.source_hash,
            "options": to_plain(self.options),
            "train": to_plain(self.train),
            "scene": self._scene_record(),
            "device": self.device,
            "version": __version__,
        }

    def _scene_record(self) -> SceneConfig:
        record: SceneConfig = {
            "name": self.scene.name,
            "sha256": self.scene_id,
            "factor": self.scene.info.get("loaded_factor"),
            "path": str(self.scene.root.resolve()),
        }
        if any(self.scene.background):
            record["background"] = list(self.scene.background)
        return record

    @property
    def identity(self) -> str:
        """Hash of all settings that decide the result, so without those in `IGNORED`.

        `on_nonfinite` is among them: it acts only on a value that is not finite, which the facts report.
        """
        return config_identity(self.config)

    def result(
        self,
        *,
        error: str | None = None,
        per_image: Sequence[ImageRow] = (),
        missing: Mapping[str, str] | None = None,
        masks: MaskScores | None = None,
        facts: RunFacts | None = None,
        cost: Cost | None = None,
    ) -> RunResult:
        """Return the result of this cell, made by a training or a program; with an error, of a failure.

        Args:
            error: why the run failed; None = it was trained and measured.
            per_image: metrics of each test image.
            missing: why a metric is missing, by metric.
            masks: scores of the predicted masks; None without exact masks.
            facts: what the method, its effects and the watchdog report.
            cost: time, memory and size.
        """
        all_facts: RunFacts = {
            **(facts or {}),
            "length": ", continued to ".join(
                [f"{before['iteration']} iterations" for before in self.continued]
                + [length_text(self.train.iterations, self.train.budget_s)]
            ),
        }
        if self.corrections is not None:
            all_facts["corrections"] = f"by hand ({self.corrections.sha256[:8]})"
        if mixed := mixed_tests(self.scene):
            all_facts["test_photos"] = mixed
        if masks is None and error is None and (why := self._why_no_masks(cost or {})):
            all_facts["no_masks"] = why
        if self.start is not None:
            all_facts["start"] = f"{self.start.path.name} ({self.start.sha256[:8]})"
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
            "facts": all_facts,
            "cost": cost or {},
            "config_hash": self.identity,
            "scene_hash": self.scene_id,
            "version": __version__,
        }

    def _why_no_masks(self, cost: Cost) -> str:
        """Return why no masks could be compared with exact ones; empty if no train photo has one."""
        if not any(self.scene.truth_file("distractor", view).is_file() for view in self.scene.train):
            return ""
        from ambiguous_wild.harness.regions import other_size
        from ambiguous_wild.methods.mask_policies import makes_masks

        if self.method.program is None and not makes_masks(self.method.build(self.options)):
            return "the method makes no masks"
        if why := other_size(self.scene):
            return why
        if self.method.program is not None:
            return "the program wrote no masks"
        return f"{NOT_BEGUN} at {cost.get('iterations', self.train.iterations)} iterations"


@dataclass(frozen=True)
class RunOptions:
    """How runs are made and kept. No option changes a result."""

    cache_dir: Path  # features and instance masks that runs share
    # "missing" keeps a finished run and resumes a stopped one, "longer" also continues a shorter one,
    # "changed" also replaces one whose method's file has changed, "always" starts anew, "never" leaves a
    # folder that exists as it is
    overwrite: Overwrite = "missing"
    pictures: bool = True  # draw what the method saw into pictures/


@dataclass
class CellReport:
    """The outcome of a cell's run."""

    folder: Path
    outcome: Outcome
    error: str = ""
    result: RunResult | None = None  # only of a run that was trained now


def provenance(cell: Cell) -> Provenance:
    """Return the machine, the code and the command that make the result of a cell."""
    return {
        "environment": environment(cell.device),
        "code_hash": code_hash(),
        "reproduce": reproduce_command(cell),
    }


@cache
def code_hash() -> str:
    """Return the sha256 over the package's Python files: two runs with the same one ran the same code.

    Plugins are not included: the hash of a plugin stands in config.yaml under `source`.
    """
    root = Path(ambiguous_wild.__file__).parent
    sources = sorted(p for p in root.rglob("*.py") if "__pycache__" not in p.parts)
    return config_hash([[p.relative_to(root).as_posix(), sha256_file(p)] for p in sources])


@cache
def package_commit() -> str:
    """Return the commit of the package, see `own_commit`; asked once a process."""
    return own_commit()


def reproduce_command(cell: Cell) -> str:
    """Return the command that makes this result again, whatever the defaults of a later version are.

    It names no output folder (-o, by default runs/).
    """
    method, train = cell.method, cell.train
    name = _base(method).name
    given = method.given_as or second_pass_name(name, method.passes)
    options: list[tuple[str, object]] = [
        ("--device", cell.device.partition(":")[0]),
        ("--resolution", train.resolution),
        ("--effects", ",".join(cell.chosen.effects) or "none"),
        ("--factor", cell.scene.info.get("loaded_factor") or None),
        ("--start", cell.start and cell.start.path),
        ("--corrections", cell.corrections and cell.corrections.path),
        ("--max-gaussians", train.max_gaussians),
        ("--protocol", None if cell.protocol == scene_protocol(cell.scene) else cell.protocol),
        *(("--set", setting) for setting in changed_settings(method, name, cell.options)),
        *(("--plugin", plugin) for plugin in _plugins(method)),
    ]
    scene, length = str(cell.scene.root.resolve()), length_options(train.iterations, train.budget_s)
    return shlex.join(bench_command(("--method", given), scene, train.seed, length, options))


def _base(method: MethodEntry) -> MethodEntry:
    """Return the method with the same recipe whose name can be looked up: a variant's name cannot."""
    if isinstance(method.recipe, Graft):
        return replace(method, name=method.recipe.name)
    methods = all_methods()
    if method.name in methods:
        return method
    same = (e for e in methods.values() if (e.recipe, e.config) == (method.recipe, method.config))
    return next(same, method)


def changed_settings(method: MethodEntry, name: str, options: Any) -> list[str]:
    """Return METHOD.KEY=VALUE for every option that is not at its default.

    Args:
        method: the method, which has the defaults.
        name: how settings name it.
        options: its options, as their dataclass or as plain values.
    """
    now, default = flatten(to_plain(options)), flatten(to_plain(method.options()))
    changed = {key: value for key, value in now.items() if default.get(key, ...) != value}
    settings = []
    for key, value in changed.items():
        owner, rest = name, key
        if method.slots:  # a graft: its settings are named after the donor of the part
            slot, _, rest = key.partition(".")
            owner = dict(method.slots)[slot]
        settings.append(f"{owner}.{rest}={option_text(value)}")
    return list(dict.fromkeys(settings))


def _plugins(method: MethodEntry) -> list[Path]:
    """Return the --plugin files that a method, or the members of a graft, came from."""
    methods = all_methods()
    members = [methods[name] for _, name in method.slots if name in methods] or [method]
    # a reference is no plugin: its file need not call register
    files = [method_file(member) for member in members if not member.given_as]
    return [path for path in dict.fromkeys(files) if path is not None]


def method_file(method: MethodEntry) -> Path | None:
    """Return the file of a user's own method; None for every other."""
    if method.given_as:
        return reference_file(method.given_as)
    module = sys.modules.get(getattr(method.recipe, "__module__", "") or "")
    if module is None or not module.__name__.startswith("aw_plugin_") or module.__file__ is None:
        return None
    return Path(module.__file__).resolve()
