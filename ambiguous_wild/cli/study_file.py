"""A study of `aw bench` in a file: the options of the command by their names, in YAML.

`read_study` gives the command the file's options as defaults, `write_study` writes those of a command beside
its runs. The config.yaml of a run is read too: as the study that makes this run again. Paths are relative to
the folder of the file.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import yaml
from click.core import ParameterSource

from ambiguous_wild.cli.options import PathName, say
from ambiguous_wild.cli.run_progress import ProgressBar
from ambiguous_wild.core.config import flatten
from ambiguous_wild.core.errors import AwError, counted, shortlist, unknown
from ambiguous_wild.core.names import plain, quoted
from ambiguous_wild.harness.command_lines import length_options, option_text
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.files import patient_lock, write_text

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell, CellReport

NAME = "study"
HEADER = "# What 'aw bench' made here; 'aw bench FILE' makes it again. Paths are relative to this file.\n"
AXES = ("method", "scene", "seed")  # of the grid, whose folders keep their names when it grows along one
# Options of the command, by key: a file may not hold the first, as who runs it decides what is replaced. Those
# of both are not written into a file: they say how runs are made and kept, not which.
NOT_READ = {"json", "overwrite", "help"}
NOT_WRITTEN = {"output", "cache", "threads", "jobs", "engine", "address", "pictures"}
LOCKED_S = 10.0  # longest wait for another command that writes its study into the same folder
Values = Mapping[str, Any]  # by the name of the parameter, or of the option


@dataclass(frozen=True)
class StudyFile:
    """A file that was given to the command."""

    path: Path
    settings: tuple[str, ...] = ()  # METHOD.KEY=VALUE; those of the command line are added
    run: Mapping[str, Any] = field(default_factory=dict)  # its config.yaml, where the file is that of a run

    def check_method(self, found: bool) -> None:
        """Raise AwError if the method of a run is in a file that nobody `found`."""
        if self.run.get("source") and not found:
            raise AwError(
                f"{self.path} is of the method {quoted(self.run.get('method'))}, which takes files of yours: add "
                "--plugin FILE.py, --method FILE.py:RECIPE or --mask FOLDER"
            )

    def report_changes(self, cells: Sequence[Cell]) -> None:
        """Say in what the planned run differs from the run that was given back."""
        if not self.run or not cells or cells[0].identity == self.run.get("config_hash"):
            return
        from ambiguous_wild.harness.cell_run import describe_change, different_keys

        before, now = flatten(dict(self.run)), flatten(dict(cells[0].config))
        changes = (describe_change(key, before, now, cells[0]) for key in different_keys(before, now))
        say(f"not the same run as {self.path}: {shortlist(changes)}")

    def report_others(self, cells: Sequence[Cell], output: Path) -> None:
        """Name the runs below the output that the study does not make (any more)."""
        from ambiguous_wild.harness.grid import cell_folder
        from ambiguous_wild.harness.store import run_folders

        own = {cell_folder(output, cell).resolve() for cell in cells}
        others = [str(run.relative_to(output)) for run in run_folders(output) if run.resolve() not in own]
        if others:
            say(
                f"{counted(len(others), 'run')} in {output} not of {self.path}, but in its tables: "
                f"{shortlist(others)}; move or delete what is not wanted"
            )


def read_study(ctx: click.Context, _: click.Parameter, word: str | None) -> StudyFile | None:
    """Make the options of the file the defaults of the command (a callback of the argument STUDY).

    Raises:
        AwError: it cannot be read, has an unknown key, or a value that is none of its option's.
        click.UsageError: the word is no file of a study, but meant otherwise.
    """
    if word is None or ctx.resilient_parsing:
        return None
    path = Path(word)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise click.UsageError(f"Got unexpected extra argument ({word})", ctx)
    if not path.is_file():
        raise AwError(f"no study {path}: an 'aw bench' writes {NAME}.yaml beside its runs")
    data = plain_yaml.read_mapping(path)
    run = data if "config_hash" in data else {}
    texts = _texts(ctx, _options_of_run(path, run) if run else data, path)
    ctx.default_map = texts
    return StudyFile(path, tuple(texts.get("settings", ())), run)


def _texts(ctx: click.Context, data: Mapping[Any, Any], path: Path) -> dict[str, Any]:
    """Return the values of a file as words of the command line, by parameter; paths as seen from here.

    Raises:
        AwError: unknown key, or a value that is none of its option's.
    """
    options = _options(ctx)
    known = options.keys() - NOT_READ
    texts: dict[str, Any] = {}
    for key, value in data.items():
        if key in NOT_READ and key in options:
            raise AwError(f"{path}: {key!r} is for the command line alone: leave it out, and give --{key}")
        if key not in known:
            raise unknown(f"key in {path}", plain(str(key)), known, "the options of 'aw bench --help'")
        if value is None:
            continue
        option = options[key]
        where = f"{path}: {key}"
        if key == "set" and isinstance(value, dict):
            value = [
                f"{name}={_word(inner, f'{where}: {name}', lists=True)}" for name, inner in value.items()
            ]
        if option.is_flag:
            if not isinstance(value, bool):
                raise AwError(f"{where}: write true or false, not {quoted(value)}")
            texts[str(option.name)] = value
            continue
        if not option.multiple and isinstance(value, list):
            raise AwError(f"{where}: one value is expected, not a list")
        words = [_word(one, where) for one in (value if isinstance(value, list) else [value])]
        words = [found for word in words for found in _seen(option, word, path.resolve().parent, Path.cwd())]
        try:
            option.type_cast_value(ctx, words if option.multiple else words[0])
        except click.BadParameter as error:
            raise AwError(f"{where}: {error.message}") from None
        texts[str(option.name)] = words if option.multiple else words[0]
    return texts


def _options(ctx: click.Context) -> dict[str, click.Option]:
    """Return the options of the command by their long names, without the dashes."""
    options = [param for param in ctx.command.get_params(ctx) if isinstance(param, click.Option)]
    return {max(option.opts, key=len).lstrip("-"): option for option in options}


def decisive(ctx: click.Context) -> list[str]:
    """Return the parameters that decide which runs are made."""
    return [str(option.name) for key, option in _options(ctx).items() if key not in NOT_READ | NOT_WRITTEN]


def _word(value: Any, where: str, *, lists: bool = False) -> str:
    """Return a plain value as a word of the command line.

    Raises:
        AwError: a mapping, nothing, or a text that no command line can hold.
    """
    items = value if isinstance(value, list) and lists else [value]
    if not all(isinstance(item, str | int | float) for item in items):
        raise AwError(f"{where}: a text or a number is expected, not {quoted(value)}")
    text = option_text(value)
    if plain(text) != text:
        raise AwError(f"{where}: {quoted(text)} holds an invisible character: leave it out")
    return text


def _seen(option: click.Option, word: str, folder: Path, here: Path) -> list[str]:
    """Return a word of an option, relative to `folder`, as seen from `here`; several methods become several words."""

    def moved(path: Path) -> Path:
        absolute = os.path.normpath(folder / path)
        try:
            return Path(Path(os.path.relpath(absolute, here)).as_posix())
        except ValueError:  # another drive of Windows
            return Path(absolute)

    if isinstance(option.type, PathName):
        return [str(moved(Path(word)))] if word else [word]
    if option.name == "effects":
        return [str(moved(Path(word))) if is_plan(word) else word]
    if option.name not in ("methods", "mask"):
        return [word]
    from ambiguous_wild.harness.benchmark import split_methods
    from ambiguous_wild.methods.graft import ALIASES, replace_reference_files
    from ambiguous_wild.methods.registry import all_methods

    method = all_methods().get(word)
    named = word in ALIASES or (method is not None and not method.given_as)  # given: read from that folder
    if option.name == "mask" and not named and (folder / word).is_dir():
        return [str(moved(Path(word)))]
    names = split_methods(word, folder) if option.multiple else [word]
    return [replace_reference_files(name, moved) for name in names]


def is_plan(effects: str) -> bool:
    """Whether a value of --effects is the file of a plan, not names of effects."""
    return bool(Path(effects).suffix) or len(Path(effects).parts) > 1


def _options_of_run(path: Path, run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that make the run of a config.yaml again.

    Raises:
        AwError: it is damaged.
    """
    from ambiguous_wild.harness.cell import changed_settings
    from ambiguous_wild.methods.graft import graft_pairs, split_graft
    from ambiguous_wild.methods.registry import get_method
    from ambiguous_wild.splat.train_config import TrainConfig

    try:
        method, train, scene = str(run["method"]), dict(run["train"]), dict(run["scene"])
        try:
            host, _ = split_graft(method)
            graft_pairs(method)
        except AwError:  # a variant of 'aw ablate': its method, with other settings
            method = host = method.partition("@")[0]
        if run["source"]:  # it is found, and its defaults are known, when the command line has been read
            owners = {"host": host, **dict(graft_pairs(method))}
            pairs = flatten(run["options"]).items()
            split = [(key.partition("."), value) for key, value in pairs]
            settings = [
                f"{owners[slot]}.{rest}={option_text(value)}"
                if host != method
                else f"{method}.{slot}{dot}{rest}={option_text(value)}"
                for (slot, dot, rest), value in split
            ]
        else:
            settings = changed_settings(get_method(method), method, run["options"])
        usual = TrainConfig()
        settings += [
            f"train.{key}={option_text(train[key])}"
            for key in ("probes", "checkpoint_every_s", "on_nonfinite")
            if train.get(key, getattr(usual, key)) != getattr(usual, key)
        ]
        flag, length = length_options(train["iterations"], train["budget_s"])
        files = {key: run[key]["path"] for key in ("start", "corrections") if key in run}
        return {
            "method": method,
            "scene": scene["path"],
            "seed": train["seed"],
            flag.lstrip("-"): length,
            "resolution": train["resolution"],
            "max-gaussians": train["max_gaussians"],
            "factor": scene["factor"],
            "effects": ",".join(run.get("effects", ())) or "none",
            "protocol": run.get("protocol", "full"),
            "device": str(run["device"]).partition(":")[0],
            "set": settings,
            **files,
        }
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise AwError(f"{path} is a damaged config.yaml of a run: {error!r:.80}") from None


