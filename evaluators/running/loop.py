"""The loop that trains any offline algorithm and evaluates its policy on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from cudc_bench.envs import Domain, make_simulators, reward_function
from cudc_bench.envs.rewards import CustomReward, Measured
from cudc_bench.envs.simulator import Float64, Simulator
from cudc_bench.execution import interrupts
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.execution.parallel import cores, torch_threads
from cudc_bench.execution.runlog import RunLog
from cudc_bench.learning.checks import check_actions, check_simulated, member_rows
from cudc_bench.learning.cuda_graphs import Updater, rehearse
from cudc_bench.learning.engines import engine_of, graphs_for
from cudc_bench.learning.learner import set_precision
from cudc_bench.learning.replay import Episodes
from cudc_bench.settings.evaluate_config import EvaluateConfig
from cudc_bench.settings.seeding import episode_seed

from ..base import Evaluator

FINAL = "final evaluation"  # the purpose of the seeds of the larger ones' episodes
_NOTIFY_EVERY = 100  # gradient steps


@dataclass(frozen=True)
class Outcome:
    """What came out for one member.

    Attributes:
        curve: (gradient step, undiscounted return of each episode) at every evaluation.
        finals: the same at the larger evaluations at the end.
        metrics: (gradient step, {metric: value}) at every evaluation after the first.
    """

    curve: list[tuple[int, list[float]]]
    finals: list[tuple[int, list[float]]]
    metrics: list[tuple[int, dict[str, float]]]


class Ledger:
    """What comes out for each member, while it does; logs hear of it as well.

    Args:
        members: E.
        logs: for each member or for none, take the training metrics and, as ``return_mean`` and ``final_return_mean``, the mean returns.

    Attributes:
        outcomes: so far.
    """

    def __init__(self, members: int, logs: Sequence[RunLog] = ()) -> None:
        self.outcomes = [Outcome([], [], []) for _ in range(members)]
        self._logs = logs

    @property
    def evaluated(self) -> int:
        """The step of the last evaluation of the curve; -1 before the first."""
        return self.outcomes[0].curve[-1][0] if self.outcomes[0].curve else -1

    @property
    def concluded(self) -> int:
        """The step of the last larger evaluation; -1 before the first."""
        return self.outcomes[0].finals[-1][0] if self.outcomes[0].finals else -1

    def add_returns(self, step: int, returns: Float64) -> None:
        """Returns (E, n) of an evaluation of the curve."""
        for outcome, row in zip(self.outcomes, returns, strict=True):
            outcome.curve.append((step, row.tolist()))
        self._log(step, ({"return_mean": float(row.mean())} for row in returns))

    def add_metrics(self, step: int, rows: Sequence[dict[str, float]]) -> None:
        """Each member's training metrics."""
        for outcome, values in zip(self.outcomes, rows, strict=True):
            outcome.metrics.append((step, values))
        self._log(step, rows)

    def add_final(self, step: int, returns: Float64) -> None:
        """Returns (E, n) of a larger evaluation."""
        for outcome, row in zip(self.outcomes, returns, strict=True):
            outcome.finals.append((step, row.tolist()))
        self._log(step, ({"final_return_mean": float(row.mean())} for row in returns))

    def _log(self, step: int, rows: Iterable[Mapping[str, float]]) -> None:
        for one, row in zip(self._logs, rows, strict=False):
            one.add(step, row)

    def state_dict(self) -> list[Any]:
        """All so far."""
        return [[list(outcome.curve), list(outcome.finals), list(outcome.metrics)] for outcome in self.outcomes]

    def load_state_dict(self, state: list[Any]) -> None:
        """Go back to where ``state_dict`` was called; the logs hear of it all."""
        self.outcomes = [Outcome(*parts) for parts in state]
        for outcome, one in zip(self.outcomes, self._logs, strict=False):
            measured = [(step, values) for step, values in outcome.metrics]
            scored = [
                (step, {name: sum(returns) / len(returns)})
                for name, evaluations in (("return_mean", outcome.curve), ("final_return_mean", outcome.finals))
                for step, returns in evaluations
            ]
            for step, values in sorted([*measured, *scored], key=lambda row: row[0]):
                one.add(step, values)


class Actor(Protocol):
    """What can be tried in an arena."""

    @property
    def device(self) -> torch.device:
        """Where it takes observations."""

    def act(self, observation: Tensor) -> Tensor:
        """Actions (E, n, A) in [-1, 1] for observations (E, n, S)."""


