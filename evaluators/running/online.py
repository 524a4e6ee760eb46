"""The loop that trains an agent on tasks themselves: it acts with noise, keeps what it did and what it was rewarded for, and learns.

ExORL's oracle is such an agent (Yarats et al. 2022): what it gets at last is what a dataset's training is measured against.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import Any, Protocol, cast

import numpy as np
import torch
from torch import Tensor

from cudc_bench.data.writer import Episode
from cudc_bench.envs import Domain, reward_function
from cudc_bench.execution import interrupts
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.execution.runlog import RunLog
from cudc_bench.learning.checks import member_rows
from cudc_bench.learning.learner import set_precision
from cudc_bench.learning.networks import MemberRandom, noisy_action
from cudc_bench.learning.replay import Batch
from cudc_bench.runs.interaction import EpisodeStore, Interaction
from cudc_bench.settings.evaluate_config import OnlineConfig

from ..base import Evaluator
from .loop import FINAL, Arena, Ledger, Outcome


class EpisodeSink(Protocol):
    """Takes what one member does; with checkpoints, also an :class:`~cudc_bench.runs.interaction.EpisodeStore`."""

    def add(self, episode: Episode) -> None:
        """One finished episode, with the states (``physics``) and the task's rewards; its arrays are written over later."""


def run_online(
    agent: Evaluator, config: OnlineConfig, domain: Domain, tasks: Sequence[str], arena: Arena, advance: Callable[[int], None],
    sinks: Sequence[EpisodeSink] = (), logs: Sequence[RunLog] = (), checkpoints: Checkpoints | None = None,
    evaluated: Callable[[int], None] = lambda step: None,
) -> list[Outcome]:  # fmt: skip
    """Train for ``config.steps`` environment steps on each member's task, and evaluate the deterministic policy on the way.

    The actions are the policy's with Gaussian noise, clamped; minibatches are one-step transitions of all whole episodes so far.

    Args:
        agent: E members.
        config: how much, how often, and with how much noise.
        domain: what they act in.
        tasks: the task of each member.
        arena: where the policies are tried, with the same tasks.
        advance: told how many environment steps have been done since it was last called.
        sinks: one for each member, or none; with ``checkpoints`` they must hold what they get for longer than the process lives.
        logs: see :class:`~.loop.Ledger`; steps are the environment's.
        checkpoints: as for :meth:`Interaction.run <cudc_bench.runs.interaction.Interaction.run>`; the evaluations are repeated exactly.
        evaluated: told of each evaluation's step, while the policies are those that were evaluated; of some again after a resumption.

    Returns:
        Of each member the curve, the final evaluation and the metrics, by environment steps.

    Raises:
        BrokenDownError: training diverged (an action or a metric is not finite), or a simulation did.
        Interrupted: the process was asked to leave; the state is kept.
    """
    set_precision(agent, config.precision)
    run = _Run(agent, config, domain, tasks, arena, sinks, Ledger(len(agent.seeds), logs), evaluated)
    run.run(advance, checkpoints)
    try:
        run.ledger.add_final(config.steps, arena.evaluate(agent, agent.seeds, FINAL, config.steps, config.final_episodes))
    except interrupts.Interrupted:
        # It is repeated from the state after the last step, which is kept.
        raise interrupts.interrupted(f"at step {config.steps:,} of {config.steps:,}") from None
    return run.ledger.outcomes


def rehearse_online(agent: Evaluator, config: OnlineConfig, domain: Domain, tasks: Sequence[str]) -> None:
    """Take the memory that such a training takes, by a few updates on made-up data."""
    set_precision(agent, config.precision)
    _Run(agent, config, domain, tasks, Arena(domain, tasks), [], Ledger(len(agent.seeds))).rehearse()


class PolicyInteraction(Interaction):
    """Agents that act with Gaussian noise around their policies, each on its task, and whose episodes hold the live rewards.

    Args:
        agent, config, domain, tasks, sinks: those of :func:`run_online`.
        learns: whether they do, on the way.
        stream: what their noise is drawn for.
    """

    def __init__(
        self, agent: Evaluator, config: OnlineConfig, domain: Domain, tasks: Sequence[str], sinks: Sequence[EpisodeSink], *, learns: bool,
        stream: str = "act",
    ) -> None:  # fmt: skip
        self._agent, self._config, self._sinks = agent, config, sinks
        self._noise = MemberRandom(agent.seeds, stream, agent.device)
        self._tasks = [domain.tasks.index(task) for task in tasks]
        self._rewards = reward_function(domain.name)
        super().__init__(agent, domain, config, [self._noise], learns=learns, rewards=True, quantities=True)

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        mean = self._agent.policy(observation[:, None])[:, 0]
        return noisy_action(mean, self._noise.normal(*mean.shape[1:]), self._config.exploration_std, None)

    def draw(self, measure: bool) -> Batch:
        raise NotImplementedError("these members do not learn")

    def is_measured(self, step: int) -> bool:
        return False

    def episode(self, member: int, length: int) -> Episode:
        rewards = self._rewards(self.quantities[member, :length])[:, self._tasks[member]].astype(np.float32)
        infos = {"physics": self.physics[member, : length + 1]}
        return Episode(self.reset_seeds[member], self.observations[member, : length + 1], self.actions[member, :length], infos, rewards)

    def hand_on(self, member: int, episode: Episode) -> None:
        if self._sinks:
            self._sinks[member].add(episode)

    def stores(self) -> Sequence[EpisodeStore]:
        return cast(Sequence[EpisodeStore], self._sinks)

    def state(self) -> dict[str, Any]:
        return super().state() | {"noise": self._noise.state_dict()}

    def load_state(self, steps: int, state: dict[str, Any]) -> None:
        super().load_state(steps, state)
        self._noise.load_state_dict(state["noise"])


class _Run(PolicyInteraction):
    """A run after some steps. The arguments are those of :func:`run_online`."""

    def __init__(
        self, agent: Evaluator, config: OnlineConfig, domain: Domain, tasks: Sequence[str], arena: Arena,
        sinks: Sequence[EpisodeSink], ledger: Ledger, evaluated: Callable[[int], None] = lambda step: None,
    ) -> None:  # fmt: skip
        self._arena, self.ledger, self._evaluated = arena, ledger, evaluated
        self._horizon = torch.ones(len(agent.seeds), dtype=torch.int64, device=agent.device)
        self._points = config.points
        super().__init__(agent, config, domain, tasks, sinks, learns=True)

    def draw(self, measure: bool) -> Batch:
        assert self.replay is not None
        agent = self._agent
        return self.replay.sample(agent.config.batch_size, self._horizon, measure, next_action=agent.wants_next_action)

    def is_measured(self, step: int) -> bool:
        # The last update before an evaluation.
        return self._points[bisect_right(self._points, step)] <= step + self._config.update_every

    def between(self) -> None:
        step, ledger = self.steps, self.ledger
        if ledger.evaluated >= step or step not in self._points:
            return
        returns = self._arena.evaluate(self._agent, self._agent.seeds, "evaluation", step, self._config.evaluation_episodes)
        self._evaluated(step)
        if self.metrics:
            ledger.add_metrics(step, member_rows(self.metrics, step))
            self.metrics = {}
        ledger.add_returns(step, returns)

    def state(self) -> dict[str, Any]:
        return super().state() | {"ledger": self.ledger.state_dict()}

    def load_state(self, steps: int, state: dict[str, Any]) -> None:
        super().load_state(steps, state)
        self.ledger.load_state_dict(state["ledger"])
