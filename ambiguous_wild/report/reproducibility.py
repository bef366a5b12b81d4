"""The statement on reproducibility of a paper: code, machine, data, seeds and commands of its runs.

Where runs differ in one of these, the statement says which have what. It names no path of this machine.
"""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import cast

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.errors import counted, shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.core.names import plain
from ambiguous_wild.harness.cell import code_hash, package_commit
from ambiguous_wild.harness.command_lines import length_text
from ambiguous_wild.harness.result_file import Environment, RunConfig, RunResult
from ambiguous_wild.harness.store import checked_result, config_section, effects_of, find_runs, read_config
from ambiguous_wild.report.board import hidden_in
from ambiguous_wild.report.board_reproduce import Scenes, command_words, preparation
from ambiguous_wild.report.plain_formats import WIDTH, markdown_text
from ambiguous_wild.report.typeset import latex_text

HASH = 12  # hex digits of a hash that are printed
LONGEST = 200  # characters of a name in a result, which may be a stranger's
AXES = ("--seed", "--method", "--scene")  # options that a command takes several times


@dataclass(frozen=True)
class Statement:
    """What a paper says of its runs."""

    sentences: tuple[str, ...]
    commands: tuple[str, ...]  # first those that make simulated scenes; in an empty folder, in this order


@dataclass(frozen=True)
class _Run:
    folder: Path
    result: RunResult
    config: RunConfig | None  # None: config.yaml is absent or damaged
    words: tuple[str, ...]  # of its command; empty without a config.yaml
    before: tuple[str, ...]  # commands that make its scene

    @property
    def environment(self) -> Environment:
        return self.result.get("environment") or {}


def statement(folders: Sequence[Path]) -> Statement:
    """Describe the finished runs below folders.

    Args:
        folders: outputs of `aw bench` or `aw ablate`, or folders of them.

    Raises:
        AwError: no such folder, no finished run in it, or a run and its copy.
    """
    runs, left_out, scenes = [], [], Scenes()
    for folder in find_runs(folders):
        try:
            result = checked_result(folder)
        except AwError:
            left_out.append(f"{folder.parent.name} on {folder.parent.parent.name}")
            continue
        if result["status"] == "ok":
            runs.append(_read(folder, result, scenes))
        else:
            left_out.append(f"{result['method']} on {result['scene']}, seed {result['seed']}")
    if not runs:
        raise AwError(
            f"no finished run below {', '.join(map(str, folders))}: 'aw bench --method NAME --scene SCENE -o "
            "RUNS' makes one"
        )
    for run, other in combinations(runs, 2):
        if run.result == other.result:
            raise AwError(f"{other.folder} is a copy of {run.folder}, which would count twice: leave it out")
    sentences = [*_grid(runs), *_code(runs), *_machine(runs), *_data(runs), _repeats(runs)]
    sentences += _later(runs)
    if left_out:
        named = shortlist(map(_short, left_out))
        sentences.append(f"{counted(len(left_out), 'run')} failed, did not end or changed since ({named}).")
    silent = [run for run in runs if not run.words]
    if silent:
        sentences.append(
            f"The command of {_which(silent, runs)} is not known: config.yaml is absent or damaged."
        )
    return Statement(tuple(sentences), tuple(_commands(runs)))


def _read(folder: Path, result: RunResult, scenes: Scenes) -> _Run:
    config = read_config(folder)
    given = cast(RunConfig, config)
    words: Sequence[str] = ()
    scene: Scene | None = None
    try:
        words = command_words(given, str(result.get("reproduce", "")))
        scene = scenes.find(folder, given)
    except AwError:  # the scene has changed since
        pass
    except (TypeError, ValueError, AttributeError, LookupError):
        config, words = {}, ()
    before = preparation(scene)
    if hidden_in(shlex.join([*words, *before])) is not None:  # readers paste it into a shell
        words = before = []
    return _Run(folder, result, given if config else None, tuple(words), tuple(before))


