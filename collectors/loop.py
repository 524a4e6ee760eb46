"""The loop that runs any collector: act, store, update, and hand every finished episode on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import numpy as np
import torch

from cudc_bench import interrupts
from cudc_bench.checkpoints import Checkpoints
from cudc_bench.config import LATER, NonNegativeInt, PositiveInt, Precision
from cudc_bench.data.writer import Episode
from cudc_bench.descriptors import Visits
from cudc_bench.envs import Domain, make_simulators
from cudc_bench.envs.simulator import Float32, Float64
from cudc_bench.errors import UnusableError
from cudc_bench.graphs import Acts, Updates, graphs_for
from cudc_bench.learner import set_precision
from cudc_bench.metrics import check_actions, check_simulated, member_rows
from cudc_bench.networks import MemberRandom
from cudc_bench.profiles import PAPER_STEPS
from cudc_bench.replay import Batch, Episodes
from cudc_bench.seeding import episode_seed

from .base import Collector

_TELL_EVERY = 200  # steps


@dataclass(frozen=True)
class CollectConfig:
    """How much is collected and how often the method learns (paper, appendix; URLB).

    Attributes:
        steps: environment steps, all of which form the dataset.
        seed_steps: steps of uniformly random actions before the first update.
        update_every: environment steps for each update.
        measure_every: updates between two lines of diagnostics, which is ``measure_every * update_every`` environment steps, whether the
            method learns or not.
        precision: of wide matrix products in updates: float32, bf16, or TF32 on CUDA.
    """

    steps: PositiveInt = PAPER_STEPS
    seed_steps: NonNegativeInt = 4_000
    update_every: PositiveInt = 2
    measure_every: PositiveInt = 1_000
    precision: Precision = field(default="float32", metadata=LATER)


class Sink(Protocol):
    """Takes what one member collects."""

    def add_episode(self, seed: int, observations: Float32, actions: Float32, infos: dict[str, Float32 | Float64]) -> None:
        """One finished episode: its reset seed, observations (T+1, S), actions (T, A), and ``infos``.

        These are ``physics`` (T+1, P), the states, and for methods with skills ``skill`` (T+1, K): row t is what action t followed, and
        the last row repeats the one before, since no action follows it.
        """

    def add_diagnostics(self, row: dict[str, Any], steps_per_second: float) -> None:
        """One line of diagnostics: ``step``, ``updates``, the coverage of the domain's descriptors so far (see
        ``cudc_bench.descriptors``) where it has some, and what the last update since the line before measured of itself.

        Args:
            row: the same in every run with the same seed.
            steps_per_second: since the line before, or since the run was continued.
        """


class ResumableSink(Sink, Protocol):
    """A sink whose episodes outlive the process, for runs with checkpoints."""

    def episodes(self) -> Iterator[Episode]:
        """All episodes so far, in order."""

    def state_dict(self) -> dict[str, Any]:
        """What is needed to find all that was added so far, which is on the disk when this returns."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to what had been added when ``state_dict`` was called.

        Raises:
            UnusableError: some of it is gone or damaged; nothing has changed.
        """


class Watcher(Protocol):
    """Looks at every update of a run."""

    def after_update(self, batch: Batch) -> None:
        """The method has just learnt from this batch."""

    def state_dict(self) -> dict[str, Any]:
        """What it has seen so far."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""


def run_collection(
    collector: Collector, config: CollectConfig, domain: Domain, sinks: Sequence[Sink], advance: Callable[[int], None],
    checkpoints: Checkpoints | None = None, watcher: Watcher | None = None,
) -> None:  # fmt: skip
    """Collect ``config.steps`` steps for every member. The environment's reward is never even computed.

    Physical quantities are read for the coverage of diagnostics alone; no collector sees them.

    Args:
        collector: E members.
        config: how much and how often.
        domain: what is explored.
        sinks: one for each member; with ``checkpoints``, resumable ones.
        advance: told how many steps have been done since it was last called.
        checkpoints: where the run's state is kept at the ends of episodes, from time to time, and after the last step; what is found
            there is continued, with the same result as if the run had never stopped.
        watcher: looks at every update.

    Raises:
        BrokenDownError: the simulation diverged, or an observation, an action or a metric is not finite.
        Interrupted: the process was asked to leave; the state after the last step is kept.
    """
    set_precision(collector, config.precision)
    run = _Run(collector, config, domain, sinks, watcher)
    kept = None if checkpoints is None else checkpoints.load(run.load_state, collector.device)

    def keep() -> None:
        nonlocal kept
        if checkpoints is not None and kept != run.steps:
            checkpoints.save(run.steps, run.state())
            kept = run.steps

    told = 0
    while True:
        done = run.steps == config.steps
        if run.steps - told >= _TELL_EVERY or done:
            advance(run.steps - told)
            told = run.steps
        if interrupts.requested():
            keep()
            raise interrupts.interrupted(f"at step {run.steps:,} of {config.steps:,}")
        if done:
            break
        run.step()
        if checkpoints is not None and run.steps % domain.episode_length == 0 and checkpoints.due():
            keep()
    keep()


