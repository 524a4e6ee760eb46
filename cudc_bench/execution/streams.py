"""Standard streams that work whatever this process was started with."""

from __future__ import annotations

import os
import sys

_NAMES = ("stdin", "stdout", "stderr")


def open_streams() -> None:
    """Replace standard streams that are closed by ones that lead nowhere, and print what the terminal's encoding lacks by its number.

    The next file that is opened would have a closed stream's number, and whatever a library prints would end up in it.
    """
    for number, name in enumerate(_NAMES):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened == number:
                os.set_inheritable(number, True)  # processes that are started here have streams, too
            else:
                os.dup2(opened, number)
                os.close(opened)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8", closefd=False))
    # Where somebody has put another stream in its place, that is theirs to care for.
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")
