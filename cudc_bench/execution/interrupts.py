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
from contextlib import contextmanager, suppress
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_NOTICE = "\ncudc-bench: finishing this step{}; interrupt once more to stop at once.\n"
_SAME = 0.3  # seconds within which two signals are one request

_asked = 0  # the signal's number, 0 for none
_when = 0.0  # it was asked first
_inside = 0  # contexts, one within another: a request holds until the outermost ends
_for_good = False  # in a worker: whoever started it decides what a second request means


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
        if not self.where:
            return "interrupted before the next run began; the same command continues from there."
        return f"interrupted: {self.where}; the same command continues from there."


class Terminated(KeyboardInterrupt):
    """SIGTERM came where nothing is kept by leaving later; whatever must be put away is put away on the way out."""

    exit_code = 128 + signal.SIGTERM
    message = "interrupted."


def requested() -> bool:
    """Whether this process has been asked to leave."""
    return _asked != 0


def request_stop(number: int = signal.SIGINT) -> None:
    """Ask this process to leave, as a signal of that number does."""
    global _asked, _when
    if not _asked:
        _asked, _when = int(number), time.monotonic()


def on_sigterm() -> None:
    """In a worker process: SIGTERM asks from now on, and what was asked is never forgotten."""
    global _for_good
    _for_good = True
    signal.signal(signal.SIGTERM, lambda number, _: request_stop(number))


def interrupted(where: str) -> Interrupted:
    """What a loop raises once it has saved its state; see :class:`Interrupted`."""
    return Interrupted(where, _asked or signal.SIGINT)


@contextmanager
def tidying_up() -> Iterator[None]:
    """Within this context a SIGTERM that nobody else waits for raises :class:`Terminated`, where it would end the process with all that it
    left on the disk; outside the main thread, and where whoever started the process ignores the signal, nothing changes."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return

    def handle(number: int, _: FrameType | None) -> None:
        raise Terminated

    signal.signal(signal.SIGTERM, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def leaving_gracefully(pass_on: Callable[[], None] = lambda: None, saves: bool = True) -> Iterator[None]:
    """Within this context the first SIGINT or SIGTERM only asks; outside the main thread and in workers, nothing changes.

    Work in several stages, each with such a context, needs one around all: a request may come when a stage has looked for the last time.

    Args:
        pass_on: called with the first signal, to ask processes that work for this one.
        saves: whether what is done by then is kept.
    """
    global _asked, _inside
    if _for_good or threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, _: FrameType | None) -> None:
        if requested():
            # One request can come as two signals: some senders address the process, and then its group.
            if time.monotonic() - _when > _SAME:
                raise KeyboardInterrupt
            return
        request_stop(number)
        pass_on()
        # Whoever reads may have left by the same signal (a pipe to tee). Not through a stream: its buffer may be half written.
        with suppress(OSError, ValueError):
            os.write(sys.__stderr__.fileno() if sys.__stderr__ is not None else 2, _NOTICE.format(" and saving" if saves else "").encode())

    _inside += 1
    before = [signal.signal(number, handle) for number in _SIGNALS]
    try:
        yield
    finally:
        for number, handler in zip(_SIGNALS, before, strict=True):
            signal.signal(number, handler)
        _inside -= 1
        if not _inside:
            _asked = 0
