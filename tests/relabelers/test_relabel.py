"""Relabelled rewards are the live ones, and relabelled datasets are what they say."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import minari
import numpy as np
import pytest

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.ids import dataset_path
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.data.reader import load_episodes, verify_fingerprint
from cudc_bench.envs import DOMAINS, env_id, make_simulators
from cudc_bench.errors import RunError, UsageError

TASKS = ("stand", "walk", "run", "flip")
BASE = "walker/cudc-smoke-v0"


def relabeled(task: str) -> str:
    return f"walker/{task}/cudc-smoke-v0"


def live(domain: str, task: str, seed: int, policy: Callable[[int], np.ndarray], steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, the actions that led to them, and rewards of one episode, as the task's environment gives them."""
    environment = gymnasium.make(env_id(domain, task))
    environment.reset(seed=seed)
    states, actions, rewards = [], [], []
    for t in range(steps):
        actions.append(policy(t))
        _, reward, _, _, info = environment.step(actions[-1])
        states.append(info["physics"])
        rewards.append(reward)
    return np.stack(states), np.stack(actions), np.array(rewards)


def policies(domain: str, seed: int) -> list[Callable[[int], np.ndarray]]:
    """Uniform actions; full-range oscillations, which reach higher speeds and spins; none."""
    size = DOMAINS[domain].action_size
    generator = np.random.default_rng(seed)
    rates = generator.uniform(0.05, 0.6, size)
    return [
        lambda t: generator.uniform(-1, 1, size).astype(np.float32),
        lambda t: np.sign(np.sin(rates * t)).astype(np.float32),
        lambda t: np.zeros(size, np.float32),
    ]


# ---------------------------------------------------------------------------------------------------------------- every relabeler


@pytest.fixture(params=DOMAINS, scope="module")
def domain(request: pytest.FixtureRequest) -> str:
    return request.param


def relabeler_of(domain: str) -> Any:
    return plugins.load("relabelers", DOMAINS[domain].relabeler)(DOMAINS[domain])


@pytest.fixture(scope="module")
def reached(domain: str) -> tuple[np.ndarray, np.ndarray]:
    """States of a domain from short episodes of different policies, and the actions that led to them.

    Many starts, too: an arm that moves at random seldom comes near a target, but some of its initial states are there.
    """
    (simulator,), states, actions = make_simulators(domain, 1), [], []
    starts = [(policy, 200) for policy in policies(domain, 5)] + [(policy, 1) for policy in policies(domain, 5) * 50]
    for seed, (policy, steps) in enumerate(starts):
        simulator.reset(seed)
        for t in range(steps):
            actions.append(policy(t))
            simulator.step(actions[-1])
            states.append(np.empty(DOMAINS[domain].physics_size))
            simulator.state(states[-1])
    return np.stack(states), np.stack(actions)


def test_rewards_are_finite_and_within_bounds(domain: str, reached: tuple[np.ndarray, np.ndarray]) -> None:
    states, actions = reached
    before = states.copy()
    rewards = relabeler_of(domain).rewards(states, actions)
    assert rewards.shape == (len(states), len(DOMAINS[domain].tasks))
    assert rewards.dtype == np.float64
    assert np.isfinite(rewards).all()
    assert rewards.min() >= 0.0
    assert rewards.max() <= DOMAINS[domain].max_return / DOMAINS[domain].episode_length
    assert (np.ptp(rewards, axis=0) > 0.01).all(), "these states do not exercise the rewards"
    assert states.tobytes() == before.tobytes()


