"""Names of files and folders on the command line."""

from __future__ import annotations

from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.main import cli
from ambiguous_wild.cli.options import PathName


def _paths(group: click.Command, ctx: click.Context) -> list[tuple[str, click.Parameter]]:
    found = [(group.name or "", p) for p in group.params if isinstance(p.type, click.Path)]
    if isinstance(group, click.Group):
        for name in group.list_commands(ctx):
            inner = group.get_command(ctx, name)
            assert inner is not None
            found += _paths(inner, ctx)
    return found


def test_every_command_refuses_an_empty_name() -> None:
    found = _paths(cli, click.Context(cli))
    assert len(found) > 30 and {p.type.__class__ for _, p in found} == {PathName}


@pytest.mark.parametrize("words", [["build-scene", "", "-o", "x"], ["plan", ""], ["bench", "-o", ""]])
def test_an_empty_word_is_not_the_present_folder(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(cli, words)
    assert result.exit_code == 2 and "the name is empty" in result.output
    assert not list(tmp_path.iterdir())
