"""`external:my.yaml`: a program with commands to train and render, described in a YAML or TOML file.

The file holds a train command, a render command and the paths of the pictures. Commands and paths may contain
placeholders such as ``{scene}`` and ``{index:05d}``: names only, no expressions.
"""

from __future__ import annotations

import dataclasses
import glob
import json
import os
import re
import shlex
import shutil
import string
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from ambiguous_wild.core import AwError, View
from ambiguous_wild.core.config import Facts, config_hash, from_plain, to_plain
from ambiguous_wild.core.errors import shortlist, unknown
from ambiguous_wild.core.names import check_name
from ambiguous_wild.core.processes import git_commit, last_lines
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.files import own_json, sha256_file, write_json
from ambiguous_wild.methods.entry import MethodEntry, NoOptions
from ambiguous_wild.methods.external_process import (
    DONE,
    Photos,
    Produced,
    Task,
    end_left_over,
    no_parts,
    run_logged,
    split_lists,
    stage_scene,
)

_FORMATTER = string.Formatter()
COMMANDS = ("train", "render", "resume")
BEGUN = "begun.json"  # in the program's folder: the command that was started, which `resume` must match
RUN = ("scene", "source", "images", "output", "seed", "iterations", "budget_s", "factor", "device")
VIEW = ("stem", "name", "index")
_WITHOUT_INFLUENCE = ("summary", "paper", "needs", "version", "timeout_h")  # keys without influence
_ADDED = {"photos": "all", "drawn_by": "program"}  # keys of later versions, with their defaults
_CODE = (".py", ".sh", ".yaml", ".yml", ".toml", ".json")  # other files may be logs, weights or builds
LISTS = ("train_names", "test_names", "train_stems", "test_stems")
PACKAGED = Path(__file__).parent / "descriptions"


def placeholders(template: str, where: str) -> set[str]:
    """Return the names in braces.

    Raises:
        AwError: a brace has no partner, or braces hold more than a name.
    """
    try:
        parts = list(_FORMATTER.parse(template))
    except ValueError as error:
        raise AwError(f"{where}: {template!r}: {error}; write {{{{ for a brace that is meant") from None
    names = {name for _, name, _, _ in parts if name is not None}
    for name in names:
        if not name.isidentifier():
            raise AwError(f"{where}: {{{name}}} in {template!r} is no placeholder: write a name")
    return names


def check_placeholders(template: str, known: Iterable[str], where: str) -> set[str]:
    """Return the placeholders of a template.

    Raises:
        AwError: a placeholder is unknown; the message suggests the nearest.
    """
    names, choices = placeholders(template, where), set(known)
    for name in sorted(names - choices):
        raise unknown(f"placeholder in {where}", name, choices, "{{ is a brace that is meant")
    return names


def fill_template(template: str, values: Mapping[str, object]) -> str:
    """Fill in a template; a value stays within the argument that holds its placeholder."""
    try:
        return _FORMATTER.vformat(template, (), values)
    except (ValueError, TypeError, KeyError) as error:
        raise AwError(f"{template!r} cannot be filled in: {error}") from None


def fill_pattern(template: str, values: Mapping[str, object]) -> str:
    """Fill in a glob pattern: wildcards of the template work, those in values are plain text."""
    escaped = {k: glob.escape(v) if isinstance(v, str) else v for k, v in values.items()}
    return fill_template(template, escaped)