def test_rewards_do_not_depend_on_the_state_before(domain: str, reached: tuple[np.ndarray, np.ndarray]) -> None:
    """MuJoCo caches derived quantities; one that is not refreshed would be that of another state."""
    states, actions = reached
    relabeler = relabeler_of(domain)
    in_order = relabeler.rewards(states, actions)
    order = np.random.default_rng(0).permutation(len(states))
    assert relabeler.rewards(states[order], actions[order]).tobytes() == in_order[order].tobytes()
    repeated = relabeler.rewards(np.repeat(states[:50], 2, axis=0), np.repeat(actions[:50], 2, axis=0))
    assert repeated.tobytes() == np.repeat(in_order[:50], 2, axis=0).tobytes()
    for row in (0, 17, len(states) - 1):
        alone = relabeler_of(domain).rewards(states[row : row + 1], actions[row : row + 1])
        assert alone.tobytes() == in_order[row : row + 1].tobytes()


def test_rewards_do_not_depend_on_how_the_states_lie_in_memory(domain: str, reached: tuple[np.ndarray, np.ndarray]) -> None:
    states, actions = reached
    relabeler = relabeler_of(domain)
    expected = relabeler.rewards(states, actions)
    assert relabeler.rewards(np.asfortranarray(states), actions).tobytes() == expected.tobytes()
    assert relabeler.rewards(states[::2], actions[::2]).tobytes() == expected[::2].tobytes()


def test_columns_are_the_domains_tasks_in_order_and_equal_the_live_rewards(domain: str) -> None:
    """Whole episodes, no difference in float64, at most 1e-6 as stored in float32; from starts near each task's goal."""
    relabeler, (simulator,) = relabeler_of(domain), make_simulators(domain, 1)
    starts = np.empty((100, DOMAINS[domain].physics_size))
    for seed, start in enumerate(starts):
        simulator.reset(seed)
        simulator.state(start)
    best = relabeler.rewards(starts, np.zeros((100, DOMAINS[domain].action_size), np.float32)).argmax(axis=0)
    for column, (task, seed) in enumerate(zip(DOMAINS[domain].tasks, best.tolist(), strict=True)):
        seen = []
        for policy in policies(domain, seed):
            states, actions, rewards = live(domain, task, seed, policy, DOMAINS[domain].episode_length)
            found = relabeler.rewards(states, actions)[:, column]
            assert np.abs(found - rewards).max() == 0.0
            assert np.abs(found.astype(np.float32) - rewards).max() <= 1e-6
            seen.append(rewards)
        assert np.ptp(np.concatenate(seen)) > 0.01


# --------------------------------------------------------------------------------------------------------------------- datasets


@pytest.mark.parametrize("name", ["quadruped", "jaco"])
def test_datasets_of_other_domains_hold_the_rewards_of_their_recovered_environments(name: str, datasets: Path) -> None:
    length, tasks = DOMAINS[name].episode_length, DOMAINS[name].tasks
    (base,) = cudc_bench.collect("random", name, profile="smoke", settings={"steps": length + 40})
    assert cudc_bench.relabel(base) == [f"{name}/{task}/random-smoke-v0" for task in tasks]
    for task in tasks:
        dataset = minari.load_dataset(f"{name}/{task}/random-smoke-v0")
        environment = dataset.recover_environment()
        assert environment.spec.id == env_id(name, task)
        assert [len(episode.actions) for episode in dataset.iterate_episodes()] == [length, 40]
        for metadata, episode in zip(dataset.storage.get_episode_metadata(range(2)), dataset.iterate_episodes(), strict=True):
            observation, info = environment.reset(seed=int(metadata["seed"]))
            observations, states, rewards = [observation], [info["physics"]], []
            for action in episode.actions:
                observation, reward, _, _, info = environment.step(action)
                observations.append(observation)
                states.append(info["physics"])
                rewards.append(reward)
            assert episode.observations.tobytes() == np.stack(observations).tobytes()
            assert episode.infos["physics"].tobytes() == np.stack(states).tobytes()
            assert episode.rewards.tobytes() == np.array(rewards).astype(np.float32).tobytes()


