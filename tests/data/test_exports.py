"""What leaves for torch, d3rlpy and TorchRL is what was written, value by value and in every episode, not only the first.

What needs d3rlpy or TorchRL is skipped where it is not installed; ``pip install -e '.[d3rlpy,torchrl]'`` runs all.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import cudc_bench
from cudc_bench.data.writer import Episode
from cudc_bench.errors import UsageError
from tests import ROOT

from ..waiting import PATIENCE

ID, UNLABELLED = "walker/walk/made-v0", "walker/made-v0"
# Of different lengths, so that a reader which is wrong by a row an episode cannot be right by chance; the shortest has a single step.
LENGTHS = (40, 1, 17, 250, 3, 60, 2, 33, 5)
EXPORTS = ("to_d3rlpy", "to_torchrl")


@pytest.fixture
def episodes(make_dataset: Callable, make_episodes: Callable) -> list[Episode]:
    """The episodes of a labelled dataset; every number in them is different."""
    made = make_episodes(LENGTHS)
    make_dataset(ID, made, task="walk")
    return made


@pytest.fixture
def unlabelled(make_dataset: Callable, make_episodes: Callable) -> list[Episode]:
    """The episodes of a dataset without rewards."""
    made = make_episodes(LENGTHS, rewards=False)
    make_dataset(UNLABELLED, made)
    return made


# ------------------------------------------------------------------------------------------------------------------------------- torch


def test_tensors_are_the_arrays(episodes: list[Episode]) -> None:
    arrays = cudc_bench.load_transitions(ID)
    tensors = arrays.to_torch()
    assert len(tensors) == len(arrays) == sum(LENGTHS)
    for name in cudc_bench.Transitions.__dataclass_fields__:
        array, tensor = getattr(arrays, name), getattr(tensors, name)
        assert tensor.device.type == "cpu"
        assert tensor.is_contiguous()
        assert tensor.numpy().dtype == array.dtype
        assert tensor.numpy().shape == array.shape
        assert tensor.numpy().tobytes() == array.tobytes(), name
    assert tensors.observations.data_ptr() == arrays.observations.ctypes.data  # not copied
    first = sum(LENGTHS[:7])
    assert tensors.episodes[first : first + LENGTHS[7]].tolist() == [7] * LENGTHS[7]
    assert torch.equal(tensors.next_observations[first : first + LENGTHS[7]], torch.from_numpy(episodes[7].observations[1:]))


def test_tensors_go_where_they_are_wanted(episodes: list[Episode]) -> None:
    arrays = cudc_bench.load_transitions(ID)
    assert arrays.to_torch("auto").rewards.device.type == ("cuda" if torch.cuda.is_available() else "cpu")
    assert arrays.to_torch(torch.device("meta")).rewards.shape == (sum(LENGTHS),)
    for wrong in ("gpu", "cuda:99"):
        with pytest.raises(UsageError, match=f"device '{wrong}' is not available here: .") as caught:
            arrays.to_torch(wrong)
        assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------------------------------------------ d3rlpy


def all_transitions(dataset: Any) -> list[Any]:
    """Every transition that d3rlpy can draw, in its own order and made by its own picker."""
    return [dataset.transition_picker(*dataset.buffer[index]) for index in range(dataset.transition_count)]


def test_d3rlpy_draws_every_transition_of_every_episode_and_no_other(episodes: list[Episode]) -> None:
    pytest.importorskip("d3rlpy")
    dataset = cudc_bench.to_d3rlpy(ID)
    assert dataset.transition_count == sum(LENGTHS)
    assert [episode.transition_count for episode in dataset.episodes] == list(LENGTHS)
    found = iter(all_transitions(dataset))
    for number, ours in enumerate(episodes):
        for t in range(LENGTHS[number]):
            theirs = next(found)
            assert theirs.observation.tobytes() == ours.observations[t].tobytes(), (number, t)
            assert theirs.action.tobytes() == ours.actions[t].tobytes(), (number, t)
            assert theirs.reward.tobytes() == ours.rewards[t].tobytes(), (number, t)
            assert theirs.next_observation.tobytes() == ours.observations[t + 1].tobytes(), (number, t)
            # What no data can tell after the last step is the last action once more.
            assert theirs.next_action.tobytes() == ours.actions[min(t + 1, LENGTHS[number] - 1)].tobytes(), (number, t)
            # A target is r + γ Q(s', ·) (1 - terminal): values bootstrap through the end of an episode, which is a time limit.
            assert (theirs.terminal, theirs.interval) == (0.0, 1)


def test_d3rlpy_samples_batches_of_these(episodes: list[Episode]) -> None:
    pytest.importorskip("d3rlpy")
    np.random.seed(1)  # noqa: NPY002 - it is what d3rlpy draws from
    batch = cudc_bench.to_d3rlpy(ID).sample_transition_batch(5000)
    ours = cudc_bench.load_transitions(ID)
    rows = {row.tobytes(): index for index, row in enumerate(ours.observations)}
    drawn = [rows[row.tobytes()] for row in batch.observations]
    assert batch.actions.tobytes() == ours.actions[drawn].tobytes()
    assert batch.rewards.tobytes() == ours.rewards[drawn, None].tobytes()
    assert batch.next_observations.tobytes() == ours.next_observations[drawn].tobytes()
    assert not batch.terminals.any()
    assert len(set(ours.episodes[drawn])) == len(LENGTHS)
    assert ours.truncations[drawn].any()  # last transitions are among them


def test_d3rlpys_returns_of_several_steps_stop_at_the_end(episodes: list[Episode]) -> None:
    d3rlpy = pytest.importorskip("d3rlpy")
    gamma, steps = 0.9, 3
    dataset = cudc_bench.to_d3rlpy(ID, transition_picker=d3rlpy.dataset.MultiStepTransitionPicker(steps, gamma))
    found = iter(all_transitions(dataset))
    for number, ours in enumerate(episodes):
        for t in range(LENGTHS[number]):
            theirs, end = next(found), min(t + steps, LENGTHS[number])
            assert theirs.interval == end - t
            assert theirs.next_observation.tobytes() == ours.observations[end].tobytes()
            assert theirs.reward[0] == pytest.approx(sum(gamma**i * float(r) for i, r in enumerate(ours.rewards[t:end])))
            assert theirs.terminal == 0


def test_d3rlpys_trajectories_never_see_the_closing_row(episodes: list[Episode]) -> None:
    pytest.importorskip("d3rlpy")
    dataset = cudc_bench.to_d3rlpy(ID)
    for index in range(dataset.transition_count):
        episode, t = dataset.buffer[index]
        number = next(n for n, e in enumerate(dataset.episodes) if e is episode)
        ours, part = episodes[number], dataset.trajectory_slicer(episode, t, 10)
        start = max(t - 9, 0)
        kept = part.masks.astype(bool)
        assert part.observations[kept].tobytes() == ours.observations[start : t + 1].tobytes()
        assert part.actions[kept].tobytes() == ours.actions[start : t + 1].tobytes()
        assert part.rewards[kept, 0].tobytes() == ours.rewards[start : t + 1].tobytes()
        to_go = [float(ours.rewards[i:].sum()) for i in range(start, t + 1)]
        assert part.returns_to_go[kept, 0].tolist() == pytest.approx(to_go, abs=1e-4)
    for theirs, ours in zip(dataset.episodes, episodes, strict=True):
        assert theirs.compute_return() == pytest.approx(float(ours.rewards.sum()), rel=1e-6)


# ----------------------------------------------------------------------------------------------------------------------------- TorchRL


def test_torchrl_holds_every_transition_of_every_episode_in_order(episodes: list[Episode]) -> None:
    pytest.importorskip("torchrl")
    buffer = cudc_bench.to_torchrl(ID, batch_size=16)
    assert len(buffer) == sum(LENGTHS)
    rows = buffer[:]
    start = 0
    for number, ours in enumerate(episodes):
        theirs = rows[start : start + LENGTHS[number]]
        assert theirs["episode"].tolist() == [number] * LENGTHS[number]
        assert theirs["observation"].numpy().tobytes() == ours.observations[:-1].tobytes(), number
        assert theirs["action"].numpy().tobytes() == ours.actions.tobytes(), number
        assert theirs["next", "reward"].numpy().tobytes() == ours.rewards.tobytes(), number
        assert theirs["next", "observation"].numpy().tobytes() == ours.observations[1:].tobytes(), number
        ends = [False] * (LENGTHS[number] - 1) + [True]
        assert theirs["next", "truncated"][:, 0].tolist() == theirs["next", "done"][:, 0].tolist() == ends
        start += LENGTHS[number]
    # A target is r + γ Q(s', ·) (1 - terminated).
    assert not rows["next", "terminated"].any()
    shapes = {"reward": (1,), "done": (1,), "terminated": (1,), "truncated": (1,), "observation": (24,)}
    assert {name: rows["next", name].shape[1:] for name in shapes} == shapes
    assert {rows["next", name].dtype for name in ("done", "terminated", "truncated")} == {torch.bool}


def test_torchrl_samples_batches_of_these(episodes: list[Episode]) -> None:
    pytest.importorskip("torchrl")
    torch.manual_seed(1)
    batch = cudc_bench.to_torchrl(ID, batch_size=5000).sample()
    ours = cudc_bench.load_transitions(ID)
    rows = {row.tobytes(): index for index, row in enumerate(ours.observations)}
    drawn = [rows[row.numpy().tobytes()] for row in batch["observation"]]
    assert batch["action"].numpy().tobytes() == ours.actions[drawn].tobytes()
    assert batch["next", "reward"].numpy().tobytes() == ours.rewards[drawn, None].tobytes()
    assert batch["next", "observation"].numpy().tobytes() == ours.next_observations[drawn].tobytes()
    assert batch["next", "truncated"].numpy().tobytes() == ours.truncations[drawn, None].tobytes()
    assert len(set(ours.episodes[drawn])) == len(LENGTHS)


def test_torchrls_targets_bootstrap_through_the_end(episodes: list[Episode]) -> None:
    pytest.importorskip("torchrl")
    from torchrl.objectives.value import TD0Estimator

    rows = cudc_bench.to_torchrl(ID)[:]
    rows["next", "state_value"] = torch.full_like(rows["next", "reward"], 8.0)
    target = TD0Estimator(gamma=0.5, value_network=None).value_estimate(rows)
    assert torch.allclose(target, rows["next", "reward"] + 4.0)


def test_torchrls_options_reach_the_buffer(episodes: list[Episode]) -> None:
    data = pytest.importorskip("torchrl.data")
    sampler = data.SliceSampler(num_slices=4, traj_key="episode", strict_length=False)
    batch = cudc_bench.to_torchrl(ID, batch_size=64, sampler=sampler).sample()
    same = batch["episode"][1:] == batch["episode"][:-1]
    follows = (batch["observation"][1:] == batch["next", "observation"][:-1]).all(-1)
    assert same.sum() >= 8
    assert (follows == same).float().mean() > 0.9  # two slices may be of the same episode

    once = cudc_bench.to_torchrl(ID, batch_size=sum(LENGTHS), sampler=data.SamplerWithoutReplacement())
    assert sorted(once.sample()["index"].tolist()) == list(range(sum(LENGTHS)))
    with pytest.raises(UsageError, match="device 'gpu' is not available here"):
        cudc_bench.to_torchrl(ID, device="gpu")


# ---------------------------------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize("name", EXPORTS)
def test_a_dataset_without_rewards_is_refused_unless_told(name: str, unlabelled: list[Episode]) -> None:
    with pytest.raises(UsageError, match=f"'{UNLABELLED}' has no rewards.*cudc-bench relabel {UNLABELLED} .*unlabelled=True"):
        getattr(cudc_bench, name)(UNLABELLED)


def test_told_so_it_leaves_with_rewards_of_zero(unlabelled: list[Episode]) -> None:
    pytest.importorskip("d3rlpy")
    pytest.importorskip("torchrl")
    found = all_transitions(cudc_bench.to_d3rlpy(UNLABELLED, unlabelled=True))
    assert len(found) == sum(LENGTHS)
    assert not any(one.reward.any() for one in found)
    rows = cudc_bench.to_torchrl(UNLABELLED, unlabelled=True)[:]
    assert not rows["next", "reward"].any()
    expected = np.concatenate([episode.observations[1:] for episode in unlabelled])
    assert rows["next", "observation"].numpy().tobytes() == expected.tobytes()
    assert np.stack([one.next_observation for one in found]).tobytes() == expected.tobytes()


@pytest.mark.parametrize("name", EXPORTS)
def test_without_the_library_one_line_says_what_to_install(name: str, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch) -> None:
    library = name.removeprefix("to_")
    for module in [known for known in sys.modules if known.split(".")[0] == library]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, library, None)  # as if it were not installed, whether or not it is
    with pytest.raises(UsageError) as caught:
        getattr(cudc_bench, name)(ID)
    assert str(caught.value).startswith(f"{name} needs {library}, which cannot be imported (")
    assert str(caught.value).endswith(f"pip install 'cudc-bench[{library}]'.")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", EXPORTS)
def test_what_is_not_there_is_refused_before_anything_is_imported(
    name: str, episodes: list[Episode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name.removeprefix("to_"), None)
    with pytest.raises(UsageError, match="there is no dataset"):
        getattr(cudc_bench, name)("walker/walk/nothing-v0")
    with pytest.raises(UsageError, match="is not a dataset id"):
        getattr(cudc_bench, name)("../cudc-smoke-v0")
    with pytest.raises(UsageError, match="there is no dataset"):
        getattr(cudc_bench, name)(ID, root=str(tmp_path))


# ----------------------------------------------------------------------------------------------------------------- examples, documents


def example(script: str, library: str) -> Any:
    # Not importorskip inside the test, which would come after the fixtures have collected a dataset.
    return pytest.param(script, marks=pytest.mark.skipif(find_spec(library) is None, reason=f"{library} is not installed"))


@pytest.mark.parametrize("script", [example("d3rlpy_td3bc", "d3rlpy"), example("torchrl_offline", "torchrl")])
def test_the_example_trains_and_plays(script: str, smoke: Path, environment: dict[str, str], tmp_path: Path) -> None:
    command = [sys.executable, ROOT / "examples" / f"{script}.py", "walker/walk/cudc-smoke-v0", "--steps", "20", "--episodes", "1"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    (result,) = re.findall(r"^mean return of 1 episodes in cudc_bench/walker-walk-v0: (\S+)$", done.stdout, re.MULTILINE)
    assert 0 < float(result) < 1000
    assert list(tmp_path.iterdir()) == []


def test_the_documents_exports_run(make_dataset: Callable, make_episodes: Callable) -> None:
    pytest.importorskip("d3rlpy")
    pytest.importorskip("torchrl")
    make_dataset("walker/walk/cudc-smoke-v0", make_episodes(LENGTHS), task="walk")
    (code,) = [
        code
        for code in re.findall(r"```python\n(.*?)```", (ROOT / "docs/tutorials/read-data.md").read_text(), re.DOTALL)
        if "to_d3rlpy" in code
    ]
    names: dict[str, Any] = {}
    exec(code, names)
    assert names["tensors"].observations.shape == (sum(LENGTHS), 24)
    assert names["dataset"].transition_count == sum(LENGTHS)
    assert names["batch"]["next", "reward"].shape == (256, 1)
