"""Compiled kernels that Numba keeps on disk."""

from __future__ import annotations

from typing import Any


def forgiving(dispatcher: Any) -> Any:
    """Let a damaged file of the cache be made anew; Numba would fail on it for ever.

    A full disk or a lost power line leaves such files. A decorator, above ``numba.njit(cache=True)``.
    """
    cache: Any = getattr(dispatcher, "_cache", None)
    if not hasattr(cache, "load_overload") or not hasattr(cache, "flush"):
        return dispatcher  # compiled without a cache, or another Numba: as it comes
    load = cache.load_overload

    def load_overload(*args: Any) -> Any:
        try:
            return load(*args)
        except Exception:  # what pickle says of garbage is anything
            cache.flush()
            return None

    cache.load_overload = load_overload
    return dispatcher
