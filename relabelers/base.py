"""What every relabeler offers: rewards of all tasks of a domain from stored physics states."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import mujoco
import numpy as np

from cudc_bench.envs import check_domain, reward_function, simulator_class
from cudc_bench.envs.simulator import Float64


class Relabeler(ABC):
    """Computes what rewards depend on by the shortest exact part of MuJoCo's forward pass.

    Rewards depend on the state alone, so that no dynamics, contacts or actuators need computing.
    """

    domain: ClassVar[str]

    def __init__(self) -> None:
        self.tasks = check_domain(self.domain).tasks
        self.simulator = simulator_class(self.domain)()
        self._rewards = reward_function(self.domain)

    @abstractmethod
    def refresh(self) -> None:
        """Bring what the domain's physical quantities are read from up to date with the state that was just set."""

    def quantities(self, states: Float64) -> Float64:
        """The domain's physical quantities (N, Q) of states (N, P)."""
        model, data = self.simulator.model, self.simulator.data
        kind, width = int(mujoco.mjtState.mjSTATE_PHYSICS), len(self.simulator.quantity_names)
        out = np.empty((len(states), width), np.float64)
        for state, row in zip(np.ascontiguousarray(states, np.float64), out, strict=True):
            mujoco.mj_setState(model, data, state, kind)
            self.refresh()
            self.simulator.quantities(row)
        return out

    def rewards(self, states: Float64) -> Float64:
        """Rewards (N, tasks) of states (N, P), in the order of the domain's tasks.

        The reward of a transition is that of the state it leads to, as in dm_control.
        """
        return self._rewards(self.quantities(states))
