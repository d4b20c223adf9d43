"""Ctrl-C and SIGTERM as a request to stop, for loops that save their work first."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_signals(request_stop: Callable[[], None]) -> Iterator[None]:
    """Call ``request_stop`` on Ctrl-C and SIGTERM inside the context; the handlers of before return after it."""

    def handle(number: int, frame: FrameType | None) -> None:
        print("stopping at the next safe point", file=sys.stderr, flush=True)
        request_stop()

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
