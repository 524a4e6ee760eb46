"""``evaluate``: from datasets to run records."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from cudc_bench import plugins
from cudc_bench.config import as_dict, build, changed, check_settings, config_hash
from cudc_bench.data.reader import FlatEpisodes, load_episodes
from cudc_bench.envs import check_domain, check_tasks
from cudc_bench.envs.rewards import CustomReward, Measured, load_reward
from cudc_bench.errors import UsageError
from cudc_bench.ids import datasets_root, default_id, parse_id
from cudc_bench.manifest import Manifest, read_manifest
from cudc_bench.networks import MemberRandom
from cudc_bench.options import LOG_DIR, check_folder, check_seeds
from cudc_bench.parallel import Job, run_jobs, worker_count
from cudc_bench.profiles import resolve_device, resolve_profile
from cudc_bench.progress import Advance, say
from cudc_bench.provenance import command_line, commit, machine, versions
from cudc_bench.records import (
    DatasetReference,
    Evaluation,
    Record,
    TrainingMetrics,
    read_record,
    record_path,
    write_record,
)
from cudc_bench.replay import Episodes
from cudc_bench.runlog import LogTarget, check_log, open_log
from cudc_bench.stages import check_collected, check_profile, check_reward, ensure_collected, ensure_relabelled

from .loop import Arena, EvaluateConfig, Outcome, run_evaluation


def evaluate(
    algo: str = "td3",
    domain: str = "walker",
    tasks: Sequence[str] | None = None,
    methods: Sequence[str] = ("cudc",),
    seeds: Sequence[int] = (1,),
    *,
    profile: str = "auto",
    settings: Mapping[str, Any] | None = None,
    dataset_id: str | None = None,
    reward: str | Callable[[Measured], Any] | None = None,
    output: str | Path = "results",
    overwrite: bool = False,
    device: str = "auto",
    workers: int | None = 1,
    log: str | None = None,
    log_dir: str | Path = LOG_DIR,
) -> list[Path]:
    """Train an offline algorithm on relabelled datasets and write one record for each (method, seed, task).

    Datasets that are missing are collected and relabelled first. Offline seed i trains on the dataset of collector seed i. A record that
    exists for the same data and hyperparameters is kept.

    Args:
        algo: a registered evaluator.
        domain: of the datasets.
        tasks: of the domain; all unless given.
        methods: whose datasets.
        seeds: of the datasets and of the training.
        profile: ``paper``, ``cpu``, ``demo``, ``smoke`` or ``auto``; datasets must be of the same, unless they are imported.
        settings: hyperparameters of the training that differ from the profile, by name.
        dataset_id: train on this dataset (task-agnostic or relabelled) instead of those of ``methods``; ``seeds`` is then its own.
        reward: an own reward function instead of tasks, as in :func:`relabel`.
        output: folder of the records.
        overwrite: train again where a record exists.
        device: ``cpu``, ``cuda`` or ``auto``.
        workers: processes on a CPU; 1 works in this process, None takes one for each core.
        log: also send training metrics and mean returns to ``"tensorboard"`` or ``"wandb"`` while they are measured. Datasets that are
            collected on the way are not logged.
        log_dir: the folder of these logs; a run's own in it is ``evaluate/`` and its record's place below ``output``, less ``.json``.

    Returns:
        The paths of all records, trained now or before.

    Raises:
        UsageError: wrong input; nothing has been trained.
        RunError: the run failed; the records written before stay.
    """
    kind = plugins.load("evaluators", algo)
    chosen = resolve_profile(profile)
    settings = dict(settings or {})
    check_settings(settings, [EvaluateConfig, kind.config_class])
    loop, config = (build(one, chosen.evaluate, settings) for one in (EvaluateConfig, kind.config_class))
    check_milestones(loop)
    values = as_dict(loop, config)
    overrides = changed(values, as_dict(*(build(one, chosen.evaluate) for one in (EvaluateConfig, kind.config_class))))
    results = check_folder(output, "the output")
    check_folder(datasets_root(), "the dataset root")
    logs = check_log(log, log_dir)
    device = resolve_device(device)
    worker_count(workers, 1)
    # A dataset says itself what it is of.
    facts = check_domain(domain if dataset_id is None else read_manifest(parse_id(dataset_id)).domain)
    custom = None if reward is None else load_reward(reward, facts)
    if custom is not None and tasks is not None:
        raise UsageError("--reward makes a task of its own; leave out --tasks.")
    if dataset_id is None and custom is None and not check_tasks(facts, tasks):
        raise UsageError(f"no task was given; allowed: {', '.join(facts.tasks)}.")
    seeds = check_seeds(seeds)
    if not methods:
        raise UsageError("no method was given; see cudc-bench list.")
    for method in () if dataset_id else methods:
        check_collected(method, domain, seeds, profile=profile)

    ids = _datasets(domain, tasks, custom, methods, seeds, dataset_id, profile=profile, device=device, workers=workers)
    manifests = {one: read_manifest(one) for one in ids}
    for one, manifest in manifests.items():
        check_reward(manifest, one, custom)
    paths = {one: record_path(results, one, algo, manifests[one].seed, chosen.name) for one in ids}
    todo = [one for one in ids if overwrite or not _done(paths[one], manifests[one], config_hash(values))]
    say(
        f"evaluate {algo} on {facts.name}: profile {chosen.name}, {len(ids)} runs of {loop.gradient_steps:,} gradient steps, {device}"
        + (f"; {len(ids) - len(todo)} recorded before are kept" if len(todo) < len(ids) else "")
    )
    targets = {
        one: None if log is None else LogTarget(
            log, logs, "evaluate", chosen.name, facts.name, str(paths[one].relative_to(results / chosen.name).with_suffix("")),
            f"{manifests[one].task}-{manifests[one].method}-{algo}-seed{manifests[one].seed}", values,
        )
        for one in todo
    }  # fmt: skip
    groups = [todo] if device == "cuda" and todo else [[one] for one in todo]
    jobs = [
        Job(
            description=" + ".join(group) if len(group) < 3 else f"{len(group)} datasets",
            total=loop.gradient_steps,
            arguments={
                "algo": algo, "ids": group, "paths": [paths[one] for one in group], "profile": chosen.name, "loop": loop,
                "config": config, "overrides": overrides, "device": device,
                "reward": None if custom is None else custom.reference,
                "targets": [targets[one] for one in group],
            },
        )
        for group in groups
    ]  # fmt: skip
    if jobs:
        count = 1 if device == "cuda" else worker_count(workers, len(jobs))
        run_jobs(evaluate_members, jobs, unit="gradient steps", workers=count, threads=chosen.threads)
    return list(paths.values())


def evaluate_members(
    advance: Advance, *, algo: str, ids: list[str], paths: list[Path], profile: str, loop: EvaluateConfig, config: Any,
    overrides: dict[str, Any], device: str, reward: str | None, targets: list[LogTarget | None],
) -> None:  # fmt: skip
    """Train some members in this process and write their records (the job of :func:`evaluate`)."""
    started = time.monotonic()
    manifests = [read_manifest(one) for one in ids]
    seeds = [manifest.seed for manifest in manifests]
    facts = check_domain(manifests[0].domain)
    agent = plugins.load("evaluators", algo)(facts.observation_size, facts.action_size, config, seeds, device)
    data = load_members(ids, seeds, device)
    tasks = [str(manifest.task) for manifest in manifests]
    arena = Arena(facts, tasks if reward is None else load_reward(reward, facts))
    with ExitStack() as stack:
        logs = [stack.enter_context(open_log(target)) for target in targets]
        outcomes = run_evaluation(agent, data, loop, arena, advance, logs)
    seconds = round(time.monotonic() - started, 1)
    for one, path, manifest, outcome in zip(ids, paths, manifests, outcomes, strict=True):
        write_record(path, _record(algo, one, manifest, outcome, profile, loop, config, overrides, device, seconds))


def load_members(ids: Sequence[str], seeds: Sequence[int], device: torch.device | str) -> Episodes:
    """The datasets of a stack of members, for sampling one-step transitions.

    Members whose datasets differ in their rewards only (the tasks of one collected dataset) share one copy of the rest.

    Args:
        ids: a relabelled dataset for each member.
        seeds: of the members' index streams.
        device: where the arrays go.
    """
    sources: dict[tuple[str, str], int] = {}
    flats: list[FlatEpisodes] = []
    source_of_member, rewards = [], []
    for one in ids:
        fields = read_manifest(one).fields
        key = (fields["observations"], fields["actions"])
        if key not in sources:
            sources[key] = len(flats)
            flats.append(load_episodes(one, ("observations", "actions")))
        source_of_member.append(sources[key])
        rewards.append(torch.from_numpy(load_episodes(one, ("rewards",)).arrays["rewards"]))
    steps = max(int(flat.lengths.sum()) for flat in flats)
    first = flats[0].arrays
    episodes = Episodes(
        len(flats), max(len(flat.lengths) for flat in flats), steps, first["observations"].shape[1], first["actions"].shape[1],
        MemberRandom(seeds, "replay", device), source_of_member,
    )  # fmt: skip
    for source, flat in enumerate(flats):
        for observations, actions in zip(flat.split("observations"), flat.split("actions"), strict=True):
            episodes.add(source, torch.from_numpy(observations), torch.from_numpy(actions))
    padded = torch.zeros(len(ids), steps, device=device)
    for row, values in zip(padded, rewards, strict=True):
        row[: len(values)] = values.to(device)
    episodes.rewards = padded
    return episodes


def check_milestones(loop: EvaluateConfig) -> None:
    """Refuse milestones at which nothing is evaluated.

    Raises:
        UsageError: names the milestone.
    """
    for milestone in loop.milestones:
        on_the_way = milestone % loop.evaluate_every == 0 and milestone <= loop.gradient_steps
        if not (on_the_way or milestone == loop.gradient_steps):
            raise UsageError(
                f"the milestone {milestone:,} is never evaluated: there is an evaluation every {loop.evaluate_every:,} steps "
                f"up to {loop.gradient_steps:,}; set milestones=[a,b] to fit."
            )


def _datasets(
    domain: str, tasks: Sequence[str] | None, reward: CustomReward | None, methods: Sequence[str], seeds: Sequence[int],
    dataset_id: str | None, *,
    profile: str, device: str, workers: int | None,
) -> list[str]:  # fmt: skip
    """The relabelled datasets to train on, made where they are missing."""
    if dataset_id is None:
        bases = [
            one for method in methods for one in ensure_collected(method, domain, seeds, profile=profile, device=device, workers=workers)
        ]
    else:
        manifest = read_manifest(parse_id(dataset_id))
        check_profile(manifest, dataset_id, profile)
        if manifest.task is not None:
            if tasks is not None and manifest.task not in tasks:
                raise UsageError(f"'{dataset_id}' is labelled for {manifest.task}, not for {', '.join(tasks)}; leave out --tasks.")
            return [dataset_id]
        bases = [dataset_id]
    return [one for base in bases for one in ensure_relabelled(base, tasks, reward)]


def _done(path: Path, manifest: Manifest, values_hash: str) -> bool:
    """Whether this very run is recorded already.

    Raises:
        UsageError: another run stands in its place.
    """
    if not path.exists():
        return False
    record = read_record(path)
    if record.dataset.fingerprint == manifest.fingerprint and record.hyperparameters_hash == values_hash:
        return True
    raise UsageError(f"{path} records another run (other data or settings); use --overwrite or another --output.")


def _record(
    algo: str, dataset_id: str, manifest: Manifest, outcome: Outcome, profile: str, loop: EvaluateConfig, config: Any,
    overrides: dict[str, Any], device: str, seconds: float,
) -> Record:  # fmt: skip
    values = as_dict(loop, config)
    head, dirty = commit()
    options = {"--algo": algo, "--profile": profile}
    usual = default_id(manifest.domain, manifest.method, manifest.seed).for_task(str(manifest.task))
    if dataset_id == str(usual) and not manifest.overrides and manifest.imported is None:
        # Written like this, the command also makes the datasets anew where they are missing.
        options |= {"--domain": manifest.domain, "--method": manifest.method, "--seed": str(manifest.seed)}
        if manifest.reward is None:
            options["--task"] = str(manifest.task)
    else:
        options["--dataset-id"] = dataset_id
    if manifest.reward is not None:
        options["--reward"] = manifest.reward.reference
    return Record(
        dataset=DatasetReference(
            id=dataset_id, fingerprint=manifest.fingerprint, domain=manifest.domain, task=str(manifest.task), method=manifest.method,
            seed=manifest.seed, steps=manifest.steps, profile=manifest.profile, overrides=manifest.overrides,
            reward=manifest.reward, source=None if manifest.imported is None else manifest.imported.source,
        ),
        algorithm=algo,
        profile=profile,
        overrides=overrides,
        seed=manifest.seed,
        hyperparameters=values,
        hyperparameters_hash=config_hash(values),
        milestones=list(loop.milestones),
        curve=[Evaluation(step=step, returns=returns) for step, returns in outcome.curve],
        final=Evaluation(step=loop.gradient_steps, returns=outcome.final),
        metrics=[TrainingMetrics(step=step, values=row) for step, row in outcome.metrics],
        seconds=seconds,
        versions=versions(),
        commit=head,
        dirty=dirty,
        machine=machine(device, torch.get_num_threads()),
        command=command_line("evaluate", options, overrides, "--overwrite"),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )  # fmt: skip
