"""Members that act in simulators of their own and learn on the way: what collecting and training online have in common.

A loop says how its members choose actions, which minibatches they learn from, and where finished episodes go.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from cudc_bench.data.writer import Episode
from cudc_bench.envs import Domain, make_simulators
from cudc_bench.errors import UnusableError
from cudc_bench.execution import interrupts
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.learning.checks import check_actions, check_bounds, check_simulated
from cudc_bench.learning.cuda_graphs import ActionRunner, Updater, rehearse
from cudc_bench.learning.engines import engine_of, graphs_for
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Batch, Episodes
from cudc_bench.settings.seeding import episode_seed

_NOTIFY_EVERY = 200  # steps


class Pace(Protocol):
    """How much members act and how often they learn."""

    @property
    def steps(self) -> int:
        """Environment steps in all."""

    @property
    def seed_steps(self) -> int:
        """Steps of uniformly random actions before the first update."""

    @property
    def update_every(self) -> int:
        """Environment steps for each update."""


class EpisodeStore(Protocol):
    """Holds the finished episodes of one member, for longer than the process lives."""

    def episodes(self) -> Iterator[Episode]:
        """All episodes so far, in order."""

    def state_dict(self) -> dict[str, Any]:
        """What is needed to find all that was added so far, which is on the disk when this returns."""

    def check(self, state: dict[str, Any]) -> None:
        """Whether all is there that had been added when ``state_dict`` was called.

        Raises:
            UnusableError: some of it is gone or damaged.
        """

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to what had been added when ``state_dict`` was called, after :meth:`check`."""


