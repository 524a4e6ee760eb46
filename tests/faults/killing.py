"""Kills real runs with SIGKILL at random moments, resumes them, and compares what comes out with an uninterrupted run, byte by byte.

``python -m tests.faults.killing collect 200`` does so 200 times; the test suite a few times, and for several commands in one process. A
moment is a point in time, or just before or after a call by which a run changes what is on the disk: each such call of an uninterrupted run
is as likely as any other of its function. Processes are forked from one that has imported everything, which saves seconds for each.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import minari

import cudc_bench
import cudc_bench.data.writer
from cudc_bench.cli import app as cli
from cudc_bench.data.reader import verify_fingerprint
from cudc_bench.leaderboard.output.incremental import LEDGER
from cudc_bench.suites import scheduler
from cudc_bench.suites.pool import job_worker

from ..served import briefly

COLLECT = ["collect", "--set", "steps=3300", "--set", "seed_steps=900", "--set", "update_every=30", "--checkpoint-every", "0"]
COMMANDS = {
    "collect": [*COLLECT, "--method", "cudc"],
    "collect with skills": [*COLLECT, "--method", "smm"],
    "pilot": [
        "pilot", "--method", "cudc-vary-icm", "--set", "steps=5500", "--set", "seed_steps=900", "--set", "update_every=30",
        "--checkpoint-every", "0",
    ],
    "relabel": ["relabel", "walker/cudc-smoke-v0"],
    "evaluate": [
        "evaluate", "--algo", "td3", "--dataset-id", "walker/walk/cudc-smoke-v0", "--set", "gradient_steps=16", "--set", "evaluate_every=8",
        "--set", "milestones=[8,16]", "--set", "evaluation_episodes=1", "--set", "final_episodes=1", "--checkpoint-every", "0",
    ],
    "reference": [
        "reference", "--domain", "jaco", "--task", "reach_top_left", "--seeds", "1-2", "--set", "steps=400", "--set", "seed_steps=200",
        "--set", "update_every=30", "--set", "evaluations=2", "--set", "evaluation_episodes=1", "--set", "final_episodes=1",
        "--checkpoint-every", "0",
    ],
    "suite": ["run", "suite.toml", "--checkpoint-every", "0"],
}  # fmt: skip
SUITE = """
methods = ["icm"]
domains = ["jaco"]
tasks = ["reach_top_left"]
algos = ["bc"]
seeds = 1
collect = { steps = 1500, seed_steps = 500, update_every = 30 }
evaluate = { gradient_steps = 40, evaluate_every = 40, milestones = [40], final_episodes = 1 }
"""
# The calls by which a run changes what is on the disk, by what they belong to.
CALLS = {
    "mkdir": (os, "mkdir"),
    "fsync": (os, "fsync"),
    "replace": (os, "replace"),
    "rename": (os, "rename"),
    "unlink": (os, "unlink"),
    "rmdir": (os, "rmdir"),
    "consolidation": (cudc_bench.data.writer, "write_contiguous"),
}
TIMED = {"seconds", "created"}  # all that may differ between two runs


class Killer:
    """Runs one command in folders of its own.

    Args:
        what: a key of COMMANDS.
        folder: an empty one to work in.
        needed: datasets that the command starts from.
        seed: of the moments.
    """

    def __init__(self, what: str, folder: Path, needed: Path, seed: int) -> None:
        self.command, self.folder, self.needed = [*COMMANDS[what], "--workers", "1", "--profile", "smoke"], folder, needed
        self.random = random.Random(seed)
        self.killed: Counter[str] = Counter()
        self.finished = self.resumed = 0
        self._start_over()
        started = time.monotonic()
        self.calls = self._count()
        self.seconds = time.monotonic() - started
        self.expected = self._outcome()
        self._start_over()

    def kill(self, moment: str) -> None:
        """Start or resume the run, and kill it at a moment: ``"time"``, or a key of CALLS."""
        if moment == "time":
            child = self._fork(lambda: None)
            time.sleep(self.random.uniform(0, self.seconds))
            os.kill(child, signal.SIGKILL)
        else:
            owner, name = CALLS[moment]
            number, before = self.random.randint(1, max(1, self.calls[moment])), self.random.random() < 0.5
            child = self._fork(lambda: _die_at(owner, name, number, before))
        _, status = os.waitpid(child, 0)
        self._went_on()
        # Whatever happened, nothing half-written can be seen.
        for one in minari.list_local_datasets():
            verify_fingerprint(one)
        if os.WIFSIGNALED(status) or self._lost_a_worker():
            self.killed[moment] += 1
            self.resumed += any(self.folder.rglob("*.pt"))
        else:  # it was faster
            assert os.waitstatus_to_exitcode(status) == 0, (self.folder / "said").read_text()
            self.check()

    def _went_on(self) -> None:
        """A run that starts over ends the same way; but what was killed has left something to go on from."""
        assert "starts over" not in (self.folder / "said").read_text()

    def _lost_a_worker(self) -> bool:
        """Whether a process of a suite's was killed, and not the one that was started: that one says so, and goes on with the rest."""
        return "its process died (SIGKILL" in (self.folder / "said").read_text()

    def check(self) -> None:
        """Let the run end, compare it with the uninterrupted one, and start a new one."""
        self._run()
        self._went_on()
        found = self._outcome()
        different = [name for name in {*found, *self.expected} if found.get(name) != self.expected.get(name)]
        assert not different, different
        self.finished += 1
        self._start_over()

    def _start_over(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self.needed, self.folder)
        (self.folder / "datasets").mkdir(exist_ok=True)
        os.environ["MINARI_DATASETS_PATH"] = str(self.folder / "datasets")
        os.environ["CUDC_BENCH_THRESHOLDS"] = str(self.folder / "thresholds.json")

    def _fork(self, prepare: Callable[[], None]) -> int:
        child = os.fork()
        if child:
            return child
        try:
            os.chdir(self.folder)
            with (self.folder / "said").open("w") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            prepare()
            cli.main(self.command)
        except SystemExit as ended:
            os._exit(int(ended.code or 0))
        except BaseException as error:
            print(repr(error), file=sys.stderr, flush=True)
        os._exit(99)

    def _run(self) -> None:
        _, status = os.waitpid(self._fork(lambda: None), 0)
        assert os.waitstatus_to_exitcode(status) == 0, (self.folder / "said").read_text()

    def _count(self) -> dict[str, int]:
        """How often an uninterrupted run makes each call; it leaves its result."""
        reader, writer = os.pipe()

        def prepare() -> None:
            counts = Counter[str]()
            for moment, (owner, name) in CALLS.items():
                setattr(owner, name, _counting(getattr(owner, name), moment, counts))
            leave = sys.exit

            def tell(code: Any = 0) -> None:
                os.write(writer, json.dumps(counts).encode())
                leave(code)

            cli.sys = type("sys", (), {"exit": staticmethod(tell), "stdout": sys.stdout, "stderr": sys.stderr})  # type: ignore[attr-defined]

        _, status = os.waitpid(self._fork(prepare), 0)
        assert os.waitstatus_to_exitcode(status) == 0, (self.folder / "said").read_text()
        os.close(writer)
        with os.fdopen(reader, "rb") as pipe:
            return Counter(json.loads(pipe.read()))

    def _outcome(self) -> dict[str, str]:
        """Every file below the folder, hidden ones included; of JSON and weights what does not tell the time."""
        found = {}
        for path in sorted(self.folder.rglob("*")):
            # Of what a suite keeps for itself, nothing goes into a result: logs, and who made a dataset.
            if path.is_dir() or path.name == "said" or ".suite" in path.parts:
                continue
            if path.suffix == ".html" or path.name == LEDGER:
                # Pages show when records were made; what they are made from is compared.
                content = b""
            elif path.suffix == ".json":
                content = json.dumps(_timeless(json.loads(path.read_text())), sort_keys=True).encode()
            elif path.name == "README.md":
                content = b"".join(line for line in path.read_bytes().splitlines(True) if b"seconds" not in line and b"20" not in line)
            else:
                content = path.read_bytes()
            found[str(path.relative_to(self.folder))] = hashlib.sha256(content).hexdigest()
        return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _timeless(one) for name, one in value.items() if name not in TIMED}
    return [_timeless(one) for one in value] if isinstance(value, list) else value


