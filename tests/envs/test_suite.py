"""Domains of dm_control's suite through Shimmy, against plain environments of the suite that are stepped beside them."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
from dm_control import suite
from dm_control.rl import control
from dm_control.suite import cheetah, hopper
from dm_control.suite.wrappers import action_scale

from cudc_bench import plugins
from cudc_bench.artefacts.ids import default_id, domain_namespace, domain_slug, parse_id
from cudc_bench.envs import Domain, check_domain, check_tasks, env_spec, make_simulators, reward_function
from cudc_bench.envs.domains import SUITE
from cudc_bench.envs.simulator import DivergedError, Simulator
from cudc_bench.envs.suite import SuiteSimulator, suite_domain, suite_names
from cudc_bench.errors import RunError, UsageError

# One of several tasks, whose rewards depend on actions and whose touch sensors lag; one whose actions are scaled.
NAMES = ["cheetah-run", "hopper-hop", "quadruped-walk"]


def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
    """In the order in which dm_control gives its parts, as stored."""
    return np.concatenate([np.ravel(part) for part in observation.values()]).astype(np.float32)


def plain(name: str, seed: int) -> control.Environment:
    """The suite's own environment with actions in [-1, 1]."""
    return action_scale.Wrapper(suite.load(*name.split("-"), task_kwargs={"random": seed}), -1.0, 1.0)


