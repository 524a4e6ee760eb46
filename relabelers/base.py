"""What every relabeler offers: rewards of all tasks of a domain from stored physics states."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from cudc_bench.envs import Domain, make_simulators, reward_function
from cudc_bench.envs.headless import mujoco
from cudc_bench.envs.simulator import PHYSICS, Float32, Float64, MujocoSimulator


class Relabeler(ABC):
    """Computes a domain's physical quantities, and from them its rewards, from stored states.

    Args:
        domain: whose states.
    """

    def __init__(self, domain: Domain) -> None:
        self.domain = domain
        self._rewards = reward_function(domain.name)

    @abstractmethod
    def quantities(self, states: Float64, actions: Float32) -> Float64:
        """The domain's physical quantities (N, Q) of states (N, P) that actions (N, A) led to."""

    def rewards(self, states: Float64, actions: Float32) -> Float64:
        """Rewards (N, tasks), in the order of the domain's tasks.

        The reward of a transition is that of the state it leads to, as in dm_control.

        Args:
            states: (N, P) float64.
            actions: (N, A), which led to those states.
        """
        return self._rewards(self.quantities(states, actions))


class KinematicRelabeler(Relabeler):
    """Computes what rewards depend on by the shortest exact part of MuJoCo's forward pass.

    Rewards depend on the state alone, so that no dynamics, contacts or actuators need computing.
    """

    def __init__(self, domain: Domain) -> None:
        super().__init__(domain)
        (simulator,) = make_simulators(domain.name, 1)
        assert isinstance(simulator, MujocoSimulator)
        self.simulator = simulator

    @abstractmethod
    def refresh(self) -> None:
        """Bring what the domain's physical quantities are read from up to date with the state that was just set."""

    def quantities(self, states: Float64, actions: Float32) -> Float64:
        model, data = self.simulator.model, self.simulator.data
        out = np.empty((len(states), len(self.domain.quantities)), np.float64)
        for state, row in zip(np.ascontiguousarray(states, np.float64), out, strict=True):
            mujoco.mj_setState(model, data, state, PHYSICS)
            self.refresh()
            self.simulator.quantities(row)
        return out
