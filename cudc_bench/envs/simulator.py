"""The thin layer over raw MuJoCo that all fast environments share.

It does what ``dm_control.rl.control.Environment`` does, in the same order and bit for bit, without its named indexing, observation
dictionaries and time steps. The tests hold it against dm_control.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy
from functools import cache
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from cudc_bench.envs.domains import Domain
from cudc_bench.envs.headless import mujoco
from cudc_bench.errors import BrokenDownError

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
PHYSICS = int(mujoco.mjtState.mjSTATE_PHYSICS)
_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)


class DivergedError(BrokenDownError):
    """MuJoCo met a non-finite or huge number; by itself it would have teleported to the initial state and gone on."""


def diverged(domain: str, warnings: str) -> DivergedError:
    """The error for a domain in which MuJoCo gave some warnings."""
    return DivergedError(f"the {domain} simulation diverged ({warnings}); run again with another seed.")


class Simulator(ABC):
    """One simulated body: what collection, evaluation and Gymnasium need of a domain."""

    @classmethod
    @abstractmethod
    def make(cls, domain: Domain, count: int) -> list[Self]:
        """Simulators of a domain that run independently; they may share what is read only."""

    @abstractmethod
    def reset(self, seed: int) -> None:
        """Start an episode from ``numpy.random.RandomState(seed)``; equals dm_control's reset with ``random=seed``.

        Args:
            seed: 0 or more; values of 2**32 and above are split into 32-bit words.
        """

    @abstractmethod
    def step(self, action: Float32 | Float64) -> None:
        """Apply an action (A,) in [-1, 1] for one control step; it is scaled to the actuators' own ranges.

        Raises:
            DivergedError: the simulation became unstable.
        """

    @abstractmethod
    def observe(self, out: Float32) -> None:
        """Write the flat observation (S,) in dm_control's order, cast to float32."""

    @abstractmethod
    def state(self, out: Float64) -> None:
        """Write the physics state (P,): positions, velocities and activations."""

    @abstractmethod
    def set_state(self, state: Float64) -> None:
        """Set the physics state (P,) and bring everything that depends on it up to date, as for the start of a control step."""

    def overwrite_state(self, state: Float64) -> None:
        """Correct the physics state (P,) between two control steps; what a solver remembers of the last one is kept, if possible."""
        self.set_state(state)

    @abstractmethod
    def quantities(self, out: Float64) -> None:
        """Write the physical quantities (Q,) that the domain's rewards are functions of."""

    @property
    @abstractmethod
    def timestep(self) -> float:
        """Seconds that one control step simulates."""

    @property
    @abstractmethod
    def compiled(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """MuJoCo's model and state, as they are: for drawing, and for the names of parts."""


class MujocoSimulator(Simulator):
    """The thin layer over raw MuJoCo. Subclasses give the model, the initial state, the observation and the physical quantities.

    Several simulators may share one compiled model: pass ``model``.

    Attributes:
        domain: the domain's fixed facts.
        substeps: physics steps in a control step, at least 3.
        model: the compiled MuJoCo model, read only.
        data: the MuJoCo state.
    """

    domain: ClassVar[Domain]
    substeps: ClassVar[int]

    def __init__(self, model: mujoco.MjModel | None = None) -> None:
        self.model = self._own_model() if model is None else model
        self.data = mujoco.MjData(self.model)
        self._warnings = self.data.warning.number
        self._native = action_map(*self.model.actuator_ctrlrange.T)

    @classmethod
    def make(cls, domain: Domain, count: int) -> list[Self]:
        model = cls._own_model()
        return [cls(model) for _ in range(count)]

    @classmethod
    def _own_model(cls) -> mujoco.MjModel:
        # To compile a model takes twenty times as long as to copy one.
        return copy(cls._compiled_once())

    @classmethod
    @cache
    def _compiled_once(cls) -> mujoco.MjModel:
        return cls.build_model()

    @classmethod
    @abstractmethod
    def build_model(cls) -> mujoco.MjModel:
        """Compile dm_control's own model of this domain; asked once in a process, whose simulators have copies."""

    @abstractmethod
    def initialise(self, random: np.random.RandomState) -> None:
        """Draw the initial state as dm_control's ``initialize_episode`` does, from a freshly reset ``data``."""

    def reset(self, seed: int) -> None:
        self.restart(random_state(seed))

    def restart(self, random: np.random.RandomState) -> None:
        """Start an episode from a generator that lives on between episodes, as dm_control's does."""
        mujoco.mj_resetData(self.model, self.data)
        self._forward_without_actuation()
        self.initialise(random)
        self._forward_without_actuation()

    def step(self, action: Float32 | Float64) -> None:
        data, model = self.data, self.model
        data.ctrl[:] = self._native(action)
        # dm_control's order: positions and velocities are already up to date, and are left so at the end. Only what sensors measure in
        # the last substep is ever read; leaving out the others' changes no bit and saves up to a twentieth of the time.
        flags = model.opt.disableflags
        model.opt.disableflags = flags | _NO_SENSORS
        mujoco.mj_step2(model, data)
        mujoco.mj_step(model, data, self.substeps - 2)
        model.opt.disableflags = flags
        mujoco.mj_step(model, data)
        mujoco.mj_step1(model, data)
        if self._warnings.any():
            names = [mujoco.mjtWarning(i).name for i in np.flatnonzero(self._warnings)]
            raise diverged(self.domain.name, ", ".join(names))

    def state(self, out: Float64) -> None:
        mujoco.mj_getState(self.model, self.data, out, PHYSICS)

    def set_state(self, state: Float64) -> None:
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, state, PHYSICS)
        self._forward_without_actuation()
        # What actuators need of positions and velocities was left out; at the start of a step it is there.
        mujoco.mj_step1(self.model, self.data)

    def overwrite_state(self, state: Float64) -> None:
        mujoco.mj_setState(self.model, self.data, state, PHYSICS)
        mujoco.mj_step1(self.model, self.data)

    @property
    def timestep(self) -> float:
        return self.substeps * float(self.model.opt.timestep)

    @property
    def compiled(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        return self.model, self.data

    def _forward_without_actuation(self) -> None:
        flags = self.model.opt.disableflags
        self.model.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        mujoco.mj_forward(self.model, self.data)
        self.model.opt.disableflags = flags


def action_map(low: Float64, high: Float64) -> Callable[[Float32 | Float64], Float32 | Float64]:
    """The map from actions (A,) in [-1, 1] to the actuators' ranges, to the last bit that of dm_control's ``action_scale`` wrapper.

    Args:
        low, high: the ranges (A,). Where all are [-1, 1], actions stay as they are.
    """
    if (low == -1.0).all() and (high == 1.0).all():
        return lambda action: action
    start, scale = low.copy(), (high - low) / 2.0
    return lambda action: start + scale * (action.astype(np.float64) + 1.0)


def random_state(seed: int) -> np.random.RandomState:
    """A legacy generator from a seed of any size; below 2**32 it is ``RandomState(seed)``, as in dm_control."""
    if seed < 2**32:
        return np.random.RandomState(seed)
    words = []
    while seed:
        words.append(seed & 0xFFFFFFFF)
        seed >>= 32
    return np.random.RandomState(words)


def tolerance_above(x: Float64, bound: float, margin: float, value_at_margin: float) -> Float64:
    """dm_control's ``rewards.tolerance`` with bounds [bound, inf) and the linear sigmoid, vectorised."""
    distance = (bound - x) / margin * (1.0 - value_at_margin)
    return np.where(x >= bound, 1.0, np.where(np.abs(distance) < 1.0, 1.0 - distance, 0.0))


def gaussian_above(x: Float64, bound: float, margin: float, value_at_margin: float = 0.1) -> Float64:
    """dm_control's ``rewards.tolerance`` with bounds [bound, inf) and the Gaussian sigmoid, vectorised."""
    distance = (bound - x) / margin
    scale = np.sqrt(-2.0 * np.log(value_at_margin))
    return np.where(x >= bound, 1.0, np.exp(-0.5 * (distance * scale) ** 2))
