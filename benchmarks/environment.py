"""Steps a second of the thin Walker against dm_control's own and against MuJoCo alone, on one core, with observation and reward."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from benchmarks.measure import Row, fastest_interleaved


def run() -> Iterator[Row]:
    """Both step the same 1,000 actions from the same reset; ours also stores the state and computes all four rewards."""
    from dm_control import suite

    from cudc_bench.envs import make_simulators, reward_function
    from cudc_bench.envs.simulator import MujocoSimulator

    actions = np.random.default_rng(0).uniform(-1, 1, (1000, 6)).astype(np.float32)
    reference = suite.load("walker", "walk", task_kwargs={"random": 1})
    (simulator,), rewards = make_simulators("walker", 1), reward_function("walker")
    assert isinstance(simulator, MujocoSimulator)
    observation, state, quantities = np.empty(24, np.float32), np.empty(18), np.empty((1000, 4))

    def theirs() -> None:
        reference.reset()
        for action in actions:
            reference.step(action)

    def ours() -> None:
        simulator.reset(1)
        for action, row in zip(actions, quantities, strict=True):
            simulator.step(action)
            simulator.observe(observation)
            simulator.state(state)
            simulator.quantities(row)
        rewards(quantities)

    def physics() -> None:
        simulator.reset(1)
        for action in actions:
            simulator.data.ctrl[:] = action
            mujoco.mj_step(simulator.model, simulator.data, simulator.substeps)

    slow, fast, floor = fastest_interleaved([theirs, ours, physics], rounds=15)
    yield Row("walker, env steps/s", f"{1000 / fast:,.0f}", f"dm_control {1000 / slow:,.0f}", f"{slow / fast:.2f}x", "", True)
    share = floor / fast
    yield Row("walker, share of MuJoCo alone", f"{1000 / fast:,.0f}", f"mj_step {1000 / floor:,.0f}", f"{share:.0%}", "≥ 90%", share >= 0.9)
