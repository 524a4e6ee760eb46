"""Waiting for other processes, whatever else the machine does.

No test may depend on how fast anything is. What waits, waits until the other has done it; only what hangs takes ``PATIENCE``. What has to
happen in the middle of a run happens while that run has stopped itself: see :data:`STOPS_ITSELF`.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

PATIENCE = 1800.0  # seconds
Found = TypeVar("Found")

# For a process's environment: it, and each of its workers, stops with SIGSTOP when it has kept its first checkpoint.
STOPS_ITSELF = {"PYTHONPATH": str(Path(__file__).with_name("stopping"))}


def wait_for(what: Callable[[], Found], process: subprocess.Popen[str] | None = None) -> Found:
    """Until something is true, and what it then is.

    Args:
        what: asked again and again.
        process: must be alive as long as it is not.
    """
    deadline = time.monotonic() + PATIENCE
    while not (found := what()):
        if process is not None and process.poll() is not None and not (found := what()):
            raise AssertionError(f"it ended before that: {process.communicate()}")
        if found:
            break
        assert time.monotonic() < deadline, "it never came"
        time.sleep(0.005)
    return found


def has_stopped(process: int) -> bool:
    """Whether a process lies still, by SIGSTOP."""
    return "State:\tT" in Path(f"/proc/{process}/status").read_text()
