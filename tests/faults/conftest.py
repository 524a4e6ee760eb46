"""The command line within this process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from cudc_bench.cli import app as command_line

from .smalldisk import Ended


@pytest.fixture
def main(
    datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], ready_command_line: None
) -> Callable[..., Ended]:
    """``cudc-bench`` within this process, in ``tmp_path``."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDC_BENCH_PROFILE", "smoke")
    threads = torch.get_num_threads()

    def run(*command: str) -> Ended:
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            command_line.main([str(one) for one in command])
        torch.set_num_threads(threads)
        out, err = capfd.readouterr()
        return Ended(int(ended.value.code or 0), out, err)

    return run
