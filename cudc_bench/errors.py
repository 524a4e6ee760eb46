"""The two ways in which a command ends badly, each one line long.

``UsageError`` is the user's mistake, refused before any work starts (exit code 2); ``RunError`` is a failure during the work
(exit code 1). The command line prints their text and nothing else, unless it was asked for more; from Python they are ordinary exceptions.
"""

from __future__ import annotations

import difflib
import os
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

DEBUG = "CUDC_BENCH_DEBUG"  # the environment variable that asks for more than a line; processes that are started here hear of it, too


class CudcBenchError(Exception):
    """Base of the errors that carry a complete, one-line message for people."""

    exit_code = 1


class UsageError(CudcBenchError):
    """A value that was given is not allowed; the message names it, what is allowed, and what to do."""

    exit_code = 2


class RunError(CudcBenchError):
    """Work that had started could not be finished; what was complete before is kept."""


class HeldError(RunError):
    """Another process is at work on the same thing; later, it will not be."""


class BrokenDownError(RunError):
    """The work itself went wrong, not what is around it: continued from where it stood, it would go wrong again."""


class UnusableError(Exception):
    """A checkpoint is whole, but what it refers to is not; the one before it may do."""


def wants_traceback() -> bool:
    """Whether an error should show where it came from: ``CUDC_BENCH_DEBUG`` is neither empty nor 0."""
    return os.environ.get(DEBUG, "") not in {"", "0"}


def traceback_of(error: BaseException) -> str:
    """An error's traceback with all that led to it, that of an error included which the message for people hides (``from None``)."""
    seen = set[int]()
    one: BaseException | None = error
    while one is not None and id(one) not in seen:
        seen.add(id(one))
        one.__suppress_context__ = one.__cause__ is not None
        one = one.__cause__ or one.__context__
    return "".join(traceback.format_exception(error))


@contextmanager
def finishing() -> Iterator[None]:
    """Within this context a call of ``sys.exit`` is a failure: whose code it may be, an unfinished command may not look done.

    Raises:
        RunError: somebody called it; the message says where.
    """
    try:
        yield
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):
            raise  # how rich leaves when nobody reads any more
        frames = traceback.extract_tb(error.__traceback__)
        where = f"'{frames[-1].filename}' line {frames[-1].lineno}"
        raise RunError(
            f"{where} called for the end of the process (exit code {error.code!r}) before the work was done; take that out."
        ) from error


def nearest(value: str, allowed: Iterable[str]) -> str:
    """Return ``" Did you mean 'x'?"`` for the closest allowed value, or an empty string when nothing is close."""
    matches = difflib.get_close_matches(value, list(allowed), n=1, cutoff=0.5)
    return f" Did you mean '{matches[0]}'?" if matches else ""


def unknown(kind: str, value: str, allowed: Iterable[str]) -> UsageError:
    """The one refusal for a name that is not in a set of names.

    Args:
        kind: what the name stands for, such as ``"method"``.
        value: the name that was given.
        allowed: the names that exist.
    """
    names = sorted(allowed)
    listed = ", ".join(names) if names else "none installed"
    return UsageError(f"unknown {kind} '{value}'; allowed: {listed}.{nearest(value, names)}")
