"""The Gymnasium face of a simulator, for users and for ``dataset.recover_environment()``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from cudc_bench.envs.registry import check_domain, check_tasks, make_simulators, reward_function
from cudc_bench.envs.rewards import Measured, load_reward
from cudc_bench.envs.simulator import Float32


def observation_space(domain: str) -> Box:
    """Flat, unbounded float32 observations (S,)."""
    return Box(-np.inf, np.inf, (check_domain(domain).observation_size,), np.float32)


def action_space(domain: str) -> Box:
    """Actions (A,) in [-1, 1], float32."""
    return Box(-1.0, 1.0, (check_domain(domain).action_size,), np.float32)


class SimulatorEnv(gymnasium.Env[Float32, Float32]):
    """A domain, reward-free or with one task's reward.

    The time limit is Gymnasium's ``TimeLimit`` (part of the registered id); the environment itself never ends an episode.
    ``info["physics"]`` is the float64 state (P,) after the step.

    Args:
        domain: such as ``"walker"``.
        task: such as ``"walk"``; None gives reward 0.
        reward: instead of a task, an own reward function as ``module:function`` (see ``cudc_bench.envs.rewards``).
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own attribute

    def __init__(self, domain: str, task: str | None = None, reward: str | None = None) -> None:
        facts = check_domain(domain)
        self._custom = None if reward is None else load_reward(reward, facts)
        self._task = None if task is None else facts.tasks.index(check_tasks(facts, [task])[0])
        self._rewards = reward_function(domain)
        self._simulator = make_simulators(domain, 1)[0]
        self._quantities = np.empty(len(facts.quantities), np.float64)
        self._facts = facts
        self.observation_space = observation_space(domain)
        self.action_space = action_space(domain)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Float32, dict[str, Any]]:
        super().reset(seed=seed)
        self._simulator.reset(int(self.np_random.integers(2**32)) if seed is None else seed)
        return self._observation(), self._info()

    def step(self, action: Float32) -> tuple[Float32, float, bool, bool, dict[str, Any]]:
        self._simulator.step(action)
        observation, info, reward = self._observation(), self._info(), 0.0
        if self._task is not None or self._custom is not None:
            self._simulator.quantities(self._quantities)
        if self._task is not None:
            reward = float(self._rewards(self._quantities)[self._task])
        elif self._custom is not None:
            rows = (self._quantities, info["physics"], np.asarray(action), observation)
            reward = float(self._custom(Measured(self._facts, *(row[None] for row in rows)))[0])
        return observation, reward, False, False, info

    def _observation(self) -> Float32:
        observation = np.empty(self._facts.observation_size, np.float32)
        self._simulator.observe(observation)
        return observation

    def _info(self) -> dict[str, Any]:
        state = np.empty(self._facts.physics_size, np.float64)
        self._simulator.state(state)
        return {"physics": state}