@pytest.mark.parametrize("task", TASKS)
def test_dataset_holds_the_rewards_of_its_recovered_environment(task: str, smoke: Path) -> None:
    dataset = minari.load_dataset(relabeled(task))
    environment = dataset.recover_environment()
    assert environment.spec.id == env_id("walker", task)
    for metadata, episode in zip(dataset.storage.get_episode_metadata(range(3)), dataset.iterate_episodes(), strict=True):
        environment.reset(seed=int(metadata["seed"]))
        rewards = [environment.step(action)[1] for action in episode.actions]
        assert episode.rewards.dtype == np.float32
        assert episode.rewards.tobytes() == np.array(rewards).astype(np.float32).tobytes()
        assert metadata["rewards_sum"] == pytest.approx(float(np.sum(episode.rewards, dtype=np.float64)))
        assert np.ptp(episode.rewards) > 0


def test_linked_and_standalone_sets_are_the_same_to_minari(smoke: Path) -> None:
    linked = {task: list(minari.load_dataset(relabeled(task)).iterate_episodes()) for task in TASKS}
    manifests = {task: read_manifest(relabeled(task)) for task in TASKS}
    sizes = {task: (smoke / relabeled(task) / "data" / "main_data.hdf5").stat().st_size for task in TASKS}
    cudc_bench.relabel(BASE, standalone=True, overwrite=True)
    base = smoke / BASE / "data" / "main_data.hdf5"
    for task in TASKS:
        dataset = minari.load_dataset(relabeled(task))
        for ours, theirs in zip(linked[task], dataset.iterate_episodes(), strict=True):
            for name in ("observations", "actions", "rewards", "terminations", "truncations"):
                a, b = getattr(ours, name), getattr(theirs, name)
                assert a.dtype == b.dtype
                assert a.tobytes() == b.tobytes()
            assert ours.infos["physics"].tobytes() == theirs.infos["physics"].tobytes()
        manifest = read_manifest(relabeled(task))
        assert manifest.fingerprint == manifests[task].fingerprint == verify_fingerprint(relabeled(task))
        assert manifest.base is not None
        assert not manifest.base.linked
        assert "combined_datasets" not in dataset.storage.metadata
        assert (smoke / relabeled(task) / "data" / "main_data.hdf5").stat().st_size > 0.9 * base.stat().st_size
        assert sizes[task] < 0.05 * base.stat().st_size
    assert len({manifest.fingerprint for manifest in manifests.values()}) == len(TASKS)


def test_a_standalone_set_outlives_its_base(smoke: Path) -> None:
    expected = cudc_bench.load_transitions(relabeled("walk"))
    cudc_bench.relabel(BASE, ["walk"], standalone=True, overwrite=True)
    with h5py.File(smoke / relabeled("walk") / "data" / "main_data.hdf5") as file:
        assert all(file["episode_0"].get(name, getlink=True).__class__ is h5py.HardLink for name in file["episode_0"])
    dataset_path(BASE).rename(smoke / "elsewhere")
    found = cudc_bench.load_transitions(relabeled("walk"), verify=True)
    assert found.observations.tobytes() == expected.observations.tobytes()
    assert found.rewards.tobytes() == expected.rewards.tobytes()


def test_relabelling_leaves_the_base_as_it_was(smoke: Path, collected_once: Path) -> None:
    cudc_bench.relabel(BASE, overwrite=True)
    for name in ("main_data.hdf5", "metadata.json"):
        assert (smoke / BASE / "data" / name).read_bytes() == (collected_once / BASE / "data" / name).read_bytes()


def test_a_linked_set_names_its_base(smoke: Path) -> None:
    manifest = read_manifest(relabeled("flip"))
    assert manifest.base is not None
    assert (manifest.base.id, manifest.base.linked) == (BASE, True)
    assert manifest.base.fingerprint == read_manifest(BASE).fingerprint
    assert manifest.task == "flip"
    assert manifest.fields.keys() == read_manifest(BASE).fields.keys()
    changed = {name for name, digest in manifest.fields.items() if digest != read_manifest(BASE).fields[name]}
    assert changed == {"rewards"}
    metadata = json.loads((smoke / relabeled("flip") / "data" / "metadata.json").read_text())
    assert metadata["combined_datasets"] == [BASE]


