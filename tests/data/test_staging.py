"""Whatever ends a run, nothing half-written is ever visible, and the same command then succeeds."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

import minari
import pytest

from cudc_bench.artefacts.ids import parse_id
from cudc_bench.data.reader import verify_fingerprint
from cudc_bench.data.staging import publish, staging
from cudc_bench.errors import RunError

from ..waiting import PATIENCE, STOPS_ITSELF, has_stopped, wait_for

ID = parse_id("walker/made-v0")
LONG = {"steps": 10_000}  # about a second
COLLECT = [sys.executable, "-m", "cudc_bench.cli", "collect", "--method", "random", "--set", "steps=10000", "--checkpoint-every", "0"]


def everything(root: Path) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*"))


def files(name: str) -> list[str]:
    """What a finished dataset consists of."""
    inside = ("README.md", "data", "data/main_data.hdf5", "data/metadata.json", "diagnostics.jsonl")
    return [name, *(f"{name}/{file}" for file in inside)]


@contextmanager
def started(command: list[str], **arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A process that does not outlive the test."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **arguments)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def break_off(error: BaseException) -> None:
    """Start building a dataset, and stop."""
    with staging(ID) as folder:
        (folder / "data").mkdir()
        (folder / "data" / "main_data.hdf5").write_text("half")
        assert minari.list_local_datasets() == {}
        raise error


@pytest.mark.parametrize("error", [ValueError(), RunError("stop"), KeyboardInterrupt(), SystemExit()], ids=repr)
def test_an_exception_leaves_nothing_behind(error: BaseException, datasets: Path) -> None:
    with pytest.raises(type(error)):
        break_off(error)
    assert everything(datasets) == []


def test_an_operating_systems_error_becomes_one_line(datasets: Path) -> None:
    with pytest.raises(RunError, match=r"^cannot write 'walker/made-v0' below .*: No space left on device; free some space") as caught:
        break_off(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    assert "\n" not in str(caught.value)
    assert everything(datasets) == []


def test_a_root_that_is_a_file_becomes_one_line(datasets: Path) -> None:
    datasets.write_text("")
    with pytest.raises(RunError, match="cannot write 'walker/made-v0'"), staging(ID):
        pytest.fail("there is nowhere to write")


def test_what_is_not_published_never_existed(datasets: Path) -> None:
    with staging(ID) as folder:
        (folder / "file").write_text("")
    assert everything(datasets) == []


def test_what_a_killed_process_left_is_removed(datasets: Path) -> None:
    left = datasets / "walker" / ".made-v0.building"
    left.mkdir(parents=True)
    (left / "old").write_text("")
    (datasets / "walker" / ".made-v0.lock").write_text("1")
    with staging(ID) as folder:
        assert everything(folder) == []
        (folder / "new").write_text("")
        publish(folder, ID)
    assert everything(datasets / "walker") == ["made-v0", "made-v0/new", "namespace_metadata.json"]


def test_publishing_replaces_the_whole_dataset(datasets: Path) -> None:
    for name in ("first", "second"):
        with staging(ID) as folder:
            (folder / name).write_text("")
            publish(folder, ID)
    assert everything(datasets / "walker") == ["made-v0", "made-v0/second", "namespace_metadata.json"]


def test_what_was_being_replaced_when_the_process_died_comes_back(datasets: Path) -> None:
    aside = datasets / "walker" / ".made-v0.replaced"
    aside.mkdir(parents=True)
    (aside / "old").write_text("")
    with pytest.raises(RuntimeError, match="collecting failed"), staging(ID):
        raise RuntimeError("collecting failed")
    assert everything(datasets / "walker") == ["made-v0", "made-v0/old"]


def test_minari_lists_the_namespaces_and_their_descriptions_are_kept(datasets: Path) -> None:
    minari.namespace.create_namespace("walker", description="somebody's own words")
    for one in (ID, ID.for_task("walk"), parse_id("other/made-v0")):
        with staging(one) as folder:
            publish(folder, one)
    assert minari.namespace.list_local_namespaces() == ["other", "walker", "walker/walk"]
    assert minari.namespace.get_namespace_metadata("walker") == {"description": "somebody's own words"}


def test_a_second_writer_is_told_who_writes_and_touches_nothing(datasets: Path) -> None:
    with staging(ID) as folder:
        (folder / "file").write_text("")
        with pytest.raises(RunError, match=rf"^process {os.getpid()} is writing 'walker/made-v0'; wait for it to end\.$"), staging(ID):
            pytest.fail("two writers")
        with staging(parse_id("walker/other-v0")):
            pass
        assert (folder / "file").exists()
        publish(folder, ID)
    assert (datasets / "walker" / "made-v0" / "file").exists()


def test_a_lock_file_that_its_holder_removed_is_no_lock(datasets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first writer ends between the second one's opening and locking of the lock file; a third must still be refused."""
    first, real = ExitStack(), fcntl.flock
    first.enter_context(staging(ID))

    def flock(file: IO[str], operation: int) -> None:
        first.close()
        real(file, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    with (
        staging(ID),
        pytest.raises(RunError, match=rf"^process {os.getpid()} is writing 'walker/made-v0'"),
        staging(ID),
    ):
        pytest.fail("two writers")


def test_of_two_processes_on_one_id_one_runs_and_the_other_says_so(datasets: Path, environment: dict[str, str], tmp_path: Path) -> None:
    with started(COLLECT, env=environment | STOPS_ITSELF, cwd=tmp_path) as first:
        wait_for(lambda: has_stopped(first.pid), first)
        second = subprocess.run(COLLECT, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE)
        first.send_signal(signal.SIGCONT)
        out, err = first.communicate(timeout=PATIENCE)
    assert (first.returncode, out) == (0, "walker/random-smoke-v0\n"), err
    assert (second.returncode, second.stdout) == (1, "")
    assert [line for line in second.stderr.splitlines() if "error" in line] == [
        f"cudc-bench: error: process {first.pid} is writing 'walker/random-smoke-v0'; wait for it to end."
    ]
    assert "Traceback" not in second.stderr
    assert verify_fingerprint("walker/random-smoke-v0")
    assert everything(datasets / "walker") == ["namespace_metadata.json", *files("random-smoke-v0")]
