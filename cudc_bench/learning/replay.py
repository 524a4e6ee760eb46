"""Episodes as flat arrays, and k-step transitions drawn from them by vectorised indexing.

One class serves both sides: a collector's growing replay buffer and an offline learner's fixed dataset. Arrays live on the device
where the networks live, and indices are drawn there.

Layout of one source (one collector seed): observations of all episodes one after the other, T+1 rows an episode; actions T rows an
episode. Episode i starts at action row ``starts[i]`` and at observation row ``starts[i] + i``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from cudc_bench.learning.networks import MemberRandom

FUTURE = 0.99  # how probable each further step is on the way to a future state, in all of HILP's and C-TeC's experiments
# What becomes of futures beyond the end of the episode: its last state takes their place, or those within share their probability.
Future = Literal["last", "within"]


@dataclass
class Batch:
    """One minibatch of k-step transitions for E members.

    Attributes:
        observation: s_t (E, B, S).
        action: a_t (E, B, A).
        next_observation: s_{t+k} (E, B, S).
        horizon: k of each member (E,), int64.
        reward: r_t (E, B); absent (None) in reward-free collection, where no extrinsic reward exists at all.
        measure: whether this update's metrics will be read; methods skip costly ones otherwise.
        skill: the skill (E, B, K) that a_t followed; None for methods without skills.
        next_action: a_{t+k} (E, B, A), for algorithms that ask for it.
        nearer_observation, nearer_horizon: s_{t+k'} (E, B, S) and k' ≤ k (E, B), int64, for methods that ask for a second end.
        future_observation, other_observation: a later state of the same episode and any state of the data, each (E, B, S), for algorithms
            that ask for them.
        cache: what a method computed for one step of its update and needs in a later one: values by name, or an object of its own.
        signal: what a method compares with the threshold that a pilot measures (E, B); set by the update, where there is one.
    """

    observation: Tensor
    action: Tensor
    next_observation: Tensor
    horizon: Tensor
    reward: Tensor | None = None
    measure: bool = False
    skill: Tensor | None = None
    next_action: Tensor | None = None
    nearer_observation: Tensor | None = None
    nearer_horizon: Tensor | None = None
    future_observation: Tensor | None = None
    other_observation: Tensor | None = None
    cache: Any = field(default_factory=dict)
    signal: Tensor | None = None


class Episodes:
    """Flat episodes of D sources, sampled for E members.

    Args:
        sources: D.
        episodes: capacity in episodes.
        steps: capacity in actions.
        observation: S.
        action: A.
        random: the members' streams for drawing indices.
        source_of_member: (E,) which source each member samples; member e samples source e by default.
        skill: K, the size of the skill that each action follows; 0 for none.
        rewards: whether episodes come with rewards; each member then has a source of its own.
    """

    def __init__(
        self, sources: int, episodes: int, steps: int, observation: int, action: int,
        random: MemberRandom, source_of_member: list[int] | None = None, skill: int = 0, rewards: bool = False,
    ) -> None:  # fmt: skip
        device = random.device
        self.random = random
        self.observations = torch.zeros(sources, steps + episodes, observation, device=device)
        self.actions = torch.zeros(sources, steps, action, device=device)
        self.skills = torch.zeros(sources, steps, skill, device=device) if skill else None
        self.rewards: Tensor | None = torch.zeros(sources, steps, device=device) if rewards else None
        self.starts = torch.zeros(sources, episodes, dtype=torch.int64, device=device)
        self.lengths = torch.zeros(sources, episodes, dtype=torch.int64, device=device)
        self.counts = torch.zeros(sources, dtype=torch.int64, device=device)
        self.source = torch.tensor(source_of_member or list(range(random.count)), device=device)
        self._filled = [(0, 0)] * sources

    def add(self, source: int, observations: Tensor, actions: Tensor, skills: Tensor | None = None, rewards: Tensor | None = None) -> None:
        """Append one finished episode: observations (T+1, S), actions (T, A), and, where there are some, skills (T, K) and rewards (T,)."""
        episode, start = self._filled[source]
        length = actions.shape[0]
        self.observations[source, start + episode : start + episode + length + 1] = observations.to(self.random.device)
        self.actions[source, start : start + length] = actions.to(self.random.device)
        if self.skills is not None and skills is not None:
            self.skills[source, start : start + length] = skills.to(self.random.device)
        if self.rewards is not None and rewards is not None:
            self.rewards[source, start : start + length] = rewards.to(self.random.device)
        self.starts[source, episode] = start
        self.lengths[source, episode] = length
        self.counts[source] = episode + 1
        self._filled[source] = (episode + 1, start + length)

    def episodes(self, source: int = 0) -> int:
        """How many finished episodes a source holds."""
        return self._filled[source][0]

    def indices(self, size: int, horizon: Tensor) -> tuple[Tensor, Tensor]:
        """Draw transitions: uniformly an episode, then uniformly a start t in {0, ..., T - k}.

        The window never leaves its episode; every episode must be at least k long.

        Args:
            size: B.
            horizon: k of each member (E,).

        Returns:
            Rows of s_t and of a_t in their source, each (E, B).
        """
        observation_row, action_row, _ = self._draw(size, horizon)
        return observation_row, action_row

    def _draw(self, size: int, horizon: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`indices`, and how many steps of its episode follow each s_t."""
        draws = self.random.uniform(2, size, dtype=torch.float64)
        counts = self.counts[self.source, None]
        episode = torch.minimum((draws[:, 0] * counts).long(), counts - 1)
        length = self.lengths[self.source[:, None], episode]
        starts_allowed = length - horizon[:, None] + 1
        offset = torch.minimum((draws[:, 1] * starts_allowed).long(), starts_allowed - 1)
        action_row = self.starts[self.source[:, None], episode] + offset
        return action_row + episode, action_row, length - offset

    def sample(
        self, size: int, horizon: Tensor, measure: bool = False, min_horizon: int | None = None, next_action: bool = False,
        future: Future | None = None,
    ) -> Batch:  # fmt: skip
        """A minibatch of B k-step transitions for each member; rewards are those of the first step.

        Args:
            size: B.
            horizon: k of each member (E,).
            measure: see :class:`Batch`.
            next_action: also give the action that follows s_{t+k}; transitions to the end of an episode, which has none, are left out.
            min_horizon: also give a second end to each transition, k' steps after its start, k' uniform from there to k.
            future: also give a state of the same episode that is Δ steps after s_t, Δ ≥ 1 geometric (``FUTURE``), or, with ``last``, the
                episode's last one where that is less, and with ``within`` under the condition that it is not; and any state of the data:
                uniformly an episode, then uniformly one of its states.
        """
        observation_row, action_row, left = self._draw(size, horizon + 1 if next_action else horizon)
        flat_observation = self.observations.flatten(0, 1)
        base = self.source[:, None]
        first = observation_row + base * self.observations.shape[1]
        rows = torch.cat([first, first + horizon[:, None]], dim=1)
        both = flat_observation.index_select(0, rows.flatten()).view(*rows.shape, -1)
        of_action = (action_row + base * self.actions.shape[1]).flatten()
        flat_action = self.actions.flatten(0, 1)
        action = flat_action.index_select(0, of_action)
        skill = None if self.skills is None else self.skills.flatten(0, 1).index_select(0, of_action).view(*action_row.shape, -1)
        following = None
        if next_action:
            of_next = (action_row + horizon[:, None] + base * self.actions.shape[1]).flatten()
            following = flat_action.index_select(0, of_next).view(*action_row.shape, -1)
        nearer, k = None, None
        if min_horizon is not None:
            span = horizon[:, None] - min_horizon + 1
            k = min_horizon + torch.minimum((self.random.uniform(size, dtype=torch.float64) * span).long(), span - 1)
            nearer = flat_observation.index_select(0, (first + k).flatten()).view(*first.shape, -1)
        later, other = None, None
        if future:
            reach = self.random.uniform(size, dtype=torch.float64)
            if future == "within":
                reach *= 1.0 - FUTURE ** left.double()
            steps = 1 + (torch.log1p(-reach) / math.log(FUTURE)).long()
            any_row, _ = self.indices(size, torch.zeros_like(horizon))
            rows = torch.cat([first + torch.minimum(steps, left), any_row + base * self.observations.shape[1]], dim=1)
            later, other = flat_observation.index_select(0, rows.flatten()).view(*rows.shape, -1).split(size, dim=1)
        return Batch(
            observation=both[:, :size],
            action=action.view(*action_row.shape, -1),
            next_observation=both[:, size:],
            horizon=horizon,
            reward=None if self.rewards is None else self.rewards.gather(1, action_row),
            skill=skill,
            measure=measure,
            next_action=following,
            nearer_observation=nearer,
            nearer_horizon=k,
            future_observation=later,
            other_observation=other,
        )