def test_a_moved_root_still_links(smoke: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = smoke.with_name("moved")
    smoke.rename(moved)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(moved))
    assert minari.load_dataset(relabeled("run"))[2].observations.shape == (1001, 24)


def test_a_missing_base_is_named_in_one_line(smoke: Path) -> None:
    dataset_path(BASE).rename(smoke / "elsewhere")
    with pytest.raises(RunError, match=rf"^'{relabeled('walk')}' links to '{BASE}', which is missing; .*--standalone\.$") as caught:
        cudc_bench.load_transitions(relabeled("walk"))
    assert "\n" not in str(caught.value)


def test_a_base_with_other_content_is_refused(smoke: Path) -> None:
    cudc_bench.collect("random", profile="smoke", dataset_id=BASE, overwrite=True)
    with pytest.raises(RunError, match=rf"^'{relabeled('walk')}' was made from another '{BASE}'; .*--overwrite\.$"):
        cudc_bench.load_transitions(relabeled("walk"))
    cudc_bench.relabel(BASE, ["walk"], overwrite=True)
    found = cudc_bench.load_transitions(relabeled("walk"), verify=True)
    assert found.actions.tobytes() == load_episodes(BASE, ("actions",)).arrays["actions"].tobytes()


def test_relabelling_a_relabelled_set_is_refused(smoke: Path) -> None:
    with pytest.raises(UsageError, match=rf"'{relabeled('walk')}' is already relabelled for walk; relabel its base of '{BASE}'\."):
        cudc_bench.relabel(relabeled("walk"))
    assert not (smoke / "walker" / "walk" / "walk").exists()


def test_existing_sets_are_refused_before_any_is_written(smoke: Path) -> None:
    gone = smoke / relabeled("stand")
    gone.rename(smoke / "elsewhere")
    with pytest.raises(UsageError, match=f"'{relabeled('walk')}' exists"):
        cudc_bench.relabel(BASE, ["stand", "walk"], standalone=True)
    assert not gone.exists()


def test_what_exists_already_is_kept(smoke: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(smoke / relabeled("stand"))
    made = read_manifest(relabeled("walk")).created, (smoke / relabeled("walk") / "data").stat().st_mtime_ns
    assert cudc_bench.relabel(BASE, ["stand", "walk"]) == [relabeled("stand"), relabeled("walk")]
    assert (read_manifest(relabeled("walk")).created, (smoke / relabeled("walk") / "data").stat().st_mtime_ns) == made
    assert "walker/walk/cudc-smoke-v0 was made from this very base: kept\n" in capsys.readouterr().err
    assert (smoke / relabeled("stand") / "data").is_dir()


def test_tasks_come_in_the_domains_order_whatever_was_asked(smoke: Path) -> None:
    assert cudc_bench.relabel(BASE, ["flip", "stand", "flip"], overwrite=True) == [relabeled("stand"), relabeled("flip")]
    with pytest.raises(UsageError, match="unknown walker task 'fly'; allowed: flip, run, stand, walk"):
        cudc_bench.relabel(BASE, ["stand", "fly"])
    with pytest.raises(UsageError, match="no task was given"):
        cudc_bench.relabel(BASE, [])


def test_the_reward_of_a_step_is_that_of_the_state_which_it_led_to(smoke: Path) -> None:
    """Row t of the rewards belongs to row t + 1 of the states."""
    flat = load_episodes(BASE, ("infos/physics",))
    relabeler = relabeler_of("walker")
    for index, states in enumerate(flat.split("infos/physics")):
        expected = relabeler.rewards(states, np.zeros((len(states), 6), np.float32)).astype(np.float32)
        for column, task in enumerate(TASKS):
            found = minari.load_dataset(relabeled(task))[index].rewards
            assert found.tobytes() == expected[1:, column].tobytes()
            assert found.tobytes() != expected[:-1, column].tobytes()
