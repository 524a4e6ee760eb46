"""A run that is killed at any moment goes on with the same command, and ends with the same bytes as one that was left alone."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import minari
import pytest

import cudc_bench
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.data.reader import verify_fingerprint
from tests import ROOT

from ..waiting import PATIENCE, STOPS_ITSELF, has_stopped, wait_for
from .killing import CALLS

RANDOM = [sys.executable, "-m", "cudc_bench.cli", "collect", "--method", "random", "--checkpoint-every", "0"]
COLLECT = [*RANDOM, "--set", "steps=8000"]
TWO = [*RANDOM, "--set", "steps=6000", "--seeds", "1-2", "--workers", "2"]

KILLS = {"collect": 12, "evaluate": 3, "relabel": 3, "pilot": 2, "reference": 4, "suite": 2}


@pytest.mark.longest
def test_killed_at_random_moments_a_run_ends_as_if_it_had_not_been(tmp_path: Path) -> None:
    """One process for all commands: to import everything, and to make what they start from, takes as long as many kills."""
    command = [sys.executable, "-m", "tests.faults.killing", *(str(word) for pair in KILLS.items() for word in pair)]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"TMPDIR": str(tmp_path)}, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    found = {what: json.loads(rest) for what, rest in (line.split("\t") for line in done.stdout.splitlines())}
    assert found.keys() == KILLS.keys()
    for what, one in found.items():
        assert sum(one["killed"].values()) == KILLS[what]
        assert one["ended well"] >= 1
        if what != "relabel":
            assert one["with a checkpoint to resume from"] > 0
    assert set(found["collect"]["killed"]) == {*CALLS, "time"}


def test_interrupted_a_run_says_where_it_stopped_and_goes_on_from_there(
    datasets: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    (undisturbed,) = cudc_bench.collect("random", profile="smoke", settings={"steps": 8_000}, dataset_id="walker/undisturbed-v0")
    stopped = 0
    for number in (signal.SIGINT, signal.SIGTERM):
        process = subprocess.Popen(COLLECT, env=environment | STOPS_ITSELF, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        with killed_in_the_end(process):
            wait_for(lambda one=process.pid: has_stopped(one), process)
            assert max(int(path.stem) for path in datasets.rglob("*.pt")) > stopped
            process.send_signal(number)
            process.send_signal(signal.SIGCONT)
            _, said = process.communicate(timeout=PATIENCE)
        assert process.returncode == 128 + number
        line = said.splitlines()[-1]
        assert re.fullmatch(
            r"cudc-bench: error: interrupted: random seed 1 at step [\d,]+ of 8,000; the same command continues from there\.", line
        )
        stopped = int(line.split("step ")[1].split(" of")[0].replace(",", ""))
        assert max(int(path.stem) for path in datasets.rglob("*.pt")) == stopped
        assert set(minari.list_local_datasets()) == {undisturbed}
    assert cudc_bench.collect("random", profile="smoke", settings={"steps": 8_000}) == ["walker/random-smoke-v0"]
    first, second = (read_manifest(one) for one in (undisturbed, "walker/random-smoke-v0"))
    assert verify_fingerprint("walker/random-smoke-v0") == first.fingerprint
    assert second.final_state == first.final_state
    diagnostics = [datasets / one / "diagnostics.jsonl" for one in ("walker/random-smoke-v0", undisturbed)]
    assert diagnostics[0].read_bytes() == diagnostics[1].read_bytes()


def test_interrupted_twice_it_stops_at_once_and_loses_nothing_that_was_kept(
    datasets: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    process = subprocess.Popen(TWO, env=environment | STOPS_ITSELF, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    with killed_in_the_end(process):
        stopped_with_something_kept(datasets, process)
        kept = {path.parent: path.read_bytes() for path in sorted(datasets.rglob("*.pt"))}
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None
        # It has heard the first; one that comes at once would be taken for the same.
        assert any("interrupt once more to stop at once" in line for line in iter(process.stderr.readline, ""))
        time.sleep(0.6)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert said.splitlines()[-1] == "cudc-bench: error: interrupted."
    assert {path.parent: path.read_bytes() for path in sorted(datasets.rglob("*.pt"))} == kept


@pytest.mark.parametrize("reader", [True, False], ids=["read", "whoever read its output has left, as tee does"])
def test_ctrl_c_in_a_terminal_reaches_all_and_all_save(reader: bool, datasets: Path, environment: dict[str, str], tmp_path: Path) -> None:
    process = subprocess.Popen(TWO, env=environment | STOPS_ITSELF, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    with killed_in_the_end(process):
        workers = stopped_with_something_kept(datasets, process)
        assert process.stderr is not None
        if not reader:
            process.stderr.close()
        os.killpg(process.pid, signal.SIGINT)
        for worker in workers:
            wait_for(lambda worker=worker: waits_for(worker, signal.SIGTERM), process)
            os.kill(worker, signal.SIGCONT)
        said = process.communicate(timeout=PATIENCE)[1] if reader else ""
        assert process.wait(PATIENCE) == 130
    assert minari.list_local_datasets() == {}
    assert len({path.parent for path in datasets.rglob("*.pt")}) == 2
    if reader:
        where = "random seed {} at step [\\d,]+ of 6,000"
        line = f"cudc-bench: error: interrupted: {where.format(1)}, {where.format(2)}; the same command continues from there."
        assert re.fullmatch(line, said.splitlines()[-1])


def test_a_worker_that_is_killed_takes_nothing_with_it(datasets: Path, environment: dict[str, str], tmp_path: Path, cli: Callable) -> None:
    process = subprocess.Popen(TWO, env=environment | STOPS_ITSELF, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    with killed_in_the_end(process):
        first, second = stopped_with_something_kept(datasets, process)
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: waits_for(second, signal.SIGTERM), process)
        os.kill(second, signal.SIGCONT)
        _, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    death = "a worker process died (SIGKILL, perhaps out of memory)"
    assert said.splitlines()[-1] == f"cudc-bench: error: {death}; run the same command again."
    assert "Traceback" not in said
    assert minari.list_local_datasets() == {}
    assert len({path.parent for path in datasets.rglob("*.pt")}) == 2
    done = cli(*TWO[3:])
    assert (done.code, done.out.split()) == (0, ["walker/random-smoke-v0", "walker/random-smoke-seed2-v0"])
    (undisturbed,) = cudc_bench.collect("random", profile="smoke", settings={"steps": 6_000}, dataset_id="walker/undisturbed-v0")
    assert verify_fingerprint("walker/random-smoke-v0") == read_manifest(undisturbed).fingerprint


def test_another_configuration_is_refused_and_fresh_starts_over(
    datasets: Path, environment: dict[str, str], tmp_path: Path, cli: Callable
) -> None:
    process = subprocess.Popen(COLLECT, env=environment | STOPS_ITSELF, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    with killed_in_the_end(process):
        wait_for(lambda: has_stopped(process.pid), process)
    at = max(int(path.stem) for path in datasets.rglob("*.pt"))
    line = f"Unfinished: walker/random-smoke-v0: was interrupted; its last checkpoint is at step {at:,}"
    assert line in cli("list").out.splitlines()
    before = sorted((path, path.stat().st_mtime_ns) for path in datasets.rglob("*"))
    done = cli("collect", "--method", "random", "--set", "steps=3000")
    assert done.code == 2
    assert done.err == (
        "cudc-bench: error: an interrupted run of 'walker/random-smoke-v0' had other settings: hyperparameters.steps 8000, not 3000."
        " Use those to continue it, or cudc-bench collect --fresh to start over.\n"
    )
    assert sorted((path, path.stat().st_mtime_ns) for path in datasets.rglob("*")) == before
    done = cli("collect", "--method", "random", "--set", "steps=3000", "--fresh")
    assert (done.code, done.out) == (0, "walker/random-smoke-v0\n"), done.err
    assert read_manifest("walker/random-smoke-v0").steps == 3000
    assert sorted(path.name for path in (datasets / "walker").iterdir()) == ["namespace_metadata.json", "random-smoke-v0"]


def stopped_with_something_kept(datasets: Path, process: subprocess.Popen[str]) -> list[int]:
    """The two workers, which have stopped themselves at their first checkpoints: otherwise one could be done when the other begins."""

    def both() -> list[int]:
        names = ("random-smoke-v0", "random-smoke-seed2-v0")
        kept = [name for name in names if any((datasets / "walker" / f".{name}.building").rglob("*.pt"))]
        found = [int((datasets / "walker" / f".{name}.lock").read_text().split()[0]) for name in kept]
        return found if len(found) == 2 and all(map(has_stopped, found)) else []

    return wait_for(both, process)


@contextmanager
def killed_in_the_end(process: subprocess.Popen[str]) -> Iterator[None]:
    """With its workers, which leave by themselves if they are not stopped."""
    try:
        yield
    finally:
        if process.poll() is None:
            for path in Path(f"/proc/{process.pid}/task").glob("*/children"):
                for child in path.read_text().split():
                    os.kill(int(child), signal.SIGKILL)
            process.kill()
            process.wait()


def waits_for(process: int, number: signal.Signals) -> bool:
    """Whether the signal was sent to a stopped process, which will hear it when it goes on."""
    pending = re.search(r"^ShdPnd:\s+(\w+)", Path(f"/proc/{process}/status").read_text(), re.MULTILINE)
    return pending is not None and bool(int(pending[1], 16) >> (number - 1) & 1)