def write_study(ctx: click.Context, values: Values, folder: Path) -> Path | None:
    """Write the options of a command into the folder of its runs, as study.yaml, and return the path.

    A study that lies there grows by the command's methods, scenes or seeds if all else is equal. Otherwise the
    command gets a file of its own, study-2.yaml and so on. A file of another kind, or one that a person has
    written or commented, stays as it is. None: a file there holds these options already.

    Args:
        ctx: of the command.
        values: its parameters.
        folder: folder of its runs.
    """
    new: Values = _plain(ctx, values, folder)
    with patient_lock(folder / NAME, "aw bench", LOCKED_S):
        for number in count(1):
            path = folder / (f"{NAME}.yaml" if number == 1 else f"{NAME}-{number}.yaml")
            if os.path.lexists(path):
                try:
                    text = plain_yaml.read_text(path)
                    there = _texts(ctx, plain_yaml.parse(text.removeprefix(HEADER)) or {}, path)
                    old = _plain(ctx, _converted(ctx, there), folder)
                except (AwError, AttributeError):  # not ours
                    continue
                joined = _joined(old, new)
                if joined == old:
                    return None
                if joined is None or text != _written(old):
                    continue
                new = joined
            write_text(path, _written(new))
            return path
    raise AssertionError  # count() does not end


