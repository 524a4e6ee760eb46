"""How good datasets are before anything is trained on them: what their states are worth to each task, and how far they spread.

Rewards and coverage are computed from the physics states, so that a dataset has them for every task of its domain, whatever it is
labelled for. Datasets of one domain are compared with one another; numbers of other domains have nothing to do with them.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from cudc_bench import plugins
from cudc_bench.artefacts.manifest import Manifest
from cudc_bench.data.descriptors import DescriptorCoverage
from cudc_bench.data.measure import NEIGHBOUR, STATS, EvenlySpaced, mean_log_distance
from cudc_bench.data.reader import read_episodes
from cudc_bench.envs import Domain, check_domain, reward_function
from cudc_bench.errors import UsageError
from cudc_bench.execution.progress import Advance, bars
from cudc_bench.text import plain

from ..intake.select import Chosen, select
from ..methods import METHOD_ORDER
from ..numbers.words import ordered, slug
from .diagnostics import group_of
from .visited import Trail, Visited

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
QUANTILES = (0.25, 0.5, 0.75, 0.95)
BINS = 50  # of the density of rewards, over [0, 1]


@dataclass(frozen=True)
class RewardDensity:
    """What a dataset's states are worth to one task, per step, in [0, 1] (the paper's Fig. 10, for every task).

    A trajectory's reward is the mean over the steps of an episode.

    Attributes:
        mean: over trajectories.
        quantiles: 25, 50, 75 and 95 % of the trajectories.
        best: the largest of a trajectory.
        top: mean of the 1 % largest rewards of single steps.
        above_half, above_nine: shares of the steps with rewards above 0.5 and 0.9.
        density: of the rewards of single steps in 50 equal bins of [0, 1]; its mean over the bins is 1.
    """

    mean: float
    quantiles: tuple[float, ...]
    best: float
    top: float
    above_half: float
    above_nine: float
    density: tuple[float, ...]


@dataclass(frozen=True)
class TaskMeasures:
    """What a dataset has of a task beside others (see :mod:`.yardsticks`); None where there is nothing to measure it by.

    Attributes:
        trajectory_quality: TQ, the mean return of its episodes between the task's floor, 0, and its ceiling, 1.
        coverage_ratio: SACo, how many state-action pairs it has for each that a replay of the task has.
        expert_recall: the share of an expert's states in whose cells it has been.
        expert_precision: the share of its states in whose cells an expert has been.
    """

    trajectory_quality: float | None
    coverage_ratio: float | None
    expert_recall: float | None
    expert_precision: float | None


@dataclass(frozen=True)
class Quality:
    """One dataset's.

    Attributes:
        id, manifest: which.
        rewards: by task, in the domain's order.
        coverage: of its behaviour descriptors; None for a domain without any.
        particle_entropy: Kozachenko and Leonenko's estimate of the differential entropy of the observations in nats, from the distances to
            the 12th neighbour among up to 20,000 of them (Singh et al. 2003), each observation standardised over all datasets that it is
            compared with, so that it means nothing beside another comparison's. None for 12 observations or fewer.
        action_std: of each actuator over all steps (A,).
        action_saturated: share of all action components with a size above 0.95; 0.05 for uniform actions.
        action_correlation: between a component of an action and that of the next step, mean over actuators; 0 for independent actions.
            None where actions never vary.
        visited: where its states lie, and how many state-action pairs it has; None for a domain without descriptors, and of what was kept
            from an earlier measurement.
        tasks: what it has of tasks beside others, of those for which there is anything to measure by.
    """

    id: str
    manifest: Manifest
    rewards: dict[str, RewardDensity]
    coverage: DescriptorCoverage | None
    particle_entropy: float | None
    action_std: tuple[float, ...]
    action_saturated: float
    action_correlation: float | None
    visited: Visited | None = field(default=None, repr=False, compare=False)
    tasks: Mapping[str, TaskMeasures] = field(default_factory=dict, repr=False)


@dataclass(frozen=True)
class QualityTable:
    """Datasets that may be compared: of one domain, one profile, with the same settings changed.

    Attributes:
        group: profile and whatever differs from it, on one line.
        domain, tasks: what was explored.
        slug: a safe and unique name for files.
        methods: in the order of leaderboards.
        datasets: by method and seed.
    """

    group: str
    domain: str
    tasks: tuple[str, ...]
    slug: str
    methods: tuple[str, ...]
    datasets: tuple[Quality, ...] = field(repr=False)

    def of(self, method: str) -> list[Quality]:
        """A method's datasets."""
        return [one for one in self.datasets if one.manifest.label == method]


def measure_stored(
    dataset_ids: str | Sequence[str] | None = None, domain: str | None = None, methods: Sequence[str] | None = None
) -> tuple[list[QualityTable], list[str]]:
    """The quality of datasets side by side, and one line for each that was left out.

    Args:
        dataset_ids: task-agnostic datasets; all below the dataset root unless given.
        domain, methods: only datasets of that domain, of these methods.

    Raises:
        UsageError: there is no such dataset, or one that was named is labelled or holds no physics states.
        RunError: a dataset is damaged.
    """
    found, remarks = measurable(dataset_ids, domain, methods)
    return _compare(found), remarks


def measurable(
    dataset_ids: str | Sequence[str] | None, domain: str | None = None, methods: Sequence[str] | None = None
) -> tuple[Chosen, list[str]]:
    """The datasets that :func:`measure_stored` measures, and a line for each that was left out; the arguments and errors are its own."""
    return select(
        dataset_ids, domain, methods, others=lambda manifest: manifest.base is not None, refuse=_refuse, lacks=_lacks,
        verb="can be measured",
    )  # fmt: skip