class Arena:
    """Simulators in which a stack of policies is tried, all episodes of all members side by side.

    They are stepped by as many threads as the policies are computed by, each its own share of them: MuJoCo lets other threads run
    while it works. The returns do not depend on how many there are.

    Args:
        domain: what is simulated.
        tasks: the task of each member, or one own reward function for all.
        threads: those that torch computes with by default; all cores for policies on another device.
    """

    def __init__(self, domain: Domain, tasks: Sequence[str] | CustomReward, threads: int | None = None) -> None:
        self._domain = domain
        self._custom = tasks if isinstance(tasks, CustomReward) else None
        self._tasks = None if isinstance(tasks, CustomReward) else np.array([domain.tasks.index(task) for task in tasks])
        self._rewards = reward_function(domain.name)
        self._threads = threads
        self._simulators: list[Simulator] = []
        self._kept: list[list[Simulator]] = []  # of each thread
        self._shares: list[slice] = []

    def evaluate(self, agent: Actor, seeds: Sequence[int], purpose: str, step: int, episodes: int) -> Float64:
        """Undiscounted returns (E, n) of an evaluation's episodes.

        Args:
            agent: E members.
            seeds: theirs.
            purpose, step: which evaluation; its episodes start where no other's do.
            episodes: n.

        Raises:
            BrokenDownError, Interrupted: as :meth:`returns`.
        """
        return self.returns(agent, [[episode_seed(seed, purpose, step, episode) for episode in range(episodes)] for seed in seeds])

    def returns(self, agent: Actor, seeds: Sequence[Sequence[int]]) -> Float64:
        """Undiscounted returns (E, n) of the deterministic policies; episode j of member e starts from ``seeds[e][j]``.

        Raises:
            BrokenDownError: a simulation diverged, or an observation, an action or a return is not finite.
            Interrupted: the process was asked to leave; an evaluation is repeated as a whole.
        """
        members, episodes = len(seeds), len(seeds[0])
        count = members * episodes
        threads = self._threads or (cores() if agent.device.type != "cpu" else torch.get_num_threads())
        self._prepare(count, min(threads, count))
        simulators = self._simulators
        observations = np.empty((count, self._domain.observation_size), np.float32)
        quantities = np.empty((count, len(self._domain.quantities)), np.float64)
        states = np.empty((count if self._custom else 0, self._domain.physics_size), np.float64)
        task = None if self._tasks is None else np.repeat(self._tasks, episodes)
        rows = np.arange(count)
        total = np.zeros(count)
        for simulator, seed, out in zip(simulators, (s for row in seeds for s in row), observations, strict=True):
            simulator.reset(seed)
            simulator.observe(out)

        def step(share: slice) -> None:
            for row in range(share.start, share.stop):
                simulator = simulators[row]
                simulator.step(actions[row])
                simulator.observe(observations[row])
                simulator.quantities(quantities[row])
                if len(states):
                    simulator.state(states[row])

        mine, *others = self._shares
        # Torch's own threads would wait for their next work in a busy loop, on the cores that the simulators now need.
        with torch_threads(1 if others else torch.get_num_threads()), ThreadPoolExecutor(max(1, len(others))) as pool:
            for _ in range(self._domain.episode_length):
                if interrupts.requested():
                    raise interrupts.interrupted("")
                stacked = torch.from_numpy(observations).view(members, episodes, -1).to(agent.device)
                actions = agent.act(stacked).cpu().numpy().reshape(count, -1)
                check_actions(actions, observations, "before this evaluation")
                stepping = [pool.submit(step, share) for share in others]
                step(mine)
                for one in stepping:
                    one.result()
                if self._custom is None:
                    total += self._rewards(quantities)[rows, task]
                else:
                    total += self._custom(Measured(self._domain, quantities, states, actions, observations))
        check_simulated(total, "in an evaluation")
        return total.reshape(members, episodes)

    def _prepare(self, count: int, threads: int) -> None:
        """Simulators in equal shares; those of two threads have no model in common, since stepping sets and resets flags in it."""
        ends = [round(count * (index + 1) / threads) for index in range(threads)]
        self._shares = [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]
        self._kept += [[] for _ in range(threads - len(self._kept))]
        self._simulators = []
        for share, kept in zip(self._shares, self._kept, strict=False):
            size = share.stop - share.start
            # Evaluations of two sizes follow one another, and to compile a model takes as long as many steps.
            if size > len(kept):
                kept[:] = make_simulators(self._domain.name, size)
            self._simulators += kept[:size]


