"""Where numbers of a run go while it runs, beside this project's own files: TensorBoard or Weights & Biases.

Both are extras, and each is imported only when a run asks for it.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cudc_bench.artefacts.ids import domain_slug
from cudc_bench.errors import RunError, UsageError, unknown
from cudc_bench.execution import LOG_DIR
from cudc_bench.files import check_folder

LOGS = ("tensorboard", "wandb")  # each is the name of its package and of the extra that installs it


@dataclass(frozen=True)
class LogTarget:
    """Where the numbers of one member's run go.

    Attributes:
        kind: one of :data:`LOGS`.
        folder: the log folder of all runs.
        stage: ``"collect"``, ``"evaluate"`` or ``"reference"``.
        profile, domain: of the run.
        place: the run's own folder below ``<folder>/<stage>/<profile>/``; no two runs share it.
        name: of the run among those of its stage, profile and domain, such as ``"cudc-seed1"``.
        values: its hyperparameters.
    """

    kind: str
    folder: Path
    stage: str
    profile: str
    domain: str
    place: str
    name: str
    values: Mapping[str, Any] = field(hash=False)

    @property
    def path(self) -> Path:
        """The run's own folder."""
        return self.folder / self.stage / self.profile / self.place


class RunLog(ABC):
    """Takes the numbers of one member's run."""

    @abstractmethod
    def add(self, step: int, row: Mapping[str, float]) -> None:
        """Log some numbers by name.

        Args:
            step: environment steps in collection, gradient steps in training; not below that of the row before.
            row: the numbers, in any units.
        """


class _Nowhere(RunLog):
    def add(self, step: int, row: Mapping[str, float]) -> None:
        pass


class _TensorBoard(RunLog):
    def __init__(self, writer: Any) -> None:
        self._writer = writer

    def add(self, step: int, row: Mapping[str, float]) -> None:
        for name, value in row.items():
            self._writer.add_scalar(name, value, step)


class _WeightsAndBiases(RunLog):
    def __init__(self, run: Any) -> None:
        self._run = run

    def add(self, step: int, row: Mapping[str, float]) -> None:
        self._run.log(dict(row), step=step)


def check_log(log: str | None, folder: str | Path) -> Path:
    """Refuse a log that cannot be kept before any work starts.

    Args:
        log: one of :data:`LOGS`, or None for none.
        folder: where it goes.

    Returns:
        The folder.

    Raises:
        UsageError: there is no such log, its package is not installed, or the folder cannot be written.
    """
    if log is None:
        # Nothing will be written; but a folder that somebody named should be one.
        return Path(folder) if str(folder) == LOG_DIR else check_folder(folder, "the log folder", writable=False)
    if log not in LOGS:
        raise unknown("log", log, LOGS)
    if find_spec(log) is None:
        raise UsageError(f"--log {log} needs a package that is not installed; pip install 'cudc-bench[{log}]', or leave out --log.")
    return check_folder(folder, "the log folder")


@contextmanager
def open_log(target: LogTarget | None) -> Iterator[RunLog]:
    """Log a run for the time of this context; without a target, nowhere.

    A run that is made again takes the place of the earlier one in TensorBoard; at Weights & Biases it is a further run of the same name.
    Nothing waits for a network: Weights & Biases writes below the log folder (``wandb sync`` uploads it), unless ``WANDB_MODE`` says
    otherwise.

    Raises:
        RunError: Weights & Biases was told to go online, and cannot.
    """
    if target is None:
        yield _Nowhere()
    elif target.kind == "tensorboard":
        from torch.utils.tensorboard import SummaryWriter

        # From step 0 on, what an earlier run left in this folder is void.
        with SummaryWriter(str(target.path), purge_step=0) as writer:
            yield _TensorBoard(writer)
    else:
        import wandb

        target.folder.mkdir(parents=True, exist_ok=True)
        try:
            run = wandb.init(
                project=f"cudc-bench-{domain_slug(target.domain)}", name=target.name, group=target.profile, job_type=target.stage,
                config=dict(target.values), dir=str(target.folder), mode=os.environ.get("WANDB_MODE") or "offline",
                # Several members of one process log side by side, and the terminal belongs to the progress bars.
                reinit="create_new", settings=wandb.Settings(console="off", silent=True),
            )  # fmt: skip
        except wandb.Error as error:
            raise RunError(f"Weights & Biases did not start ({' '.join(str(error).split())}); set WANDB_MODE=offline.") from None
        # Not as a context of its own, which would print a traceback where one line ends a run that fails.
        try:
            yield _WeightsAndBiases(run)
        except BaseException:
            run.finish(exit_code=1)
            raise
        run.finish()
