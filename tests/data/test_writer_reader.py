"""What is written is what plain Minari and our reader read back."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import minari
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cudc_bench
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.data.reader import load_episodes
from cudc_bench.data.writer import Episode, EpisodeShards, write_episodes
from cudc_bench.errors import BrokenDownError, UsageError

from ..conftest import TASKS

ID = "walker/made-v0"
LENGTHS = (4, 1, 1000, 17, 2, 250)


def naive_transitions(dataset: minari.MinariDataset) -> dict[str, list[np.ndarray]]:
    """One transition after the other, from Minari's own episodes."""
    rows: dict[str, list[np.ndarray]] = {name: [] for name in cudc_bench.Transitions.__dataclass_fields__}
    for number, episode in enumerate(dataset.iterate_episodes()):
        for t in range(len(episode.actions)):
            rows["observations"].append(episode.observations[t])
            rows["actions"].append(episode.actions[t])
            rows["rewards"].append(episode.rewards[t])
            rows["next_observations"].append(episode.observations[t + 1])
            rows["terminations"].append(episode.terminations[t])
            rows["truncations"].append(episode.truncations[t])
            rows["episodes"].append(np.int64(number))
    return rows


@pytest.mark.parametrize("per_shard", [1, 4, 25])
def test_episodes_of_any_length_round_trip_through_shards_and_minari(
    per_shard: int, tmp_path: Path, make_dataset: Callable, make_episodes: Callable
) -> None:
    episodes = make_episodes(LENGTHS)
    shards = EpisodeShards(tmp_path / "shards", per_shard)
    for episode in episodes:
        # The collector's loop reuses its arrays, so that a shard must hold copies.
        scratch = Episode(
            episode.seed, episode.observations.copy(), episode.actions.copy(), {"physics": episode.infos["physics"].copy()},
            episode.rewards.copy(),
        )  # fmt: skip
        shards.add(scratch)
        for array in (scratch.observations, scratch.actions, scratch.infos["physics"], scratch.rewards):
            array[...] = np.nan
    manifest = make_dataset(ID, list(shards))
    assert list(tmp_path.rglob("*.tmp")) == []
    dataset = minari.load_dataset(ID)
    assert (dataset.total_episodes, dataset.total_steps) == (len(LENGTHS), sum(LENGTHS)) == (manifest.episodes, manifest.steps)
    stored = list(dataset.storage.get_episode_metadata(range(len(LENGTHS))))
    for index, (ours, theirs) in enumerate(zip(episodes, dataset.iterate_episodes(), strict=True)):
        length = LENGTHS[index]
        assert theirs.id == stored[index]["id"] == index
        assert stored[index]["seed"] == ours.seed
        assert stored[index]["total_steps"] == length
        for name in ("observations", "actions", "rewards"):
            assert getattr(theirs, name).dtype == np.float32
            assert getattr(theirs, name).tobytes() == getattr(ours, name).tobytes()
        assert theirs.infos.keys() == {"physics"}
        assert theirs.infos["physics"].dtype == np.float64
        assert theirs.infos["physics"].tobytes() == ours.infos["physics"].tobytes()
        assert theirs.terminations.dtype == theirs.truncations.dtype == np.bool_
        assert theirs.terminations.tolist() == [False] * length
        assert theirs.truncations.tolist() == [False] * (length - 1) + [True]


def test_transitions_are_naive_pythons(make_dataset: Callable, make_episodes: Callable) -> None:
    make_dataset(ID, make_episodes(LENGTHS))
    found = cudc_bench.load_transitions(ID, verify=True)
    assert len(found) == sum(LENGTHS)
    for name, rows in naive_transitions(minari.load_dataset(ID)).items():
        expected, array = np.stack(rows), getattr(found, name)
        assert array.dtype == expected.dtype
        assert array.shape == expected.shape
        assert array.tobytes() == expected.tobytes(), name
        assert array.flags.c_contiguous


def test_rows_behind_a_border_belong_to_their_own_episode(make_dataset: Callable, make_episodes: Callable) -> None:
    """Readers elsewhere shift every episode after the first by one; look at those."""
    episodes = make_episodes([3, 2, 4])
    make_dataset(ID, episodes)
    found = cudc_bench.load_transitions(ID)
    assert found.episodes.tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 2]
    assert found.truncations.tolist() == [False, False, True, False, True, False, False, False, True]
    for row, (number, t) in {2: (0, 2), 3: (1, 0), 4: (1, 1), 5: (2, 0), 8: (2, 3)}.items():
        assert found.observations[row].tolist() == episodes[number].observations[t].tolist()
        assert found.next_observations[row].tolist() == episodes[number].observations[t + 1].tolist()
        assert found.actions[row].tolist() == episodes[number].actions[t].tolist()
        assert found.rewards[row] == episodes[number].rewards[t]


@given(st.lists(st.integers(1, 6), min_size=1, max_size=6))
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_lengths_read_back(make_dataset: Callable, make_episodes: Callable, lengths: list[int]) -> None:
    episodes = make_episodes(lengths, seed=sum(lengths))
    make_dataset(ID, episodes)
    flat = load_episodes(ID, ("observations", "actions", "infos/physics"))
    assert flat.lengths.tolist() == lengths
    for name, take in (
        ("observations", lambda e: e.observations),
        ("actions", lambda e: e.actions),
        ("infos/physics", lambda e: e.infos["physics"]),
    ):
        for ours, theirs in zip(flat.split(name), episodes, strict=True):
            assert ours.tobytes() == take(theirs).tobytes()


