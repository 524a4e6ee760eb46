"""The command line in the test's own process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cudc_bench.cli.app import main

from ..served import Finished


@pytest.fixture
def here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], ready_command_line: None
) -> Callable[[list[str]], Finished]:
    """Runs the command line in this process, which spares the seconds of loading PyTorch, in ``tmp_path`` at the smoke profile."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDC_BENCH_PROFILE", "smoke")

    def run(arguments: list[str]) -> Finished:
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert isinstance(ended.value.code, int)
        return Finished(ended.value.code, *capfd.readouterr())

    return run