class Interaction(ABC):
    """A run after some steps: all that the rest of it depends on.

    One step is one fixed sequence: act, learn, simulate. An episode that ends is handed on first, and then learnt from.

    Attributes:
        steps: done so far.
        updates: done so far.
        metrics: of the last update that measured itself.
        domain, pace: what is acted in, how much and how often.
        replay: all whole episodes; None for members that do not learn.
        observations, actions, physics, quantities: of the episode that is under way, (E, T+1, S), (E, T, A), (E, T+1, P) and, of the states
            that its actions led to, (E, T, Q).
        reset_seeds: with which its environments were reset.
    """

    def __init__(
        self, learner: Any, domain: Domain, pace: Pace, random: Iterable[MemberRandom], *,
        learns: bool = True, rewards: bool = False, quantities: bool = False, skill: int = 0,
    ) -> None:  # fmt: skip
        """Begin a run.

        Args:
            learner: E members with ``seeds`` and a ``device``, whose ``update`` is called.
            domain: what they act in.
            pace: how much and how often.
            random: the streams that :meth:`act` draws from.
            learns: whether they learn at all; those that do not act by themselves from the first step on.
            rewards: whether the replay holds the rewards of episodes.
            quantities: whether the physical quantities after each step are read.
            skill: K, the size of the skill that each action follows.
        """
        seeds, members, length = learner.seeds, len(learner.seeds), domain.episode_length
        self.steps = self.updates = 0
        self.metrics: dict[str, Tensor] = {}
        self.domain, self.pace = domain, pace
        self._learner, self._seeds, self._reads, self._random_steps = learner, seeds, quantities, pace.seed_steps if learns else 0
        self._simulators = make_simulators(domain.name, members)
        self._first_actions = MemberRandom(seeds, "first actions")
        graphs = graphs_for(learner, learner.device)
        # On a CPU an action is a few small products, and compiling it would take longer than it could save.
        self._acts = ActionRunner(self.act, random, learner.device, None if learner.device.type == "cpu" else graphs)
        self.replay: Episodes | None = None
        if learns:
            episodes = math.ceil(pace.steps / length)
            self.replay = Episodes(
                members, episodes, episodes * length, domain.observation_size, domain.action_size,
                MemberRandom(seeds, "replay", learner.device), skill=skill, rewards=rewards,
            )  # fmt: skip
            self._update = Updater(learner, self.draw, self.replay.random, graphs)
        self.reset_seeds = [0] * members
        self.observations = np.empty((members, length + 1, domain.observation_size), np.float32)
        self.actions = np.empty((members, length, domain.action_size), np.float32)
        self.physics = np.empty((members, length + 1, domain.physics_size), np.float64)
        self.quantities = np.empty((members, length, len(domain.quantities)), np.float64)

    # What a loop says

    @abstractmethod
    def act(self, observation: Tensor) -> Tensor:
        """Actions (E, A) in [-1, 1] for observations (E, S), on the learner's device."""

    @abstractmethod
    def draw(self, measure: bool) -> Batch:
        """The minibatch of an update from the replay; told whether the update's metrics will be read."""

    @abstractmethod
    def is_measured(self, step: int) -> bool:
        """Whether the metrics of the update at a step will be read."""

    @abstractmethod
    def episode(self, member: int, length: int) -> Episode:
        """What is kept of a member's episode, which has just ended after so many steps; its arrays are written over later."""

    @abstractmethod
    def hand_on(self, member: int, episode: Episode) -> None:
        """Give a finished episode to whoever keeps it."""

    @abstractmethod
    def stores(self) -> Sequence[EpisodeStore]:
        """Where each member's finished episodes are, in a run with checkpoints."""

    def learnt(self, batch: Batch) -> None:  # noqa: B027, most have nothing to do here
        """The learner has just learnt from this minibatch."""

    def between(self) -> None:  # noqa: B027, most have nothing to do here
        """Called before the first step, between two of them, and after the last one.

        Raises:
            Interrupted: the process was asked to leave; what was begun here leaves no trace.
        """

    def rehearse(self) -> None:
        """Learn a little from one made-up episode of each member, which takes the memory that a run takes, and spoils this one."""
        if self.replay is None:
            return
        length, skills, rewards = self.domain.episode_length, self.replay.skills, self.replay.rewards
        observations, actions = torch.zeros(length + 1, self.domain.observation_size), torch.zeros(length, self.domain.action_size)
        for member in range(len(self._seeds)):
            self.replay.add(
                member, observations, actions, None if skills is None else torch.zeros(length, skills.shape[2]),
                None if rewards is None else torch.zeros(length),
            )  # fmt: skip
        rehearse(self._update)

    # The fixed sequence

    def run(self, advance: Callable[[int], None], checkpoints: Checkpoints | None = None) -> None:
        """Do all steps.

        Args:
            advance: told how many steps have been done since it was last called.
            checkpoints: where the state is kept at the ends of episodes, from time to time, and after the last step; what is found there is
                continued, with the same result as if the run had never stopped.

        Raises:
            BrokenDownError: the simulation diverged, or an observation, an action or a metric is not finite.
            Interrupted: the process was asked to leave; the state after the last step is kept.
        """
        kept = None if checkpoints is None else checkpoints.load(self.load_state, self._learner.device)

        def keep() -> None:
            nonlocal kept
            if checkpoints is not None and kept != self.steps:
                checkpoints.save(self.steps, self.state())
                kept = self.steps

        told, total = 0, self.pace.steps
        try:
            while True:
                done = self.steps == total
                if self.steps - told >= _NOTIFY_EVERY or done:
                    advance(self.steps - told)
                    told = self.steps
                if interrupts.requested():
                    raise interrupts.interrupted("")
                self.between()
                if done:
                    break
                self.step()
                if checkpoints is not None and self.steps % self.domain.episode_length == 0 and checkpoints.due():
                    keep()
        except interrupts.Interrupted:
            keep()
            raise interrupts.interrupted(f"at step {self.steps:,} of {total:,}") from None
        keep()

    def step(self) -> None:
        """One step of every member, and the update that is due after it."""
        length = self.domain.episode_length
        step, t = self.steps, self.steps % length
        if t == 0:
            self._reset(step // length)
        if step < self._random_steps:
            chosen = self._first_actions.uniform(self.domain.action_size) * 2.0 - 1.0
        else:
            chosen = self._acts(torch.from_numpy(self.observations[:, t]))
        self.actions[:, t] = chosen.numpy()
        check_actions(self.actions[:, t], self.observations[:, t], f"at step {step:,}")
        check_bounds(self.actions[:, t], f"at step {step:,}")
        ends = t + 1 == length or step + 1 == self.pace.steps
        # Within an episode the replay does not change: the update can begin, and a GPU be at it while the simulator steps.
        if not ends:
            self._learn(step)
        self._simulate(t)
        self.steps = step + 1
        if ends:
            self._end(t + 1)
            self._learn(step)

    def _learn(self, step: int) -> None:
        """The update that is due at a step, if one is."""
        if step < self.pace.seed_steps or step % self.pace.update_every or self.replay is None or not self.replay.episodes():
            return
        self.metrics, batch = self._update(self.is_measured(step))
        self.updates += 1
        self.learnt(batch)

    def _reset(self, episode: int) -> None:
        for member, simulator in enumerate(self._simulators):
            self.reset_seeds[member] = episode_seed(self._seeds[member], "environment", episode)
            simulator.reset(self.reset_seeds[member])
            simulator.observe(self.observations[member, 0])
            simulator.state(self.physics[member, 0])

    def _simulate(self, t: int) -> None:
        for member, simulator in enumerate(self._simulators):
            simulator.step(self.actions[member, t])
            simulator.observe(self.observations[member, t + 1])
            simulator.state(self.physics[member, t + 1])
            if self._reads:
                simulator.quantities(self.quantities[member, t])

    def _end(self, length: int) -> None:
        """Hand on the episode that has just ended, and remember it if it is whole; nobody ever sees a NaN."""
        for array in (self.observations, self.physics):
            check_simulated(array[:, : length + 1], f"in the episode before step {self.steps:,}")
        for member in range(len(self._seeds)):
            episode = self.episode(member, length)
            self.hand_on(member, episode)
            self._remember(member, episode)

    def _remember(self, member: int, episode: Episode) -> None:
        if self.replay is not None and len(episode.actions) == self.domain.episode_length:
            skill, rewards = episode.infos.get("skill"), episode.rewards
            self.replay.add(
                member, torch.from_numpy(episode.observations), torch.from_numpy(episode.actions),
                None if skill is None else torch.from_numpy(skill[:-1]), None if rewards is None else torch.from_numpy(rewards),
            )  # fmt: skip

    # The state

    def state(self) -> dict[str, Any]:
        """Everything but the finished episodes, which are stored, and the simulators, which repeat the episode's actions."""
        t = self.steps % self.domain.episode_length
        return {
            "stores": [store.state_dict() for store in self.stores()],
            "learner": self._learner.state_dict(),
            "engine": engine_of(self._learner),
            "first_actions": self._first_actions.state_dict(),
            "replay": None if self.replay is None else self.replay.random.state_dict(),
            "actions": torch.from_numpy(self.actions[:, :t].copy()),
            "observation": torch.from_numpy(self.observations[:, t].copy()),
            "updates": self.updates,
            "metrics": dict(self.metrics),
        }

    def load_state(self, steps: int, state: dict[str, Any]) -> None:
        """Continue exactly where ``state`` was taken, after so many steps.

        Raises:
            UnusableError: the finished episodes are damaged, or this machine's simulation goes another way.
        """
        t = steps % self.domain.episode_length
        self.actions[:, :t] = state["actions"].cpu().numpy()
        if t and steps < self.pace.steps:
            self._reset(steps // self.domain.episode_length)
            for past in range(t):
                self._simulate(past)
            if not np.array_equal(self.observations[:, t], state["observation"].cpu().numpy()):
                raise UnusableError
        stored = list(zip(self.stores(), state["stores"], strict=True))
        # All before the first goes back: it would keep what this run is about to do again if another one cannot.
        for store, part in stored:
            store.check(part)
        for store, part in stored:
            store.load_state_dict(part)
        self.steps, self.updates, self.metrics = steps, state["updates"], state["metrics"]
        self._learner.load_state_dict(state["learner"])
        self._first_actions.load_state_dict(state["first_actions"])
        if self.replay is not None:
            self._update.go_on_with(state["engine"])
            for member, store in enumerate(self.stores()):
                for episode in store.episodes():
                    self._remember(member, episode)
            self.replay.random.load_state_dict(state["replay"])
