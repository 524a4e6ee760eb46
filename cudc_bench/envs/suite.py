"""Any domain of dm_control's suite, through Shimmy: slower than the thin simulators, and defined by looking at the suite itself.

``dm_control/cheetah-run`` names one environment of the suite. Exploration takes the body and the initial states from it. The tasks
are all those of the suite whose rewards follow from the stored states and actions of that body.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Self

# Before dm_control, which would look for OpenGL by itself.
from cudc_bench.envs.headless import mujoco

# isort: split

import absl.logging
import numpy as np
from dm_control import suite
from dm_control.mujoco import Physics
from dm_control.rl import control
from shimmy.dm_control_compatibility import DmControlCompatibilityV0

from cudc_bench.envs.domains import SUITE, Domain
from cudc_bench.envs.simulator import DivergedError, Float32, Float64, Simulator, action_map, diverged, random_state
from cudc_bench.errors import RunError, UsageError, unknown
from cudc_bench.execution.progress import echo

_ELSEWHERE = f"choose another one, such as {SUITE}cheetah-run"
# The trial that decides which rewards follow from states: so many episodes, each of so many steps and single steps from drawn states.
_EPISODES, _STEPS, _STATES = 2, 15, 150
_TOLERANCE = 1e-6  # of a recomputed reward; datasets hold float32, which is no finer
# Measured as for the other domains (see STEP_TOLERANCE there), on 400 transitions of random actions from each body: at most 0.023
# (quadruped-fetch, whose ball hits walls), 1.6e-4 (dog) and 1.9e-8 (all others). What adds up in an episode was measured for the
# first alone.
_DRIFT_TOLERANCE = 0.1
_LOOSE = {f"{SUITE}quadruped-fetch": 1.0}
_LARGE = 50  # degrees of freedom, from which the trial takes some seconds
_OTHER_BODY = "its model is another one or changes at resets"
_OTHER_REWARD = "its reward depends on more than state and action (a target drawn at reset, a sensor that lags)"
_CONSTANT = "its reward never changed in a trial, so that nothing is known about it"


@cache
def suite_domain(name: str) -> Domain:
    """Define the domain of that name, such as ``dm_control/cheetah-run``, from the suite; once in each process.

    Several tasks of the suite draw targets or strengths into the model at each reset; their rewards depend on what no stored state
    tells. Which tasks can be relabelled is therefore found by a trial, the same one every time, and never assumed.

    Raises:
        UsageError: the suite has no such environment, its episodes do not end by a time limit, or it cannot run on this machine.
    """
    if name not in suite_names():
        raise unknown("domain", name, suite_names())
    environment = _load(name)
    limit = environment._step_limit
    if not math.isfinite(limit):
        raise UsageError(f"the domain '{name}' has no time limit, by which alone episodes end here; {_ELSEWHERE}.")
    if _ends_itself(environment):
        raise UsageError(f"the domain '{name}' ends episodes by itself, but here a time limit alone ends them; {_ELSEWHERE}.")
    try:
        simulator = SuiteSimulator(name)
    except RuntimeError as error:
        raise UsageError(f"the domain '{name}' cannot be simulated here: {_plain(error)}; {_ELSEWHERE}.") from None
    if simulator.physics.model.nv > _LARGE:
        echo(f"looking at {name}: which rewards follow from its states")
    with _quiet():
        reasons = {task: _obstacle(name, task) for task in suite.TASKS_BY_DOMAIN[_split(name)[0]]}
    tasks = tuple(task for task, reason in reasons.items() if reason is None)
    steps = math.ceil(limit)
    return Domain(
        name=name,
        tasks=tasks,
        observation_size=simulator.sizes[0],
        action_size=simulator.sizes[1],
        physics_size=simulator.sizes[2],
        episode_length=steps,
        max_return=float(steps),
        quantities=tuple(f"{task}_reward" for task in tasks),
        simulator="cudc_bench.envs.suite:SuiteSimulator",
        rewards="cudc_bench.envs.suite:suite_rewards",
        relabeler="dm_control",
        beyond_state=_beyond_state(simulator),
        drift_tolerance=_LOOSE.get(name, _DRIFT_TOLERANCE),
        excluded={task: reason for task, reason in reasons.items() if reason is not None},
    )


@cache
def suite_names() -> tuple[str, ...]:
    """The names of all environments of the suite, such as ``dm_control/cheetah-run``, whether they can be used here or not."""
    return tuple(f"{SUITE}{body}-{task}" for body, task in suite.ALL_TASKS)


def suite_rewards(quantities: Float64) -> Float64:
    """Rewards (..., tasks) of a suite domain from its quantities (..., tasks), which are the rewards themselves."""
    return quantities


class SuiteSimulator(Simulator):
    """An environment of the suite behind Shimmy's ``DmControlCompatibilityV0``.

    Observations are flattened in dm_control's own order, not in the alphabetical one of Gymnasium's ``Dict`` spaces.

    Args:
        name: such as ``dm_control/cheetah-run``.
        tasks: of the same body, whose rewards are the quantities; started (see :func:`started_task`).

    Attributes:
        sizes: (S, A, P), as in :class:`~cudc_bench.envs.domains.Domain`.
        environment, physics: dm_control's.
        reward: of the last step, as the environment itself gave it.
    """

    def __init__(self, name: str, tasks: Sequence[control.Task] = ()) -> None:
        self._name, self._tasks = name, tasks
        # The limit is the caller's to keep: dm_control would start a new episode by itself.
        self.environment = _load(name, time_limit=math.inf)
        self._shimmy = DmControlCompatibilityV0(self.environment)
        self.physics: Physics = self.environment.physics
        bounds = self.environment.action_spec()
        self._native = action_map(bounds.minimum, bounds.maximum)
        self.reward = 0.0
        # Without this, the first step after set_state would be a reset.
        self.reset(0)
        self.sizes = (self._observation.size, bounds.shape[0], self.physics.get_state().size)

    @classmethod
    def make(cls, domain: Domain, count: int) -> list[Self]:
        tasks = [started_task(domain.name, task) for task in domain.tasks]
        return [cls(domain.name, tasks) for _ in range(count)]

    def reset(self, seed: int) -> None:
        self._shimmy.np_random = random_state(seed)
        observation, _ = self._shimmy.reset()
        self._observation: Float64 = observation[control.FLAT_OBSERVATION_KEY]

    def step(self, action: Float32 | Float64) -> None:
        with self._divergence():
            observation, reward, terminated, truncated, _ = self._shimmy.step(self._native(action))
        if terminated or truncated:
            raise RunError(f"{self._name} ended an episode by itself, but a time limit alone may end them; {_ELSEWHERE}.")
        self._observation, self.reward = observation[control.FLAT_OBSERVATION_KEY], _number(reward)

    def observe(self, out: Float32) -> None:
        out[:] = self._observation

    def state(self, out: Float64) -> None:
        out[:] = self.physics.get_state()

    def set_state(self, state: Float64) -> None:
        with self._divergence(), self.physics.reset_context():
            self.physics.set_state(state)
        # What actuators need of positions and velocities was left out; at the start of a step it is there.
        self.overwrite_state(state)

    def overwrite_state(self, state: Float64) -> None:
        self.physics.set_state(state)
        with self._divergence(), self.physics.check_invalid_state():
            mujoco.mj_step1(self.physics.model.ptr, self.physics.data.ptr)
        self._observation = self.look()

    def look(self) -> Float64:
        """The observation (S,) of the physics as it stands."""
        return control.flatten_observation(self.environment.task.get_observation(self.physics))[control.FLAT_OBSERVATION_KEY]

    def parts(self) -> list[tuple[str, int]]:
        """The names and sizes of what the observation (S,) is made of, in order."""
        found = self.environment.task.get_observation(self.physics)
        return [(str(name), int(np.size(value))) for name, value in found.items()]

    def set_outcome(self, state: Float64, action: Float32 | Float64) -> None:
        """Set a state (P,) as if an action (A,) had just led to it, for the quantities alone: rewards may depend on both.

        Raises:
            DivergedError: the state is not a possible one.
        """
        with self._divergence(), self.physics.reset_context():
            self.physics.set_state(state)
            self.physics.set_control(self._native(action))

    def quantities(self, out: Float64) -> None:
        for index, task in enumerate(self._tasks):
            out[index] = _number(task.get_reward(self.physics))

    @property
    def timestep(self) -> float:
        return float(self.environment.control_timestep())

    @property
    def compiled(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        return self.physics.model.ptr, self.physics.data.ptr

    @contextmanager
    def _divergence(self) -> Iterator[None]:
        try:
            yield
        except control.PhysicsError as error:
            raise diverged(self._name, str(error).rpartition(": ")[2]) from None


def started_task(name: str, task: str) -> control.Task:
    """A task of a domain's body, after one episode's start in an environment of its own: some find their constants in that."""
    environment = _load(_sibling(name, task))
    environment.reset()
    return environment.task


def _beyond_state(simulator: SuiteSimulator) -> tuple[tuple[int, int], ...]:
    """Ranges [start, stop) of observations made from what MuJoCo computes last, and dm_control leaves a physics step behind.

    They are those that change when nothing else does.
    """
    model, data = simulator.physics.model, simulator.physics.data
    simulator.reset(0)
    before = simulator.look()
    late = np.repeat(model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC, model.sensor_dim)
    data.sensordata[late] += 1.0
    for array in (data.qacc, data.cacc, data.cfrc_int, data.cfrc_ext, data.actuator_force, data.qfrc_actuator, data.qfrc_constraint):
        array += 1.0
    changed = np.flatnonzero(simulator.look() != before)
    return tuple((int(run[0]), int(run[-1]) + 1) for run in np.split(changed, np.flatnonzero(np.diff(changed) > 1) + 1) if len(run))


def _obstacle(name: str, task: str) -> str | None:
    """Why rewards of a task cannot be recomputed from what is stored of a domain, or None when they can.

    The task's own environment acts, from resets and from drawn states. After every step the domain's simulator, which was reset
    otherwise, must give the same reward for the state and the action; and from the same state it must reach the same next one.
    """
    try:
        own, ours = SuiteSimulator(_sibling(name, task)), SuiteSimulator(name, [started_task(name, task)])
    except RuntimeError as error:
        return f"it cannot be simulated here: {_plain(error)}"
    if _ends_itself(own.environment):
        return "it ends episodes by itself"
    if own.sizes[1:] != ours.sizes[1:]:
        return _OTHER_BODY
    random, rewards = np.random.RandomState(0), set()
    for episode in range(_EPISODES):
        own.reset(episode)
        ours.reset(_EPISODES + episode)
        for step in range(_STEPS + _STATES):
            action, start = random.uniform(-1.0, 1.0, own.sizes[1]), None
            if step < _STEPS:
                action = np.sign(action)
            else:
                start = _draw_state(own.physics, random)
            try:
                agree, found = _compare(own, ours, start, action)
            except DivergedError:
                own.reset(episode)
                ours.reset(_EPISODES + episode)
                continue
            except (AttributeError, KeyError, ValueError):
                return _OTHER_BODY  # the reward looks for a part that this body does not have
            if not agree:
                return _OTHER_BODY
            if not all(abs(reward - own.reward) <= _TOLERANCE for reward in found):
                return _OTHER_REWARD
            rewards.add(own.reward)
    return None if len(rewards) > 1 else _CONSTANT


def _compare(own: SuiteSimulator, ours: SuiteSimulator, start: Float64 | None, action: Float64) -> tuple[bool, list[float]]:
    """One step of a task's own simulator, from a state (P,) or from where it is.

    Returns:
        Whether ours does the same from that state, and the rewards that it gives: live, and for the stored state and action.
    """
    agree, found, reward = True, [], np.empty(1)
    if start is not None:
        own.set_state(start)
        ours.set_state(start)
        ours.step(action)
        ours.quantities(reward)
        found.append(float(reward[0]))
    own.step(action)
    reached = own.physics.get_state()
    if start is not None:
        agree = ours.physics.get_state().tobytes() == reached.tobytes()
    ours.set_outcome(reached, action)
    ours.quantities(reward)
    return agree, [*found, float(reward[0])]


def _draw_state(physics: Physics, random: np.random.RandomState) -> Float64:
    """A state (P,) in which even sparse rewards are likely to be met.

    Each joint is near where it is, near where the model has it at rest, or anywhere in its range; speeds are of any magnitude.
    """
    model, scale = physics.model, 10.0 ** random.uniform(-3.0, 0.0)
    positions = physics.data.qpos.copy()
    for joint in range(model.njnt):
        kind, start = model.jnt_type[joint], model.jnt_qposadr[joint]
        stop = start + {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}.get(kind, 1)
        choice = random.randint(3)
        if choice == 1:
            positions[start:stop] = model.qpos0[start:stop]
        if stop - start == 1 and choice == 2:
            turn = np.pi if kind == mujoco.mjtJoint.mjJNT_HINGE else 1.0
            positions[start] = random.uniform(*(model.jnt_range[joint] if model.jnt_limited[joint] else (-turn, turn)))
        else:
            positions[start:stop] += random.randn(stop - start) * scale
        if stop - start > 1:
            if choice == 2:
                positions[stop - 4 : stop] = random.randn(4)
            positions[stop - 4 : stop] /= np.linalg.norm(positions[stop - 4 : stop])
    velocities = random.randn(model.nv) * 10.0 ** random.uniform(-1.0, 1.3)
    return np.concatenate([positions, velocities, random.uniform(-1.0, 1.0, model.na)])


def _load(name: str, **settings: float) -> control.Environment:
    body, task = _split(name)
    with _quiet():
        return suite.load(body, task, task_kwargs={"random": 0} | settings, environment_kwargs={"flat_observation": True})


@contextmanager
def _quiet() -> Iterator[None]:
    """Without dm_control's remarks on models that use what will be removed one day, and on drawn states that diverge."""
    verbosity = absl.logging.get_verbosity()
    absl.logging.set_verbosity(absl.logging.ERROR)
    try:
        yield
    finally:
        absl.logging.set_verbosity(verbosity)


def _ends_itself(environment: control.Environment) -> bool:
    """Whether episodes may end before the time limit."""
    return type(environment.task).get_termination is not control.Task.get_termination


def _split(name: str) -> tuple[str, str]:
    body, _, task = name.removeprefix(SUITE).partition("-")
    return body, task


def _sibling(name: str, task: str) -> str:
    """The name of the same body's environment for a task."""
    return f"{SUITE}{_split(name)[0]}-{task}"


def _number(reward: float | Float64) -> float:
    """Tasks give rewards as numbers and as arrays of one element."""
    return float(np.asarray(reward).item())


def _plain(error: Exception) -> str:
    return str(error).rstrip(".")
