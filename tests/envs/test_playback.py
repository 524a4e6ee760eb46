"""Stored episodes against the simulator: what is true passes bit for bit, and one wrong number does not."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from cudc_bench.envs import DOMAINS, make_simulators
from cudc_bench.envs.playback import Playback

STEPS, SEED = 120, 7


class Lived(NamedTuple):
    """An episode as a collector stores it."""

    states: np.ndarray
    actions: np.ndarray
    observations: np.ndarray


@pytest.fixture(params=DOMAINS, scope="module")
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def playback(name: str) -> Playback:
    return Playback(DOMAINS[name])


@pytest.fixture(scope="module")
def once(name: str) -> Lived:
    facts, generator = DOMAINS[name], np.random.default_rng(1)
    (simulator,) = make_simulators(name, 1)
    rates = generator.uniform(0.05, 0.6, facts.action_size)
    actions = np.sign(np.sin(rates * np.arange(STEPS)[:, None])).astype(np.float32) * np.float32(0.9)
    states = np.empty((STEPS + 1, facts.physics_size))
    observations = np.empty((STEPS + 1, facts.observation_size), np.float32)
    simulator.reset(SEED)
    for t in range(STEPS + 1):
        simulator.state(states[t])
        simulator.observe(observations[t])
        if t < STEPS:
            simulator.step(actions[t])
    return Lived(states, actions, observations)


@pytest.fixture
def lived(once: Lived) -> Lived:
    return Lived(*(array.copy() for array in once))


def test_a_step_from_a_state_that_was_set_leads_to_the_next_state(name: str, lived: Lived) -> None:
    """In each domain, also where actuators depend on velocities; but for the solver's warm start the simulation goes on as it did."""
    (simulator,), found = make_simulators(name, 1), np.empty(DOMAINS[name].physics_size)
    for t in range(STEPS):
        simulator.set_state(lived.states[t])
        simulator.step(lived.actions[t])
        simulator.state(found)
        np.testing.assert_allclose(found, lived.states[t + 1], rtol=1e-3, atol=1e-3)
    # Correcting a state with itself changes nothing at all.
    simulator.reset(SEED)
    for t in range(STEPS):
        simulator.overwrite_state(lived.states[t])
        simulator.step(lived.actions[t])
        simulator.state(found)
        assert found.tobytes() == lived.states[t + 1].tobytes()


def test_a_true_episode_passes(playback: Playback, lived: Lived) -> None:
    before = [array.tobytes() for array in lived]
    verdict = playback.test(SEED, *lived)
    assert (verdict.inexact, verdict.fault) == (None, None)
    verdict = playback.test(None, *lived)
    assert verdict.fault is None
    assert verdict.inexact is not None
    assert [array.tobytes() for array in lived] == before


def test_another_seed_or_another_order_of_actions_does_not(playback: Playback, lived: Lived) -> None:
    fault = playback.test(SEED + 1, *lived).fault
    assert fault is not None
    assert fault.row == 0
    shifted = lived._replace(actions=np.roll(lived.actions, 40, axis=0))
    first = int(np.flatnonzero((shifted.actions != lived.actions).any(axis=1))[0])
    for seed in (SEED, None):
        fault = playback.test(seed, *shifted).fault
        assert fault is not None
        # The joints of a free body may need a step until they feel it.
        assert first < fault.row <= first + 10


@pytest.mark.parametrize("row", [0, 1, 60, STEPS])
def test_a_wrong_state_is_found_where_it_is(row: int, playback: Playback, lived: Lived) -> None:
    lived.states[row, 3] += 1.5
    for seed in (SEED, None):
        fault = playback.test(seed, *lived).fault
        assert fault is not None
        assert fault.row == row


@pytest.mark.parametrize("row", [0, 60, STEPS])
def test_a_wrong_observation_is_found_where_it_is(row: int, name: str, playback: Playback, lived: Lived) -> None:
    """Also one that no state determines, as long as the seed is known."""
    hidden = [index for start, stop in DOMAINS[name].beyond_state for index in range(start, stop)]
    for index in range(DOMAINS[name].observation_size):
        changed = lived._replace(observations=lived.observations.copy())
        changed.observations[row, index] += 0.01 * (1 + abs(changed.observations[row, index]))
        if index in {0, 4, 13, DOMAINS[name].observation_size - 1, *hidden[:1]}:
            fault = playback.test(SEED, *changed).fault
            assert fault is not None
            assert (fault.row, f"observation {index} is " in fault.what) == (row, True)
            assert (playback.test(None, *changed).fault is None) == (index in hidden)


def test_what_cannot_be_simulated_is_a_fault(playback: Playback, lived: Lived, tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(str(tmp_path))
    for value in (1e11, 1e300):
        lived.states[30, 0] = value
        for seed in (SEED, None):
            fault = playback.test(seed, *lived).fault
            assert fault is not None
            assert fault.row == 30


def test_the_state_determines_what_is_not_marked_as_beyond_it(name: str, lived: Lived) -> None:
    (simulator,), facts = make_simulators(name, 1), DOMAINS[name]
    found, differed = np.empty(facts.observation_size, np.float32), np.zeros(facts.observation_size, np.bool_)
    for state, observation in zip(lived.states[1:], lived.observations[1:], strict=True):
        simulator.set_state(state)
        simulator.observe(found)
        differed |= found != observation
    hidden = {index for start, stop in facts.beyond_state for index in range(start, stop)}
    assert set(np.flatnonzero(differed)) <= hidden
    assert bool(differed.any()) == bool(hidden)
