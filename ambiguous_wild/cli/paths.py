"""How commands read the name of a file or folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click


class PathName(click.Path):
    """A path; an empty word is an unset variable of a script, not the folder one stands in."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(path_type=Path, **kwargs)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("the name is empty; write . for the folder you are in", param, ctx)
        return super().convert(value, param, ctx)
