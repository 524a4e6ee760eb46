"""The loop that runs any collector: act, store, update, and hand every finished episode on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from cudc_bench.config import NonNegativeInt, PositiveInt
from cudc_bench.descriptors import Visits
from cudc_bench.envs import Domain, make_simulators
from cudc_bench.envs.simulator import Float32, Float64
from cudc_bench.metrics import member_rows
from cudc_bench.networks import MemberRandom
from cudc_bench.replay import Episodes
from cudc_bench.seeding import episode_seed

from .base import Collector


@dataclass(frozen=True)
class CollectConfig:
    """How much is collected and how often the method learns (paper, appendix; URLB).

    Attributes:
        steps: environment steps, all of which form the dataset.
        seed_steps: steps of uniformly random actions before the first update.
        update_every: environment steps for each update.
        measure_every: updates between two lines of diagnostics, which is ``measure_every * update_every`` environment steps, whether the
            method learns or not.
    """

    steps: PositiveInt = 1_000_000
    seed_steps: NonNegativeInt = 4_000
    update_every: PositiveInt = 2
    measure_every: PositiveInt = 1_000


class Sink(Protocol):
    """Takes what one member collects."""

    def add_episode(self, seed: int, observations: Float32, actions: Float32, infos: dict[str, Float32 | Float64]) -> None:
        """One finished episode: its reset seed, observations (T+1, S), actions (T, A), and ``infos``.

        These are ``physics`` (T+1, P), the states, and for methods with skills ``skill`` (T+1, K): row t is what action t followed, and
        the last row repeats the one before, since no action follows it.
        """

    def add_diagnostics(self, row: dict[str, Any]) -> None:
        """One line of diagnostics: ``step``, ``updates``, ``steps_per_second`` since the line before, the coverage of the domain's
        descriptors so far (see ``cudc_bench.descriptors``) where it has some, and what the last update since then measured of itself.
        """


def run_collection(collector: Collector, config: CollectConfig, domain: Domain, sinks: list[Sink], advance: Callable[[int], None]) -> None:
    """Collect ``config.steps`` steps for every member. The environment's reward is never even computed.

    Physical quantities are read for the coverage of diagnostics alone; no collector sees them.

    Args:
        collector: E members.
        config: how much and how often.
        domain: what is explored.
        sinks: one for each member.
        advance: told how many steps have been done since it was last called.

    Raises:
        RunError: the simulation diverged or a metric is not finite.
    """
    seeds, members = collector.seeds, len(collector.seeds)
    length = domain.episode_length
    simulators = make_simulators(domain.name, members)
    first_actions = MemberRandom(seeds, "first actions")
    replay = None
    if collector.learns:
        episodes = math.ceil(config.steps / length)
        replay = Episodes(
            members, episodes, episodes * length, domain.observation_size, domain.action_size,
            MemberRandom(seeds, "replay", collector.device), skill=collector.skill_size,
        )  # fmt: skip
    observations = np.empty((members, length + 1, domain.observation_size), np.float32)
    actions = np.empty((members, length, domain.action_size), np.float32)
    physics = np.empty((members, length + 1, domain.physics_size), np.float64)
    skills = np.empty((members, length + 1, collector.skill_size), np.float32)
    updates, reset_seeds = 0, [0] * members
    # Of the episode's states that actions led to; those from ``counted`` on are not in ``visits`` yet.
    quantities = np.empty((members, length, len(domain.quantities)), np.float64)
    visits = [Visits(domain) for _ in simulators] if domain.descriptors else []
    counted, metrics = 0, dict[str, torch.Tensor]()
    every, last_row, last_time = config.measure_every * config.update_every, 0, time.perf_counter()

    for step in range(config.steps):
        t = step % length
        if t == 0:
            for member, simulator in enumerate(simulators):
                reset_seeds[member] = episode_seed(seeds[member], "environment", step // length)
                simulator.reset(reset_seeds[member])
                simulator.observe(observations[member, 0])
                simulator.state(physics[member, 0])
        if collector.skill_size:
            skills[:, t : t + 2] = collector.next_skill(t).cpu().numpy()[:, None]
        if step < config.seed_steps and collector.learns:
            chosen = first_actions.uniform(domain.action_size) * 2.0 - 1.0
        else:
            chosen = collector.act(torch.from_numpy(observations[:, t]).to(collector.device)).cpu()
        actions[:, t] = chosen.numpy()
        for member, simulator in enumerate(simulators):
            simulator.step(actions[member, t])
            simulator.observe(observations[member, t + 1])
            simulator.state(physics[member, t + 1])
            if visits:
                simulator.quantities(quantities[member, t])
        done = step + 1 == config.steps
        if t + 1 == length or done:
            for member, sink in enumerate(sinks):
                o, a = observations[member, : t + 2], actions[member, : t + 1]
                infos: dict[str, Float32 | Float64] = {"physics": physics[member, : t + 2]}
                if collector.skill_size:
                    infos["skill"] = skills[member, : t + 2]
                sink.add_episode(reset_seeds[member], o, a, infos)
                if replay is not None and t + 1 == length:
                    replay.add(member, torch.from_numpy(o), torch.from_numpy(a), torch.from_numpy(skills[member, :length]))
        due = step >= config.seed_steps and step % config.update_every == 0
        if due and replay is not None and replay.episodes():
            # The last update before a line.
            measure = (step + config.update_every) % every == 0 or step + config.update_every >= config.steps
            batch = replay.sample(collector.config.batch_size, collector.horizon, measure, collector.nearest)
            metrics = collector.update(batch)
            updates += 1
        row_due = (step + 1) % every == 0 or done
        if visits and (row_due or t + 1 == length):
            for member, counts in enumerate(visits):
                counts.add(quantities[member, counted : t + 1])
            counted = (t + 1) % length
        if row_due:
            now = time.perf_counter()
            rate = (step + 1 - last_row) / max(now - last_time, 1e-9)
            measured = member_rows(metrics, step + 1) if metrics else [{}] * members
            for member, (sink, row) in enumerate(zip(sinks, measured, strict=True)):
                covered = visits[member].coverage.as_row() if visits else {}
                sink.add_diagnostics({"step": step + 1, "updates": updates, "steps_per_second": rate} | covered | row)
            last_row, last_time, metrics = step + 1, now, {}
        if t % 200 == 199 or done:
            advance(200 if t % 200 == 199 else (t + 1) % 200)
