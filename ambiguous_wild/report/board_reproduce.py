"""Describe the settings of a run, and the commands that make it and its scene again in an empty folder."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import fields
from functools import cache
from itertools import pairwise
from pathlib import Path

from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.config import Facts, config_hash, flatten, to_plain
from ambiguous_wild.datasets.suites import simulated_dataset
from ambiguous_wild.harness.command_lines import length_options, option_text
from ambiguous_wild.harness.result_file import Options, RunConfig, RunResult, SceneConfig, TrainRecord
from ambiguous_wild.harness.trained_models import Opened, open_scene
from ambiguous_wild.io.files import own_json
from ambiguous_wild.methods.entry import trained_once
from ambiguous_wild.methods.graft import graft_name, graft_pairs, split_graft
from ambiguous_wild.methods.references import MASKS
from ambiguous_wild.report.board import Entry, hidden_in
from ambiguous_wild.simulate.presets import PRESETS, resized
from ambiguous_wild.simulate.spec import CaptureSpec
from ambiguous_wild.simulate.spec_file import plain_spec

# options of `aw build-scene`
FLAGS = ("camera", "matcher", "mapper", "max_features", "seed", "masks_missing", "sfm")
_PLUGIN = re.compile(r"[\w.-]+\.py")
_REFERENCE = re.compile(rf"({_PLUGIN.pattern}:\w+|external:[\w.-]+|nerfbaselines:[\w.-]+)([@+][\w@+=,.-]+)?")
SIMULATED = "simulated"
EXACT_POSES = ", exact poses"  # ends the name of a dataset whose poses are not estimated


def setting(config: RunConfig, planned: bool) -> str:
    """Return length, effects, protocol and limits as text: "2000 iterations, effects exposure".

    Where each scene's plan chose the effects (`planned`), they differ by scene and are called "auto".

    The text identifies a cell of the board. So it depends on the run alone, not on defaults of methods, which
    later versions may change. The options have their own hash.
    """
    train = config["train"]
    words = [_length(train)]
    if planned or config.get("effects"):
        words.append("effects " + ("auto" if planned else "+".join(map(str, config["effects"]))))
    if config.get("protocol", "full") != "full":
        words.append(f"{config['protocol']} images")
    if isinstance(start := config.get("start"), dict):
        words.append(f"start {str(start.get('sha256'))[:8]}")
    if train.get("resolution", "auto") != "auto":
        words.append(f"resolution {train['resolution']}")
    if train.get("max_gaussians") is not None:
        words.append(f"at most {train['max_gaussians']} Gaussians")
    return ", ".join(words)


def dataset_of(name: str, exact_poses: bool) -> str:
    """Return the name under which runs are on the board: those with exact poses are apart from all others."""
    return name + EXACT_POSES if exact_poses and not name.endswith(EXACT_POSES) else name


def _length(train: TrainRecord) -> str:
    seconds = train.get("budget_s")
    if seconds is None:
        return f"{train.get('iterations')} iterations"
    return f"{seconds / 60:g} min" if seconds >= 60 else f"{seconds:g} s"


def options_hash(config: RunConfig) -> str:
    """Return the first 8 hex digits of the hash of the method's options; empty without options."""
    return config_hash(config["options"])[:8] if config["options"] else ""


def command(config: RunConfig, before: Sequence[str] = (), recorded: str = "") -> str:
    """Return the command that makes the run again, with the scene by its name.

    It is made from the hashed configuration, and the names of an own method's files. The command in a result
    file may be a stranger's text, and readers of a board paste this one into a shell.

    Args:
        config: configuration of the run.
        before: commands that make its scene, see `preparation`.
        recorded: the command in the result file.

    Raises:
        AwError: it would hold invisible characters: control characters, line breaks, text-direction marks.
    """
    text = " && ".join([*before, shlex.join(command_words(config, recorded))])
    hidden = hidden_in(text)
    if hidden is not None:
        raise AwError(f"config.yaml holds the invisible character {hidden!a}: run again without it")
    return text


def command_words(config: RunConfig, recorded: str) -> list[str]:
    """Return the words of the command, "aw", "bench", then options with a value each, unchecked."""
    train = config["train"]
    words: list[object] = ["aw", "bench", *_method(config, recorded)]
    words += ["--scene", config["scene"].get("name"), "--seed", train["seed"]]
    words += length_options(train.get("iterations"), train.get("budget_s"))
    for flag, value, usual in (
        ("--resolution", train.get("resolution"), "auto"),
        ("--max-gaussians", train.get("max_gaussians"), None),
        ("--protocol", config.get("protocol", "full"), "full"),
        ("--factor", config["scene"].get("factor"), None),
    ):
        words += [flag, value] if value != usual else []
    words += ["--start", "START.ply"] if config.get("start") else []
    words += ["--corrections", "CORRECTIONS.json"] if config.get("corrections") else []
    words += ["--effects", ",".join(map(str, config.get("effects") or ["none"]))]
    for key, value in _changed(config).items():
        words += ["--set", f"{key}={value}"]
    words += ["--device", config.get("device", "cpu"), "-o", "runs"]
    return [str(word) for word in words]