def _refuse(one: str, manifest: Manifest) -> None:
    if manifest.base is not None:
        raise UsageError(f"'{one}' is labelled for {plain(str(manifest.task))}; name its base '{plain(manifest.base.id)}'.")
    if _lacks(one, manifest):
        raise UsageError(f"'{one}' holds no physics states, from which rewards are computed; import files that have them.")


def _lacks(_: str, manifest: Manifest) -> str | None:
    return None if "infos/physics" in manifest.fields else "it holds no physics states"


def _compare(found: Iterable[tuple[str, Manifest]]) -> list[QualityTable]:
    split: dict[tuple[str, str], list[tuple[str, Manifest]]] = defaultdict(list)
    for one, manifest in found:
        split[manifest.domain, group_of(manifest)].append((one, manifest))
    tables = []
    for (name, group), members in sorted(split.items()):
        domain = check_domain(name)
        methods = ordered({manifest.label for _, manifest in members}, METHOD_ORDER)
        members.sort(key=lambda one: (methods.index(one[1].label), one[1].seed, one[0]))
        with bars([(f"quality of {one}", manifest.steps) for one, manifest in members], "states") as advances:
            measured = [measure(one, manifest, domain, advance) for (one, manifest), advance in zip(members, advances, strict=True)]
        entropies = particle_entropies([points for _, points in measured])
        datasets = tuple(replace(one, particle_entropy=entropy) for (one, _), entropy in zip(measured, entropies, strict=True))
        tables.append(QualityTable(plain(group), plain(name), domain.tasks, slug(group, "quality", name), methods, datasets))
    return tables


def measure(
    dataset_id: str, manifest: Manifest, domain: Domain, advance: Advance, look: Callable[[Float64, Float32], None] | None = None
) -> tuple[Quality, Float32]:
    """One dataset's quality but for the particle entropy, and observations (n, S) for that.

    Args:
        dataset_id, manifest, domain: which.
        advance: told of the states that have been read.
        look: takes each episode's quantities (T, Q), without the reset's, and actions (T, A), to see more in them.
    """
    relabeler, function = plugins.load("relabelers", domain.relabeler)(domain), reward_function(domain.name)
    trail = Trail(domain) if domain.descriptors else None
    points = EvenlySpaced(manifest, STATS.points)
    rewards, actions = [], []
    for episode in read_episodes(dataset_id, ("infos/physics", "actions", "observations")):
        # Row 0 of an episode is its reset, which no action led to.
        quantities = relabeler.quantities(episode["infos/physics"][1:], episode["actions"])
        if trail is not None:
            trail.add(quantities, episode["actions"])
        rewards.append(function(quantities))
        if look is not None:
            look(quantities, episode["actions"])
        actions.append(episode["actions"])
        points.add(episode["observations"])
        advance(len(episode["actions"]))
    densities = {task: reward_density([one[:, index] for one in rewards]) for index, task in enumerate(domain.tasks)}
    together = np.concatenate(actions)
    visited = None if trail is None else trail.visited
    quality = Quality(
        id=dataset_id,
        manifest=manifest,
        rewards=densities,
        coverage=None if visited is None else visited.coverage,
        particle_entropy=None,
        action_std=tuple(together.std(0, dtype=np.float64).tolist()),
        action_saturated=float(STATS.at_bound(together).mean()),
        action_correlation=action_correlation(actions),
        visited=visited,
    )
    return quality, points.together()


def reward_density(rewards: Sequence[Float64]) -> RewardDensity:
    """From the rewards (T,) of each episode, in [0, 1]."""
    means = np.array([episode.mean() for episode in rewards])
    steps = np.concatenate(rewards)
    top = max(1, len(steps) // 100)
    density, _ = np.histogram(steps, bins=BINS, range=(0.0, 1.0), density=True)
    return RewardDensity(
        mean=float(means.mean()),
        quantiles=tuple(np.quantile(means, QUANTILES).tolist()),
        best=float(means.max()),
        top=float(np.partition(steps, len(steps) - top)[-top:].mean()),
        above_half=float((steps > 0.5).mean()),
        above_nine=float((steps > 0.9).mean()),
        density=tuple(density.tolist()),
    )


def action_correlation(actions: Sequence[Float32]) -> float | None:
    """The correlation of consecutive actions (T, A) of the episodes, mean over actuators that vary; None if none does."""
    pairs = [episode.astype(np.float64) for episode in actions if len(episode) > 1]
    if not pairs:
        return None
    before, after = (np.concatenate([episode[part] for episode in pairs]) for part in (slice(None, -1), slice(1, None)))
    before, after = before - before.mean(0), after - after.mean(0)
    scale = np.sqrt((before**2).sum(0) * (after**2).sum(0))
    varies = scale > 0
    return float(((before * after).sum(0)[varies] / scale[varies]).mean()) if varies.any() else None


def particle_entropies(points: Sequence[Float32]) -> list[float | None]:
    """The particle entropy of each dataset's observations (n, S), as :class:`Quality` has it; all are standardised by their union."""
    from scipy.special import digamma, gammaln

    union = np.concatenate(points).astype(np.float64)
    mean, spread = union.mean(0), union.std(0)
    varies = spread > 1e-8 * (1 + np.abs(mean))
    size = int(varies.sum())
    found: list[float | None] = []
    for one in points:
        if len(one) <= NEIGHBOUR or not size:
            found.append(None)
            continue
        scaled = ((one[:, varies] - mean[varies]) / spread[varies]).astype(np.float32)
        ball = size / 2 * math.log(math.pi) - gammaln(size / 2 + 1)
        found.append(float(digamma(len(one)) - digamma(NEIGHBOUR) + ball + size * mean_log_distance(scaled, STATS)))
    return found
