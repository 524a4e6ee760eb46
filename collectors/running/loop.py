"""The loop that runs any collector: act, store, update, and hand every finished episode on."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol, cast

import numpy as np
import torch
from torch import Tensor

from cudc_bench.data.descriptors import Visits
from cudc_bench.data.writer import Episode
from cudc_bench.envs import Domain
from cudc_bench.envs.simulator import Float32, Float64
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.learning.checks import member_rows
from cudc_bench.learning.learner import set_precision
from cudc_bench.learning.replay import Batch
from cudc_bench.runs.interaction import EpisodeStore, Interaction
from cudc_bench.settings.collect_config import CollectConfig

from ..base import Collector


class Sink(Protocol):
    """Takes what one member collects."""

    def add_episode(self, seed: int, observations: Float32, actions: Float32, infos: dict[str, Float32 | Float64]) -> None:
        """One finished episode: its reset seed, observations (T+1, S), actions (T, A), and ``infos``.

        These are ``physics`` (T+1, P), the states, and for methods with skills ``skill`` (T+1, K): row t is what action t followed, and
        the last row repeats the one before, since no action follows it.
        """

    def add_diagnostics(self, row: dict[str, Any], steps_per_second: float) -> None:
        """One line of diagnostics: ``step``, ``updates``, the coverage of the domain's descriptors so far (see
        ``cudc_bench.data.descriptors``) where it has some, and what the last update since the line before measured of itself.

        Args:
            row: the same in every run with the same seed.
            steps_per_second: since the line before, or since the run was continued.
        """


class ResumableSink(Sink, EpisodeStore, Protocol):
    """A sink whose episodes outlive the process, for runs with checkpoints."""


class Callback(Protocol):
    """Looks at every update of a run."""

    def after_update(self, batch: Batch) -> None:
        """The method has just learnt from this batch."""

    def state_dict(self) -> dict[str, Any]:
        """What it has seen so far."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""


def run_collection(
    collector: Collector, config: CollectConfig, domain: Domain, sinks: Sequence[Sink], advance: Callable[[int], None],
    checkpoints: Checkpoints | None = None, callback: Callback | None = None,
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
    _Run(collector, config, domain, sinks, callback).run(advance, checkpoints)


def rehearse_collection(collector: Collector, config: CollectConfig, domain: Domain) -> None:
    """Take the memory that a collection takes, by a few updates on made-up data."""
    set_precision(collector, config.precision)
    _Run(collector, config, domain, [], None).rehearse()


class _Run(Interaction):
    """A run after some steps. The arguments are those of :func:`run_collection`."""

    def __init__(
        self, collector: Collector, config: CollectConfig, domain: Domain, sinks: Sequence[Sink], callback: Callback | None
    ) -> None:
        super().__init__(
            collector, domain, config, getattr(collector, "random", {}).values(),
            learns=collector.learns, quantities=bool(domain.descriptors), skill=collector.skill_size,
        )  # fmt: skip
        self._collector, self._config, self._sinks, self._callback = collector, config, sinks, callback
        self._skills = np.empty((len(collector.seeds), domain.episode_length + 1, collector.skill_size), np.float32)
        # Of the quantities of the episode that is under way, those from ``counted`` on are not in ``visits`` yet.
        self._visits = [Visits(domain) for _ in collector.seeds] if domain.descriptors else []
        self._counted = 0
        self._row_every = config.measure_every * config.update_every
        self._timed_from = (0, time.perf_counter())

    def act(self, observation: Tensor) -> Tensor:
        return self._collector.act(observation)

    def draw(self, measure: bool) -> Batch:
        assert self.replay is not None
        collector = self._collector
        size, horizon = collector.config.batch_size, collector.horizon
        return self.replay.sample(size, horizon, measure, collector.min_horizon, future=collector.wants_future)

    def is_measured(self, step: int) -> bool:
        # The last update before a line.
        config = self._config
        return (step + config.update_every) % self._row_every == 0 or step + config.update_every >= config.steps

    def learnt(self, batch: Batch) -> None:
        if self._callback is not None:
            self._callback.after_update(batch)

    def step(self) -> None:
        """One step of every member, the update that is due after it, and the line of diagnostics."""
        t, length = self.steps % self.domain.episode_length, self.domain.episode_length
        if self._collector.skill_size:
            self._skills[:, t : t + 2] = self._collector.next_skill(t).cpu().numpy()[:, None]
        super().step()
        row_due = self.steps % self._row_every == 0 or self.steps == self._config.steps
        if self._visits and (row_due or t + 1 == length):
            for member, counts in enumerate(self._visits):
                counts.add(self.quantities[member, self._counted : t + 1])
            self._counted = (t + 1) % length
        if row_due:
            self._add_row()

    def episode(self, member: int, length: int) -> Episode:
        infos: dict[str, Float32 | Float64] = {"physics": self.physics[member, : length + 1]}
        if self._collector.skill_size:
            infos["skill"] = self._skills[member, : length + 1]
        return Episode(self.reset_seeds[member], self.observations[member, : length + 1], self.actions[member, :length], infos)

    def hand_on(self, member: int, episode: Episode) -> None:
        self._sinks[member].add_episode(self.reset_seeds[member], episode.observations, episode.actions, dict(episode.infos))

    def stores(self) -> Sequence[ResumableSink]:
        return cast(Sequence[ResumableSink], self._sinks)

    def _add_row(self) -> None:
        before, then = self._timed_from
        now = time.perf_counter()
        rate = (self.steps - before) / max(now - then, 1e-9)
        measured: Sequence[dict[str, Any]] = member_rows(self.metrics, self.steps) if self.metrics else [{}] * len(self._sinks)
        for member, (sink, row) in enumerate(zip(self._sinks, measured, strict=True)):
            covered = self._visits[member].coverage.as_row() if self._visits else {}
            sink.add_diagnostics({"step": self.steps, "updates": self.updates} | covered | row, rate)
        self._timed_from, self.metrics = (self.steps, now), {}

    def state(self) -> dict[str, Any]:
        t = self.steps % self.domain.episode_length
        return super().state() | {
            "skills": torch.from_numpy(self._skills[:, : t + 1].copy()),
            "visits": [torch.from_numpy(counts.counts.copy()) for counts in self._visits],
            "counted": self._counted,
            "watcher": None if self._callback is None else self._callback.state_dict(),
        }

    def load_state(self, steps: int, state: dict[str, Any]) -> None:
        super().load_state(steps, state)
        self._counted = state["counted"]
        self._skills[:, : steps % self.domain.episode_length + 1] = state["skills"].cpu().numpy()
        for counts, values in zip(self._visits, state["visits"], strict=True):
            counts.counts[:] = values.cpu().numpy()
        if self._callback is not None:
            self._callback.load_state_dict(state["watcher"])
        self._timed_from = (steps, time.perf_counter())
