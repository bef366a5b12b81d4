"""Repair Numba's cache of compiled kernels on disk."""

from __future__ import annotations

from typing import Any


def rebuild_damaged_cache(dispatcher: Any) -> Any:
    """Decorator above ``numba.njit(cache=True)``: compile again where a file of the cache is damaged.

    A full disk or a power failure leaves such files, and Numba would fail on them every time.
    """
    cache: Any = getattr(dispatcher, "_cache", None)
    if not hasattr(cache, "load_overload") or not hasattr(cache, "flush"):
        return dispatcher  # it has no cache, or this is another version of Numba
    load = cache.load_overload

    def load_overload(*args: Any) -> Any:
        try:
            return load(*args)
        except Exception:  # pickle raises any exception on damaged data
            cache.flush()
            return None

    cache.load_overload = load_overload
    return dispatcher