class Trial(Protocol):
    """Who is tried at the evaluations of a training, where it is not its members themselves, each on its own task."""

    @property
    def each(self) -> int:
        """How many outcomes each member has."""

    def actor(self) -> Actor:
        """What is tried now: ``each`` policies of the first member, then those of the next."""


def rehearse_evaluation(agent: Evaluator, data: Episodes, config: EvaluateConfig) -> None:
    """Take the memory that a training takes, by a few updates."""
    rehearse(_updates(agent, data, config))


def _updates(agent: Evaluator, data: Episodes, config: EvaluateConfig) -> Updater:
    set_precision(agent, config.precision)
    horizon = torch.ones(len(agent.seeds), dtype=torch.int64, device=agent.device)
    return Updater(
        agent,
        lambda measure: data.sample(
            agent.config.batch_size, horizon, measure, next_action=agent.wants_next_action, future=agent.wants_future
        ),
        data.random,
        graphs_for(agent, agent.device),
    )


def run_evaluation(
    agent: Evaluator, data: Episodes, config: EvaluateConfig, arena: Arena, advance: Callable[[int], None], logs: Sequence[RunLog] = (),
    checkpoints: Checkpoints | None = None, trial: Trial | None = None,
) -> list[Outcome]:  # fmt: skip
    """Train ``config.gradient_steps`` updates on a fixed dataset and evaluate at 0, at every interval and at the end.

    The last few of these evaluations have a larger one beside them, of other episodes.

    Args:
        agent: E members.
        data: episodes, with a reward (E, steps) for each member that learns from rewards.
        config: how long and how often.
        arena: where the policies are tried.
        advance: told how many gradient steps have been done since it was last called.
        checkpoints: where the run's state is kept from time to time; what is found there is continued, with the same result as
            if it had never stopped.
        logs: see :class:`Ledger`.
        trial: who is tried instead of the members.

    Returns:
        What came out for each member, or for each of those that are tried.

    Raises:
        RunError: training diverged (a metric is not finite), or a simulation did.
        Interrupted: the process was asked to leave; the state is kept.
    """
    updates = _updates(agent, data, config)
    each = 1 if trial is None else trial.each
    seeds = [seed for seed in agent.seeds for _ in range(each)]
    ledger = Ledger(len(seeds), logs)
    points, final_points = set(config.points), set(config.final_points)

    def restore(_: int, state: dict[str, Any]) -> None:
        agent.load_state_dict(state["agent"])
        updates.go_on_with(state["engine"])
        data.random.load_state_dict(state["draws"])
        ledger.load_state_dict(state["outcomes"])

    def state() -> dict[str, Any]:
        # All that the rest of a run depends on. The episodes of an evaluation depend on its step alone.
        return {"agent": agent.state_dict(), "engine": engine_of(agent), "draws": data.random.state_dict(), "outcomes": ledger.state_dict()}

    step = start = 0 if checkpoints is None else checkpoints.load(restore, agent.device)
    advance(start)
    told = start
    try:
        for step in range(start, config.gradient_steps + 1):
            last = step == config.gradient_steps
            tries = step in points and ledger.evaluated < step
            concludes = step in final_points and ledger.concluded < step
            if tries or concludes:
                tried: Actor = agent if trial is None else trial.actor()
            if tries:
                ledger.add_returns(step, arena.evaluate(tried, seeds, "evaluation", step, config.evaluation_episodes))
            if concludes:
                ledger.add_final(step, arena.evaluate(tried, seeds, FINAL, step, config.final_episodes))
            if checkpoints is not None and checkpoints.due():
                checkpoints.save(step, state())
            if interrupts.requested():
                raise interrupts.interrupted("")
            if last:
                break
            measure = (step + 1) % config.evaluate_every == 0 or step + 1 == config.gradient_steps
            metrics, _ = updates(measure)
            if measure:
                ledger.add_metrics(step + 1, [row for row in member_rows(metrics, step + 1) for _ in range(each)])
            if step + 1 - told >= _NOTIFY_EVERY or step + 1 == config.gradient_steps:
                advance(step + 1 - told)
                told = step + 1
    except interrupts.Interrupted:
        # Raised between two updates, or in the middle of an evaluation, which leaves no trace: the state is that after ``step`` updates.
        if checkpoints is not None:
            checkpoints.save(step, state())
        raise interrupts.interrupted(f"at gradient step {step:,} of {config.gradient_steps:,}") from None
    return ledger.outcomes
