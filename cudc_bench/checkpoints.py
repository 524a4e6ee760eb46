"""Checkpoints of long runs: whole or absent, and only ever of the very run that asks for them.

A run is named by what determines its result. Its checkpoints lie in a hidden folder of that name, so that a run with other settings or
other data never meets them. They hold tensors, numbers, strings and containers of these, and are read as such: nothing in a file
can run code.
"""

from __future__ import annotations

import io
import pickle
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from cudc_bench.config import config_hash
from cudc_bench.errors import RunError
from cudc_bench.files import write_atomically

KEPT = 2


class Checkpoints:
    """The checkpoints of one run.

    Args:
        folder: of all runs' checkpoints; made when the first is written.
        run: what determines the run's result, JSON-ready.
        every: seconds between two checkpoints.
    """

    def __init__(self, folder: Path, run: Mapping[str, Any], every: float = 60.0) -> None:
        self._run = dict(run)
        self.folder = folder / config_hash(self._run)
        self._every = every
        self._last = time.monotonic()

    def due(self) -> bool:
        """Whether it is time for another one."""
        return time.monotonic() - self._last >= self._every

    def save(self, step: int, state: Mapping[str, Any]) -> None:
        """Write the state after so many steps, and drop all but the last two.

        Raises:
            RunError: it cannot be written.
        """
        content = io.BytesIO()
        torch.save({"run": self._run, "step": step, "state": dict(state)}, content)
        try:
            write_atomically(self.folder / f"{step:012d}.pt", content.getvalue())
            for old in self._files()[KEPT:]:
                old.unlink(missing_ok=True)
        except OSError as error:
            raise RunError(f"cannot write a checkpoint into {self.folder}: {error.strerror}.") from None
        self._last = time.monotonic()

    def load(self, device: torch.device | str = "cpu") -> tuple[int, dict[str, Any]] | None:
        """The newest whole checkpoint of this run, as (step, state), or None."""
        for path in self._files():
            try:
                found = torch.load(path, map_location=device, weights_only=True)
                if found["run"] == self._run:
                    return int(found["step"]), found["state"]
            except (OSError, EOFError, KeyError, TypeError, ValueError, RuntimeError, pickle.UnpicklingError):
                continue  # cut short or overwritten: the one before it is whole
        return None

    def remove(self) -> None:
        """Drop them all, when the run's result is written."""
        shutil.rmtree(self.folder, ignore_errors=True)
        if self.folder.parent.is_dir() and not any(self.folder.parent.iterdir()):
            self.folder.parent.rmdir()

    def _files(self) -> list[Path]:
        """Newest first."""
        return sorted(self.folder.glob("*.pt"), reverse=True) if self.folder.is_dir() else []