@dataclass(frozen=True)
class CommandProgram:
    """A described program."""

    keys: Description
    cwd: Path  # absolute

    @property
    def name(self) -> str:
        return self.keys.name

    @property
    def drawn_by_us(self) -> bool:
        """Whether it writes splats, which our renderer draws."""
        return self.keys.drawn_by == "us"

    def words(self, key: str) -> tuple[str, ...]:
        """Return a command split as a shell splits it; empty if the file has none.

        Raises:
            AwError: a quotation has no end.
        """
        text = getattr(self.keys, key)
        try:
            return tuple(shlex.split(text)) if isinstance(text, str) else text
        except ValueError as error:
            raise AwError(f"command {text!r}: {error}") from None

    @property
    def environment(self) -> dict[str, str]:
        return {str(name): str(text) for name, text in self.keys.environment.items()}

    @property
    def scene_files(self) -> dict[str, str]:
        return {str(name): str(text) for name, text in self.keys.scene_files.items()}

    def missing(self, options: Any) -> str:
        """Return the first program of the commands that this machine lacks; empty if it has all."""
        values = dataclasses.asdict(options)
        commands = map(self.words, ("prefix",) if self.keys.prefix else COMMANDS)
        words = [command[0] for command in commands if command]
        path = self.environment.get("PATH")
        for word in dict.fromkeys(words):
            if placeholders(f"{word}{path or ''}", self.name) - values.keys():
                continue  # its value is known only in a run
            program = fill_template(word, values)
            where = self.cwd / program if os.path.dirname(program) else program
            if shutil.which(where, path=path and fill_template(path, values)) is None:
                return program
        return ""

    def run(self, task: Task) -> Produced:
        """Train and render, unless already done, and collect the output.

        Raises:
            AwError: a command fails or writes no complete output.
        """
        self._check_length(task)
        end_left_over(task.logs)
        lists = split_lists(task.scene)
        files = {name: fill_template(text, lists) for name, text in self.scene_files.items()}
        staged = stage_scene(task.scene, task.folder / ".scene", files, photos=self.keys.photos)
        try:
            values = self._values(task, staged)
            state = task.work / DONE
            done: dict[str, float] = _read(state)
            output = self._output(task)
            if "train_s" not in done:
                if self.keys.version:  # of the program that trains, whatever renders later
                    self._command("version", "version", values, task)
                resuming = self._may_resume(task, output)
                if not resuming:
                    shutil.rmtree(output, ignore_errors=True)
                output.mkdir(parents=True, exist_ok=True)
                command = "resume" if resuming else "train"
                write_json(task.work / BEGUN, list(self.words("train")))
                done["train_s"] = self._command("train", command, values, task)
                done |= {"resumed": 1.0} if resuming else {}
                write_json(state, done)
            if self.keys.render and "render_s" not in done:
                done["render_s"] = self._command("render", "render", values, task)
                write_json(state, done)
            return self._collect(task, values, done)
        finally:
            shutil.rmtree(staged, ignore_errors=True)

    @staticmethod
    def _output(task: Task) -> Path:
        return (task.work / "output").absolute()

    def _may_resume(self, task: Task, output: Path) -> bool:
        """Whether there is output of the same train command, which `resume` can continue."""
        try:
            begun = json.loads((task.work / BEGUN).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return False
        same = begun == list(self.words("train"))
        return bool(self.keys.resume) and same and output.is_dir() and any(output.iterdir())

    def _check_length(self, task: Task) -> None:
        if task.budget_s is not None and "budget_s" not in self._used():
            raise AwError(
                f"{self.name} has no {{budget_s}} in its commands, so it cannot keep a --budget: "
                "give --iterations instead"
            )

    def _used(self) -> set[str]:
        texts = (*self.words("train"), *self.words("render"), *self.environment.values())
        return set().union(*(placeholders(text, self.name) for text in texts))

    def _values(self, task: Task, staged: Path) -> dict[str, object]:
        factor = int(task.scene.info.get("loaded_factor") or 1)
        return dataclasses.asdict(task.options) | {
            "scene": str(staged.absolute()),
            "source": str(task.scene.root.resolve()),
            "images": "images" if factor == 1 or self.keys.photos != "all" else f"images_{factor}",
            "output": str(self._output(task)),
            "seed": task.seed,
            "iterations": task.iterations,
            "budget_s": task.budget_s,
            "factor": 1 if self.keys.photos == "train" else factor,
            "device": task.device,
        }

    def _command(self, step: str, key: str, values: dict[str, object], task: Task) -> float:
        return run_logged(
            f"{step} of {self.name}",
            [*self.words("prefix"), *(fill_template(argument, values) for argument in self.words(key))],
            log=task.logs / f"{step}.log",
            cwd=self.cwd,
            environment={name: fill_template(text, values) for name, text in self.environment.items()},
            timeout_s=self.keys.timeout_h * 3600.0 or None,
        )

    def _revision(self, task: Task) -> str | None:
        """Return what the program calls its version; else the commit of `cwd`, unless that is our own."""
        if self.keys.version:
            return "".join(last_lines(task.logs / "version.log")[-1:]) or None
        return git_commit(self.cwd) if self.cwd != PACKAGED.resolve() else None

    def _collect(self, task: Task, values: dict[str, object], done: dict[str, float]) -> Produced:
        tests, trains = task.scene.test, task.scene.train
        drawn = [] if self.drawn_by_us else list(enumerate(tests))
        renders = {view.name: self._find(self.keys.renders, values, view, i) for i, view in drawn}
        missing = [name for name, path in renders.items() if path is None]
        if missing:
            wanted = self._pattern(self.keys.renders, values, tests[0], 0)
            raise AwError(
                f"{self.name} left no render of {len(missing)} of {len(tests)} test photos "
                f"({shortlist(missing)}): {wanted} is not there"
            )
        masks = {}
        if self.keys.masks:
            masks = {view.name: self._find(self.keys.masks, values, view, i) for i, view in enumerate(trains)}
        ply = self._one(fill_pattern(self.keys.ply, values)) if self.keys.ply else None
        if self.keys.ply and ply is None:
            raise AwError(f"{self.name} left no splats: {fill_pattern(self.keys.ply, values)} is not there")
        # the part before a stop was not timed
        untimed = {"resumed", "train_s"} if "resumed" in done else set()
        cost = {name: seconds for name, seconds in done.items() if name not in untimed}
        if task.budget_s is None and "iterations" in self._used():
            cost["iterations"] = task.iterations
            if "train_s" in cost:
                cost["ms_per_iteration"] = 1e3 * cost["train_s"] / task.iterations
        return Produced(
            renders={name: path for name, path in renders.items() if path is not None},
            masks={name: path for name, path in masks.items() if path is not None},
            ply=ply,
            drawn_by_us=self.drawn_by_us,
            cost=cost,
            # the settings of the run that the commands do not pass
            facts={
                "revision": self._revision(task),
                "not_told": sorted({"seed", "iterations"} - self._used()),
            },
        )

    def _pattern(self, template: str, values: dict[str, object], view: View, index: int) -> str:
        stem = str(PurePosixPath(view.name).with_suffix(""))
        pattern = fill_pattern(template, values | {"stem": stem, "name": view.name, "index": index})
        return str(self.cwd / pattern)  # an absolute pattern stays as it is

    def _find(self, template: str, values: dict[str, object], view: View, index: int) -> Path | None:
        return self._one(self._pattern(template, values, view, index))

    def _one(self, pattern: str) -> Path | None:
        paths = sorted(glob.glob(str(self.cwd / pattern)))
        if len(paths) > 1:
            raise AwError(
                f"{self.name}: {len(paths)} files fit {pattern} ({shortlist(paths, 2)}): one must; "
                "make the pattern narrower"
            )
        return Path(paths[0]) if paths else None


def _read(state: Path) -> dict[str, float]:
    data = own_json(state)
    return {
        k: float(data[k]) for k in ("train_s", "render_s", "resumed") if isinstance(data.get(k), (int, float))
    }


@dataclass(frozen=True)
class Description:
    """The keys of the file. Commands are lists, or text split as a shell splits it; no shell runs them."""

    name: str = ""  # name in tables
    summary: str = ""
    paper: str = ""
    needs: str = ""
    train: str | tuple[str, ...] = ()
    render: str | tuple[str, ...] = ()  # not needed if the train command renders
    resume: str | tuple[str, ...] = ()  # instead of train, if a stopped run left files in {output}
    version: str | tuple[str, ...] = ()  # prints the program's version, which the result records
    renders: str = ""  # path of a test photo's render; may contain wildcards
    masks: str = ""  # path of a train photo's keep map, white = kept
    ply: str = ""  # splats, for counting and size
    cwd: str = ""  # relative to the file; empty = the file's folder
    prefix: str | tuple[str, ...] = ()  # before every command, e.g. conda run --no-capture-output -n theirs
    # `from_plain` reads these types at run time, where a recursive type cannot be evaluated
    environment: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)  # placeholders of your own; --set NAME.KEY=VALUE
    scene_files: dict[str, Any] = field(default_factory=dict)  # text files that the program needs in {scene}
    photos: Photos = "all"  # what {scene} holds: "all", "train" alone, or as "nerf-w"
    drawn_by: Literal["program", "us"] = "program"  # "us": our renderer draws the test views from `ply`
    timeout_h: float = 0.0  # limit of each command; 0 = none


