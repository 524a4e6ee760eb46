"""The command line in the test's own process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer

from cudc_bench.cli import app
from cudc_bench.cli.app import main

from ..served import Finished


@pytest.fixture(scope="session")
def command_line() -> Callable[..., Any]:
    """The command line: to make it of its functions takes longer than most of what it is asked here, and what comes out is the same."""
    return typer.main.get_command(app.build_app())


@pytest.fixture
def here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], command_line: Callable[..., Any]
) -> Callable[[list[str]], Finished]:
    """Runs the command line in this process, which spares the seconds of loading PyTorch, in ``tmp_path`` at the smoke profile."""
    monkeypatch.setattr(app, "build_app", lambda: command_line)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDC_BENCH_PROFILE", "smoke")

    def run(arguments: list[str]) -> Finished:
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert isinstance(ended.value.code, int)
        return Finished(ended.value.code, *capfd.readouterr())

    return run
