"""The tests that every domain passes, third parties' included; the only module of this folder that needs pytest.

A package with a domain of its own runs them on it from its own tests::

    from cudc_bench.envs.contract import DomainContract


    class TestHalfCheetah(DomainContract):
        domain = "half_cheetah"

They prove what datasets, relabelling and ``verify`` rest on: sizes, episodes that repeat to the last bit from seed and actions, states that
can be set, and rewards that follow from them.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from cudc_bench import plugins
from cudc_bench.envs import Domain, check_domain, make_simulators, reward_function
from cudc_bench.envs.gym import SimulatorEnv
from cudc_bench.envs.simulator import Float32, Float64, Simulator

_STEPS = 60


def _episode(simulator: Simulator, facts: Domain, seed: int) -> tuple[Float64, Float32, Float32, Float64]:
    """States (T+1, P), observations (T+1, S), actions (T, A) and quantities (T, Q) of an episode of random actions."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (_STEPS, facts.action_size)).astype(np.float32)
    states, quantities = np.empty((_STEPS + 1, facts.physics_size)), np.empty((_STEPS, len(facts.quantities)))
    observations = np.empty((_STEPS + 1, facts.observation_size), np.float32)
    simulator.reset(seed)
    for t in range(_STEPS + 1):
        simulator.state(states[t])
        simulator.observe(observations[t])
        if t < _STEPS:
            simulator.step(actions[t])
            simulator.quantities(quantities[t])
    return states, observations, actions, quantities


class DomainContract:
    """One battery for one registered domain: subclass it under a name that starts with Test, and say its ``domain``.

    Class attributes:
        domain: the name under which it is registered.
    """

    domain: ClassVar[str]

    @pytest.fixture
    def facts(self) -> Domain:
        """The domain under test."""
        return check_domain(self.domain)

    def test_an_episode_repeats_from_its_seed(self, facts: Domain) -> None:
        first, second = make_simulators(facts.name, 2)
        _episode(second, facts, 8)  # what came before must not matter
        parts: list[tuple[NDArray[Any], NDArray[Any]]] = list(zip(_episode(first, facts, 3), _episode(second, facts, 3), strict=True))
        for one, other in parts:
            assert np.isfinite(one).all(), "an episode holds numbers that are not finite"
            assert one.tobytes() == other.tobytes(), "the same seed and actions gave another episode; reset must undo all that was before"
        third = _episode(first, facts, 4)[0]
        assert (third[0] != _episode(first, facts, 3)[0][0]).any(), "another seed gave the same first state"

    def test_a_state_that_is_set_is_the_state_and_leads_on(self, facts: Domain) -> None:
        live, other = make_simulators(facts.name, 2)
        states, observations, actions, _ = _episode(live, facts, 3)
        determined = np.ones(facts.observation_size, np.bool_)
        for start, stop in facts.beyond_state:
            determined[start:stop] = False
        found, seen = np.empty(facts.physics_size), np.empty(facts.observation_size, np.float32)
        drift = np.zeros(facts.physics_size)
        for t in range(_STEPS):
            other.set_state(states[t])
            other.state(found)
            assert found.tobytes() == states[t].tobytes(), "set_state and state must be each other's inverse"
            other.observe(seen)
            hidden = np.flatnonzero(determined & (np.abs(seen - observations[t]) > 1e-6 * (1 + np.abs(seen))))
            assert not len(hidden), f"observations {hidden.tolist()} do not follow from the state; name them in beyond_state"
            other.step(actions[t])
            other.state(found)
            drift += (found - states[t + 1]) / (1 + np.abs(found))
            error = np.abs(drift).max()
            assert error <= facts.drift_tolerance, f"steps from states that were set end {error:.2g} elsewhere in all (drift_tolerance)"

    def test_rewards_follow_from_stored_states(self, facts: Domain) -> None:
        (simulator,) = make_simulators(facts.name, 1)
        states, _, actions, quantities = _episode(simulator, facts, 3)
        live = reward_function(facts.name)(quantities)
        assert live.shape == (_STEPS, len(facts.tasks)), f"rewards are {live.shape}; one a step and task is {(_STEPS, len(facts.tasks))}"
        labelled = plugins.load("relabelers", facts.relabeler)(facts).rewards(states[1:], actions)
        np.testing.assert_allclose(
            labelled, live, rtol=0, atol=1e-6, err_msg="rewards must be functions of the state that an action led to"
        )
        assert (np.abs(live).sum(0) * facts.episode_length / _STEPS <= facts.max_return).all(), "a return can be larger than max_return"

    @pytest.mark.filterwarnings("ignore:.*Box observation space")
    def test_gymnasiums_checker_passes(self, facts: Domain) -> None:
        check_env(SimulatorEnv(facts.name, facts.tasks[0] if facts.tasks else None), skip_render_check=True)