def typed_in(ctx: click.Context, name: str) -> bool:
    """Whether the parameter stands on the command line; it is not a study's, nor a default."""
    return ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE


class Recorded(ProgressBar):
    """A bar for each run; writes the options of the command beside its runs, when the first one begins."""

    def __init__(
        self, ctx: click.Context, values: Mapping[str, Any], study: StudyFile | None, output: Path
    ) -> None:
        super().__init__()
        self.ctx, self.values, self.study, self.output = ctx, values, study, output
        self.written = False

    def planned(self, cells: Sequence[Cell], one_by_one: bool) -> None:
        super().planned(cells, one_by_one)
        if self.study is not None:
            self.study.report_changes(cells)
            if not self.study.run and not any(typed_in(self.ctx, name) for name in decisive(self.ctx)):
                self.study.report_others(cells, self.output)

    def started(self, cell: Cell, folder: Path) -> None:
        self.record()
        super().started(cell, folder)

    def ended(self, cell: Cell, report: CellReport) -> None:
        self.record()  # with Ray nothing tells that a run begins
        super().ended(cell, report)

    def record(self) -> None:
        """Write the study, once."""
        if not self.written:
            self.written = True
            if path := write_study(self.ctx, self.values, self.output):
                longer = " --overwrite longer" if self.values["overwrite"] == "longer" else ""
                say(f"wrote {path}: 'aw bench {shlex.quote(str(path))}{longer}' makes these runs again")


