"""Worlds of one seed and one detail are built once for all tests of a process: that is most of their work."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ambiguous_wild.simulate import capture_writer, world

_built: dict[str, world.World] = {}


@pytest.fixture(autouse=True)
def worlds_are_built_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Captures of module fixtures are made before this and so from a world of their own."""

    original = capture_writer.build_world

    def build_world(rng: np.random.Generator, *what: Any) -> world.World:
        bits: Any = rng.bit_generator
        key = repr((bits.state, bits.seed_seq.state, what, list(world.SHEETS)))
        if key not in _built:
            _built[key] = original(rng, *what)
        return _built[key]

    monkeypatch.setattr(capture_writer, "build_world", build_world)
