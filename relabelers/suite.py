"""Tasks of any domain of dm_control's suite from physics states, by dm_control's own route."""

from __future__ import annotations

import numpy as np

from cudc_bench.envs import Domain, make_simulators
from cudc_bench.envs.simulator import Float32, Float64
from cudc_bench.envs.suite import SuiteSimulator

from .base import Relabeler


class SuiteRelabeler(Relabeler):
    """Sets each state and the action that led to it, computes the dynamics anew, and asks dm_control's tasks, as ExORL does.

    Slower than a domain's own relabeler, which computes only what rewards depend on; a trial has shown that the rewards are the live
    ones (see :func:`~cudc_bench.envs.suite.suite_domain`).
    """

    def __init__(self, domain: Domain) -> None:
        super().__init__(domain)
        (simulator,) = make_simulators(domain.name, 1)
        assert isinstance(simulator, SuiteSimulator)
        self.simulator = simulator

    def quantities(self, states: Float64, actions: Float32) -> Float64:
        out = np.empty((len(states), len(self.domain.quantities)), np.float64)
        for state, action, row in zip(states, actions, out, strict=True):
            self.simulator.set_outcome(state, action)
            self.simulator.quantities(row)
        return out
