"""The type of file and folder arguments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click


class PathName(click.Path):
    """A path; an empty name is an error (an unset variable in a script), not the current folder."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(path_type=Path, **kwargs)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("the name is empty; write . for the current folder", param, ctx)
        return super().convert(value, param, ctx)
