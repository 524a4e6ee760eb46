"""Leaving a long run well: the first Ctrl-C, or a SIGTERM, asks it to save its state and go; the second ends it at once.

Loops ask :func:`requested` at each step, save what they have, and raise :class:`Interrupted`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_NOTICE = "\ncudc-bench: finishing this step{}; interrupt once more to stop at once.\n"
_SAME = 0.3  # seconds within which two signals are one request

_asked = 0  # the signal's number, 0 for none


class Interrupted(KeyboardInterrupt):
    """A run left early because somebody asked it to, and has kept what it had done.

    Args:
        where: it stopped, such as ``"cudc seed 1 at step 12,000 of 400,000"``.
        number: of the signal.
    """

    def __init__(self, where: str, number: int = signal.SIGINT) -> None:
        super().__init__(where, number)
        self.where = where
        self.exit_code = 128 + number

    @property
    def message(self) -> str:
        """For people, with what to do."""
        return f"interrupted: {self.where}; the same command continues from there."


def requested() -> bool:
    """Whether this process has been asked to leave."""
    return _asked != 0


def ask(number: int = signal.SIGINT) -> None:
    """Ask this process to leave, as a signal of that number does."""
    global _asked
    _asked = _asked or int(number)


def interrupted(where: str) -> Interrupted:
    """What a loop raises once it has saved its state; see :class:`Interrupted`."""
    return Interrupted(where, _asked or signal.SIGINT)


@contextmanager
def leave_well(pass_on: Callable[[], None] = lambda: None, saves: bool = True) -> Iterator[None]:
    """Within this context the first SIGINT or SIGTERM only asks; outside the main thread, nothing changes.

    Args:
        pass_on: called with the first signal, to ask processes that work for this one.
        saves: whether what is done by then is kept.
    """
    global _asked
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    first = 0.0

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal first
        if requested():
            # One request can come as two signals: some senders address the process, and then its group.
            if time.monotonic() - first > _SAME:
                raise KeyboardInterrupt
            return
        first = time.monotonic()
        ask(number)
        # Not through a stream: this may have come while its buffer was being written.
        os.write(sys.__stderr__.fileno() if sys.__stderr__ is not None else 2, _NOTICE.format(" and saving" if saves else "").encode())
        pass_on()

    before = [signal.signal(number, handle) for number in _SIGNALS]
    try:
        yield
    finally:
        for number, handler in zip(_SIGNALS, before, strict=True):
            signal.signal(number, handler)
        _asked = 0
