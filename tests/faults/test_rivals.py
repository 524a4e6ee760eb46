"""Of two that want the same thing one works; the other says who does, or keeps what is there."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from cudc_bench.cli import app as command_line
from tests import ROOT

from ..served import briefly
from ..waiting import PATIENCE
from .helpers import COLLECT, EVALUATE, HDF5


def test_of_two_that_start_at_the_same_moment_one_works_and_the_other_names_it(tmp_path: Path) -> None:
    races = {"collect": 8, "relabel": 4, "evaluate": 2}
    command = [sys.executable, "-m", "tests.faults.racing", *(str(word) for pair in races.items() for word in pair)]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"TMPDIR": str(tmp_path)}, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    for line, times in zip(done.stdout.splitlines(), races.values(), strict=True):
        found = json.loads(line)
        assert sum(found.values()) == times
        # In every second race they meet, however fast the machine is.
        assert found["refused"] >= times // 2


def a_dead_process() -> int:
    child = os.fork()
    if not child:
        os._exit(0)
    os.waitpid(child, 0)
    return child


@pytest.fixture
def three(smoke: Path) -> list[tuple[tuple[str, ...], Path, Path]]:
    """Commands, the lock of each, and the file by which what it makes is known."""
    shutil.rmtree(smoke / "walker/run")
    record = "smoke/walker/walk/cudc-smoke-v0/td3-seed1"
    return [
        (COLLECT, smoke / "walker/.random-smoke-v0.lock", smoke / "walker/random-smoke-v0" / HDF5),
        (
            ("relabel", "walker/cudc-smoke-v0", "--task", "run"),
            smoke / "walker/run/.cudc-smoke-v0.lock",
            smoke / "walker/run/cudc-smoke-v0" / HDF5,
        ),
        (
            (*EVALUATE, "--dataset-id", "walker/walk/cudc-smoke-v0", "--output", "results"),
            Path(f"results/.checkpoints/{record}.lock"),
            Path(f"results/{record}.json"),
        ),
    ]  # fmt: skip


def test_the_lock_of_a_dead_process_is_taken_over(main: Callable, three: list) -> None:
    for command, lock, made in three:
        lock.parent.mkdir(parents=True, exist_ok=True)
        lock.write_text(f"{a_dead_process()} {platform.node()}")
        assert main(*command).code == 0
        assert made.exists()
        assert not lock.exists()


def test_who_comes_when_another_is_done_keeps_what_is_there(main: Callable, three: list, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also who looked when it was not there yet."""
    from cudc_bench.relabelers import api as relabelling
    from cudc_bench.runs import execution

    doors = [(execution, "run_jobs"), (relabelling, "echo"), (execution, "run_jobs")]  # behind the first look
    for (command, lock, made), (module, door) in zip(three, doors, strict=True):
        real, before = getattr(module, door), []

        def first(
            *arguments: Any, real: Any = real, before: list = before, here: Any = (module, door, command, made), **options: Any
        ) -> Any:
            module, door, command, made = here
            monkeypatch.setattr(module, door, real)
            with pytest.raises(SystemExit) as ended:
                command_line.main(list(command))
            assert not ended.value.code
            before.append((made.stat().st_ino, made.stat().st_mtime_ns))
            return real(*arguments, **options)

        monkeypatch.setattr(module, door, first)
        for _ in range(2):  # while the other works, and after
            with briefly() if command[0] == "evaluate" else nullcontext():
                assert main(*command).code == 0
            assert before == [(made.stat().st_ino, made.stat().st_mtime_ns)]
        assert not lock.exists()