class _Run:
    """A run after some steps: all that the rest of it depends on. The arguments are those of :func:`run_collection`."""

    def __init__(self, collector: Collector, config: CollectConfig, domain: Domain, sinks: Sequence[Sink], watcher: Watcher | None) -> None:
        seeds, members, length = collector.seeds, len(collector.seeds), domain.episode_length
        self.steps = 0
        self._collector, self._config, self._domain, self._sinks, self._watcher = collector, config, domain, sinks, watcher
        self._simulators = make_simulators(domain.name, members)
        self._first_actions = MemberRandom(seeds, "first actions")
        self._replay = None
        graphs = graphs_for(collector, collector.device)
        # Found anew at each step, so that whoever looks on may put itself in its place.
        self._act = Acts(lambda seen: collector.act(seen), getattr(collector, "random", {}).values(), collector.device, graphs)
        if collector.learns:
            episodes = math.ceil(config.steps / length)
            self._replay = Episodes(
                members, episodes, episodes * length, domain.observation_size, domain.action_size,
                MemberRandom(seeds, "replay", collector.device), skill=collector.skill_size,
            )  # fmt: skip
            self._update = Updates(collector, self._draw, self._replay.random, graphs)
        # The episode that is under way.
        self._reset_seeds = [0] * members
        self._observations = np.empty((members, length + 1, domain.observation_size), np.float32)
        self._actions = np.empty((members, length, domain.action_size), np.float32)
        self._physics = np.empty((members, length + 1, domain.physics_size), np.float64)
        self._skills = np.empty((members, length + 1, collector.skill_size), np.float32)
        # Of the states that its actions led to; those from ``counted`` on are not in ``visits`` yet.
        self._quantities = np.empty((members, length, len(domain.quantities)), np.float64)
        self._visits = [Visits(domain) for _ in self._simulators] if domain.descriptors else []
        self._counted = 0
        self._updates = 0
        self._metrics: dict[str, torch.Tensor] = {}
        self._row_every = config.measure_every * config.update_every
        self._timed_from = (0, time.perf_counter())

    def step(self) -> None:
        """One step of every member, and the update that is due after it."""
        collector, config, length = self._collector, self._config, self._domain.episode_length
        step, t = self.steps, self.steps % length
        if t == 0:
            self._reset(step // length)
        if collector.skill_size:
            self._skills[:, t : t + 2] = collector.next_skill(t).cpu().numpy()[:, None]
        if step < config.seed_steps and collector.learns:
            chosen = self._first_actions.uniform(self._domain.action_size) * 2.0 - 1.0
        else:
            chosen = self._act(torch.from_numpy(self._observations[:, t]))
        self._actions[:, t] = chosen.numpy()
        check_actions(self._actions[:, t], self._observations[:, t], f"at step {step:,}")
        done = step + 1 == config.steps
        ends = t + 1 == length or done
        # Within an episode the replay does not change: the update can begin, and a GPU be at it while the simulator steps.
        if not ends:
            self._learn(step)
        self._simulate(t)
        self.steps = step + 1
        if ends:
            self._hand_on(t + 1)
            self._learn(step)
        row_due = self.steps % self._row_every == 0 or done
        if self._visits and (row_due or t + 1 == length):
            for member, counts in enumerate(self._visits):
                counts.add(self._quantities[member, self._counted : t + 1])
            self._counted = (t + 1) % length
        if row_due:
            self._add_row()

    def _learn(self, step: int) -> None:
        """The update that is due at a step, if one is."""
        config = self._config
        if step < config.seed_steps or step % config.update_every or self._replay is None or not self._replay.episodes():
            return
        # The last update before a line.
        measure = (step + config.update_every) % self._row_every == 0 or step + config.update_every >= config.steps
        self._metrics, batch = self._update(measure)
        self._updates += 1
        if self._watcher is not None:
            self._watcher.after_update(batch)

    def _draw(self, measure: bool) -> Batch:
        assert self._replay is not None
        collector = self._collector
        return self._replay.sample(collector.config.batch_size, collector.horizon, measure, collector.nearest)

    def _reset(self, episode: int) -> None:
        for member, simulator in enumerate(self._simulators):
            self._reset_seeds[member] = episode_seed(self._collector.seeds[member], "environment", episode)
            simulator.reset(self._reset_seeds[member])
            simulator.observe(self._observations[member, 0])
            simulator.state(self._physics[member, 0])

    def _simulate(self, t: int) -> None:
        for member, simulator in enumerate(self._simulators):
            simulator.step(self._actions[member, t])
            simulator.observe(self._observations[member, t + 1])
            simulator.state(self._physics[member, t + 1])
            if self._visits:
                simulator.quantities(self._quantities[member, t])

    def _hand_on(self, length: int) -> None:
        """Give the episode that has just ended to the sinks, and, if it is whole, to the replay; neither ever sees a NaN."""
        for array in (self._observations, self._physics):
            check_simulated(array[:, : length + 1], f"in the episode before step {self.steps:,}")
        for member, sink in enumerate(self._sinks):
            observations, actions = self._observations[member, : length + 1], self._actions[member, :length]
            infos: dict[str, Float32 | Float64] = {"physics": self._physics[member, : length + 1]}
            skills = self._skills[member, : length + 1]
            if self._collector.skill_size:
                infos["skill"] = skills
            sink.add_episode(self._reset_seeds[member], observations, actions, infos)
            if length == self._domain.episode_length:
                self._remember(member, observations, actions, skills)

    def _remember(self, member: int, observations: Float32, actions: Float32, skills: Float32) -> None:
        if self._replay is not None:
            self._replay.add(member, *(torch.from_numpy(array) for array in (observations, actions, skills[:-1])))

    def _add_row(self) -> None:
        before, then = self._timed_from
        now = time.perf_counter()
        rate = (self.steps - before) / max(now - then, 1e-9)
        measured: Sequence[dict[str, Any]] = member_rows(self._metrics, self.steps) if self._metrics else [{}] * len(self._sinks)
        for member, (sink, row) in enumerate(zip(self._sinks, measured, strict=True)):
            covered = self._visits[member].coverage.as_row() if self._visits else {}
            sink.add_diagnostics({"step": self.steps, "updates": self._updates} | covered | row, rate)
        self._timed_from, self._metrics = (self.steps, now), {}

    def state(self) -> dict[str, Any]:
        """Everything but the finished episodes, which the sinks hold, and the simulators, which repeat the episode's actions."""
        t = self.steps % self._domain.episode_length
        return {
            "sinks": [sink.state_dict() for sink in self._resumable()],
            "collector": self._collector.state_dict(),
            "first_actions": self._first_actions.state_dict(),
            "replay": None if self._replay is None else self._replay.random.state_dict(),
            "actions": torch.from_numpy(self._actions[:, :t].copy()),
            "skills": torch.from_numpy(self._skills[:, : t + 1].copy()),
            "observation": torch.from_numpy(self._observations[:, t].copy()),
            "visits": [torch.from_numpy(counts.counts.copy()) for counts in self._visits],
            "counted": self._counted,
            "updates": self._updates,
            "metrics": dict(self._metrics),
            "watcher": None if self._watcher is None else self._watcher.state_dict(),
        }

    def load_state(self, steps: int, state: dict[str, Any]) -> None:
        """Continue exactly where ``state`` was taken, after so many steps.

        Raises:
            UnusableError: the finished episodes are damaged, or this machine's simulation goes another way.
        """
        length = self._domain.episode_length
        t = steps % length
        self._actions[:, :t] = state["actions"].cpu().numpy()
        if t and steps < self._config.steps:
            self._reset(steps // length)
            for past in range(t):
                self._simulate(past)
            if not np.array_equal(self._observations[:, t], state["observation"].cpu().numpy()):
                raise UnusableError
        for sink, part in zip(self._resumable(), state["sinks"], strict=True):
            sink.load_state_dict(part)
        self.steps, self._updates, self._counted = steps, state["updates"], state["counted"]
        self._skills[:, : t + 1] = state["skills"].cpu().numpy()
        self._collector.load_state_dict(state["collector"])
        self._first_actions.load_state_dict(state["first_actions"])
        for counts, values in zip(self._visits, state["visits"], strict=True):
            counts.counts[:] = values.cpu().numpy()
        self._metrics = state["metrics"]
        if self._watcher is not None:
            self._watcher.load_state_dict(state["watcher"])
        if self._replay is not None:
            for member, sink in enumerate(self._resumable()):
                for episode in sink.episodes():
                    if len(episode.actions) == length:
                        skills = episode.infos.get("skill", self._skills[member, :0])
                        self._remember(member, episode.observations, episode.actions, skills)
            self._replay.random.load_state_dict(state["replay"])
        self._timed_from = (steps, time.perf_counter())

    def _resumable(self) -> Sequence[ResumableSink]:
        return cast(Sequence[ResumableSink], self._sinks)