def _grid(runs: Sequence[_Run]) -> list[str]:
    methods = list(dict.fromkeys(run.result["method"] for run in runs))
    of = f"{counted(len(runs), 'run')} of {counted(len(methods), 'method')} ({_listed(methods)})"
    seeds = _differing(runs, lambda run: run.result["method"], lambda of: _listed(_seeds(of), "seed"))
    lengths = _said(runs, _length, "they trained for {}", "they trained for different lengths: {}")
    sentences = [f"The results are those of {of}, with {seeds}; {lengths}."]
    files: dict[str, None] = {}  # an ordered set: one name can have several hashes
    masks: dict[str, None] = {}
    for run in runs:
        if run.config and (source := str(run.config.get("source") or "")[:HASH]):
            if "--mask" in run.words:
                masks[f"{run.words[run.words.index('--mask') + 1]} {source}"] = None
            else:
                files[f"{run.result['method']} {source}"] = None
    if files:
        sentences.append(f"Methods in files of their own, with the SHA-256 of the file: {_listed(files)}.")
    if masks:
        sentences.append(f"Masks given as files, with the SHA-256 of all in a folder: {_listed(masks)}.")
    if corrected := [run for run in runs if run.config and run.config.get("corrections")]:
        sentences.append(f"Masks of {_which(corrected, runs)} were corrected by hand.")
    effects = _said(runs, lambda run: effects_of(run.result["facts"]), "{}", "{}")
    if effects != "none":
        sentences.append(f"Effects learnt beside the Gaussians: {effects}.")
    return sentences


def _seeds(runs: Iterable[_Run]) -> list[str]:
    return [str(seed) for seed in sorted({run.result["seed"] for run in runs})]


def _length(run: _Run) -> str:
    train = config_section(dict(run.config), "train") if run.config else {}
    length = run.result["facts"].get("length")
    return str(
        length or length_text(train.get("iterations"), train.get("budget_s")) or "an unrecorded length"
    )


def _code(runs: Sequence[_Run]) -> list[str]:
    code = _said(
        runs, _version, "The code was ambiguous_wild {}", "The code differs between runs: ambiguous_wild {}"
    )
    packages = _said(runs, _packages, "with {}", "with different packages: {}")
    return [f"{code}, {packages}."]


def _version(run: _Run) -> str:
    code = str(run.result.get("code_hash", ""))
    # a result of an earlier version names no commit; if its code is the present one, so is its commit
    of = run.environment.get("commit") or (package_commit() if code and code == code_hash() else "")
    parts = [f"commit {of}"] if of else []
    parts += [f"code {code[:HASH]}"] if code else []
    return run.result["version"] + (f" ({', '.join(parts)})" if parts else "")


def _packages(run: _Run) -> str:
    machine = run.environment
    parts = [f"Python {machine['python']}"] if "python" in machine else []
    parts += [f"{name} {version}" for name, version in machine.get("packages", {}).items() if version]
    return _listed(parts) or "unrecorded packages"


def _machine(runs: Sequence[_Run]) -> list[str]:
    return [_said(runs, _hardware, "All ran on {}", "They ran on different machines: {}") + "."]


def _hardware(run: _Run) -> str:
    machine, threads = run.environment, run.result["cost"].get("threads")
    name = " ".join(str(machine.get("gpu") or machine.get("cpu") or "an unrecorded machine").split())
    parts = [counted(threads, "thread")] if threads and not machine.get("gpu") else []
    parts += [str(machine["platform"])] if "platform" in machine else []
    return name + (f" ({', '.join(parts)})" if parts else "")


def _data(runs: Sequence[_Run]) -> list[str]:
    hashes = grouped(runs, lambda run: run.result["scene"])
    named = [
        f"{scene} {' and '.join(dict.fromkeys(run.result['scene_hash'][:HASH] for run in of))}"
        for scene, of in hashes.items()
    ]
    sentences = [f"Scenes, with the SHA-256 of photos, poses and split: {_listed(named)}."]
    if several := [s for s, of in hashes.items() if len({run.result["scene_hash"] for run in of}) > 1]:
        sentences.append(f"Runs are of different states of {_listed(several)} and cannot be compared.")
    return sentences


def _repeats(runs: Sequence[_Run]) -> str:
    exact = [run for run in runs if not _why_not(run)]
    if len(exact) == len(runs):
        return "The commands repeat bit for bit on a processor of this kind, for any number of threads."
    rest = [run for run in runs if _why_not(run)]
    because = " or ".join(dict.fromkeys(map(_why_not, rest)))
    if not exact:
        return f"The runs do not repeat bit for bit, as they {because}."
    return f"{_which(exact, runs)} repeat bit for bit; {_which(rest, runs)} do not, as they {because}."


def _why_not(run: _Run) -> str:
    """Return why a run does not repeat bit for bit, of "they ..."; empty if it does."""
    train = config_section(dict(run.config), "train") if run.config else {}
    if not train:
        return "have no record of their settings"
    if run.result["facts"].get("no_effects"):
        return "are of another program"
    if not str(run.result["cost"].get("device", "")).startswith("cpu"):
        return "were trained on a GPU"
    if train.get("budget_s") is not None:
        return "end by the clock"
    return "went on from shorter ones" if run.config and run.config.get("continued") else ""