def packaged(name: str) -> Path:
    """Return the file of a description of the package, as for external:opensplat.

    Raises:
        AwError: the package has no description of this name.
    """
    known = sorted(file.stem for file in PACKAGED.glob("*.yaml"))
    if name not in known:
        raise unknown("description", name, known, "or write external:PATH.yaml")
    return PACKAGED / f"{name}.yaml"


def load_description(path: Path) -> MethodEntry:
    """Read a description; returns its method.

    Raises:
        AwError: no such file, no YAML or TOML, an unknown key or placeholder, or a missing key.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise AwError(f"no description {path}: {error.strerror}; write external:PATH.yaml") from None
    description = from_plain(Description, _parse(path, content), str(path))
    options = _options_class(description.options, path)
    name = check_name(f"name in {path}", description.name)
    program = CommandProgram(dataclasses.replace(description, name=name), _folder(description.cwd, path))
    _check(program, set(description.options), path)
    return MethodEntry(
        name=program.name,
        summary=description.summary or f"external program of {path.name}",
        recipe=no_parts,
        config=options,
        paper=description.paper,
        needs=description.needs or "its own environment",
        # keys without influence on the result may change without a new training
        source_hash=config_hash(_decisive(description) | _named_files(program, path.resolve().parent)),
        program=program,
    )


def _folder(text: str, path: Path) -> Path:
    """Return the folder `cwd`, in which $NAME is a variable of the environment."""
    for name in re.findall(r"\$(\w+)", text):
        if not os.environ.get(name):
            raise AwError(f"{path.stem} needs {name}: export {name}=FOLDER, the folder of its repository")
    return (path.resolve().parent / Path(os.path.expandvars(text)).expanduser()).resolve()


def _decisive(description: Description) -> Facts:
    """Return the keys that decide the result, without `_ADDED` keys at their defaults: so runs of earlier
    versions keep their identity."""
    plain = {k: v for k, v in to_plain(description).items() if k not in _WITHOUT_INFLUENCE}
    return {k: v for k, v in plain.items() if k not in _ADDED or v != _ADDED[k]}


def _named_files(program: CommandProgram, folder: Path) -> Facts:
    """Return {"files": sha256 by word}: words of commands that are code below `folder` or `cwd`; or {}."""
    words = {word for key in ("prefix", *COMMANDS) for word in program.words(key)}
    paths = {word: (program.cwd / word).resolve() for word in words if word.endswith(_CODE)}
    files = {
        word: sha256_file(path)
        for word, path in paths.items()
        if path.is_file() and any(path.is_relative_to(root) for root in (program.cwd, folder))
    }
    return {"files": files} if files else {}


def _parse(path: Path, content: bytes) -> Facts:
    try:
        text = content.decode()
        data = tomllib.loads(text) if path.suffix == ".toml" else plain_yaml.parse(text)
    except (AwError, ValueError, RecursionError) as error:
        raise AwError(f"{path} cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict):
        raise AwError(f"{path} holds no keys: see docs/external-methods.md for name, train and renders")
    return data


def _options_class(options: Facts, path: Path) -> type:
    """Make a frozen dataclass with the file's values as defaults, by which `--set` checks types."""
    if not options:
        return NoOptions
    for key, value in options.items():
        if not str(key).isidentifier() or key in (*RUN, *VIEW, *LISTS):
            raise AwError(f"{path}: option {key!r} must be a name, and none of {', '.join(RUN)}")
        if not isinstance(value, (str, int, float, bool)):
            raise AwError(f"{path}: option {key!r} needs a text, a number or a truth value as its default")
    fields = [(key, type(value), field(default=value)) for key, value in options.items()]
    return dataclasses.make_dataclass("ProgramOptions", fields, frozen=True)


def _check(program: CommandProgram, options: set[str], path: Path) -> None:
    needed = ("train", "ply" if program.drawn_by_us else "renders")
    keys = program.keys
    missing = [key for key in needed if not getattr(keys, key)]
    if missing:
        raise AwError(f"{path} does not say {' and '.join(missing)}; see docs/external-methods.md")
    run = {*RUN, *options}
    for key in (*COMMANDS, "version"):
        for argument in program.words(key):
            check_placeholders(argument, run, f"{path}, {key}")
    for name, value in program.environment.items():
        check_placeholders(value, run, f"{path}, environment {name}")
    for name, value in program.scene_files.items():
        check_placeholders(value, LISTS, f"{path}, scene_files {name}")
    for key, known in (("renders", run | {*VIEW}), ("masks", run | {*VIEW}), ("ply", run)):
        check_placeholders(getattr(keys, key), known, f"{path}, {key}")
    if keys.renders and not {*VIEW} & placeholders(keys.renders, "renders"):
        raise AwError(f"{path}: renders must hold {{stem}}, {{name}} or {{index}}: one file a test photo")
    if not program.cwd.is_dir():
        raise AwError(f"{path}: cwd {program.cwd} is no folder")