def _counting(real: Callable[..., Any], moment: str, counts: Counter[str]) -> Callable[..., Any]:
    def call(*arguments: Any, **options: Any) -> Any:
        counts[moment] += 1
        return real(*arguments, **options)

    return call


def _die_at(owner: Any, name: str, number: int, before: bool) -> None:
    real, calls = getattr(owner, name), 0

    def call(*arguments: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == number and before:
            os.kill(os.getpid(), signal.SIGKILL)
        try:
            return real(*arguments, **options)
        finally:  # also after one that is refused, as mkdir is where a folder exists
            if calls == number:
                os.kill(os.getpid(), signal.SIGKILL)

    setattr(owner, name, call)


@contextmanager
def prepared() -> Iterator[Path]:
    """A folder in which what every command needs was made, by a process that has then imported everything."""
    from .. import imported  # noqa: F401

    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        # What a process has imported once, those forked from it need not import again.
        os.environ["MINARI_DATASETS_PATH"] = str(base / "first")
        cudc_bench.relabel(*cudc_bench.collect("cudc", profile="smoke"), ["walk"])
        short = {"evaluate_every": 1, "evaluation_episodes": 1, "final_episodes": 1}
        cudc_bench.evaluate(tasks=["walk"], profile="smoke", steps=1, settings=short, output=base / "results")
        cudc_bench.make_leaderboard(base / "results", base / "report")
        yield base


def run(what: str, kills: int, base: Path, seed: int = 0) -> dict[str, Any]:
    """Kill a command so many times, and say where and how often it ended well.

    Args:
        what: a key of COMMANDS.
        kills: how many times.
        base: the folder of ``prepared``.
        seed: of the moments.

    Raises:
        AssertionError: something half-written was visible, a run could not be resumed, or its outcome differs.
    """
    needed = base / what / "needed"
    needed.mkdir(parents=True)
    if what == "suite":
        # Its workers, too, are forked from what has imported everything.
        scheduler.job_worker = partial(job_worker, context=multiprocessing.get_context("fork"))  # type: ignore[assignment]
        (needed / "suite.toml").write_text(SUITE)
    if what in ("relabel", "evaluate"):
        shutil.copytree(base / "first", needed / "datasets")
    if what == "relabel":
        shutil.rmtree(needed / "datasets" / "walker" / "walk")
    # What is trained is tried in short episodes: whoever kills it need not wait for long ones.
    with briefly({"evaluate": "walker", "reference": "jaco"}[what]) if what in ("evaluate", "reference") else nullcontext():
        return _kill(Killer(what, base / what / "work", needed, seed), kills)


def _kill(killer: Killer, kills: int) -> dict[str, Any]:
    moments = [moment for moment in CALLS if killer.calls[moment]]
    # Every kind of moment once, in an order that is drawn, then as it comes, half of them by time.
    every = [*moments, "time"]
    plan = killer.random.sample(every, len(every))
    plan += [killer.random.choice(["time", killer.random.choice(moments)]) for _ in range(kills)]
    for moment in plan[:kills]:
        before = killer.killed.total()
        while killer.killed.total() == before:
            killer.kill(moment)
    killer.check()
    return {"killed": dict(killer.killed), "with a checkpoint to resume from": killer.resumed, "ended well": killer.finished}


if __name__ == "__main__":
    words = sys.argv[1:]
    with prepared() as made:
        for command, times in zip(words[::2], words[1::2], strict=True):
            print(command, json.dumps(run(command, int(times), made)), sep="\t", flush=True)
