"""NAME+2passes: a method that trains twice, the second time from the start with the final masks of the first.

T-3DGS and DualSplat do so. In the second pass the method has fixed masks instead of its mask policy; density
control, effects, fields and schedule stay. Losses of the mask policy belong to the first pass. Imports no
torch.
"""

from __future__ import annotations

import dataclasses

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.methods.entry import MethodEntry

SUFFIX = "+2passes"


def second_pass_name(name: str, passes: int) -> str:
    """Return the name of a method that trains this many times, once or twice.

    Raises:
        AwError: another number of passes.
    """
    if passes not in (1, 2):
        raise AwError(f"--passes {passes}: a method trains once or twice")
    return name if passes == 1 or name.endswith(SUFFIX) else name + SUFFIX


def trained_once(name: str) -> str:
    """Return the name without `SUFFIX`."""
    return name.removesuffix(SUFFIX)


def second_pass(entry: MethodEntry) -> MethodEntry:
    """Return the method that trains twice.

    Raises:
        AwError: an external program trains it.
    """
    if entry.program is not None:
        raise AwError(
            f"{entry.name} is trained by another program, which cannot be given masks: no --passes 2"
        )
    return dataclasses.replace(
        entry,
        name=entry.name + SUFFIX,
        summary=f"{entry.summary}; then again from the start with the final masks",
        base=entry.name,
        passes=2,
        given_as=entry.given_as and entry.given_as + SUFFIX,
        ablations=(),
    )
