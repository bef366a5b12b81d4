"""The back end that a method takes by itself: the first of a list that this machine can run."""

from __future__ import annotations

import importlib.util

from ambiguous_wild.vision.backends import CONV, DINO, SAM, parse
from ambiguous_wild.vision.weights import find, named

# Metadata of an option whose default depends on the machine: a command that repeats a run elsewhere names it.
BY_MACHINE = {"by_machine": True}


def first_here(*specs: str) -> str:
    """The first of these specs that can run here, the last without asking; nothing is loaded."""
    return next((spec for spec in specs[:-1] if _can_run(parse(spec).name)), specs[-1])


def _can_run(name: str) -> bool:
    """Whether the weights are here, and the package that runs them."""
    if name in CONV:
        return find(named(name))[0] is not None
    weights = (DINO | SAM).get(name)
    if weights is None:
        return True
    return find(named(weights))[0] is not None and importlib.util.find_spec("transformers") is not None
