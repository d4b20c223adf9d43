"""How every command ends: a sentence for what its user can mend, a traceback for what is a bug."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from lowlevel.runs.interrupts import on_signals
from robots.errors import PilotError


@contextmanager
def command_line(name: str, interrupted: str) -> Iterator[None]:
    """End the command called ``name`` with one line and a non-zero status on a :class:`PilotError` and on signals.

    ``interrupted`` is what Ctrl-C, SIGTERM or SIGHUP leaves, for the user to read.
    """
    try:
        with on_signals(_interrupt):
            yield
    except PilotError as error:
        sys.exit(f"{name}: {error}")
    except KeyboardInterrupt:
        print(f"{name}: {interrupted}", file=sys.stderr)
        sys.exit(130)


def _interrupt() -> None:
    raise KeyboardInterrupt
