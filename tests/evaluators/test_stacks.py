"""Trainings side by side on one core: the same records as alone, whoever is beside them and whatever becomes of those."""

import json
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import cudc_bench
from cudc_bench.artefacts.records import read_record
from cudc_bench.errors import BrokenDownError
from cudc_bench.evaluators import td3
from cudc_bench.evaluators.policies.stored import policy_path
from cudc_bench.evaluators.running import evaluate as api
from cudc_bench.execution import interrupts
from cudc_bench.execution.parallel import run_jobs
from cudc_bench.learning.networks import MemberRandom, adam, mlp
from cudc_bench.runs import execution
from cudc_bench.runs.execution import Execution, Work

from ..served import briefly

TASKS = ("stand", "walk", "run", "flip")


def evaluated(output: Path, tasks=TASKS, **options) -> dict[str, dict]:
    """Records by task, but for the time that they took and who was beside them."""
    with briefly():
        paths = cudc_bench.evaluate(tasks=tasks, profile="smoke", output=output, **options)
    return {task: bare(path) for task, path in zip(tasks, paths, strict=True)}


def bare(path: Path) -> dict:
    found = json.loads(path.read_text())
    found["policy"] = policy_path(path).read_bytes()
    found["machine"].pop("beside", None)
    return {name: value for name, value in found.items() if name not in ("seconds", "created")}


def beside(output: Path) -> dict[str, int]:
    records = [read_record(path) for path in output.rglob("*.json")]
    return {record.dataset.task: record.machine.get("beside", 1) for record in records}


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    """Whatever is divided among several: only this one has brief episodes."""
    monkeypatch.setattr(execution, "run_jobs", lambda *arguments, **options: run_jobs(*arguments, **options | {"workers": 1}))


@pytest.fixture
def alone(smoke, tmp_path) -> dict[str, dict]:
    return {task: evaluated(tmp_path / "alone", (task,))[task] for task in TASKS}


def test_records_are_those_of_trainings_that_were_alone(smoke, alone, tmp_path):
    assert evaluated(tmp_path / "four") == alone
    assert set(beside(tmp_path / "four").values()) == {4}
    assert evaluated(tmp_path / "two", workers=2) == alone
    assert set(beside(tmp_path / "two").values()) == {2}
    # What is there already is not trained again, nor does it change the others.
    evaluated(tmp_path / "later", ("walk",))
    assert evaluated(tmp_path / "later") == alone
    assert sorted(beside(tmp_path / "later").values()) == [1, 3, 3, 3]
    assert not (tmp_path / "four" / ".checkpoints").exists()


def test_one_that_breaks_down_takes_no_other_with_it(smoke, alone, tmp_path, monkeypatch, capfd):
    real = api.load_members

    def loading(ids, *arguments, **options):
        data = real(ids, *arguments, **options)
        data.rewards[["/walk/" in one for one in ids]] = torch.nan
        return data

    monkeypatch.setattr(api, "load_members", loading)
    with pytest.raises(BrokenDownError):
        evaluated(tmp_path / "broken")
    there = {path.parent.parent.name: bare(path) for path in (tmp_path / "broken").rglob("*.json")}
    assert there == {task: record for task, record in alone.items() if task != "walk"}
    assert "each is trained alone" in capfd.readouterr().err
    assert not (tmp_path / "broken" / ".checkpoints").exists()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_stack_goes_on_with_another_number_of_processes(smoke, alone, tmp_path, monkeypatch, workers):
    output, updates = tmp_path / "stopped", []

    def update(self, batch):
        updates.append(len(self.seeds))
        if len(updates) == 25:
            interrupts.request_stop()
        return original(self, batch)

    original = td3.TD3.update
    with monkeypatch.context() as patch, interrupts.leaving_gracefully():
        patch.setattr(td3.TD3, "update", update)
        with pytest.raises(interrupts.Interrupted):
            evaluated(output, workers=1)
    assert set(updates) == {4}
    (folder,) = (output / ".checkpoints" / "stacks").iterdir()
    assert evaluated(output, workers=workers) == alone
    assert not folder.exists()
    # Killed after the records and before that: whoever finds all of them there tidies up.
    folder.mkdir(parents=True)
    evaluated(output, workers=workers)
    assert not (output / ".checkpoints").exists()


# How members are divided


class Pretended:
    def __init__(self, begun, members):
        self.members, self.begun, self.name = members, begun, ""

    def is_interrupted(self):
        return self.members in self.begun

    def checkpoints(self, every=0.0):
        return self

    def check(self, *_):
        return False


@given(groups=st.lists(st.integers(1, 9), min_size=1, max_size=4), processes=st.integers(1, 6), beside=st.integers(1, 5), data=st.data())
def test_every_member_is_in_one_stack_and_work_is_divided_equally(groups, processes, beside, data):
    members = [[(index, member) for member in range(size)] for index, size in enumerate(groups)]
    every = [member for group in members for member in group]
    left = data.draw(st.lists(st.sampled_from(every), unique=True))
    first = members[0]
    begun = [first[:2]] if len(first) > 1 and beside > 1 and data.draw(st.booleans()) else []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(execution, "worker_count", lambda workers, jobs: min(workers or 1, max(1, jobs)))
        work = Work.plan(Execution(workers=processes), "evaluate", members, left, lambda part: Pretended(begun, part), lambda _: beside)
    parts = [stack.members for stack in work.stacks]
    taken = [member for part in parts for member in part]
    assert len(taken) == len(set(taken))
    assert set(left) <= set(taken) <= {*left, *(member for part in begun for member in part)}
    assert all(len(part) <= beside and len({group for group, _ in part}) == 1 for part in parts)
    if not begun:
        # No process has more to do than if each were alone.
        assert max(map(len, parts), default=0) <= -(-len(left) // processes)
    elif any(member in left for member in begun[0]):
        assert begun[0] in parts


# What makes it so


def test_adam_moves_each_member_as_if_it_were_alone():
    """PyTorch's kernel takes eight or sixteen numbers at once and the last few one by one, which rounds differently."""

    def trained(seeds):
        network = mlp(MemberRandom(seeds, "weights"), 5, 7, 3)
        optimiser = adam([network], 1e-2, len(seeds))
        for step in range(20):
            for index, parameter in enumerate(network.parameters()):
                drawn = [torch.randn(parameter.shape[1:], generator=torch.Generator().manual_seed(100 * seed + step)) for seed in seeds]
                parameter.grad = torch.stack(drawn) * (index + 1)
            optimiser.step()
        return list(network.parameters()), optimiser

    together, optimiser = trained((1, 2, 3))
    for member, seed in enumerate((1, 2, 3)):
        alone, own = trained((seed,))
        for parameter, mine in zip(together, alone, strict=True):
            assert torch.equal(parameter[member : member + 1], mine)
            assert float(optimiser.state[parameter]["step"]) == float(own.state[mine]["step"]) == 20
