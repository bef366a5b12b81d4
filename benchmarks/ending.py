"""How a benchmark ends."""

from __future__ import annotations

import sys
from collections.abc import Callable

from ambiguous_wild.core import AwError


def exit_code(main: Callable[[], int | None]) -> int | None:
    """What `main` returns; 2 and one line on standard error where it raises AwError."""
    try:
        return main()
    except AwError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
