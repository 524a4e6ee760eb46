"""Jobs in other processes, and how they end."""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from cudc_bench.errors import DEBUG, RunError
from cudc_bench.execution import interrupts
from cudc_bench.execution.crew import Crew
from cudc_bench.execution.parallel import Job, computed, run_jobs
from cudc_bench.execution.workers import Ended, Worker
from cudc_bench.files import lives

from ..waiting import wait_for


def counting(advance: Any, *, upto: int, fail: bool = False) -> int:
    """A job that looks at each step whether it shall leave."""
    for step in range(upto):
        if interrupts.requested():
            raise interrupts.interrupted(f"at {step} of {upto}")
        if fail and step == 3:
            raise RunError("three is too many")
        advance(1)
        time.sleep(0.01)
    return upto


def stopping(advance: Any, *, upto: int, number: int) -> int:
    """A job during which somebody sends the process that started it a signal."""
    os.kill(os.getppid(), number)
    return counting(advance, upto=upto)


def threads(advance: Any) -> int:
    import torch

    return torch.get_num_threads()


def jobs(*arguments: dict[str, Any]) -> list[Job]:
    return [Job(f"job {index}", 10, one) for index, one in enumerate(arguments)]


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order_and_a_failure_is_what_failed(workers: int) -> None:
    assert run_jobs(counting, jobs({"upto": 4}, {"upto": 2}, {"upto": 3}), unit="steps", workers=workers, threads=1) == [4, 2, 3]
    with pytest.raises(RunError, match=r"^three is too many$"):
        run_jobs(counting, jobs({"upto": 5}, {"upto": 9, "fail": True}, {"upto": 5}), unit="steps", workers=workers, threads=1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_asked_to_leave_all_workers_leave_where_they_are(number: int, capfd: pytest.CaptureFixture[str]) -> None:
    todo = jobs({"upto": 3000, "number": number}, {"upto": 3000, "number": 0}, {"upto": 3000, "number": 0})
    with pytest.raises(interrupts.Interrupted) as caught:
        run_jobs(stopping, todo, unit="steps", workers=2, threads=1)
    assert caught.value.exit_code == 128 + number
    assert caught.value.message.startswith("interrupted: job 0 at ")
    assert caught.value.message.endswith(" of 3000; the same command continues from there.")
    assert capfd.readouterr().err.count("interrupt once more to stop at once") == 1
    # It is over for whoever goes on in this process.
    assert not interrupts.requested()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_in_this_process_the_first_signal_asks_and_the_second_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    def twice(advance: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)  # at once: some senders address the process, and then its group
        assert interrupts.requested()
        time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGINT)
        raise AssertionError("it went on")

    with pytest.raises(KeyboardInterrupt) as caught:
        run_jobs(twice, jobs({}), unit="steps", workers=1, threads=1)
    assert not isinstance(caught.value, interrupts.Interrupted)


def test_threads_do_not_depend_on_how_many_jobs_are_left() -> None:
    import torch  # noqa: F401  what is there already can have more threads than there are cores

    assert run_jobs(threads, jobs({}), unit="steps", workers=1, threads=3) == [3]
    alone = run_jobs(threads, jobs({}), unit="steps", workers=2, threads=None)
    assert alone == run_jobs(threads, jobs({}, {}), unit="steps", workers=2, threads=None)[:1]


class TwoParts(RunError):
    def __init__(self, one: str, two: str) -> None:
        super().__init__(one + two)


class Unpicklable(Exception):
    def __init__(self, one: str, two: str) -> None:
        super().__init__(one + two)


def ends_so(advance: Any, *, how: str) -> str:
    if how == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "exit":
        sys.exit(0)
    if how == "bug":
        raise Unpicklable("not ", "so")
    if how == "failure":
        raise TwoParts("no ", "good")
    if how == "result":
        return lambda: None  # type: ignore[return-value]
    if how == "asked":
        os.kill(os.getpid(), signal.SIGTERM)
        with interrupts.leaving_gracefully():
            pass  # a first stage, which did not look
        return str(interrupts.requested())
    while how == "long" and not interrupts.requested():
        time.sleep(0.01)
    if how == "long":
        raise interrupts.interrupted("somewhere")
    return how


def test_a_death_ends_the_others_and_those_that_have_nothing_to_do() -> None:
    """One is at work, one has died, one has done its work."""
    for order in (("short", "long", "killed"), ("killed", "short", "long")):
        with pytest.raises(RunError, match=r"a worker process died \(SIGKILL, perhaps out of memory\)"):
            run_jobs(ends_so, jobs(*({"how": how} for how in order)), unit="steps", workers=3, threads=1)


def test_a_bug_in_a_worker_comes_home_with_its_traceback() -> None:
    with pytest.raises(RuntimeError) as caught:
        run_jobs(ends_so, jobs({"how": "bug"}, {"how": "short"}), unit="steps", workers=2, threads=1)
    assert str(caught.value) == "Unpicklable: not so"
    assert 'raise Unpicklable("not ", "so")' in caught.value.__notes__[0]


@pytest.mark.parametrize(("asked", "told"), [("", False), ("0", False), ("1", True)])
def test_a_failure_comes_home_with_its_traceback_if_somebody_asks_for_it(asked: str, told: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DEBUG, asked)
    with pytest.raises(RunError, match="three is too many") as caught:
        run_jobs(counting, jobs({"upto": 9, "fail": True}, {"upto": 5}), unit="steps", workers=2, threads=1)
    assert ('raise RunError("three is too many")' in "".join(getattr(caught.value, "__notes__", []))) == told


