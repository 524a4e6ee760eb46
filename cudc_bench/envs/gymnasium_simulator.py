"""Gymnasium's MuJoCo environments as domains: any that can be set to a state.

A package names such a domain in the group ``cudc_bench.domains`` of its entry points; docs/tutorials/own-domain.md shows how.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import gymnasium
import mujoco
import numpy as np

from cudc_bench.envs.domains import Domain
from cudc_bench.envs.simulator import Float32, Float64, Simulator, action_map, diverged
from cudc_bench.errors import RunError, UsageError


class GymnasiumSimulator(Simulator):
    """An environment that derives from Gymnasium's ``MujocoEnv``. Subclasses name it and read its physical quantities.

    The state (P,) is positions and velocities. Rewards of the environment are never read: those of a domain are functions of its physical
    quantities, which must follow from the state.

    Class attributes:
        environment: Gymnasium's id.
        arguments: of its constructor; none of its own ends may be left on (``terminate_when_unhealthy=False``).

    Raises:
        UsageError: the environment is not such a one, or its sizes are not those of the domain.
    """

    environment: ClassVar[str]
    arguments: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, domain: Domain) -> None:
        self.domain = domain
        self._env: Any = gymnasium.make(self.environment, **self.arguments).unwrapped
        if not all(hasattr(self._env, name) for name in ("set_state", "model", "data", "_get_obs")):
            raise UsageError(f"{self.environment}, of the domain '{domain.name}', is no MuJoCo environment that can be set to a state.")
        self.model, self.data = self._env.model, self._env.data
        self._warnings = self.data.warning.number
        self._native = action_map(self._env.action_space.low.astype(np.float64), self._env.action_space.high.astype(np.float64))
        self.reset(0)
        there = (self._observation.size, self._env.action_space.shape[0], self.model.nq + self.model.nv)
        if self.model.na or there != (domain.observation_size, domain.action_size, domain.physics_size):
            raise UsageError(
                f"the domain '{domain.name}' says observation, action and state of {domain.observation_size}, {domain.action_size} and "
                f"{domain.physics_size} numbers; {self.environment} has {there[0]}, {there[1]} and {there[2]}"
                + (f", and {self.model.na} activations, which it cannot be set to." if self.model.na else ".")
            )

    @classmethod
    def make(cls, domain: Domain, count: int) -> list[Self]:
        return [cls(domain) for _ in range(count)]

    @abstractmethod
    def quantities(self, out: Float64) -> None:
        """Write the physical quantities (Q,), read from ``self.data``, in which all that the state determines is up to date."""

    def reset(self, seed: int) -> None:
        self._env.reset(seed=seed)
        self._refresh()
        self._observation: Float64 = self._env._get_obs()

    def step(self, action: Float32 | Float64) -> None:
        _, _, terminated, _, _ = self._env.step(self._native(action))
        if self._warnings.any():
            names = [mujoco.mjtWarning(i).name for i in np.flatnonzero(self._warnings)]
            raise diverged(self.domain.name, ", ".join(names))
        if terminated:
            raise RunError(f"{self.environment} ended an episode by itself, but a time limit alone may end those of '{self.domain.name}'.")
        self._refresh()
        self._observation = self._env._get_obs()

    def observe(self, out: Float32) -> None:
        out[:] = self._observation

    def state(self, out: Float64) -> None:
        out[: self.model.nq], out[self.model.nq :] = self.data.qpos, self.data.qvel

    def set_state(self, state: Float64) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.overwrite_state(state)

    def overwrite_state(self, state: Float64) -> None:
        self._env.set_state(state[: self.model.nq].copy(), state[self.model.nq :].copy())
        self._refresh()
        self._observation = self._env._get_obs()

    @property
    def timestep(self) -> float:
        return float(self._env.dt)

    @property
    def compiled(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        return self.model, self.data

    def _refresh(self) -> None:
        """What depends on positions and velocities is a physics step behind after Gymnasium's step; the next step computes it anew."""
        mujoco.mj_step1(self.model, self.data)