def _method(config: RunConfig, recorded: str) -> list[str]:
    """Return --method, of an own method as it was given, --plugin or --mask; files without their folders."""
    method = config["method"]
    if not config["source"]:
        return ["--method", method]
    try:
        words = shlex.split(recorded)
    except ValueError:
        words = []
    if any(f"mask={MASKS}" in word for word in words):  # named after their folder
        once = trained_once(method)
        donors = dict(graft_pairs(once))
        folder, host = donors.pop("mask", ""), split_graft(once)[0]
        return ["--method", graft_name(host, donors) + method.removeprefix(once), "--mask", folder]
    given = {flag: re.sub(r"^(external:)?.*/", r"\1", word) for flag, word in pairwise(words)}
    reference, plugin = given.get("--method", ""), given.get("--plugin", "")
    # the name of an ablation's variant says more than the reference
    if _REFERENCE.fullmatch(reference) and ("@" in reference) == ("@" in method):
        return ["--method", reference]
    return ["--method", method, "--plugin", plugin if _PLUGIN.fullmatch(plugin) else "METHOD.py"]


def _changed(config: RunConfig) -> dict[str, str]:
    """Return METHOD.KEY and value of options that are not the method's defaults on every machine.

    For a method in a file these are all options, for a variant those that depend on the machine: the others
    follow from its name.
    """
    options, name = flatten(config["options"]), config["method"]
    if "@" in name:
        kept = {f"{member}.{k}": options.get(f"{place}.{k}") for place, member, k in _chosen(name)}
        return {key: option_text(value) for key, value in kept.items() if value is not None}
    usual = {} if config["source"] else _defaults(name)
    if usual is None:
        return {}
    return {
        f"{name}.{k}": option_text(v) for k, v in sorted(options.items()) if k not in usual or usual[k] != v
    }


def _chosen(method: str) -> list[tuple[str, str, str]]:
    """Return place, member and name of each option of a graft whose default depends on the machine."""
    from ambiguous_wild.methods.registry import get_method

    try:
        slots = get_method(method).slots
        return sorted((p, member, k) for p, member in slots for k in get_method(member).by_machine())
    except (AwError, ImportError):
        return []


@cache
def _defaults(method: str) -> Options | None:
    """Return the defaults that are the same on every machine; None for an unknown method."""
    from ambiguous_wild.methods.registry import get_method

    try:
        entry = get_method(method)
        options = flatten(to_plain(entry.options()))
    except (AwError, ImportError):
        return None
    return {k: v for k, v in options.items() if k not in entry.by_machine()}


def hardware(path: Path, result: RunResult) -> str:
    """Return the processor with its threads, "Intel Xeon, 2 threads", or the GPU.

    Raises:
        AwError: env.json is damaged.
    """
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        name = facts.get("gpu") or facts["cpu"]
    except (OSError, ValueError, KeyError, AttributeError, RecursionError):
        raise AwError(
            f"{path} is damaged: restore it, or run again with 'aw bench --overwrite always'"
        ) from None
    threads = result["cost"].get("threads")
    count = ""
    if threads is not None and not facts.get("gpu"):
        count = f", {threads:g} thread{'' if threads == 1 else 's'}"
    return " ".join(str(name).split())[:100] + count


def preparation(scene: Scene | None) -> list[str]:
    """Return the commands that make a simulated scene; empty for other scenes.

    Args:
        scene: scene of a run; None: it is not on this machine.
    """
    truth = own_json(scene.root / "truth" / "capture.json") if scene is not None else {}
    settings = scene.info.get("settings") if scene is not None else None
    if scene is None or not truth or not isinstance(settings, dict):
        return []
    simulate = _simulate(truth, scene.name)
    raw = f"raw/{scene.name}"
    return [*simulate, shlex.join(_build(raw, scene.name, settings))] if simulate else []


def _simulate(truth: Facts, name: str) -> list[str]:
    """Return the command that simulates: by preset if that gives the same spec, else from a file."""
    spec, seed = truth.get("spec"), truth.get("seed")
    if not isinstance(spec, dict) or not isinstance(seed, int):
        return []
    end = [*(["--seed", str(seed)] if seed else []), "-o", f"raw/{name}"]
    preset = PRESETS.get(str(truth.get("preset")))
    if preset is not None:
        views, width = (
            spec.get(k) if spec.get(k) != getattr(preset, k) else None for k in ("train_views", "width")
        )
        if _same_spec(preset, views, width, spec):
            size = [*(["--views", str(views)] if views else []), *(["--width", str(width)] if width else [])]
            return [shlex.join(["aw", "simulate", preset.name, *size, *end])]
    file = f"{name}.yaml"
    text = json.dumps(spec, ensure_ascii=True)  # JSON is YAML
    return [
        f"printf %s {shlex.quote(text)} > {shlex.quote(file)}",
        shlex.join(["aw", "simulate", f"./{file}", *end]),
    ]