def test_what_cannot_be_sent_comes_home_in_words() -> None:
    short = {"how": "short"}
    with pytest.raises(RunError, match=r"^no good$"):
        run_jobs(ends_so, jobs({"how": "failure"}, short), unit="steps", workers=2, threads=1)
    with pytest.raises((AttributeError, pickle.PicklingError), match="lambda"):
        run_jobs(ends_so, jobs({"how": "result"}, short), unit="steps", workers=2, threads=1)


def test_a_request_holds_until_all_stages_are_over() -> None:
    assert run_jobs(ends_so, jobs({"how": "asked"}, {"how": "short"}), unit="steps", workers=2, threads=1) == ["True", "short"]
    with interrupts.leaving_gracefully():
        with interrupts.leaving_gracefully():
            interrupts.request_stop()
        with pytest.raises(interrupts.Interrupted) as caught:
            run_jobs(ends_so, jobs({"how": "short"}), unit="steps", workers=1, threads=1)
    assert caught.value.message == "interrupted before the next run began; the same command continues from there."
    assert not interrupts.requested()


# Functions that only compute


def test_many_functions_give_their_results_in_order() -> None:
    assert computed([lambda number=number: number**2 for number in range(40)], "squaring", "numbers") == [n**2 for n in range(40)]  # type: ignore[misc]


# In a process of its own: with other threads nothing would be forked. What comes after function 3 waits until home knows how that one
# ended: by the request to leave that follows, or by what home says of it.
FORKED = """
import os, signal, sys, time
from cudc_bench.errors import RunError
from cudc_bench.execution import interrupts, parallel
parallel.use_cores(2)
home = os.getpid()
os.dup2(os.open("said", os.O_RDWR | os.O_CREAT), 2)

def is_known():
    return "others that have begun go on" in open("said").read() if WHAT == "fail" else interrupts.requested()

def one(index):
    if index == 3 and WHAT == "fail":
        raise RunError("three is too many")
    if index == 3 and WHAT == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if index == 3 and WHAT == "stop":
        os.kill(home, signal.SIGINT)
    while index > 3 and WHAT != "nothing" and not is_known():
        time.sleep(0.01)
    os.write(1, f"did {index} {os.getpid() != home}\\n".encode())
    return index

try:
    print(parallel.computed([lambda index=index: one(index) for index in range(20)], "counting", "numbers"))
except (RunError, KeyboardInterrupt) as error:
    print("ended by", type(error).__name__, error)
"""


@pytest.mark.parametrize(
    ("what", "end"),
    [
        ("nothing", str(list(range(20)))),
        ("fail", "ended by RunError three is too many"),
        ("die", "ended by RunError a worker process died (SIGKILL, perhaps out of memory); run the same command again."),
        ("stop", "ended by KeyboardInterrupt "),
    ],
)
def test_functions_are_shared_by_forked_processes_and_what_ends_one_ends_all(what: str, end: str, python: Callable) -> None:
    code, out, _ = python(FORKED.replace("WHAT", repr(what)))
    lines = out.splitlines()
    assert (code, lines[-1]) == (0, end)
    assert all(line.endswith(" True") for line in lines[:-1])
    assert {int(line.split()[1]) for line in lines[:-1]} <= set(range(20 if what == "nothing" else 5))
    assert len(lines) == 21 or what != "nothing"


def leaving_once(task: str, notify: Any) -> int:
    """Somebody asks the process to leave; a job that is put back must find another."""
    if not interrupts.requested() and task == "first":
        os.kill(os.getpid(), signal.SIGTERM)
    if interrupts.requested():
        raise interrupts.interrupted("here")
    return os.getpid()


def test_a_worker_that_somebody_asks_to_leave_leaves_and_its_task_goes_on_in_another() -> None:
    left, ends = ["first"], []

    def on_news(task: str, news: Any) -> None:
        ends.append(news)
        if isinstance(news, Ended) and isinstance(news.error, interrupts.Interrupted) and len(ends) < 5:
            left.append("again")

    crew = Crew(lambda: Worker(leaving_once, context=get_context("fork")), 1)
    crew.work(lambda: left.pop() if left else None, on_news, lambda: not left)
    assert [type(one.error) for one in ends] == [interrupts.Interrupted, type(None)]
    assert ends[0].leaves
    assert not lives(ends[1].result)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux kills a process with its parent")
def test_whoever_computes_for_a_killed_process_ends_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nap() -> None:
        (tmp_path / str(os.getpid())).touch()
        # As a library computes that keeps Python waiting: no other thread of the process runs meanwhile.
        ctypes.PyDLL(None).sleep(3600)

    def compute() -> None:
        monkeypatch.setattr("cudc_bench.execution.parallel.parent_process", lambda: None)
        monkeypatch.setattr("cudc_bench.execution.parallel.cores", lambda: 2)
        computed([nap] * 2, "nap", "naps", few=0)

    killed = get_context("fork").Process(target=compute)
    killed.start()
    wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
    killed.kill()
    killed.join()
    wait_for(lambda: not any(lives(int(path.name)) for path in tmp_path.iterdir()))


def test_a_job_that_ends_the_process_is_no_success() -> None:
    for workers in (1, 2):
        with pytest.raises(RunError, match=r"test_parallel.py' line \d+ called for the end of the process \(exit code 0\) before the work"):
            run_jobs(ends_so, jobs({"how": "exit"}, {"how": "short"}), unit="steps", workers=workers, threads=1)
