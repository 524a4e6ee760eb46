"""The Gymnasium face of a simulator, for users and for ``dataset.recover_environment()``."""

from __future__ import annotations

import os
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from cudc_bench.envs.drawing import LARGEST, SMALLEST, Drawer, Frame, check_camera
from cudc_bench.envs.registry import check_domain, check_tasks, make_simulators, reward_function
from cudc_bench.envs.rewards import Measured, load_reward
from cudc_bench.envs.simulator import Float32, Float64
from cudc_bench.envs.window import Window
from cudc_bench.errors import UsageError, unknown

RENDER_MODES = ("rgb_array", "human")
_HUGE = 1e10  # MuJoCo takes larger numbers for a divergence


def observation_space(domain: str) -> Box:
    """Flat, unbounded float32 observations (S,)."""
    return Box(-np.inf, np.inf, (check_domain(domain).observation_size,), np.float32)


def action_space(domain: str) -> Box:
    """Actions (A,) in [-1, 1], float32."""
    return Box(-1.0, 1.0, (check_domain(domain).action_size,), np.float32)


class SimulatorEnv(gymnasium.Env[Float32, Float32], EzPickle):
    """A domain, reward-free or with one task's reward.

    The time limit is Gymnasium's ``TimeLimit`` (part of the registered id); the environment itself never ends an episode.
    ``info["physics"]`` is the float64 state (P,) after the step. A pickled environment is made anew from its arguments, and has to be
    reset.

    Args:
        domain: such as ``"walker"``.
        task: such as ``"walk"``; None gives reward 0.
        reward: instead of a task, an own reward function as ``module:function`` (see ``cudc_bench.envs.rewards``).
        render_mode: ``"rgb_array"`` makes ``render()`` give frames (height, width, 3), uint8; ``"human"`` shows every step in a window,
            in real time (needs pygame); None for neither. A process of its own draws, which starts with the first frame.
        width, height: of the frames, pixels.
        camera: a name or number of the model's; None for one that shows the domain well.

    Raises:
        UsageError: one of the arguments is not allowed.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES)}  # noqa: RUF012 - Gymnasium's own attribute

    def __init__(
        self,
        domain: str,
        task: str | None = None,
        reward: str | None = None,
        *,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str | int | None = None,
    ) -> None:
        EzPickle.__init__(self, domain, task, reward, render_mode=render_mode, width=width, height=height, camera=camera)
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise unknown("render mode", render_mode, RENDER_MODES)
        for name, value in (("width", width), ("height", height)):
            if not SMALLEST <= value <= LARGEST:
                raise UsageError(f"the {name} of frames is {SMALLEST} to {LARGEST} pixels, not {value}.")
        facts = check_domain(domain)
        self._custom = None if reward is None else load_reward(reward, facts)
        self._task = None if task is None else facts.tasks.index(check_tasks(facts, [task])[0])
        self._rewards = reward_function(domain)
        self._simulator = make_simulators(domain, 1)[0]
        self._quantities = np.empty(len(facts.quantities), np.float64)
        self._facts = facts
        self._seed = 0
        self._size = width, height
        self._camera = check_camera(self._simulator, domain, None if camera is None else str(camera))
        self._drawer: Drawer | None = None
        self.metadata = self.metadata | {"render_fps": round(1.0 / self._simulator.timestep)}
        self._window = Window(domain, self.metadata["render_fps"]) if render_mode == "human" else None
        self.render_mode = render_mode
        self.observation_space = observation_space(domain)
        self.action_space = action_space(domain)

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"spec": self.spec}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        # The constructor knows nothing of the id; without it, wrappers around would have no specification, either.
        self.spec = state["spec"]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Float32, dict[str, Any]]:
        """Start an episode: from a drawn state, or from a stored one.

        Args:
            seed: 0 or more; the episode is that of the dataset which names the same seed.
            options: ``{"physics": state}`` starts from a stored state (P,), such as ``episode.infos["physics"][t]``. Nothing of an
                observation differs then but what the state does not determine (``Domain.beyond_state``), and following steps
                differ by what the solver remembered of the step before (``Domain.drift_tolerance``).

        Raises:
            UsageError: the options hold something else, or a state that is not one.
        """
        state = self._stored_state(options or {})
        super().reset(seed=seed)
        self._seed = int(self.np_random.integers(2**32)) if seed is None else seed
        self._simulator.reset(self._seed)
        if state is not None:
            self._simulator.set_state(state)
        self._show()
        return self._observation(), self._info()

    def step(self, action: Float32) -> tuple[Float32, float, bool, bool, dict[str, Any]]:
        """Apply an action (A,) in [-1, 1].

        Raises:
            UsageError: it is not a finite array of that shape.
            DivergedError: the simulation became unstable.
        """
        action = self._checked(action)
        self._simulator.step(action)
        observation, info, reward = self._observation(), self._info(), 0.0
        if self._task is not None or self._custom is not None:
            self._simulator.quantities(self._quantities)
        if self._task is not None:
            reward = float(self._rewards(self._quantities)[self._task])
        elif self._custom is not None:
            rows = (self._quantities, info["physics"], action, observation)
            reward = float(self._custom(Measured(self._facts, *(row[None] for row in rows)))[0])
        self._show()
        return observation, reward, False, False, info

    def render(self) -> Frame | None:
        """The state as it is (height, width, 3), in the mode ``"rgb_array"``; None in the others.

        Raises:
            RunError: nothing here can draw; the message says what to install.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing: make the environment with render_mode='rgb_array'.")
        return self._frame() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """End the process that draws, and close the window."""
        if (drawer := getattr(self, "_drawer", None)) is not None:
            drawer.close()
            self._drawer = None
        if (window := getattr(self, "_window", None)) is not None:
            window.close()

    def _stored_state(self, options: dict[str, Any]) -> Float64 | None:
        for name in options:
            # Minari's collector gives its own options on.
            if name != "physics" and not str(name).startswith("minari_"):
                raise unknown("reset option", str(name), ["physics"])
        if "physics" not in options:
            return None
        size = self._facts.physics_size
        state = _numbers("a stored state", options["physics"], size, f"{self._facts.name} has {size} numbers, those of info['physics']")
        if not (np.abs(state) < _HUGE).all():
            raise UsageError(f"a stored state must be of numbers below {_HUGE:g}.")
        return state.astype(np.float64)

    def _checked(self, action: Any) -> NDArray[Any]:
        size = self._facts.action_size
        return _numbers("an action", action, size, f"{self._facts.name} takes {size} numbers in [-1, 1]")

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._frame())

    def _frame(self) -> Frame:
        if self._drawer is None:
            task = None if self._task is None else self._facts.tasks[self._task]
            self._drawer = Drawer(self._facts.name, task, self._camera, *self._size, os.environ.get("MUJOCO_GL"))
        (frame,) = self._drawer.frames(self._seed, self._state()[None])
        return frame

    def _observation(self) -> Float32:
        observation = np.empty(self._facts.observation_size, np.float32)
        self._simulator.observe(observation)
        return observation

    def _state(self) -> Float64:
        state = np.empty(self._facts.physics_size, np.float64)
        self._simulator.state(state)
        return state

    def _info(self) -> dict[str, Any]:
        return {"physics": self._state()}


def _numbers(what: str, value: Any, size: int, allowed: str) -> NDArray[Any]:
    """A vector of so many numbers: one number would be spread over all of them in silence.

    Raises:
        UsageError: it is something else.
    """
    try:
        found = np.asarray(value)
    except ValueError:  # rows of several lengths
        found = np.empty(0, object)
    if found.dtype.kind not in "fiu":
        raise UsageError(f"{what} must be an array of numbers; {allowed}.")
    if found.shape != (size,):
        raise UsageError(f"{what} cannot have the shape {found.shape}; {allowed}: shape ({size},).")
    if not np.isfinite(found).all():
        raise UsageError(f"{what} cannot hold {found[~np.isfinite(found)][0]}; {allowed}.")
    return found
