"""Tasks of any domain whose physical quantities follow from the state alone, by its own simulator."""

from __future__ import annotations

import numpy as np

from cudc_bench.envs import Domain, make_simulators
from cudc_bench.envs.simulator import Float32, Float64

from .base import Relabeler


class StateRelabeler(Relabeler):
    """Sets each state and reads the quantities: for domains of other packages, which need no relabeler of their own."""

    def __init__(self, domain: Domain) -> None:
        super().__init__(domain)
        (self.simulator,) = make_simulators(domain.name, 1)

    def quantities(self, states: Float64, actions: Float32) -> Float64:
        out = np.empty((len(states), len(self.domain.quantities)), np.float64)
        for state, row in zip(np.ascontiguousarray(states, np.float64), out, strict=True):
            self.simulator.set_state(state)
            self.simulator.quantities(row)
        return out