def actions(size: int, count: int, seed: int = 0) -> np.ndarray:
    """Uniform actions, then full-range oscillations."""
    random = np.random.default_rng(seed)
    rates = random.uniform(0.05, 0.6, size)
    swinging = np.sign(np.sin(rates * np.arange(count // 2)[:, None]))
    return np.concatenate([random.uniform(-1, 1, (count - count // 2, size)), swinging]).astype(np.float32)


def read(simulator: Simulator, facts: Domain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observation, state and rewards."""
    observation, state = np.full(facts.observation_size, np.nan, np.float32), np.full(facts.physics_size, np.nan)
    quantities = np.full(len(facts.quantities), np.nan)
    simulator.observe(observation)
    simulator.state(state)
    simulator.quantities(quantities)
    return observation, state, reward_function(facts.name)(quantities)


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_is_dm_controls_bit_for_bit_and_relabelling_gives_its_rewards(name: str) -> None:
    facts = check_domain(SUITE + name)
    theirs, (ours,) = plain(name, 0), make_simulators(facts.name, 1)
    ours.reset(3)
    ours.step(np.ones(facts.action_size, np.float32))  # what was before a reset leaves no trace
    ours.reset(0)
    step, chosen = theirs.reset(), actions(facts.action_size, facts.episode_length)
    states, live, column = [], [], facts.tasks.index(name.split("-")[1])
    for action in chosen:
        assert not step.last()
        observation, state, _ = read(ours, facts)
        assert observation.tobytes() == flat(step.observation).tobytes()
        assert state.tobytes() == theirs.physics.get_state().tobytes()
        ours.step(action)
        step = theirs.step(action)
        _, state, rewards = read(ours, facts)
        assert rewards[column] == step.reward
        states.append(state)
        live.append(rewards)
    assert step.last()
    assert step.discount == 1.0
    relabelled = plugins.load("relabelers", facts.relabeler)(facts).rewards(np.stack(states), chosen)
    assert relabelled.tobytes() == np.stack(live).tobytes()
    assert (np.ptp(relabelled, axis=0) > 1e-3).all(), "this episode does not exercise the rewards"


def test_the_thin_walker_and_the_suites_are_the_same() -> None:
    facts, thin = check_domain(f"{SUITE}walker-walk"), check_domain("walker")
    (theirs,), (ours,) = make_simulators(facts.name, 1), make_simulators(thin.name, 1)
    assert facts.tasks == thin.tasks[:3] == ("stand", "walk", "run")
    for seed in (0, 2**40 + 1):
        theirs.reset(seed)
        ours.reset(seed)
        for action in actions(6, 200, seed):
            for a, b in zip(read(theirs, facts), read(ours, thin), strict=True):
                assert a.tobytes() == b[: len(a)].tobytes()
            theirs.step(action)
            ours.step(action)


def test_rewards_of_another_task_are_those_of_its_own_environment() -> None:
    """Hop's, while exploring with stand's initial states; each task's own environment is put into the same state."""
    facts = check_domain(f"{SUITE}hopper-stand")
    (ours,), own = make_simulators(facts.name, 1), suite.load("hopper", "hop")
    own.reset()
    ours.reset(0)
    rewards = []
    for action in actions(4, 1000):
        before = read(ours, facts)[1]
        ours.set_state(before)
        ours.step(action)
        with own.physics.reset_context():
            own.physics.set_state(before)
        own.physics.forward()
        rewards.append((read(ours, facts)[2][facts.tasks.index("hop")], own.step(action).reward))
    ours_, theirs = np.array(rewards).T
    assert ours_.tolist() == theirs.tolist()
    assert np.ptp(theirs) > 0


@pytest.mark.parametrize(
    ("name", "tasks", "excluded"),
    [
        ("cheetah-run", ("run",), {}),
        ("ball_in_cup-catch", ("catch",), {}),
        ("cartpole-balance", ("balance", "balance_sparse", "swingup", "swingup_sparse"), {"two_poles": "model", "three_poles": "model"}),
        ("finger-spin", ("spin",), {"turn_easy": "model", "turn_hard": "model"}),
        ("finger-turn_easy", (), {"spin": "model", "turn_easy": "target", "turn_hard": "target"}),
        ("fish-swim", ("upright",), {"swim": "target"}),
        ("reacher-hard", (), {"easy": "target", "hard": "target"}),
        ("point_mass-easy", ("easy",), {"hard": "model"}),
        ("point_mass-hard", (), {"easy": "model", "hard": "model"}),
        ("manipulator-bring_ball", (), {"bring_ball": "target", "bring_peg": "model", "insert_ball": "model", "insert_peg": "model"}),
    ],
)
def test_only_tasks_whose_rewards_follow_from_states_belong(name: str, tasks: tuple[str, ...], excluded: dict[str, str]) -> None:
    facts = check_domain(SUITE + name)
    assert facts.tasks == tasks
    assert len(facts.quantities) == len(tasks)
    assert facts.excluded.keys() == excluded.keys()
    for task, word in excluded.items():
        assert word in facts.excluded[task]
        with pytest.raises(UsageError, match=f"{task}.*{word}"):
            check_tasks(facts, [task])
    if not tasks:
        with pytest.raises(UsageError, match=r"has no task that can be relabelled .* give a reward of your own \(--reward\)"):
            check_tasks(facts, None)


def test_a_target_drawn_at_reset_really_is_missing_from_the_state() -> None:
    """Why reacher is excluded, seen without any code of ours."""
    environment, rewards = suite.load("reacher", "easy", task_kwargs={"random": 0}), []
    for _ in range(60):
        environment.reset()
        with environment.physics.reset_context():
            environment.physics.set_state(np.array([0.0, 1.5, 0.0, 0.0]))
        rewards.append(environment.task.get_reward(environment.physics))
    assert set(rewards) == {0.0, 1.0}


def test_observations_that_no_state_determines_are_found() -> None:
    """The thin quadruped's were measured; these are found by changing nothing but what MuJoCo computes last."""
    assert check_domain(f"{SUITE}quadruped-walk").beyond_state == check_domain("quadruped").beyond_state
    assert check_domain(f"{SUITE}hopper-hop").beyond_state == ((13, 15),)  # the touch sensors
    assert check_domain(f"{SUITE}cheetah-run").beyond_state == ()


@pytest.mark.parametrize("name", ["cheetah-run", "hopper-hop"])
def test_a_state_that_is_set_leads_on_as_the_live_one_did(name: str) -> None:
    facts = check_domain(SUITE + name)
    live, other = make_simulators(facts.name, 2)
    live.reset(1)
    other.reset(2)
    # More steps than an episode has: only reset starts a new one.
    for t, action in enumerate(actions(facts.action_size, 1100)):
        observation, state, _ = read(live, facts)
        if t % 50 == 0:
            other.set_state(state)
        else:
            other.overwrite_state(state)
        found = read(other, facts)
        assert found[1].tobytes() == state.tobytes()
        seen = np.ones(facts.observation_size, np.bool_)
        for start, stop in facts.beyond_state:
            seen[start:stop] = False
        np.testing.assert_allclose(found[0][seen], observation[seen], rtol=1e-6, atol=1e-6)
        live.step(action)
        other.step(action)
        np.testing.assert_allclose(read(other, facts)[1], read(live, facts)[1], rtol=1e-4, atol=1e-4)


def test_divergence_is_one_line_and_leaves_no_trace() -> None:
    (simulator,) = make_simulators(f"{SUITE}cheetah-run", 1)
    assert isinstance(simulator, SuiteSimulator)
    simulator.reset(0)
    simulator.physics.data.qvel[3] = 1e12
    with pytest.raises(DivergedError, match=r"the dm_control/cheetah-run simulation diverged \(.*\); run again"):
        simulator.step(np.zeros(6, np.float32))
    fresh = SuiteSimulator(f"{SUITE}cheetah-run")
    for one in (simulator, fresh):
        one.reset(1)
        one.step(np.ones(6, np.float32))
    assert simulator.physics.get_state().tobytes() == fresh.physics.get_state().tobytes()


# -------------------------------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("dm_control/cheetah-rum", r"unknown domain 'dm_control/cheetah-rum'; allowed: .*Did you mean 'dm_control/cheetah-run'\?"),
        ("dm_control/cheetah", r"unknown domain .*Did you mean 'dm_control/cheetah-run'\?"),
        ("dm_control/", "unknown domain 'dm_control/'"),
        ("dm_control/../../etc-passwd", "unknown domain"),
        ("cheetah-run", "unknown domain 'cheetah-run'; allowed: dm_control/<domain>-<task>, "),
        ("dm_control/lqr-lqr_2_1", "has no time limit"),
    ],
)
def test_what_is_no_usable_domain_is_refused(name: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        check_domain(name)


def test_domains_that_end_episodes_by_themselves_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    suite_domain.cache_clear()
    monkeypatch.setattr(cheetah.Cheetah, "get_termination", lambda self, physics: 0.0, raising=False)
    with pytest.raises(UsageError, match="'dm_control/cheetah-run' ends episodes by itself"):
        check_domain("dm_control/cheetah-run")
    # If it did so unannounced, it would not pass unnoticed either.
    simulator = SuiteSimulator("dm_control/cheetah-run")
    with pytest.raises(RunError, match="ended an episode by itself"):
        simulator.step(np.zeros(6, np.float32))


def test_a_task_whose_reward_never_changes_in_the_trial_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    suite_domain.cache_clear()
    monkeypatch.setattr(hopper.Hopper, "get_reward", lambda self, physics: 0.0)
    facts = check_domain("dm_control/hopper-hop")
    suite_domain.cache_clear()
    assert facts.tasks == ()
    assert all("never changed" in reason for reason in facts.excluded.values())


# ----------------------------------------------------------------------------------------------------------------------------- names


def test_names_become_dataset_ids_slugs_and_environments_without_clashes() -> None:
    names = suite_names()
    assert len({domain_namespace(name) for name in names}) == len({domain_slug(name) for name in names}) == len(names) > 40
    for name in names:
        one = default_id(name, "cudc", 2, "smoke")
        assert one == parse_id(str(one))
        assert one.for_task("run").namespace == f"{domain_namespace(name)}/run"
        assert "/" not in domain_slug(name)
    assert str(default_id("dm_control/humanoid_CMU-run", "cudc", 1, "smoke")) == "dm_control/humanoid_cmu_run/cudc-smoke-v0"
    assert str(default_id("walker", "cudc", 1, "smoke")) == "walker/cudc-smoke-v0"
    assert domain_slug("walker") == "walker"


@pytest.mark.parametrize("task", [None, "run"])
def test_an_environment_is_made_from_its_stored_specification_alone(task: str | None, python: Callable) -> None:
    spec = env_spec("dm_control/cheetah-run", task)
    assert gymnasium.envs.registration.EnvSpec.from_json(spec.to_json()) == spec
    assert spec.id not in gymnasium.registry
    script = """
import sys, gymnasium
environment = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(sys.argv[1]))
observation, info = environment.reset(seed=7)
print(environment.spec.id, environment.spec.max_episode_steps, observation.shape, observation.dtype, info["physics"].shape)
low = environment.action_space.low
print(sum(environment.step(low * (-1) ** (t // 5))[1] for t in range(60)))
"""
    done = python(script, spec.to_json())
    assert (done.code, done.err) == (0, "")
    first, total = done.out.splitlines()
    assert first == f"cudc_bench/dm_control.cheetah-run{'-run' if task else ''}-v0 1000 (17,) float32 (18,)"
    oracle = plain("cheetah-run", 7)
    oracle.reset()
    expected = sum(oracle.step(-np.ones(6) * (-1) ** (t // 5)).reward for t in range(60))
    assert float(total) == pytest.approx(expected if task else 0.0, rel=1e-12)
    assert expected > 0
