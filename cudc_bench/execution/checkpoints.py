"""Checkpoints of long runs: whole or absent, and only ever of the very run that asks for them.

A folder holds the checkpoints of one run and, in ``run.json``, what determines its result: one with other settings or other data is
refused. Checkpoints hold tensors, numbers, strings and containers of these, and are read as such: nothing in a file can run code.
"""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import shutil
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cudc_bench.errors import UnusableError, UsageError
from cudc_bench.execution import CHECKPOINT_EVERY
from cudc_bench.execution.interrupted import RUN, checkpoint_files, run_there
from cudc_bench.execution.progress import warn
from cudc_bench.files import unwritable, write_atomically

KEPT = 2
_SHARE = 0.02  # of a run's time that checkpoints may cost
_NAMED = 4  # differences that a refusal names


class Checkpoints:
    """The checkpoints of one run.

    Args:
        folder: of this run alone; made when the first is written.
        run: what determines the run's result, JSON-ready.
        every: seconds between two checkpoints at least; more where one takes so long that it would cost more than a fiftieth of the time,
            unless this is 0.
    """

    def __init__(self, folder: Path, run: Mapping[str, Any], every: float = CHECKPOINT_EVERY) -> None:
        self.folder = folder
        self._run = json.loads(json.dumps(run))
        self._every = every
        self._started = self._last = time.monotonic()
        self._earlier = self._cost = 0.0

    @property
    def seconds(self) -> float:
        """Of work so far, that of earlier processes included as far as it was kept."""
        return self._earlier + time.monotonic() - self._started

    def check(self, what: str, command: str) -> bool:
        """Whether there is something of this run to continue.

        Args:
            what: the run makes, for the message.
            command: which makes it.

        Raises:
            UsageError: what is there is of a run with other settings; the message names the differences.
        """
        if not checkpoint_files(self.folder):
            return False
        there = run_there(self.folder)
        if there is None:
            return False
        if found := _differences(there, self._run):
            more = f", and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
            raise UsageError(
                f"an interrupted run of {what} had other settings: {'; '.join(found[:_NAMED])}{more}. Use those to continue it, or"
                f" cudc-bench {command} --fresh to start over."
            )
        return True

    def due(self) -> bool:
        """Whether it is time for another one."""
        return time.monotonic() - self._last >= (max(self._every, self._cost / _SHARE) if self._every else 0.0)

    def save(self, step: int, state: Mapping[str, Any]) -> None:
        """Write the state after so many steps, and drop all but the last two.

        Raises:
            RunError: it cannot be written.
        """
        started = time.monotonic()
        content = io.BytesIO()
        torch.save({"run": self._run, "step": step, "seconds": self.seconds, "threads": torch.get_num_threads(), "state": state}, content)
        try:
            if run_there(self.folder) != self._run:
                write_atomically(self.folder / RUN, json.dumps(self._run, indent=1))
            write_atomically(self.folder / f"{step:012d}.pt", content.getvalue())
            # Those of later steps are none of this run's, or damaged: it would have continued from there.
            written = [path for path in checkpoint_files(self.folder) if path.stem <= f"{step:012d}"]
            for old in set(checkpoint_files(self.folder)) - set(written[:KEPT]):
                old.unlink(missing_ok=True)
        except OSError as error:
            raise unwritable(f"a checkpoint into {self.folder}", error) from None
        self._last = time.monotonic()
        self._cost = self._last - started

    def load(self, restore: Callable[[int, dict[str, Any]], None], device: torch.device | str = "cpu") -> int:
        """Restore the newest whole checkpoint of this run.

        The process then computes with as many threads as that run, since results depend on it.

        Args:
            restore: takes the step and the state; raises :class:`UnusableError` before it has changed anything, if they will not do.
            device: where tensors go.

        Returns:
            The step; 0 if there is none and the run starts from its beginning.
        """
        for found in self._whole(device):
            try:
                restore(found["step"], found["state"])
            except UnusableError:
                continue
            self._earlier = float(found["seconds"])
            torch.set_num_threads(found["threads"])
            return int(found["step"])
        if checkpoint_files(self.folder):
            warn(f"no checkpoint in {self.folder} can be used any more: the run starts over")
        return 0

    def _whole(self, device: torch.device | str) -> Iterator[dict[str, Any]]:
        for path in checkpoint_files(self.folder):
            try:
                with zipfile.ZipFile(path) as archive:
                    if archive.testzip() is not None:  # PyTorch itself does not look at the checksums
                        continue
                found = torch.load(path, map_location=device, weights_only=True)
                if found["run"] == self._run and {"step", "seconds", "threads", "state"} <= set(found):
                    yield found
            except (
                OSError,
                EOFError,
                KeyError,
                TypeError,
                ValueError,
                RuntimeError,
                zlib.error,
                zipfile.BadZipFile,
                pickle.UnpicklingError,
            ):
                continue  # cut short or overwritten: the one before it is whole

    def remove(self) -> None:
        """Drop them all, when the run's result is written."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _differences(there: Mapping[str, Any], here: Mapping[str, Any], above: str = "") -> list[str]:
    """Where two runs differ, as ``"hyperparameters.width 128, not 256"``."""
    found = []
    for name in sorted({*there, *here}):
        old, new = there.get(name), here.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            found += _differences(old, new, f"{above}{name}.")
        elif old != new:
            found.append(f"{above}{name} {json.dumps(old)}, not {json.dumps(new)}")
    return found


def digest(state: Any) -> str:
    """SHA-256 over a state: its numbers, strings, names and structure, wherever its tensors live.

    Two runs that end with the same digest have learnt the same, to the last bit.
    """
    total = hashlib.sha256()
    _feed(state, total.update)
    return total.hexdigest()


def _feed(value: Any, update: Callable[[bytes], None]) -> None:
    if isinstance(value, torch.Tensor):
        array = np.ascontiguousarray(value.detach().cpu().numpy())
        update(f"{array.dtype.str}{array.shape}".encode())
        update(array.tobytes())
    elif isinstance(value, Mapping):
        update(f"{{{len(value)}".encode())
        for name in sorted(value, key=str):
            update(f"{name}:".encode())
            _feed(value[name], update)
    elif isinstance(value, list | tuple):
        update(f"[{len(value)}".encode())
        for one in value:
            _feed(one, update)
    else:
        update(f"{value!r};".encode())
