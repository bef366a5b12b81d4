"""What a release says of itself agrees."""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import yaml

from ambiguous_wild import __version__
from ambiguous_wild.cli.main import cli

ROOT = Path(__file__).resolve().parents[2]


def test_version_licence_and_changes_agree() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert citation["version"] == __version__
    assert citation["license"] == project["license"]
    assert {"cff-version", "message", "title", "authors", "type"} <= citation.keys()
    versions = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert versions[0] == "Unreleased" and versions[1] == __version__


def test_every_dependency_has_a_tested_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pinned = {
        line.partition("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        if "==" in line
    }
    asked = [re.split(r"[<>=\[ ]", text)[0].lower().replace("_", "-") for text in project["dependencies"]]
    assert [name for name in asked if name not in pinned] == []


def commands_of(text: str) -> Iterator[str]:
    """Every `aw ...` of a page, from its blocks of code and from code between words."""
    blocks = re.findall(r"```\w*\n(.*?)```", text, re.S) + re.findall(r"(?:^    .*\n)+", text, re.M)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    for line in lines + re.findall(r"`(aw [^`]+)`", text.replace("\n", " ")):
        for part in re.split(r"&&|\||;", line.split(" #")[0]):
            if found := re.match(r"\s*(?:\$ |\S*/)?aw (.*)", part):
                yield found[1].replace("...", "")


def test_the_commands_and_options_of_every_page_exist() -> None:
    tried = 0
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        for text in commands_of(page.read_text(encoding="utf-8")):
            command: click.Command | None = cli
            words = shlex.split(text)
            while isinstance(command, click.Group) and words and not words[0].startswith("-"):
                command = command.get_command(click.Context(command), words.pop(0))
            assert command is not None, f"{page.name}: aw {text}"
            options = [
                p for p in command.get_params(click.Context(command)) if not getattr(p, "hidden", False)
            ]
            known = {name for option in options for name in (*option.opts, *option.secondary_opts)}
            asked = {word.split("=")[0] for word in words if re.match(r"--?[a-z]", word)}
            assert asked <= known, f"{page.name}: aw {text}"
            tried += 1
    assert tried > 150