def _later(runs: Sequence[_Run]) -> list[str]:
    added = {
        f"{', '.join(record['metrics'])} (version {record['version']}, code {record['code_hash'][:HASH]})"
        for run in runs
        for record in run.result.get("rescored", ())
    }
    return [f"Measured later, from the saved renders: {_listed(sorted(added))}."] if added else []


def _said(runs: Sequence[_Run], value: Callable[[_Run], str], same: str, different: str) -> str:
    """Return `same` with the value of all runs, or `different` with each value and the runs that have it."""
    values = grouped(runs, value)
    if len(values) == 1:
        return same.format(_short(next(iter(values))))
    return different.format(
        "; ".join(f"{_short(text)} for {_which(of, runs)}" for text, of in values.items())
    )


def _differing(
    runs: Sequence[_Run], part: Callable[[_Run], str], value: Callable[[Sequence[_Run]], str]
) -> str:
    """Return the value of all parts, or each value with the parts that have it."""
    values = grouped(grouped(runs, part).items(), lambda item: value(item[1]))
    if len(values) == 1:
        return next(iter(values))
    return "; ".join(f"{text} for {_listed(name for name, _ in of)}" for text, of in values.items())


def _which(some: Sequence[_Run], runs: Sequence[_Run]) -> str:
    """Return which of the runs these are: all of some methods, scenes or seeds; else how many."""
    others = [run for run in runs if not any(run is one for one in some)]
    for key, noun in (("method", ""), ("scene", "scene"), ("seed", "seed")):
        names = {run.result[key] for run in some}  # type: ignore[literal-required]
        if names.isdisjoint(run.result[key] for run in others):  # type: ignore[literal-required]
            return _listed(map(str, sorted(names)), noun)
    return f"{len(some)} of {counted(len(runs), 'run')}"


def _listed(names: Iterable[str], noun: str = "") -> str:
    """Return "seeds 0, 1 and 2"."""
    listed = [_short(name) for name in names]
    text = " and ".join([", ".join(listed[:-1]), listed[-1]] if len(listed) > 1 else listed)
    return f"{noun}{'s' if len(listed) > 1 else ''} {text}" if noun else text


def _short(text: str) -> str:
    text = plain(text)
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def _commands(runs: Sequence[_Run]) -> list[str]:
    """Return the commands that make the runs again; those of one grid are joined."""
    pairs = [[*zip(run.words[2::2], run.words[3::2])] for run in runs if run.words]
    commands = [{flag: tuple(v for f, v in words if f == flag) for flag, _ in words} for words in pairs]
    for axis in AXES:
        same = grouped(commands, lambda words: tuple((k, v) for k, v in words.items() if k != axis))  # noqa: B023
        commands = [
            of[0] | {axis: tuple(dict.fromkeys(value for words in of for value in words[axis]))}
            for of in same.values()
        ]
    before = dict.fromkeys(line for run in runs for line in run.before)
    benches = [
        shlex.join(
            ["aw", "bench", *(word for flag, values in words.items() for v in values for word in (flag, v))]
        )
        for words in commands
    ]
    return [*before, *benches]


def to_text(statement: Statement) -> str:
    """Return a paragraph, and the commands below it."""
    lines = [
        textwrap.fill(" ".join(statement.sentences), WIDTH, break_long_words=False, break_on_hyphens=False)
    ]
    lines += ["", *(f"    {line}" for line in statement.commands)] if statement.commands else []
    return "\n".join(lines) + "\n"


def to_markdown(statement: Statement) -> str:
    """Return a paragraph, and the commands in a block of code."""
    lines = [markdown_text(" ".join(statement.sentences))]
    lines += ["", "```bash", *statement.commands, "```"] if statement.commands else []
    return "\n".join(lines) + "\n"


def to_latex(statement: Statement) -> str:
    """Return a paragraph, and the commands in typewriter that breaks between words; needs no package."""
    lines = [latex_text(" ".join(statement.sentences))]
    if statement.commands:
        lines += ["", r"\begin{flushleft}\footnotesize\ttfamily"]
        # two hyphens, or a quotation mark, are other signs in the typewriter of some encodings
        commands = (
            latex_text(line).replace("--", "-{}-").replace("'", r"\textquotesingle{}")
            for line in statement.commands
        )
        lines += [r"\par ".join(f"{line}\n" for line in commands).rstrip("\n"), r"\end{flushleft}"]
    return "\n".join(lines) + "\n"
