"""Python runs this at the start of every process that has this folder in PYTHONPATH (see tests/waiting.py)."""

import os
import signal

from cudc_bench.execution.checkpoints import Checkpoints

_save = Checkpoints.save


def _save_and_stop(self, step, state):
    Checkpoints.save = _save
    _save(self, step, state)
    os.kill(os.getpid(), signal.SIGSTOP)


Checkpoints.save = _save_and_stop
