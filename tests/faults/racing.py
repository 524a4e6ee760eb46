"""Starts one command twice at the same moment, many times over: one process does the work, and the other says who does.

``python -m tests.faults.racing collect 50`` does so 50 times; several commands may follow each other. Processes are forked from one that
has imported everything, and wait on a pipe for the start. How far they are apart is left to the machine, which may let one come when the
other is done; so in every second race the one that has taken the lock waits until the other has ended.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import IO

import cudc_bench
from cudc_bench.artefacts.records import read_record
from cudc_bench.cli import app as cli
from cudc_bench.data.reader import verify_fingerprint
from cudc_bench.execution import locks

from .smalldisk import Ended, forked

BASE = "walker/random-smoke-v0"
COMMANDS = {
    "collect": ["collect", "--method", "random", "--set", "steps=600"],
    "relabel": ["relabel", BASE, "--task", "walk"],
    "evaluate": [
        "evaluate", "--algo", "bc", "--dataset-id", "walker/run/random-smoke-v0", "--set", "gradient_steps=2", "--set", "evaluate_every=2",
        "--set", "milestones=[2]", "--set", "evaluation_episodes=1", "--set", "final_episodes=1", "--output", "results",
    ],
}  # fmt: skip


def race(what: str, folder: Path, meet: bool) -> str:
    """Start both, and say how it went: ``"refused"`` if one was, ``"kept"`` if it came when the other had done the work.

    Args:
        what: a key of COMMANDS.
        folder: to work in.
        meet: whether the one that is first waits for the other.

    Raises:
        AssertionError: both did the work, or neither, or something is left or half-written.
    """
    command = [*COMMANDS[what], "--workers", "1", "--profile", "smoke"]
    waiting, go = os.pipe()
    other, ended = os.pipe()  # of which each process holds the end that closes when it ends

    def start() -> None:
        os.close(go)
        print(os.getpid(), file=sys.stderr)
        os.read(waiting, 1)
        if meet:
            _hold_until(ended, other)
        cli.main(command)

    ends: list[Callable[[], Ended]] = [forked(start, folder / name) for name in ("first", "second")]
    for one in (go, waiting, other, ended):
        os.close(one)
    done = sorted(end() for end in ends)
    assert done[0].code == 0, done
    refusal = rf"cudc-bench: error: process {done[0].err.split()[0]} is writing '[^']+'; wait for it to end\."
    assert done[1].code == 0 or (done[1].code == 1 and re.fullmatch(refusal, done[1].line)), done
    assert "Traceback" not in done[0].err + done[1].err
    # The place, what it is made of, and nothing else.
    results, datasets = folder / "results", folder / "datasets"
    if what == "evaluate":
        (record,) = results.rglob("*.json")
        read_record(record)
        assert not (results / ".checkpoints").exists()
        shutil.rmtree(results)
    else:
        made = BASE if what == "collect" else "walker/walk/random-smoke-v0"
        verify_fingerprint(made)
        place = (datasets / made).parent
        assert [path.name for path in place.iterdir() if path.name.startswith(".")] == []
        shutil.rmtree(datasets / made)
    return "refused" if done[1].code else "kept"


def _hold_until(own: int, other: int) -> None:
    """Let this process, once it has a lock, wait until nobody else holds the end ``own`` of a pipe, and nothing comes from ``other``."""
    take = locks._take

    def take_and_wait(path: Path, what: str) -> IO[str]:
        file = take(path, what)
        locks._take = take
        os.close(own)
        os.read(other, 1)
        return file

    locks._take = take_and_wait


def run(what: str, times: int, made: Path) -> Counter[str]:
    """Race so many times in a folder of its own, and count how it went; ``made`` has the datasets that a command needs."""
    folder = made / what
    folder.mkdir()
    os.chdir(folder)
    os.environ["MINARI_DATASETS_PATH"] = str(folder / "datasets")
    if what != "collect":
        shutil.copytree(made / "datasets", folder / "datasets")
    return Counter(race(what, folder, meet=bool(number % 2)) for number in range(times))


if __name__ == "__main__":
    from .. import imported  # noqa: F401

    words = sys.argv[1:]
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        os.environ["MINARI_DATASETS_PATH"] = str(base / "datasets")
        # Whatever the commands need of it, and import.
        cudc_bench.relabel(*cudc_bench.collect("random", profile="smoke", settings={"steps": 2000}), ["run"])
        short = {"evaluate_every": 2, "evaluation_episodes": 1, "final_episodes": 1}
        there = "walker/run/random-smoke-v0"
        cudc_bench.evaluate("bc", dataset_id=there, profile="smoke", steps=2, settings=short, output=base / "results")
        for command, number in zip(words[::2], words[1::2], strict=True):
            print(json.dumps(run(command, int(number), base)), flush=True)