def test_a_task_agnostic_dataset_holds_zero_rewards_and_its_card_says_so(smoke: Path) -> None:
    dataset = minari.load_dataset("walker/cudc-smoke-v0")
    assert all(episode.rewards.tolist() == [0.0] * 1000 for episode in dataset.iterate_episodes())
    assert "rewards are all 0" in dataset.storage.metadata["description"]
    assert dataset.storage.metadata["algorithm_name"] == "cudc"
    assert dataset.env_spec.id == "cudc_bench/walker-v0"


def test_a_collected_dataset_satisfies_minari(smoke: Path) -> None:
    """The rules that keep every consumer happy."""
    for one in ("walker/cudc-smoke-v0", "walker/flip/cudc-smoke-v0"):
        dataset = minari.load_dataset(one)
        assert dataset.spec.dataset_id == one
        assert (dataset.total_episodes, dataset.total_steps) == (3, 3000)
        for number, episode in enumerate(dataset.iterate_episodes()):
            assert episode.id == number
            assert episode.observations.shape == (1001, 24)
            assert episode.actions.shape == (1000, 6)
            assert episode.rewards.shape == episode.terminations.shape == episode.truncations.shape == (1000,)
            assert episode.infos["physics"].shape == (1001, 18)
            assert all(observation in dataset.observation_space for observation in episode.observations)
            assert all(action in dataset.action_space for action in episode.actions)
            assert not episode.terminations.any()
            assert np.flatnonzero(episode.truncations).tolist() == [999]
    assert set(minari.list_local_datasets()) == {"walker/cudc-smoke-v0", *(f"walker/{task}/cudc-smoke-v0" for task in TASKS)}


def test_states_belong_to_their_observations(smoke: Path) -> None:
    """Setting a stored state and computing the observation gives the stored observation, on both sides of every border."""
    import mujoco

    from cudc_bench.envs.walker import Walker

    walker, found = Walker(), np.empty(24, np.float32)
    flat = load_episodes("walker/cudc-smoke-v0", ("observations", "infos/physics"))
    for observations, states in zip(flat.split("observations"), flat.split("infos/physics"), strict=True):
        for t in (0, 1, 500, 999, 1000):
            mujoco.mj_setState(walker.model, walker.data, states[t], int(mujoco.mjtState.mjSTATE_PHYSICS))
            mujoco.mj_kinematics(walker.model, walker.data)
            walker.observe(found)
            assert found.tobytes() == observations[t].tobytes()


@pytest.mark.parametrize("where", ["shards", "file"])
@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("observations", np.inf, "a number of observations is not finite"),
        ("rewards", 1e300, "a number of rewards is not finite"),
        ("actions", 1.5, "an action is out of [-1, 1]"),
        ("infos/skill", np.nan, "a number of infos/skill is not finite"),
    ],
)
def test_what_no_reader_takes_is_not_stored(
    field: str, value: float, says: str, where: str, tmp_path: Path, make_episodes: Callable
) -> None:
    """In the type in which it is stored: a float64 beyond float32 is not finite there."""
    whole, bad = make_episodes([4, 4])
    with np.errstate(over="ignore"):
        if field == "infos/skill":
            bad = dataclasses.replace(bad, infos=bad.infos | {"skill": np.full((5, 2), value, np.float32)})
        else:
            getattr(bad, field)[2] = value
    shards = EpisodeShards(tmp_path / "shards")
    shards.add(whole)
    with pytest.raises(BrokenDownError, match=re.escape(f"cannot be stored: {says} at step ")):
        write_episodes(tmp_path / "data", [whole, bad]) if where == "file" else shards.add(bad)


def test_the_same_episodes_give_the_same_bytes(tmp_path: Path, make_episodes: Callable) -> None:
    for name in ("a", "b"):
        write_episodes(tmp_path / name, make_episodes([5, 3]))
    assert (tmp_path / "a" / "main_data.hdf5").read_bytes() == (tmp_path / "b" / "main_data.hdf5").read_bytes()


def test_two_runs_with_one_seed_have_one_fingerprint_and_other_seeds_another(smoke: Path) -> None:
    expected = read_manifest("walker/cudc-smoke-v0").fingerprint
    cudc_bench.collect("cudc", seeds=[1], profile="smoke", dataset_id="walker/again-v0")
    cudc_bench.collect("cudc", seeds=[2], profile="smoke")
    assert read_manifest("walker/again-v0").fingerprint == expected
    assert read_manifest("walker/cudc-smoke-seed2-v0").fingerprint != expected


def test_a_shorter_last_episode_is_kept(datasets: Path) -> None:
    cudc_bench.collect("random", profile="smoke", settings={"steps": 1250})
    dataset = minari.load_dataset("walker/random-smoke-v0")
    assert [len(episode.actions) for episode in dataset.iterate_episodes()] == [1000, 250]
    assert dataset[1].truncations[-1]
    assert len(cudc_bench.load_transitions("walker/random-smoke-v0", verify=True)) == 1250


def test_datasets_of_others_are_refused_not_misread(smoke: Path) -> None:
    path = smoke / "walker" / "theirs-v0" / "data"
    path.mkdir(parents=True)
    (path / "metadata.json").write_text("{}")
    with pytest.raises(UsageError, match="was not made by cudc-bench"):
        cudc_bench.load_transitions("walker/theirs-v0")
    with pytest.raises(UsageError, match="there is no dataset"):
        cudc_bench.load_transitions("walker/nothing-v0")
    with pytest.raises(UsageError, match="is not a dataset id"):
        cudc_bench.load_transitions("../cudc-smoke-v0")


def test_another_root_can_be_named(smoke: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "empty"))
    assert len(cudc_bench.load_transitions("walker/walk/cudc-smoke-v0", root=str(smoke), verify=True)) == 3000
    with pytest.raises(UsageError):
        cudc_bench.load_transitions("walker/walk/cudc-smoke-v0")
