"""A GPU with too little memory: one line that says how many members would fit, measured as they are made."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from cudc_bench.artefacts.ids import default_id
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.collectors.running.collect import _Stack as Collecting
from cudc_bench.collectors.running.collect import collect_members
from cudc_bench.collectors.running.run_spec import resolve
from cudc_bench.errors import RunError
from cudc_bench.evaluators.running.evaluate import evaluate_members
from cudc_bench.evaluators.running.plans import make_plans
from cudc_bench.evaluators.running.reference import Member, ReferencePlan, train_members
from cudc_bench.evaluators.running.reference import Stack as Referring
from cudc_bench.evaluators.running.runs import Run
from cudc_bench.evaluators.running.runs import Stack as Training
from cudc_bench.learning.cpu_graphs import RecordedGraph
from cudc_bench.learning.learner import Learner
from cudc_bench.runs import memory
from cudc_bench.runs.execution import Execution, Work
from cudc_bench.runs.memory import GIB, members_that_fit
from cudc_bench.settings.profiles import resolve_profile

from ..learning.test_graphs import Regression, updates_of

BASE, EACH, CAPACITY, MOST = 1, 3, 11, 3  # GiB, and how many members that is enough for
SAID = "do not fit into the GPU's memory, of which 11.0 GiB are free; about 3 would, at 3.00 GiB each: give fewer seeds or tasks at a time"


@pytest.mark.parametrize(
    ("first", "second", "capacity", "members", "fit"),
    [(10, 15, 40, 20, 7), (10, 15, 41, 20, 7), (10, 15, 14, 20, 1), (10, None, 14, 2, 1), (10, 10, 40, 5, 4), (10, 11, 999, 5, 4)],
)
def test_members_that_fit(first: int, second: int | None, capacity: int, members: int, fit: int) -> None:
    assert members_that_fit(first, second, capacity, members) == fit


@pytest.fixture
def small_card(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A card on which a member takes so much when it learns, and whose memory is too small for more than MOST of them."""
    made: list[int] = []
    learn = Learner.update

    def update(self: Learner, batch: Any) -> Any:
        made.append(len(self.seeds))
        if BASE + EACH * len(self.seeds) > CAPACITY:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.00 GiB.")
        return learn(self, batch)

    monkeypatch.setattr(Learner, "update", update)
    monkeypatch.setattr(memory, "free_memory", lambda: CAPACITY * GIB)
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", made.clear)
    monkeypatch.setattr(torch.cuda, "max_memory_reserved", lambda: (BASE + EACH * max(made)) * GIB)
    return made


def collecting(seeds: tuple[int, ...], output: Path) -> tuple[Work[Any], Callable[[], Any]]:
    execution = Execution()
    setting = resolve("icm", "walker", resolve_profile("smoke"), {"steps": 2000})
    stack = Collecting(setting, execution, [(seed, default_id("walker", "icm", seed, "smoke")) for seed in seeds])
    work = Work(execution, [stack], 1)
    return work, partial(work.carry_out, collect_members, unit="steps", total=setting.loop.steps, threads=1)


def training(seeds: tuple[int, ...], output: Path) -> tuple[Work[Any], Callable[[], Any]]:
    execution, name = Execution(), "walker/walk/cudc-smoke-v0"
    (plan,) = make_plans(["td3"], resolve_profile("smoke"), {"evaluation_episodes": 1, "final_episodes": 1}, None)
    work = Work(execution, [Training(execution, [Run(plan, name, read_manifest(name), None, seed, output) for seed in seeds])], 1)
    return work, partial(
        work.carry_out, evaluate_members, unit="steps", total=plan.loop.gradient_steps, threads=1, reward=None, policies=False
    )


def referring(seeds: tuple[int, ...], output: Path) -> tuple[Work[Any], Callable[[], Any]]:
    execution = Execution()
    settings = {"steps": 1500, "seed_steps": 300, "update_every": 50, "evaluations": 1, "final_episodes": 1}
    plan = ReferencePlan.checked("walker", ["walk"], seeds, "smoke", settings, execution, results=output)
    work = Work(execution, [Referring(plan, [Member("walk", seed) for seed in seeds])], 1)
    return work, partial(work.carry_out, train_members, unit="steps", total=1500, threads=1, stacks=work.stacks)


@pytest.mark.parametrize("make", [collecting, training, referring])
def test_too_many_members_are_told_how_many_would_fit(make: Callable, small_card: list[int], smoke: Path, tmp_path: Path) -> None:
    _, too_many = make((1, 2, 3, 4, 5), tmp_path)
    with pytest.raises(RunError) as caught:
        too_many()
    assert str(caught.value).startswith(f"5 members {SAID}")
    assert len(str(caught.value).splitlines()) == 1
    assert set(small_card) == {2}, "it was measured with one member and with two"
    if make is collecting:
        # And so many do.
        make((1, 2, 3), tmp_path / "again")[1]()


def test_one_member_that_is_too_large_is_told_to_be_smaller(small_card: list[int], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tests.runs.test_memory.EACH", 20)
    _, one = collecting((1,), tmp_path)
    with pytest.raises(RunError, match=r"^one member does not fit into the GPU's memory, .* choose a smaller width or batch_size\.$"):
        one()
    _, two = collecting((1, 2), tmp_path)
    with pytest.raises(RunError, match=r"^2 members do not fit, and one alone neither into the GPU's memory"):
        two()


def test_other_errors_are_left_as_they_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def update(self: Learner, batch: Any) -> Any:
        raise RuntimeError("a bug")

    monkeypatch.setattr(Learner, "update", update)
    with pytest.raises(RuntimeError, match=r"^a bug$"):
        collecting((1, 2), tmp_path)[1]()


def test_a_capture_that_finds_no_memory_does_not_go_on_one_by_one() -> None:
    """Slower updates would hide it."""

    class Full(RecordedGraph):
        falls_back = True

        def capture(self, function: Any, random: Any) -> Any:
            raise torch.OutOfMemoryError("CUDA out of memory.")

    run = updates_of(Regression(), Full)
    for _ in range(2):
        run(False)
    # Every third update is of another plan.
    run(False)
    run(False)
    with pytest.raises(torch.OutOfMemoryError):
        run(False)
