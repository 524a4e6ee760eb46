"""Steps a second of the thin environments against dm_control's own and against MuJoCo alone, on one core, with observation and reward."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from benchmarks.measure import Row, fastest_interleaved
from cudc_bench.envs import DOMAINS, make_simulators, reward_function
from cudc_bench.envs.simulator import MujocoSimulator

# What dm_control's Environment.step should at least be beaten by.
TARGETS = {"walker": 1.6, "quadruped": 1.9, "jaco": 2.0}


def reference(domain: str) -> Any:
    """dm_control's own environment of a domain, with one task."""
    if domain == "jaco":
        from dm_control import manipulation

        return manipulation.load("reach_site_features", seed=1)
    from dm_control import suite

    return suite.load(domain, "walk", task_kwargs={"random": 1})


def run() -> Iterator[Row]:
    """All step the same actions, an episode from a reset; ours also stores the state and computes all four rewards."""
    for domain, facts in DOMAINS.items():
        steps = min(facts.episode_length, 500)
        theirs_env, (simulator,), rewards = reference(domain), make_simulators(domain, 1), reward_function(domain)
        assert isinstance(simulator, MujocoSimulator)
        actions = np.random.default_rng(0).uniform(-1, 1, (steps, facts.action_size)).astype(np.float32)
        low, high = simulator.model.actuator_ctrlrange.T
        controls = low + (high - low) / 2 * (actions + 1.0)
        observation, state = np.empty(facts.observation_size, np.float32), np.empty(facts.physics_size)
        quantities = np.empty((steps, len(facts.quantities)))

        def theirs(environment: Any = theirs_env, controls: Any = controls) -> None:
            for control in controls:
                environment.step(control)

        def ours(simulator: Any = simulator, actions: Any = actions, rest: Any = (observation, state, quantities, rewards)) -> None:
            observation, state, quantities, rewards = rest
            for action, row in zip(actions, quantities, strict=True):
                simulator.step(action)
                simulator.observe(observation)
                simulator.state(state)
                simulator.quantities(row)
            rewards(quantities)

        def physics(simulator: Any = simulator, controls: Any = controls) -> None:
            for control in controls:
                simulator.data.ctrl[:] = control
                mujoco.mj_step(simulator.model, simulator.data, simulator.substeps)

        # Resets cost each side differently and are not what is compared here.
        before = [theirs_env.reset, lambda simulator=simulator: simulator.reset(1), lambda simulator=simulator: simulator.reset(1)]
        slow, fast, floor = fastest_interleaved([theirs, ours, physics], rounds=15, before=before)
        ratio, share, target = slow / fast, floor / fast, TARGETS[domain]
        ours_rate = f"{steps / fast:,.0f}"
        yield Row(f"{domain}, env steps/s", ours_rate, f"dm_control {steps / slow:,.0f}", f"{ratio:.2f}x", f"≥ {target}x", ratio >= target)
        yield Row(f"{domain}, share of MuJoCo alone", ours_rate, f"mj_step {steps / floor:,.0f}", f"{share:.0%}", "≥ 85%", share >= 0.85)
