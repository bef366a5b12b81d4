"""Ctrl-C while a model trains: answered between two iterations, when the state is whole."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class Stopped(KeyboardInterrupt):
    """Ctrl-C during training; the checkpoint holds the run as it was after its last iteration."""


@contextmanager
def deferred() -> Iterator[Callable[[], bool]]:
    """Meanwhile Ctrl-C is only noted; yields whether it was. A second Ctrl-C interrupts at once.

    Nothing is changed outside of the main thread, or where somebody else answers the signal.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: False
        return
    noted = threading.Event()

    def note(number: int, frame: Any) -> None:
        noted.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    signal.signal(signal.SIGINT, note)
    try:
        yield noted.is_set
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
