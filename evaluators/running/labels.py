"""What learners without rewards are told of their tasks: a few transitions of a dataset, with the rewards that its states have there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cudc_bench import plugins
from cudc_bench.artefacts.manifest import RewardFunction
from cudc_bench.artefacts.records import LabelSource
from cudc_bench.data.reader import load_episodes
from cudc_bench.envs import Domain
from cudc_bench.envs.rewards import CustomReward, Measured
from cudc_bench.settings.seeding import stream_seed

from ..zero_shot import Labelled, ZeroShotLearner, normalised
from .loop import Actor


@dataclass(frozen=True)
class Question:
    """A task, and how much a learner is told of it.

    Attributes:
        task: of the domain, or the name of an own reward function.
        labels: transitions whose rewards it may see.
        reward: the own function.
        source: the dataset that the transitions are of, if not the one that was trained on.
    """

    task: str
    labels: int
    reward: RewardFunction | None = None
    source: LabelSource | None = None

    @property
    def facts(self) -> list[str | int | None]:
        """What its answer depends on, beside the training."""
        reward = None if self.reward is None else self.reward.sha256
        return [self.task, self.labels, reward, None if self.source is None else self.source.fingerprint]


@dataclass(frozen=True)
class Samples:
    """Labelled transitions of one dataset, in an order that is the same for every learner: the first so many are a budget's.

    Attributes:
        observation, action, next_observation: (m, S), (m, A), (m, S).
        rewards: of each task (m,).
    """

    observation: Tensor
    action: Tensor
    next_observation: Tensor
    rewards: dict[str, Tensor]


def draw_labels(
    dataset_id: str, domain: Domain, tasks: Sequence[str], most: int, custom: CustomReward | None = None, used: int | None = None
) -> Samples:
    """Draw transitions of a dataset, and compute their rewards from its physics states, as :func:`relabel` does.

    Which are drawn depends on the dataset alone, not on the learner, its seed or the task, and a smaller number of them is the beginning
    of a larger one.

    Args:
        dataset_id: holds physics states.
        domain: its own.
        tasks: of the domain; the own function's name with ``custom``.
        most: how many, or all that there are.
        custom: an own reward function.
        used: only of the first so many transitions.

    Raises:
        RunError: the dataset is damaged.
        BrokenDownError: the reward function failed.
    """
    flat = load_episodes(dataset_id, ("observations", "actions", "infos/physics"), verify=True)
    count = min(used or flat.manifest.steps, flat.manifest.steps)
    seed = stream_seed(int(flat.manifest.fingerprint[:16], 16), "labels")
    rows = np.random.default_rng(seed).permutation(count)[:most]
    # Rows of states and observations have one for each episode's reset, too.
    starts = rows + np.searchsorted(np.cumsum(flat.lengths), rows, side="right")
    following, actions = flat.arrays["observations"][starts + 1], flat.arrays["actions"][rows]
    states = flat.arrays["infos/physics"][starts + 1]
    relabeler = plugins.load("relabelers", domain.relabeler)(domain)
    if custom is None:
        rewards = relabeler.rewards(states, actions)
        columns = {task: rewards[:, domain.tasks.index(task)] for task in tasks}
    else:
        columns = {custom.name: custom(Measured(domain, relabeler.quantities(states, actions), states, actions, following))}
    return Samples(
        torch.from_numpy(flat.arrays["observations"][starts]), torch.from_numpy(actions), torch.from_numpy(following),
        {task: torch.from_numpy(np.asarray(column, np.float32)) for task, column in columns.items()},
    )  # fmt: skip


@dataclass(frozen=True)
class Told:
    """What a learner makes of its questions.

    Attributes:
        z: each member's vector for each question (E, K, d), of length √d or zero.
        norms: what their lengths were before they were scaled (E, K).
    """

    z: Tensor
    norms: Tensor


class Interview:
    """A zero-shot learner, and the questions that each of its members is asked at every evaluation.

    Args:
        agent: E members.
        samples: of each member; all have as many.
        questions: the same for all members.
        goal: the observation (E, S) that is each question's only rewarded state, instead of the labels' own rewards.
    """

    def __init__(
        self, agent: ZeroShotLearner, samples: Sequence[Samples], questions: Sequence[Question], goal: Tensor | None = None
    ) -> None:
        self._agent, self._questions = agent, questions
        self._samples, self._goal = samples, goal

    @property
    def each(self) -> int:
        """K, how many questions there are."""
        return len(self._questions)

    def told(self) -> Told:
        """What follows from the labels now; each question by itself, so that its answer depends on no other."""
        agent, goal = self._agent, self._goal
        known = map(self.labelled, self._questions)
        found = [agent.direction(one) if goal is None else agent.toward(goal, one) for one in known]
        raw = torch.cat(found, dim=1)
        return Told(normalised(raw), raw.norm(dim=-1))

    def actor(self) -> Actor:
        """The policies of all questions of the first member, then those of the next."""
        return _Several(self._agent, self.told().z)

    def labelled(self, question: Question) -> Labelled:
        """The labels of a question, (E, 1, m) of them."""
        device, most = self._agent.device, question.labels
        parts = [
            (one.observation[:most], one.action[:most], one.next_observation[:most], one.rewards[question.task][None, :most])
            for one in self._samples
        ]
        return Labelled(*(torch.stack(columns).to(device) for columns in zip(*parts, strict=True)))


class _Several:
    """Policies of several questions to each member, as a stack of members."""

    def __init__(self, agent: ZeroShotLearner, z: Tensor) -> None:
        self.device = agent.device
        self._agent, self._z = agent, z

    def act(self, observation: Tensor) -> Tensor:
        """(E K, n, S) -> (E K, n, A). A question's are computed by themselves: their bits do not depend on how many there are."""
        members, questions, size = self._z.shape
        count = observation.shape[1]
        apart = observation.view(members, questions, count, -1)
        actions = [
            self._agent.act_for(apart[:, one].contiguous(), self._z[:, one, None].expand(members, count, size)) for one in range(questions)
        ]
        return torch.stack(actions, 1).flatten(0, 1)
