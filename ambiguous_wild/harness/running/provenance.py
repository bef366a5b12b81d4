"""Provenance of a result: the machine, the code, and the command that makes it again."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ambiguous_wild
from ambiguous_wild.core.config import config_hash, flatten, to_plain
from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.published import scene_protocol
from ambiguous_wild.harness.running.records import Provenance, RunResult
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.methods.graft import Graft
from ambiguous_wild.methods.registry import MethodEntry, all_methods
from ambiguous_wild.splat.pace import TrainConfig

if TYPE_CHECKING:
    from ambiguous_wild.harness.running.cell import Cell


def provenance(cell: Cell) -> Provenance:
    """Where and how the result of a cell is made."""
    return {
        "environment": environment(cell.device),
        "code_hash": code_hash(),
        "reproduce": reproduce(cell),
    }


def with_provenance(result: RunResult, cell: Cell) -> RunResult:
    """The result with `provenance` in it, as it is written to a file."""
    return {**result, **provenance(cell)}


@cache
def code_hash() -> str:
    """sha256 over the package's Python files: two runs with the same one ran the same code.

    A plugin is not part of it: its own hash is in config.yaml under `source`.
    """
    root = Path(ambiguous_wild.__file__).parent
    sources = sorted(p for p in root.rglob("*.py") if "__pycache__" not in p.parts)
    return config_hash([[p.relative_to(root).as_posix(), sha256_file(p)] for p in sources])


def reproduce(cell: Cell) -> str:
    """The command that makes this result again, whatever the defaults of a later version are.

    Where it is written to is left to whoever runs it (-o, by default runs/).
    """
    method, train = cell.method, cell.train
    name = _base(method).name
    given = method.given_as or name
    words = ["aw", "bench", "--method", given, "--scene", str(cell.scene.root.resolve())]
    words += ["--seed", str(train.seed), *_length(train), "--device", cell.device.partition(":")[0]]
    words += ["--resolution", train.resolution, "--effects", ",".join(cell.chosen.effects) or "none"]
    factor = cell.scene.info.get("loaded_factor")
    words += ["--factor", str(factor)] if factor else []
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
    found = [_plugin(member) for member in members if not member.given_as]
    return [path for path in dict.fromkeys(found) if path is not None]


def _plugin(method: MethodEntry) -> Path | None:
    module = sys.modules.get(getattr(method.recipe, "__module__", "") or "")
    if module is None or not module.__name__.startswith("aw_plugin_") or module.__file__ is None:
        return None
    return Path(module.__file__).resolve()
