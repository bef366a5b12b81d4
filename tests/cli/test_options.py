"""One name per option over all commands."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import click
import pytest

from ambiguous_wild.cli.main import cli
from ambiguous_wild.cli.options import OPTION_SECTIONS, Count, PathName, SectionedCommand


def _walk(command: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    if not isinstance(command, click.Group):
        yield " ".join(words), command
        return
    ctx = click.Context(command)
    for name in command.list_commands(ctx):
        inner = command.get_command(ctx, name)
        assert inner is not None
        yield from _walk(inner, (*words, name))


COMMANDS = dict(_walk(cli))
OPTIONS = {
    name: {
        flag: p
        for p in command.params
        if isinstance(p, click.Option)
        for flag in [*p.opts, *p.secondary_opts]
    }
    for name, command in COMMANDS.items()
}


def _kind(option: click.Option) -> str:
    if isinstance(option.type, click.Path):
        return "path"
    return "flag" if option.is_flag else option.type.name.removesuffix(" range")


def test_an_option_of_one_name_has_one_kind_of_value() -> None:
    kinds: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for command, options in OPTIONS.items():
        for flag, option in options.items():
            kinds[flag][_kind(option)].add(command)
    differ = {flag: dict(found) for flag, found in kinds.items() if len(found) > 1}
    # --overwrite: a flag, or never | missing | always, see below; --path: a flag, or the path of a camera
    assert set(differ) == {"--overwrite", "--path"}, differ


def test_the_same_meaning_has_the_same_name() -> None:
    for command, options in OPTIONS.items():
        assert ("-o" in options) == ("--output" in options), command
        assert not {"--runs", "--force", "--replace", "--again"} & {*options}, command
        assert ("--jobs" in options) == ("--engine" in options), command  # runs at a time
        if "--threads" in options:
            assert "threads" in (options["--threads"].help or ""), command
        for flag, kind in {"--scene": "path", "--only": "text"}.items():
            assert flag not in options or _kind(options[flag]) == kind, (command, flag)
    described = {flag: o.help or "" for options in OPTIONS.values() for flag, o in options.items()}
    white = {flag for flag, text in described.items() if "white =" in text}
    assert white == {"--keep-masks", "--distractor-masks", "--objects", "--mask", "--for"}


def test_every_path_refuses_an_empty_name() -> None:
    paths = [
        p.type for command in COMMANDS.values() for p in command.params if isinstance(p.type, click.Path)
    ]
    assert len(paths) > 30 and all(isinstance(kind, PathName) for kind in paths)


@pytest.mark.parametrize("name", [name for name, options in OPTIONS.items() if "--overwrite" in options])
def test_overwrite_alone_replaces_what_is_there(name: str) -> None:
    option = OPTIONS[name]["--overwrite"]
    command = click.Command("any", params=[option])
    values = command.make_context("any", ["--overwrite"]).params
    assert values[option.name or ""] in (True, "always")


MANY = 15  # options, from which on help has headings


def test_commands_of_many_options_show_them_under_headings_the_most_used_first() -> None:
    for name, command in COMMANDS.items():
        options = [param for param in command.params if isinstance(param, click.Option)]
        assert isinstance(command, SectionedCommand) == (len(options) > MANY), name
    text = COMMANDS["bench"].get_help(click.Context(COMMANDS["bench"], info_name="bench"))
    headings = [line.removesuffix(":") for line in text.splitlines() if line.endswith(":") and line[0] != " "]
    assert headings == ["Most used", "Training", "Ray", "Other options"]
    first = [
        line.split()[0].strip(",") for line in text.split("Most used:")[1].splitlines() if line[:3] == "  -"
    ]
    assert first[:7] == ["-o", "--method", "--scene", "--budget", "--iterations", "--seed", "--effects"]
    assert all(flag in text for flag in OPTIONS["bench"])
    known = {flag for options in OPTIONS.values() for flag in options}
    assert {flag for flags in OPTION_SECTIONS.values() for flag in flags} <= known
    assert len({param for param in COMMANDS["bench"].params if isinstance(param, click.Option)}) <= 29


@pytest.mark.parametrize(("text", "number"), [("10k", 10_000), ("1.5k", 1500), ("700", 700)])
def test_a_number_may_be_written_in_thousands(text: str, number: int) -> None:
    assert Count(1).convert(text, None, None) == number


@pytest.mark.parametrize("group", ["leaderboard", "study", "weights"])
def test_help_of_a_group_cuts_no_sentence(group: str) -> None:
    command = cli.get_command(click.Context(cli), group)
    assert command is not None
    text = command.get_help(click.Context(command, info_name=group))
    commands = text[text.index("Commands:") :]
    assert "..." not in commands and commands.count("  ") >= 2
