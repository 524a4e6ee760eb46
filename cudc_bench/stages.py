"""How one stage has another's missing output made, without importing it.

Stages meet in artefacts on disk. When a command finds that the dataset it needs does not exist, it asks for the stage that makes it by
its registered name, and says so.
"""

from __future__ import annotations

from collections.abc import Sequence

from cudc_bench import plugins
from cudc_bench.envs import check_domain, check_tasks
from cudc_bench.errors import RunError, UsageError
from cudc_bench.ids import DatasetId, default_id, parse_id
from cudc_bench.manifest import Manifest, exists, read_manifest
from cudc_bench.profiles import resolve_profile
from cudc_bench.progress import say


def check_collected(method: str, domain: str, seeds: Sequence[int], *, profile: str) -> list[DatasetId]:
    """The default ids of a method's datasets, whether they exist or not.

    Raises:
        UsageError: wrong input, or a dataset exists that was collected at another profile.
    """
    plugins.check_name("collectors", method)
    check_domain(domain)
    name = resolve_profile(profile).name
    ids = [default_id(domain, method, seed) for seed in seeds]
    for one in ids:
        if exists(one):
            check_profile(read_manifest(one), str(one), name)
    return ids


def ensure_collected(
    method: str, domain: str, seeds: Sequence[int], *, profile: str, device: str = "auto", workers: int | None = 1
) -> list[str]:
    """The default ids of a method's datasets, collected where they are missing.

    Raises:
        UsageError: wrong input, or a dataset exists that was collected at another profile.
    """
    ids = check_collected(method, domain, seeds, profile=profile)
    missing = [seed for seed, one in zip(seeds, ids, strict=True) if not exists(one)]
    if missing:
        say(f"{', '.join(str(default_id(domain, method, seed)) for seed in missing)} missing: collecting first")
        plugins.load("stages", "collect")(method, domain, missing, profile=profile, device=device, workers=workers)
    return [str(one) for one in ids]


def ensure_relabelled(base_id: str, tasks: Sequence[str] | None) -> list[str]:
    """The ids of a dataset relabelled for tasks, made where they are missing.

    Raises:
        UsageError: wrong input.
        RunError: a relabelled dataset exists that was made from another base.
    """
    base = read_manifest(base_id)
    ids = {task: parse_id(base_id).for_task(task) for task in check_tasks(check_domain(base.domain), tasks)}
    for one in ids.values():
        if exists(one):
            there = read_manifest(one).base
            if there is None or there.fingerprint != base.fingerprint:
                raise RunError(f"'{one}' was made from another '{base_id}'; run: cudc-bench relabel {base_id} --overwrite.")
    missing = [task for task, one in ids.items() if not exists(one)]
    if missing:
        say(f"{', '.join(str(ids[task]) for task in missing)} missing: relabelling first")
        plugins.load("stages", "relabel")(base_id, missing)
    return [str(one) for one in ids.values()]


def check_profile(manifest: Manifest, dataset_id: str, profile: str) -> None:
    """Refuse to go on at one profile from a dataset collected at another.

    Raises:
        UsageError: they differ; the message names both and the ways out.
    """
    name = resolve_profile(profile).name
    if manifest.profile != name:
        raise UsageError(
            f"'{dataset_id}' exists at another profile ({manifest.describe()}) than {name}; "
            f"use --profile {manifest.profile}, or collect it anew with --overwrite."
        )