def _converted(ctx: click.Context, texts: Mapping[str, Any]) -> Values:
    """Return the values of a file as the command gets them."""
    options = {str(option.name): option for option in _options(ctx).values()}
    given = {"seeds": options["seeds"].default} | dict(texts)
    return {name: options[name].type_cast_value(ctx, value) for name, value in given.items()}


def _plain(ctx: click.Context, values: Values, folder: Path) -> dict[str, Any]:
    """Return the options that decide which runs are made, as a study in `folder` holds them."""
    data: dict[str, Any] = {"output": "."}
    for key, option in _options(ctx).items():
        value = values.get(str(option.name))
        empty = value is None or value == () or (value == option.default and key not in AXES)
        if key in NOT_READ | NOT_WRITTEN or empty:
            continue
        if key == "set":
            pairs = (setting.partition("=") for setting in value or ())
            data[key] = {name: _value(text) for name, _, text in pairs if not name.startswith("engine.")}
            continue
        words = [str(one) for one in (value if isinstance(value, Sequence) and option.multiple else [value])]
        moved = [found for word in words for found in _seen(option, word, Path.cwd(), folder.resolve())]
        listed = [int(word) if isinstance(option.type, click.IntRange) else word for word in moved]
        data[key] = list(dict.fromkeys(listed)) if option.multiple else listed[0]
    order = [*AXES, *data]
    return {key: data[key] for key in dict.fromkeys(order) if data.get(key) not in (None, {})}


def _value(text: str) -> Any:
    """Return a value of --set as YAML has it, if it is the same word again."""
    try:
        value = plain_yaml.parse(text)
    except AwError:
        return text
    return value if isinstance(value, int | float | bool) and option_text(value) == text else text


def _joined(old: Mapping[str, Any], new: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the study of both grids; None where they make no grid together."""

    def rest(data: Mapping[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in data.items() if key not in AXES}

    if rest(old) != rest(new) or not all(key in old and key in new for key in AXES):
        return old if old == new else None
    added = {key: [value for value in new[key] if value not in old[key]] for key in AXES}
    lacking = {key for key in AXES if not set(old[key]) <= set(new[key])}
    longer = [key for key in AXES if added[key]]
    # one axis grows by what the new study has along all others, or the new one has all of the old
    if lacking and (len(longer) > 1 or (longer and lacking - {longer[0]})):
        return None
    return {**old, **{key: [*old[key], *added[key]] for key in AXES}}


def _written(data: Mapping[str, Any]) -> str:
    return HEADER + yaml.safe_dump(
        dict(data), sort_keys=False, allow_unicode=True, default_flow_style=None, width=100
    )
