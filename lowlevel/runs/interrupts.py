"""Signals that ask a process to end: Ctrl-C, SIGTERM, and SIGHUP of a terminal that is closed."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@contextmanager
def on_signals(handle: Callable[[], None]) -> Iterator[None]:
    """Call ``handle`` on these signals inside the context; the handlers of before return after it.

    Only the main thread of a process receives signals: elsewhere, as in a notebook's worker thread, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def receive(number: int, frame: FrameType | None) -> None:
        handle()

    previous = {number: signal.signal(number, receive) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def stop_on_signals(request_stop: Callable[[], None]) -> Iterator[None]:
    """Call ``request_stop`` on signals inside the context, for loops that save their work first."""

    def handle() -> None:
        print("stopping at the next safe point", file=sys.stderr, flush=True)
        request_stop()

    with on_signals(handle):
        yield
