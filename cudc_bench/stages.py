"""How one stage has another's missing output made, without importing it.

Stages meet in artefacts on disk. When a command finds that the dataset it needs does not exist, it asks for the stage that makes it by
its registered name, and says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from cudc_bench import plugins
from cudc_bench.artefacts.ids import DatasetId, default_id, parse_id
from cudc_bench.artefacts.manifest import IMPORTED_PROFILE, MIXTURE, Manifest, exists, read_manifest
from cudc_bench.artefacts.provenance import command_line
from cudc_bench.envs import check_domain, check_tasks
from cudc_bench.envs.rewards import CustomReward
from cudc_bench.errors import RunError, UsageError
from cudc_bench.execution.progress import echo
from cudc_bench.settings.profiles import resolve_profile
from cudc_bench.settings.seeds import format_seeds


@dataclass(frozen=True)
class Planned:
    """One thing that a stage would make if it were asked to.

    Attributes:
        place: the dataset's id, or the record's path.
        seed: its member's.
        total: environment or gradient steps of the work.
        done: whether it exists and is of this very run, so that the stage would keep it, with nothing beside it that is left to tidy up.
        overrides: hyperparameters that differ from the profile.
        needs_pilot: whether a threshold must be measured first; ``done`` is not known before.
    """

    place: str
    seed: int
    total: int
    done: bool
    overrides: Mapping[str, Any] = field(default_factory=dict)
    needs_pilot: bool = False


def check_collected(method: str, domain: str, seeds: Sequence[int], *, profile: str) -> list[DatasetId]:
    """The default ids of a method's datasets, whether they exist or not.

    Raises:
        UsageError: wrong input, or a dataset exists that was collected at another profile, or with values that its method has not any more.
    """
    check_domain(domain)
    name = resolve_profile(profile).name
    ids = [_default_or_imported(domain, method, seed, name) for seed in seeds]
    # What exists can be used without its collector: an imported dataset's was never here.
    if method == MIXTURE and (missing := [str(one) for one in ids if not exists(one)]):
        raise UsageError(f"there is no dataset '{missing[0]}'; make it of several: cudc-bench mix DATASET DATASET.")
    if not all(exists(one) for one in ids):
        plugins.check_name("collectors", method)
    for one in ids:
        if exists(one):
            manifest = read_manifest(one)
            check_profile(manifest, str(one), name)
            if manifest.was_collected:
                _check_unchanged(manifest, str(one))
    return ids


def check_tiers(method: str, domain: str, tasks: Sequence[str], seeds: Sequence[int], *, profile: str) -> list[DatasetId]:
    """The ids of datasets of online trainings (see ``cudc_bench.artefacts.tiers``), by seed and task.

    Raises:
        UsageError: one is not there, since they take a training to make, or no task is asked for.
    """
    if not tasks:
        raise UsageError(f"{method} holds the rewards of the task that it was trained on; leave out --reward.")
    name = resolve_profile(profile).name
    ids = {(seed, task): default_id(domain, method, seed, name).for_task(task) for seed in seeds for task in tasks}
    if missing := [place for place, one in ids.items() if not exists(one)]:
        options = {"--domain": domain, "--tasks": ",".join(dict.fromkeys(task for _, task in missing))}
        options |= {"--seeds": format_seeds(sorted({seed for seed, _ in missing})), "--profile": name}
        raise UsageError(f"there is no dataset '{ids[missing[0]]}'; it comes of an online training: {command_line('tiers', options, {})}.")
    for one in ids.values():
        check_profile(read_manifest(one), str(one), name)
    return list(ids.values())


def _default_or_imported(domain: str, method: str, seed: int, profile: str) -> DatasetId:
    """The default id at a profile; where nothing is there, that of a dataset of others' data, which goes with every profile."""
    own, imported = (default_id(domain, method, seed, one) for one in (profile, IMPORTED_PROFILE))
    if own == imported or exists(own) or not exists(imported):
        return own
    try:
        return imported if read_manifest(imported).profile == IMPORTED_PROFILE else own
    except (UsageError, RunError):
        return own


def _check_unchanged(manifest: Manifest, dataset_id: str) -> None:
    # Defaults change from version to version, and a record names the method, not all of its values.
    changed = plugins.load("stages", "changed_since")(manifest)
    if changed:
        values = ", ".join(f"{name}={then}, which is {now} now" for name, (then, now) in changed.items())
        raise UsageError(
            f"'{dataset_id}' was collected with other settings than {manifest.method} has by now ({values}); collect it again with"
            " --overwrite, or take it as it is by naming its id."
        )


