"""What one member has collected so far, on the disk: its episodes and its lines of diagnostics."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from cudc_bench.data.diagnostics import DIAGNOSTICS, to_line
from cudc_bench.data.writer import Episode, EpisodeShards
from cudc_bench.envs.simulator import Float32, Float64
from cudc_bench.errors import UnusableError
from cudc_bench.execution.runlog import RunLog
from cudc_bench.files import sync


class DatasetSink:
    """The sink of one member in a folder, which a later process can take up again.

    Args:
        folder: an existing one; what is in it from earlier counts only once :meth:`load_state_dict` asks for it.
        log: takes the numbers of each line of diagnostics, too; those of earlier lines when they are taken up again.

    Attributes:
        last: the last line of diagnostics.
    """

    def __init__(self, folder: Path, log: RunLog) -> None:
        self.last: dict[str, Any] = {}
        self._shards = EpisodeShards(folder / "shards")
        self._path = folder / DIAGNOSTICS
        self._log = log
        self._file: IO[bytes] | None = None

    def add_episode(self, seed: int, observations: Float32, actions: Float32, infos: dict[str, Float32 | Float64]) -> None:
        """See :class:`~cudc_bench.collectors.running.loop.Sink`."""
        self._shards.add(Episode(seed, observations, actions, infos))

    def add_diagnostics(self, row: dict[str, Any], steps_per_second: float) -> None:
        """See :class:`~cudc_bench.collectors.running.loop.Sink`.

        The speed goes to the log alone: the file is the same in every such run.
        """
        self.last = row
        self._diagnostics().write(to_line(row))
        self._tell(row | {"steps_per_second": steps_per_second})

    def episodes(self) -> Iterator[Episode]:
        """All so far, in order."""
        return iter(self._shards)

    def state_dict(self) -> dict[str, Any]:
        """What :meth:`load_state_dict` needs; everything so far is on the disk when this returns."""
        shards = self._shards.state_dict()
        file = self._diagnostics()
        file.flush()
        sync(self._path)
        return {"shards": shards, "bytes": file.tell(), "sum": zlib.crc32(self._path.read_bytes())}

    def check(self, state: dict[str, Any]) -> None:
        """Whether all is there that was there when ``state_dict`` was called.

        Raises:
            UnusableError: some of it is gone or damaged.
        """
        try:
            lines = self._path.read_bytes()[: state["bytes"]]
        except OSError:
            raise UnusableError from None
        if (len(lines), zlib.crc32(lines)) != (state["bytes"], state["sum"]):
            raise UnusableError
        self._shards.check(state["shards"])

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to what there was when ``state_dict`` was called, after :meth:`check`."""
        lines = self._path.read_bytes()[: state["bytes"]]
        self._shards.load_state_dict(state["shards"])
        self.close()
        self._file = self._path.open("r+b")
        self._file.truncate(state["bytes"])
        self._file.seek(state["bytes"])
        for line in lines.splitlines():
            self.last = json.loads(line)
            self._tell(self.last)

    def close(self) -> None:
        """Close the file of diagnostics."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _diagnostics(self) -> IO[bytes]:
        if self._file is None:
            self._file = self._path.open("wb")
        return self._file

    def _tell(self, row: dict[str, Any]) -> None:
        self._log.add(row["step"], {name: value for name, value in row.items() if name != "step"})
