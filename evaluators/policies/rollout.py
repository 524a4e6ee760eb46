"""Plays a trained policy, as its record's final evaluation did and to the same return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from cudc_bench.artefacts.records import Record
from cudc_bench.envs import check_domain, check_tasks, make_simulators, reward_function
from cudc_bench.envs.rewards import CustomReward, Measured
from cudc_bench.envs.simulator import Float64
from cudc_bench.execution.progress import Advance
from cudc_bench.settings.seeding import episode_seed

from ..running.loop import FINAL
from .stored import Policy


@dataclass(frozen=True)
class Played:
    """One episode of T steps.

    Attributes:
        seed: with which it was reset.
        states: (T+1, P) float64.
        total: undiscounted return; None where it was not measured.
        recorded: what the record says of the same episode; None if it is none of the record's.
    """

    seed: int
    states: Float64
    total: float | None
    recorded: float | None


def recorded_seeds(record: Record, episodes: int) -> list[int]:
    """The seeds of the first episodes of a record's final evaluation; they go on beyond those that it had."""
    return [episode_seed(record.seed, FINAL, record.final.step, episode) for episode in range(episodes)]


def play(
    advance: Advance, *, policy: Policy, seeds: Sequence[int], recorded: Sequence[float] = (), reward: CustomReward | None = None
) -> list[Played]:
    """Play one episode from each seed.

    A matrix product of another number of rows rounds differently, which a simulation amplifies within seconds. The final evaluation
    tried all of its episodes side by side. Here the policy therefore gets as many rows, all the same, and the episode's own is taken.

    Args:
        advance: told of each step.
        policy: of a record.
        seeds: of the episodes.
        recorded: what the record says of the first of them.
        reward: the user's own function, if the policy was trained on one. Without it such a policy's return is not measured.

    Raises:
        RunError: the simulation diverged, or the reward function failed.
        UsageError: the domain has no such task here.
    """
    record = policy.record
    facts = check_domain(record.dataset.domain)
    (simulator,) = make_simulators(facts.name, 1)
    rewards = reward_function(facts.name)
    task = facts.tasks.index(check_tasks(facts, [record.dataset.task])[0]) if record.dataset.reward is None else None
    rows = len(record.final.returns)
    observations = np.empty((rows, facts.observation_size), np.float32)
    quantities = np.empty((rows, len(facts.quantities)), np.float64)
    played = []
    for episode, seed in enumerate(seeds):
        row = episode % rows
        states = np.empty((facts.episode_length + 1, facts.physics_size), np.float64)
        total = 0.0
        simulator.reset(seed)
        simulator.observe(observations[row])
        simulator.state(states[0])
        for t in range(facts.episode_length):
            observations[:] = observations[row]
            with torch.no_grad():
                actions = policy(torch.from_numpy(observations)).numpy()
            simulator.step(actions[row])
            simulator.observe(observations[row])
            simulator.state(states[t + 1])
            simulator.quantities(quantities[row])
            quantities[:] = quantities[row]
            if task is not None:
                total += float(rewards(quantities)[row, task])
            elif reward is not None:
                observations[:] = observations[row]
                physics = np.broadcast_to(states[t + 1], (rows, facts.physics_size))
                total += float(reward(Measured(facts, quantities, physics, actions, observations))[row])
            advance(1)
        known = task is not None or reward is not None
        there = recorded[episode] if known and episode < len(recorded) else None
        played.append(Played(seed, states, total if known else None, there))
    return played