def ensure_collected(
    method: str, domain: str, seeds: Sequence[int], *, profile: str, device: str = "auto", workers: int | None = 1
) -> list[str]:
    """The default ids of a method's datasets, collected where they are missing.

    Raises:
        UsageError: as :func:`check_collected`.
    """
    ids = check_collected(method, domain, seeds, profile=profile)
    for one in ids:
        if exists(one) and (manifest := read_manifest(one)).holds_others_data:
            echo(f"{one} was not collected here: {manifest.describe()}")
    missing = [seed for seed, one in zip(seeds, ids, strict=True) if not exists(one)]
    if missing:
        echo(f"{', '.join(str(one) for one in ids if not exists(one))} missing: collecting first")
        plugins.load("stages", "collect")(method, domain, missing, profile=profile, device=device, workers=workers)
    return [str(one) for one in ids]


def ensure_relabelled(base_id: str, tasks: Sequence[str] | None, reward: CustomReward | None = None, overwrite: bool = False) -> list[str]:
    """The ids of a dataset relabelled for tasks, or by an own reward function, made where they are missing.

    Args:
        base_id: the task-agnostic dataset.
        tasks: None for all of its domain.
        reward: an own reward function instead.
        overwrite: make those again that are of another base, or by another text of the function.

    Raises:
        UsageError: wrong input.
        RunError: there is such a one, and it is not to be made again.
    """
    ids = check_relabelled(base_id, tasks, reward, overwrite)
    stale = {task: why for task, one in ids.items() if (why := _staleness(one, base_id, reward)) is not None}
    for task, why in stale.items():
        echo(f"{ids[task]} {why}: relabelling first")
    if missing := [task for task, one in ids.items() if not exists(one)]:
        echo(f"{', '.join(str(ids[task]) for task in missing)} missing: relabelling first")
    relabel = plugins.load("stages", "relabel")
    for some, again in ((missing, False), (list(stale), True)):
        if some:
            relabel(base_id, some if reward is None else None, reward=None if reward is None else reward.reference, overwrite=again)
    return [str(one) for one in ids.values()]


def check_relabelled(
    base_id: str, tasks: Sequence[str] | None, reward: CustomReward | None = None, overwrite: bool = False
) -> dict[str, DatasetId]:
    """The ids of a dataset relabelled for tasks by task, whether they exist or not.

    Raises:
        UsageError: wrong input.
        RunError: one exists that was made from another base, or by another text of the function, and it is not to be made again.
    """
    base = read_manifest(base_id)
    wanted = check_tasks(check_domain(base.domain), tasks) if reward is None else (reward.name,)
    ids = {task: parse_id(base_id).for_task(task) for task in wanted}
    for one in () if overwrite else ids.values():
        if (why := _staleness(one, base_id, reward)) is not None:
            option = "" if reward is None else f" --reward {reward.reference}"
            raise RunError(
                f"'{one}' {why}; evaluate --overwrite labels it again and trains; to label it alone:"
                f" cudc-bench relabel {base_id}{option} --overwrite."
            )
    return ids


def _staleness(labelled: DatasetId, base_id: str, reward: CustomReward | None) -> str | None:
    """Why a labelled dataset is not what its base and an own reward function would give now; None if it is, or does not exist."""
    if not exists(labelled):
        return None
    manifest = read_manifest(labelled)
    if manifest.base is None or manifest.base.fingerprint != read_manifest(base_id).fingerprint:
        return f"was made from another '{base_id}'"
    there = manifest.reward
    if reward is not None and there is not None and there.reference == reward.reference and there.sha256 != reward.sha256:
        return f"was labelled by another text of the function {reward.reference}"
    return None


def check_reward(manifest: Manifest, dataset_id: str, reward: CustomReward | None) -> None:
    """Refuse to score policies by another reward than the dataset's.

    A dataset that names a function does not run it: data come from others. Who evaluates names the function, too.

    Raises:
        UsageError: they differ, or only one of them is there.
        RunError: the function was changed since the dataset was labelled.
    """
    there = manifest.reward
    if there is None and reward is not None:
        raise UsageError(f"'{dataset_id}' is labelled for {manifest.task}, not by {reward.reference}; leave out --reward.")
    if there is not None and (reward is None or reward.reference != there.reference):
        raise UsageError(f"'{dataset_id}' is labelled by the function {there.reference}; to run it here, give --reward {there.reference}.")
    if there is not None and reward is not None and reward.sha256 != there.sha256:
        raise RunError(
            f"'{dataset_id}' was labelled by another text of the function {there.reference}; label its base again:"
            f" cudc-bench relabel {manifest.base.id if manifest.base else dataset_id} --reward {there.reference} --overwrite."
        )


def check_profile(manifest: Manifest, dataset_id: str, profile: str) -> None:
    """Refuse to go on at one profile from a dataset collected at another; one of others' data alone goes with every profile.

    Raises:
        UsageError: they differ; the message names both and the ways out.
    """
    name = resolve_profile(profile).name
    if manifest.profile not in (name, IMPORTED_PROFILE):
        raise UsageError(
            f"'{dataset_id}' exists at another profile ({manifest.describe()}) than {name}; "
            f"use --profile {manifest.profile}, or collect it anew with --overwrite."
        )
