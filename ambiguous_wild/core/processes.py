"""Python processes that a command starts."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

_CLONE = str(Path(__file__).parents[2])


def python_command(code: str, *words: str) -> list[str]:
    """Command that runs code which may import this package.

    -P: Python would import a `random.py` of the working directory, which may be a folder of photos. Without
    that folder a clone that is not installed would not be found either, so it is added as the last one.
    """
    return [sys.executable, "-P", "-c", f"import sys; sys.path.append({_CLONE!r})\n{code}", *words]


@contextmanager
def python_meanwhile(
    code: str, variables: Mapping[str, str] | None = None, finish: bool = False
) -> Iterator[None]:
    """Run code in another process without a word; its errors are ignored.

    Args:
        variables: added to its environment.
        finish: wait for its end where the block ends without an error; else it is killed.
    """
    quiet, env = subprocess.DEVNULL, {**os.environ, **(variables or {})}
    try:
        process = subprocess.Popen(python_command(code), stdin=quiet, stdout=quiet, stderr=quiet, env=env)
    except OSError:
        yield
        return
    try:
        yield
        if finish:
            process.wait()
    finally:
        process.kill()
        process.wait()