def _same_spec(preset: CaptureSpec, views: int | None, width: int | None, spec: Facts) -> bool:
    """Tell whether a preset of this size is the spec of a capture."""
    try:
        return bool(json.loads(json.dumps(plain_spec(resized(preset, views, width)))) == spec)
    except (AwError, TypeError):
        return False


def _is_preset(truth: Facts) -> bool:
    """Tell whether a capture is that of its preset, at another width at most."""
    preset, spec = PRESETS.get(str(truth.get("preset"))), truth.get("spec")
    if preset is None or not isinstance(spec, dict):
        return False
    return _same_spec(preset, None, spec.get("width"), spec)


def _build(raw: str, name: str, settings: Facts) -> list[str]:
    usual = {f.name: f.default for f in fields(BuildSettings)}
    settings = {"sfm": "thorough", **settings}  # scenes of early versions do not say it
    words = ["aw", "build-scene", raw, "-o", name]
    if settings.get("factor") is not None:
        words += ["--factor", str(settings["factor"])]
    for key in FLAGS:
        if key in settings and settings[key] != usual[key]:
            words += [f"--{key.replace('_', '-')}", str(settings[key])]
    return words + (["--strict"] if settings.get("strict") else [])


def _stated(scene: Scene) -> str:
    """Return the dataset by scene.json, or that of a simulated scene; empty where none is known."""
    name, truth = scene.info.get("dataset"), own_json(scene.root / "truth" / "capture.json")
    if isinstance(name, str) and name.strip():
        return name
    if not isinstance(truth.get("preset"), str):
        return ""
    dataset = simulated_dataset(truth, scene.info.get("loaded_factor"))
    return dataset if dataset and _is_preset(truth) else SIMULATED


def _has_exact_poses(scene: Scene) -> bool:
    chosen = dict(scene.info).get("chosen")
    return isinstance(chosen, dict) and chosen.get("mapper") == "truth"


class Scenes:
    """Find the scenes of runs; each is opened once."""

    def __init__(
        self, folder: Path | None = None, dataset: str | None = None, board: Iterable[Entry] = ()
    ) -> None:
        """
        Args:
            folder: folder of scenes, or one scene; None = where the runs say.
            dataset: dataset of all scenes; None = what each scene says.
            board: runs of the board, which give the dataset of scenes that are not on this machine.
        """
        self._folder, self._dataset = folder, dataset
        board = list(board)
        self._datasets = {e.scene_hash: e.dataset for e in board}
        self._names = {(e.dataset, e.scene_hash): e.scene for e in board}
        self._opened = Opened()

    def find(self, run: Path, config: RunConfig) -> Scene | None:
        """Return the scene of a run; None if it is not on this machine.

        Raises:
            AwError: the folder holds another scene, or a damaged one.
        """
        path = self._path(config["scene"])
        return None if path is None else open_scene(run, path, opened=self._opened)

    def _path(self, asked: SceneConfig) -> Path | None:
        name = str(asked.get("name"))
        if self._folder is not None:
            if (self._folder / "sparse").is_dir():
                return self._folder
            # the name may be a stranger's, and must not lead out of the folder
            inside = Path(name).name == name and (self._folder / name).is_dir()
            return self._folder / name if inside else None
        path = asked.get("path")
        return Path(path) if isinstance(path, str) and path and Path(path).is_dir() else None

    def dataset(self, run: Path, scene: Scene | None, scene_hash: str) -> str:
        """Return the dataset: the given one, that in scene.json, of simulated scenes, or that on the board.

        Scenes with exact poses are in one of their own, see `dataset_of`.

        Raises:
            AwError: none of these is available.
        """
        known = self._dataset or (_stated(scene) if scene is not None else "")
        if known:
            return dataset_of(known, scene is not None and _has_exact_poses(scene))
        if scene_hash in self._datasets:
            return self._datasets[scene_hash]
        why = "its scene is not on this machine" if scene is None else f"{scene.root} names none"
        raise AwError(f"{run}: the dataset is unknown, {why}; give it with --dataset NAME")

    def check_name(self, run: Path, entry: Entry) -> None:
        """Refuse a scene that the dataset holds, or a run before this one had, under another name."""
        name = self._names.setdefault((entry.dataset, entry.scene_hash), entry.scene)
        if name != entry.scene:
            raise AwError(
                f"{run}: scene {entry.scene!a} of dataset {entry.dataset!a} is {name!a} there, with the same "
                "files, and would count twice; give its folder that name and bench again, or give another "
                "--dataset"
            )
