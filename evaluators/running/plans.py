"""What is to be trained: algorithms with all their hyperparameters, on which datasets and how many of their transitions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from cudc_bench import plugins
from cudc_bench.artefacts.ids import parse_id
from cudc_bench.artefacts.manifest import Manifest, exists, read_manifest
from cudc_bench.artefacts.records import LABELS
from cudc_bench.artefacts.tiers import TIERS
from cudc_bench.envs import check_domain, check_tasks
from cudc_bench.envs.rewards import CustomReward, Measured, load_reward
from cudc_bench.errors import UsageError
from cudc_bench.learning.learner import check_precision
from cudc_bench.settings.config import as_dict, build, changed, check_settings
from cudc_bench.settings.evaluate_config import EvaluateConfig, check_milestones, plain_values, profile_values
from cudc_bench.settings.profiles import Profile
from cudc_bench.stages import check_collected, check_profile, check_tiers, ensure_collected, ensure_relabelled


@dataclass(frozen=True)
class Plan:
    """One algorithm with everything that it needs.

    Attributes:
        algo, kind: its name and class.
        profile: the set of hyperparameters that it starts from.
        loop, config: all hyperparameters.
        overrides: those that the user changed.
    """

    algo: str
    kind: Any
    profile: str
    loop: EvaluateConfig
    config: Any
    overrides: dict[str, Any]

    @property
    def values(self) -> dict[str, Any]:
        """All hyperparameters by name."""
        return as_dict(self.loop, self.config)

    @property
    def is_zero_shot(self) -> bool:
        """Whether it trains without rewards, and is told of tasks afterwards."""
        return not self.kind.learns_from_rewards


def make_plans(algos: Sequence[str], profile: Profile, settings: dict[str, Any], steps: int | None) -> list[Plan]:
    """One for each algorithm; a setting must be known to one of them at least.

    Raises:
        UsageError: there is none, or a setting is wrong.
    """
    kinds = {name: plugins.load("evaluators", name) for name in algos}
    if not kinds:
        raise UsageError(f"no algorithm was given; allowed: {', '.join(plugins.names('evaluators'))}.")
    check_settings(settings, [EvaluateConfig, *(kind.config_class for kind in kinds.values())])
    if steps is not None:
        if "gradient_steps" in settings:
            raise UsageError("--steps and --set gradient_steps say the same; give one of them.")
        before = build(EvaluateConfig, profile.evaluate, settings).milestones
        settings = {"milestones": [*(one for one in before if one < steps), steps]} | settings | {"gradient_steps": steps}
    loop = build(EvaluateConfig, profile.evaluate, settings)
    check_milestones(loop)
    plans = []
    for name, kind in kinds.items():
        config = kind.configure(profile_values(profile, loop.gradient_steps), settings)
        overrides = changed(as_dict(loop, config), plain_values(kind, profile, loop.gradient_steps))
        plans.append(Plan(name, kind, profile.name, loop, config, overrides))
    return plans


def check_plans(plans: Sequence[Plan], device: str) -> None:
    """Refuse what cannot be computed on a device.

    Raises:
        UsageError: one of them asks for it.
    """
    for plan in plans:
        check_precision(plan.kind, plan.algo, plan.loop.precision, device)


def check_sizes(sizes: Sequence[int] | None) -> list[int] | None:
    """Numbers of transitions, ascending without repeats.

    Raises:
        UsageError: there is none, or one is less than 1.
    """
    if sizes is None:
        return None
    if not sizes or min(sizes) < 1:
        raise UsageError("a dataset size is a number of transitions, 1 or more.")
    return sorted(set(sizes))


def sizes_of(sizes: list[int] | None, dataset_id: str, manifest: Manifest) -> list[int | None]:
    """How many transitions to train on, None for all of them.

    Raises:
        UsageError: the dataset has fewer.
    """
    if sizes is None:
        return [None]
    if (largest := max(sizes)) > manifest.steps:
        raise UsageError(f"'{dataset_id}' has {manifest.steps:,} transitions, not {largest:,}; leave out the larger sizes.")
    return [None if size == manifest.steps else size for size in sizes]


@dataclass(frozen=True)
class Wanted:
    """The labelled datasets that somebody asks for, by method and task or by id; checked, and perhaps not there yet.

    Attributes:
        domains: of all of them.
        tasks: None for all, or as each dataset is labelled.
        methods, seeds: whose, unless ``ids`` are given.
        ids: task-agnostic or labelled datasets.
        reward: an own reward function instead of tasks.
        profile: at which they were collected, or will be.
    """

    domains: tuple[str, ...]
    tasks: Sequence[str] | None
    methods: Sequence[str]
    seeds: Sequence[int]
    ids: tuple[str, ...] | None
    reward: CustomReward | None
    profile: str

    @classmethod
    def checked(
        cls, domain: str, tasks: Sequence[str] | None, methods: Sequence[str], seeds: Sequence[int], dataset_id: str | Sequence[str] | None,
        reward: str | Callable[[Measured], Any] | None, profile: str,
    ) -> Wanted:  # fmt: skip
        """The same as a user asks for it.

        Raises:
            UsageError: it cannot be.
        """
        check_domain(domain)
        ids = None if dataset_id is None else tuple(dict.fromkeys([dataset_id] if isinstance(dataset_id, str) else dataset_id))
        if ids == ():
            raise UsageError("no dataset was named; give an id such as walker/cudc-v0.")
        # A dataset says itself what it is of.
        domains = (domain,) if ids is None else tuple(dict.fromkeys(read_manifest(parse_id(one)).domain for one in ids))
        facts = check_domain(domains[0])
        custom = None if reward is None else load_reward(reward, facts)
        if custom is not None and tasks is not None:
            raise UsageError("--reward makes a task of its own; leave out --tasks.")
        if custom is not None and len(domains) > 1:
            raise UsageError(f"--reward takes datasets of one domain at a time, not of {', '.join(domains)}.")
        if ids is None and custom is None and not check_tasks(facts, tasks):
            raise UsageError(f"no task was given; allowed: {', '.join(facts.tasks)}.")
        if not methods:
            raise UsageError("no method was given; see cudc-bench list.")
        for method in () if ids else methods:
            if method in TIERS:
                check_tiers(method, domain, check_tasks(facts, tasks) if custom is None else (), seeds, profile=profile)
            else:
                check_collected(method, domain, seeds, profile=profile)
        return cls(domains, tasks, methods, seeds, ids, custom, profile)

    def ensure(self, device: str, workers: int | None, overwrite: bool) -> list[str]:
        """Their ids, after those were made that were missing, and if ``overwrite`` those again whose base or function is another now.

        Raises:
            UsageError: one that was named is of another profile, or labelled for another task.
            RunError: making one failed.
        """
        if self.ids is None:
            facts = check_domain(self.domains[0])
            tiers = [
                str(one)
                for method in self.methods
                if method in TIERS
                for one in check_tiers(method, facts.name, check_tasks(facts, self.tasks), self.seeds, profile=self.profile)
            ]
            bases = [
                one
                for method in self.methods
                if method not in TIERS
                for one in ensure_collected(method, self.domains[0], self.seeds, profile=self.profile, device=device, workers=workers)
            ]
            return [one for base in bases for one in ensure_relabelled(base, self.tasks, self.reward, overwrite)] + tiers
        found: list[tuple[str, Manifest]] = []
        # All are checked before the first is relabelled.
        for dataset_id in self.ids:
            manifest = read_manifest(parse_id(dataset_id))
            check_profile(manifest, dataset_id, self.profile)
            if manifest.task is not None and self.tasks is not None and manifest.task not in self.tasks:
                raise UsageError(f"'{dataset_id}' is labelled for {manifest.task}, not for {', '.join(self.tasks)}; leave out --tasks.")
            found.append((dataset_id, manifest))
        ids = [one for base, manifest in found for one in self._labelled(base, manifest, overwrite)]
        return list(dict.fromkeys(ids))

    def ensure_bases(self, device: str, workers: int | None) -> dict[str, tuple[str, ...]]:
        """The task-agnostic datasets behind them, after those were collected that were missing, and the tasks that are asked for.

        Raises:
            UsageError: one that was named is of another profile, labelled for another task, or has no physics states to label.
            RunError: making one failed.
        """
        if self.ids is None:
            if labelled := [method for method in self.methods if method in TIERS]:
                raise UsageError(
                    f"{', '.join(labelled)} holds the rewards of one task; a learner without rewards trains on collected data."
                )
            found = {
                one: self._asked(None)
                for method in self.methods
                for one in ensure_collected(method, self.domains[0], self.seeds, profile=self.profile, device=device, workers=workers)
            }
        else:
            found = {}
            for dataset_id in self.ids:
                manifest = read_manifest(parse_id(dataset_id))
                check_profile(manifest, dataset_id, self.profile)
                one = self._base(dataset_id, manifest)
                found[one] = tuple(dict.fromkeys((*found.get(one, ()), *self._asked(manifest))))
        for one in found:
            if "infos/physics" not in read_manifest(parse_id(one)).fields:
                raise UsageError(f"'{one}' holds no physics states, from which a learner without rewards is told of its tasks.")
        return found

    def _base(self, dataset_id: str, manifest: Manifest) -> str:
        if manifest.task is None:
            return dataset_id
        if manifest.base is None or not exists(manifest.base.id):
            raise UsageError(
                f"'{dataset_id}' is labelled for {manifest.task}, and the task-agnostic dataset behind it is not here; a learner without"
                " rewards trains on that one."
            )
        return manifest.base.id

    def _asked(self, manifest: Manifest | None) -> tuple[str, ...]:
        """The tasks that a dataset is wanted for; a labelled one only for its own."""
        if self.reward is not None:
            return (self.reward.name,)
        if manifest is not None and manifest.task is not None:
            if manifest.reward is not None or (self.tasks is not None and manifest.task not in self.tasks):
                raise UsageError(
                    f"a dataset that was named is labelled for {manifest.task}; name the one behind it, and --task or --reward."
                )
            return (manifest.task,)
        return tuple(check_tasks(check_domain(self.domains[0] if manifest is None else manifest.domain), self.tasks))

    def _labelled(self, dataset_id: str, manifest: Manifest, overwrite: bool) -> list[str]:
        if manifest.task is None:
            return ensure_relabelled(dataset_id, self.tasks, self.reward, overwrite)
        base, usual = manifest.base, self.reward is not None and manifest.task == self.reward.name
        if overwrite and usual and base is not None and exists(base.id) and str(parse_id(base.id).for_task(manifest.task)) == dataset_id:
            return ensure_relabelled(base.id, None, self.reward, overwrite)
        return [dataset_id]


def check_labels(labels: Sequence[int] | None) -> list[int]:
    """Numbers of labelled transitions, ascending without repeats; the usual one unless given.

    Raises:
        UsageError: there is none, or one is less than 1.
    """
    if labels is None:
        return [LABELS]
    if not labels or min(labels) < 1:
        raise UsageError("--labels takes numbers of transitions, 1 or more.")
    return sorted(set(labels))


def check_label_source(dataset_id: str, domains: Sequence[str]) -> None:
    """Refuse a dataset from which labels cannot be drawn.

    Raises:
        UsageError: there is none of that id, or it is of another domain, or holds no physics states.
    """
    manifest = read_manifest(parse_id(dataset_id))
    if set(domains) != {manifest.domain}:
        raise UsageError(f"--labels-from takes a dataset of {', '.join(domains)}; '{dataset_id}' is of {manifest.domain}.")
    if "infos/physics" not in manifest.fields:
        raise UsageError(f"'{dataset_id}' holds no physics states, from which rewards follow; give --labels-from another dataset.")
