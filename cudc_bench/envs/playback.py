"""Holds a stored episode against the simulator: repeated from its seed, and step by step from its stored states.

Repeating is the stronger test and comes first: from the seed and the actions alone it gives every state and every observation, bit for
bit on the machine and versions that collected them. Elsewhere rounding differs, which a simulation amplifies, and imported episodes
have no seed. Then each stored action is applied to its stored state, and the differences of the next stored states from what follows are
added up. Rounding goes up and down and stays small; who pulls an episode somewhere, however gently, pulls in one direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cudc_bench.envs.domains import STEP_TOLERANCE, Domain
from cudc_bench.envs.registry import make_simulators
from cudc_bench.envs.simulator import DivergedError, Float32, Float64

# Relative to 1 + |x|: what different mathematical libraries may do to a float32 observation of the same state, or to a reset.
ROUNDING = 1e-6
_HUGE = 1e10  # MuJoCo takes larger numbers for a divergence


@dataclass(frozen=True)
class Fault:
    """Where an episode contradicts the simulator.

    Attributes:
        row: of the states and observations; row 0 is the reset, and action t leads to row t + 1.
        what: what is stored and what the simulation gives, as a part of a sentence.
    """

    row: int
    what: str


@dataclass(frozen=True)
class Drift:
    """How far an episode's stored states lie from what their predecessors lead to, relative to 1 + their size.

    Attributes:
        steps: T.
        beyond: how many steps lie further from it than ``STEP_TOLERANCE`` in any dimension.
        largest: of all steps and dimensions.
        accumulated: the largest size, at any time and in any dimension, of the signed errors added up since the reset; divided by the steps
            until then, it is their mean.
    """

    steps: int
    beyond: int
    largest: float
    accumulated: float


@dataclass(frozen=True)
class Verdict:
    """How an episode stood the test.

    Attributes:
        inexact: the first row that differs in any bit from a repetition from the seed; None when all are the same.
        fault: the first contradiction that rounding cannot explain.
        drift: of an episode that was followed step by step, without a fault.
    """

    inexact: Fault | None
    fault: Fault | None
    drift: Drift | None = None


class Playback:
    """Tests episodes of one domain.

    Args:
        domain: whose.
    """

    def __init__(self, domain: Domain) -> None:
        self._domain = domain
        (self._simulator,) = make_simulators(domain.name, 1)
        self._state = np.empty(domain.physics_size, np.float64)
        self._observation = np.empty(domain.observation_size, np.float32)
        self._visible = np.ones(domain.observation_size, np.bool_)
        for start, stop in domain.beyond_state:
            self._visible[start:stop] = False

    def test(self, seed: int | None, states: Float64, actions: Float32, observations: Float32, *, exact: bool = False) -> Verdict:
        """Test an episode of T steps whose numbers are all finite.

        Args:
            seed: with which it was reset; None where that is not known.
            states: (T+1, P) float64.
            actions: (T, A) float32.
            observations: (T+1, S) float32.
            exact: it was made by the arithmetic of this machine, so that no rounding explains anything: any other bit is a contradiction.
        """
        if seed is None:
            return self._follow(Fault(0, "the seed is not known"), seed, states, actions, observations)
        found, seen = self._repeat(seed, actions)
        same = (found == states).all(axis=1)
        different = np.flatnonzero(~(same & (seen == observations).all(axis=1)))
        if not len(different):
            return Verdict(None, None)
        inexact = self._describe(int(different[0]), states, found, observations, seen)
        if exact:
            return Verdict(inexact, inexact)
        # A simulation that has left its course by rounding never comes back to the last bit: a row that differs before one that is
        # the same was changed by itself. So was an observation that does not belong to a state which is the same.
        last = int(np.flatnonzero(same)[-1]) if same.any() else -1
        changed = ~same
        changed[last + 1 :] = False
        changed |= same & (_excess(observations, seen, ROUNDING) > 0).any(axis=1)
        if changed.any():
            return Verdict(inexact, self._describe(int(np.flatnonzero(changed)[0]), states, found, observations, seen))
        return self._follow(inexact, seed, states, actions, observations)

    def _repeat(self, seed: int, actions: Float32) -> tuple[Float64, Float32]:
        """States and observations from a seed and actions; rows after a divergence are NaN."""
        states = np.full((len(actions) + 1, len(self._state)), np.nan, np.float64)
        observations = np.full((len(actions) + 1, len(self._observation)), np.nan, np.float32)
        self._simulator.reset(seed)
        for t in range(len(actions) + 1):
            self._simulator.state(states[t])
            self._simulator.observe(observations[t])
            if t < len(actions):
                try:
                    self._simulator.step(actions[t])
                except DivergedError:
                    break
        return states, observations

    def _follow(self, inexact: Fault, seed: int | None, states: Float64, actions: Float32, observations: Float32) -> Verdict:
        """Step from each stored state to the next, carrying the solver's warm start along."""
        simulator, limit = self._simulator, self._domain.drift_tolerance
        total, beyond, largest, accumulated = np.zeros(len(self._state)), 0, 0.0, 0.0
        if seed is not None:
            # Also for what else a reset draws beside the state.
            simulator.reset(seed)
            simulator.state(self._state)
            if fault := _compare(0, "state", states[0], self._state, ROUNDING, "its seed gives"):
                return Verdict(inexact, fault)
        for t, state in enumerate(states):
            if not (np.abs(state) < _HUGE).all():
                what = f"state {int(np.argmax(np.abs(state)))} is {np.abs(state).max():.3g}, beyond what can be simulated"
                return Verdict(inexact, Fault(t, what))
            try:
                if t == 0 and seed is None:
                    simulator.set_state(state)
                simulator.overwrite_state(state)
            except DivergedError:
                return Verdict(inexact, Fault(t, "its state cannot be simulated"))
            simulator.observe(self._observation)
            there, expected = observations[t], np.where(self._visible, self._observation, observations[t])
            if fault := _compare(t, "observation", there, expected, ROUNDING, "its state gives"):
                return Verdict(inexact, fault)
            if t == len(actions):
                break
            try:
                simulator.step(actions[t])
            except DivergedError:
                return Verdict(inexact, Fault(t + 1, f"action {t} makes the simulation diverge"))
            simulator.state(self._state)
            if fault := _compare(t + 1, "state", states[t + 1], self._state, limit, f"action {t} leads to"):
                return Verdict(inexact, fault)
            error = (states[t + 1] - self._state) / (1.0 + np.abs(states[t + 1]))
            total += error
            size, pulled = float(np.abs(error).max()), int(np.argmax(np.abs(total)))
            beyond, largest = beyond + (size > STEP_TOLERANCE), max(largest, size)
            accumulated = max(accumulated, abs(float(total[pulled])))
            if accumulated > limit:
                what = (
                    f"the errors of state {pulled} over {t + 1:,} steps add up to {total[pulled]:.3g} (a mean of"
                    f" {total[pulled] / (t + 1):.2g}), where rounding makes {limit:g} at most: it was pulled away from the simulation"
                )
                return Verdict(inexact, Fault(t + 1, what))
        return Verdict(inexact, None, Drift(len(actions), beyond, largest, accumulated))

    def _describe(self, row: int, states: Float64, found: Float64, observations: Float32, seen: Float32) -> Fault:
        for name, there, expected in (("state", states[row], found[row]), ("observation", observations[row], seen[row])):
            if fault := _compare(row, name, there, expected, 0.0, "repeated from the seed it is"):
                return fault
        raise AssertionError("the row is the same")


def _excess(there: NDArray[Any], expected: NDArray[Any], tolerance: float) -> Float64:
    """By how much numbers differ, relative to 1 + their size, beyond a tolerance; inf for NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        wide = there.astype(np.float64)
        return np.nan_to_num(np.abs(wide - expected) / (1.0 + np.abs(wide)) - tolerance, nan=np.inf)


def _compare(row: int, name: str, there: NDArray[Any], expected: NDArray[Any], tolerance: float, source: str) -> Fault | None:
    excess = _excess(there, expected, tolerance)
    worst = int(np.argmax(excess))
    if excess[worst] <= 0.0:
        return None
    digits = 17 if there.dtype == np.float64 else 9
    return Fault(row, f"{name} {worst} is {there[worst]:.{digits}g}, but {source} {expected[worst]:.{digits}g}")
