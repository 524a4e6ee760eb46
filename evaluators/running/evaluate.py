"""``evaluate``: from datasets to run records."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import torch

from cudc_bench import plugins
from cudc_bench.artefacts.ids import datasets_root, default_id, parse_id
from cudc_bench.artefacts.manifest import Manifest, exists, read_manifest
from cudc_bench.artefacts.provenance import command_line, commit, machine, origin, versions
from cudc_bench.artefacts.records import DatasetReference, Evaluation, Record, TrainingMetrics, read_record, record_path, write_record
from cudc_bench.data.reader import FlatEpisodes, load_episodes
from cudc_bench.envs import check_domain, check_tasks
from cudc_bench.envs.rewards import CustomReward, Measured, load_reward
from cudc_bench.errors import BrokenDownError, RunError, UsageError
from cudc_bench.execution import interrupts
from cudc_bench.execution.checkpoints import CHECKPOINT_EVERY, Checkpoints
from cudc_bench.execution.locks import locked
from cudc_bench.execution.parallel import Job, run_jobs, worker_count
from cudc_bench.execution.progress import Advance, say
from cudc_bench.execution.runlog import LOG_DIR, LogTarget, check_log, open_log
from cudc_bench.files import check_folder, remove_empty_above
from cudc_bench.learning.learner import check_precision
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Episodes
from cudc_bench.settings.config import as_dict, build, changed, check_settings, config_hash
from cudc_bench.settings.evaluate_config import EvaluateConfig, check_milestones, in_full, plain_values, profile_values
from cudc_bench.settings.profiles import Profile, resolve_device, resolve_profile
from cudc_bench.settings.seeds import check_seeds
from cudc_bench.stages import Planned, check_collected, check_profile, check_reward, ensure_collected, ensure_relabelled

from ..policies.stored import save_policy
from .loop import Arena, Outcome, run_evaluation

CHECKPOINTS = ".checkpoints"  # folder in that of the records


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


@dataclass(frozen=True)
class Run:
    """One training run: an algorithm on a dataset, or on the first ``used`` transitions of it, with a seed, and where its record goes."""

    plan: Plan
    dataset: str
    manifest: Manifest
    used: int | None
    seed: int
    path: Path


@interrupts.leave_well()  # also between its stages
def evaluate(
    algo: str | Sequence[str] = "td3",
    domain: str = "walker",
    tasks: Sequence[str] | None = None,
    methods: Sequence[str] = ("cudc",),
    seeds: Sequence[int] = (1,),
    *,
    profile: str = "auto",
    settings: Mapping[str, Any] | None = None,
    training_seeds: Sequence[int] | None = None,
    steps: int | None = None,
    dataset_id: str | Sequence[str] | None = None,
    dataset_sizes: Sequence[int] | None = None,
    reward: str | Callable[[Measured], Any] | None = None,
    output: str | Path = "results",
    overwrite: bool = False,
    device: str = "auto",
    workers: int | None = 1,
    log: str | None = None,
    log_dir: str | Path = LOG_DIR,
    policies: bool = True,
    checkpoint_every: float = CHECKPOINT_EVERY,
    fresh: bool = False,
) -> list[Path]:
    """Train offline algorithms on relabelled datasets and write one record for each (algorithm, method, seed, task).

    Datasets that are missing are collected and relabelled first. The dataset of collector seed i is trained on with seed i, unless
    ``training_seeds`` say otherwise. A record that exists for the same data and hyperparameters is kept. A run that was interrupted is
    continued where its last checkpoint was taken, with the same result as if it had not been.

    Args:
        algo: a registered evaluator, or several.
        domain: of the datasets.
        tasks: of the domain; all unless given.
        methods: whose datasets.
        seeds: of the datasets, and of the training unless ``training_seeds`` are given.
        profile: ``paper``, ``cpu``, ``demo``, ``smoke`` or ``auto``; datasets must be of the same, unless they are imported.
        settings: hyperparameters of the training that differ from the profile, by name.
        training_seeds: train on each dataset once with each of these. A training's seed is that of its weights, minibatches and noise,
            and of the initial states of its evaluations. Tables count the trainings on one dataset once, as their mean.
        steps: gradient steps, instead of the profile's; milestones before them stay, and the last step is the last milestone.
        dataset_id: train on this dataset, or these (task-agnostic or relabelled), instead of those of ``methods``; ``seeds`` are then
            their own.
        dataset_sizes: train once for each of these numbers of transitions, on the first so many of each dataset.
        reward: an own reward function instead of tasks, as in :func:`relabel`.
        output: folder of the records.
        overwrite: train again where a record exists.
        device: ``cpu``, ``cuda`` or ``auto``.
        workers: processes on a CPU; 1 works in this process, None takes one for each core.
        log: also send training metrics and mean returns to ``"tensorboard"`` or ``"wandb"`` while they are measured. Datasets that are
            collected on the way are not logged.
        log_dir: the folder of these logs; a run's own in it is ``evaluate/`` and its record's place below ``output``, less ``.json``.
        policies: keep the trained policy beside each record, for :func:`load_policy`.
        checkpoint_every: seconds between two checkpoints, which lie in ``.checkpoints`` in ``output`` until the record is written.
        fresh: start over where a run was interrupted.

    Returns:
        The paths of all records, trained now or before.

    Raises:
        UsageError: wrong input, or a run with other settings was interrupted; nothing has been trained.
        RunError: the run failed; the records written before stay, and what the run had done until its last checkpoint is kept.
        Interrupted: the process was asked to leave; what it had done is kept.
    """
    chosen = resolve_profile(profile)
    plans = _plans([algo] if isinstance(algo, str) else algo, chosen, dict(settings or {}), steps)
    results = check_folder(output, "the output")
    check_folder(datasets_root(), "the dataset root")
    logs = check_log(log, log_dir)
    device = resolve_device(device)
    for plan in plans:
        check_precision(plan.kind, plan.algo, plan.loop.precision, device)
    worker_count(workers, 1)
    check_domain(domain)
    if not (math.isfinite(checkpoint_every) and checkpoint_every >= 0):
        raise UsageError(f"--checkpoint-every takes a number of seconds, 0 or more, not {checkpoint_every:g}.")
    sizes = _check_sizes(dataset_sizes)
    named = None if dataset_id is None else list(dict.fromkeys([dataset_id] if isinstance(dataset_id, str) else dataset_id))
    if named == []:
        raise UsageError("no dataset was named; give an id such as walker/cudc-v0.")
    # A dataset says itself what it is of.
    domains = list(dict.fromkeys([domain] if named is None else [read_manifest(parse_id(one)).domain for one in named]))
    facts = check_domain(domains[0])
    custom = None if reward is None else load_reward(reward, facts)
    if custom is not None and tasks is not None:
        raise UsageError("--reward makes a task of its own; leave out --tasks.")
    if custom is not None and len(domains) > 1:
        raise UsageError(f"--reward takes datasets of one domain at a time, not of {', '.join(domains)}.")
    if named is None and custom is None and not check_tasks(facts, tasks):
        raise UsageError(f"no task was given; allowed: {', '.join(facts.tasks)}.")
    seeds = check_seeds(seeds)
    if training_seeds is not None:
        training_seeds = check_seeds(training_seeds)
    if not methods:
        raise UsageError("no method was given; see cudc-bench list.")
    for method in () if named else methods:
        check_collected(method, domain, seeds, profile=profile)

    ids = _datasets(domain, tasks, custom, methods, seeds, named, profile=profile, device=device, workers=workers)
    manifests = {one: read_manifest(one) for one in ids}
    for one, manifest in manifests.items():
        check_reward(manifest, one, custom)
    runs = [
        _run(plan, one, manifest, used, manifest.seed if seed is None else seed, results)
        for plan in plans
        for one, manifest in manifests.items()
        for used in _used(sizes, one, manifest)
        for seed in training_seeds or (None,)
    ]
    todo = [run for run in runs if overwrite or not _done(run)]
    for run in runs:
        if run not in todo:
            _tidy(run, results, device)
    gradient_steps = plans[0].loop.gradient_steps
    say(
        f"evaluate {', '.join(plan.algo for plan in plans)} on {', '.join(domains)}: profile {chosen.name}, {len(runs)} runs of"
        f" {gradient_steps:,} gradient steps, {device}"
        + (f"; {len(runs) - len(todo)} recorded before are kept" if len(todo) < len(runs) else "")
    )
    if device == "cuda":
        # A stack that was interrupted while its records were being written goes on as a whole.
        groups = [
            whole if _checkpoints(whole, results, device).folder.exists() else part
            for whole in _groups(runs)
            if (part := [run for run in whole if run in todo])
        ]
        count = 1
    else:
        # The threads of each run, and so its result, must not depend on how many are left to do.
        groups, count = [[run] for run in todo], worker_count(workers, len(runs))
    if not fresh:
        for group in groups:
            _checkpoints(group, results, device).check(
                f"'{group[0].path}'" if len(group) == 1 else f"{len(group)} records in {results}", "evaluate"
            )
    jobs = [
        Job(
            description=_describe(group),
            total=gradient_steps,
            arguments={
                "runs": group, "device": device, "reward": None if custom is None else custom.reference,
                "targets": [_target(run, log, logs, results) for run in group], "results": results,
                "checkpoint_every": checkpoint_every, "fresh": fresh, "overwrite": overwrite, "policies": policies,
            },
        )
        for group in groups
    ]  # fmt: skip
    if jobs:
        run_jobs(evaluate_members, jobs, unit="gradient steps", workers=count, threads=chosen.threads)
    return [run.path for run in runs]


def _run(plan: Plan, dataset_id: str, manifest: Manifest, used: int | None, seed: int, results: Path) -> Run:
    path = record_path(results, dataset_id, plan.algo, manifest.seed, plan.profile, used, seed)
    return Run(plan, dataset_id, manifest, used, seed, path)


def _checkpoints(runs: Sequence[Run], results: Path, device: str, every: float = CHECKPOINT_EVERY) -> Checkpoints:
    """Those of a stack, in a folder that is named by its records."""
    plan = runs[0].plan
    decisive = {
        "algorithm": plan.algo, "hyperparameters": plan.values, "seeds": [run.seed for run in runs], "used": runs[0].used,
        "datasets": {run.dataset: run.manifest.fingerprint for run in runs}, "device": device,
        **origin(plugins.package("evaluators", plan.algo)),
    }  # fmt: skip
    places = [run.path.relative_to(results).with_suffix("").as_posix() for run in runs]
    place = places[0] if len(runs) == 1 else f"stacks/{plan.algo}-{config_hash({'records': places})}"
    return Checkpoints(results / CHECKPOINTS / place, decisive, every)


def _lock(run: Run, results: Path) -> Path:
    return results / CHECKPOINTS / run.path.relative_to(results).with_suffix(".lock")


def _tidy(run: Run, results: Path, device: str) -> None:
    """Remove what a process left that was killed just after it had written a record; nothing if somebody is writing it again."""
    checkpoints, lock = _checkpoints([run], results, device), _lock(run, results)
    if checkpoints.folder.exists() or lock.exists():
        with suppress(RunError), locked(lock, ""):
            checkpoints.remove()
        remove_empty_above(lock, results / CHECKPOINTS)


def evaluate_members(
    advance: Advance, *, runs: list[Run], device: str, reward: str | None, targets: list[LogTarget | None], results: Path,
    checkpoint_every: float, fresh: bool, overwrite: bool, policies: bool,
) -> None:  # fmt: skip
    """Train some members in this process and write their records (the job of :func:`evaluate`)."""
    plan, seeds = runs[0].plan, [run.seed for run in runs]
    facts = check_domain(runs[0].manifest.domain)
    checkpoints = _checkpoints(runs, results, device, checkpoint_every)
    with ExitStack() as stack:
        for path in (checkpoints.folder, *(_lock(run, results) for run in runs)):
            stack.callback(remove_empty_above, path, results / CHECKPOINTS)
        for run in runs:
            stack.enter_context(locked(_lock(run, results), f"'{run.path}'"))
        if not overwrite and all(map(_done, runs)):
            return  # by another process, while this one was starting
        if fresh:
            checkpoints.remove()
        agent = plan.kind(facts.observation_size, facts.action_size, plan.config, seeds, device)
        data = load_members([run.dataset for run in runs], seeds, device, runs[0].used)
        if agent.wants_next_action and int(data.lengths[data.lengths > 0].min()) < 2:
            raise RunError(f"{plan.algo} needs episodes of at least two steps, which {runs[0].dataset} does not have throughout.")
        arena = Arena(facts, [str(run.manifest.task) for run in runs] if reward is None else load_reward(reward, facts))
        logs = [stack.enter_context(open_log(target)) for target in targets]
        try:
            outcomes = run_evaluation(agent, data, plan.loop, arena, advance, logs, checkpoints)
        except BrokenDownError:
            checkpoints.remove()
            raise
        for member, (run, outcome) in enumerate(zip(runs, outcomes, strict=True)):
            if policies:
                save_policy(agent, member, run.path)
            write_record(run.path, _record(run, outcome, device, round(checkpoints.seconds, 1)))
        checkpoints.remove()


def load_members(ids: Sequence[str], seeds: Sequence[int], device: torch.device | str, used: int | None = None) -> Episodes:
    """The datasets of a stack of members, for sampling one-step transitions.

    Members whose datasets differ in their rewards only (the tasks of one collected dataset) share one copy of the rest.

    Args:
        ids: a relabelled dataset for each member.
        seeds: of the members' index streams.
        device: where the arrays go.
        used: only the first so many transitions of each dataset; the episode in which they end is cut short.
    """
    sources: dict[tuple[str, str], int] = {}
    flats: list[FlatEpisodes] = []
    source_of_member, rewards = [], []
    for one in ids:
        fields = read_manifest(one).fields
        key = (fields["observations"], fields["actions"])
        if key not in sources:
            sources[key] = len(flats)
            flats.append(load_episodes(one, ("observations", "actions"), verify=True))
        source_of_member.append(sources[key])
        rewards.append(torch.from_numpy(load_episodes(one, ("rewards",), verify=True).arrays["rewards"]))
    steps = used or max(int(flat.lengths.sum()) for flat in flats)
    first = flats[0].arrays
    episodes = Episodes(
        len(flats), max(len(flat.lengths) for flat in flats), steps, first["observations"].shape[1], first["actions"].shape[1],
        MemberRandom(seeds, "replay", device), source_of_member,
    )  # fmt: skip
    for source, flat in enumerate(flats):
        left = steps
        for observations, actions in zip(flat.split("observations"), flat.split("actions"), strict=True):
            length = min(left, len(actions))
            if length:
                episodes.add(source, torch.from_numpy(observations[: length + 1]), torch.from_numpy(actions[:length]))
            left -= length
    padded = torch.zeros(len(ids), steps, device=device)
    for row, values in zip(padded, rewards, strict=True):
        row[: len(values)] = values[:steps].to(device)
    episodes.rewards = padded
    return episodes


def _plans(algos: Sequence[str], profile: Profile, settings: dict[str, Any], steps: int | None) -> list[Plan]:
    """One for each algorithm; a setting must be known to one of them at least."""
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


def _check_sizes(sizes: Sequence[int] | None) -> list[int] | None:
    if sizes is None:
        return None
    if not sizes or min(sizes) < 1:
        raise UsageError("a dataset size is a number of transitions, 1 or more.")
    return sorted(set(sizes))


def _used(sizes: list[int] | None, dataset_id: str, manifest: Manifest) -> list[int | None]:
    """How many transitions to train on, None for all of them."""
    if sizes is None:
        return [None]
    if (largest := max(sizes)) > manifest.steps:
        raise UsageError(f"'{dataset_id}' has {manifest.steps:,} transitions, not {largest:,}; leave out the larger sizes.")
    return [None if size == manifest.steps else size for size in sizes]


def _groups(runs: Sequence[Run]) -> list[list[Run]]:
    """Runs that one stack can train: the same algorithm, domain and number of transitions."""
    found: dict[tuple[str, str, int | None], list[Run]] = {}
    for run in runs:
        found.setdefault((run.plan.algo, run.manifest.domain, run.used), []).append(run)
    return list(found.values())


def _describe(group: Sequence[Run]) -> str:
    names = [
        run.dataset
        + ("" if run.used is None else f" ({run.used:,})")
        + ("" if run.seed == run.manifest.seed else f" training seed {run.seed}")
        for run in group
    ]
    return f"{group[0].plan.algo}: {' + '.join(names) if len(names) < 3 else f'{len(names)} datasets'}"


def _target(run: Run, log: str | None, logs: Path, results: Path) -> LogTarget | None:
    if log is None:
        return None
    manifest, profile = run.manifest, run.plan.profile
    place = str(run.path.relative_to(results / profile).with_suffix(""))
    title = f"{manifest.task}-{manifest.method}-{run.path.stem}"
    return LogTarget(log, logs, "evaluate", profile, manifest.domain, place, title, run.plan.values)


def _datasets(
    domain: str, tasks: Sequence[str] | None, reward: CustomReward | None, methods: Sequence[str], seeds: Sequence[int],
    dataset_ids: Sequence[str] | None, *,
    profile: str, device: str, workers: int | None,
) -> list[str]:  # fmt: skip
    """The relabelled datasets to train on, made where they are missing."""
    if dataset_ids is None:
        bases = [
            one for method in methods for one in ensure_collected(method, domain, seeds, profile=profile, device=device, workers=workers)
        ]
        return [one for base in bases for one in ensure_relabelled(base, tasks, reward)]
    found: list[tuple[str, bool]] = []
    # All are checked before the first is relabelled.
    for dataset_id in dataset_ids:
        manifest = read_manifest(parse_id(dataset_id))
        check_profile(manifest, dataset_id, profile)
        if manifest.task is not None and tasks is not None and manifest.task not in tasks:
            raise UsageError(f"'{dataset_id}' is labelled for {manifest.task}, not for {', '.join(tasks)}; leave out --tasks.")
        found.append((dataset_id, manifest.task is not None))
    return list(dict.fromkeys(one for base, labelled in found for one in ([base] if labelled else ensure_relabelled(base, tasks, reward))))


def _done(run: Run) -> bool:
    """Whether this very run is recorded already.

    Raises:
        UsageError: another run stands in its place.
    """
    return _is_recorded(run.path, run.plan, run.used, run.seed, lambda dataset: dataset.fingerprint == run.manifest.fingerprint)


def _is_recorded(path: Path, plan: Plan, used: int | None, seed: int, is_same: Callable[[DatasetReference], bool]) -> bool:
    """Whether a record is there, of this training on the same data.

    Raises:
        UsageError: another run stands in its place.
    """
    if not path.exists():
        return False
    try:
        record = read_record(path)
    except RunError as error:
        raise RunError(f"{str(error).rstrip('.')}; use --overwrite or another --output.") from None
    made = (in_full(record.hyperparameters), record.dataset.used, record.seed)
    if made == (plan.values, used, seed) and is_same(record.dataset):
        return True
    raise UsageError(f"{path} records another run (other data or settings); use --overwrite or another --output.")


def plan_evaluate(
    algo: str, domain: str, tasks: Sequence[str] | None, method: str, seeds: Sequence[int], *, profile: str,
    settings: Mapping[str, Any] | None = None, used: int | None = None, output: str | Path = "results",
    collected: Mapping[str, Any] | None = None, training_seeds: Sequence[int] | None = None,
) -> list[Planned]:  # fmt: skip
    """What :func:`evaluate` would make with the same arguments, for each seed, task and training seed; nothing is written, and no dataset
    need exist.

    A record whose dataset is gone counts if it says that its dataset was collected like this.

    Args:
        algo, domain, tasks, method, seeds, profile, settings, output, training_seeds: as for :func:`evaluate`.
        used: the number of transitions to train on, if not all.
        collected: hyperparameters of the collection that differ from the profile.

    Raises:
        UsageError: wrong input, or another run is recorded in such a place.
        RunError: a record is damaged.
    """
    chosen = resolve_profile(profile)
    (plan,) = _plans([algo], chosen, dict(settings or {}), None)
    results = check_folder(output, "the output")
    found = []
    for seed in check_seeds(seeds):
        for task in check_tasks(check_domain(domain), tasks):
            one = default_id(domain, method, seed).for_task(task)
            for training_seed in (seed,) if training_seeds is None else check_seeds(training_seeds):
                path = record_path(results, str(one), algo, seed, chosen.name, used, training_seed)
                if exists(one):
                    run = Run(plan, str(one), read_manifest(one), used, training_seed, path)
                    # What a process left that was killed just after it had written the record is removed by whoever keeps that.
                    done = _done(run) and not _lock(run, results).exists() and not _checkpoints([run], results, "cpu").folder.exists()
                else:
                    made = (str(one), domain, task, method, seed, chosen.name, dict(collected or {}), None, None)
                    done = _is_recorded(path, plan, used, training_seed, partial(_is_of, made))
                found.append(Planned(str(path), seed, plan.loop.gradient_steps, done, plan.overrides))
    return found


def _is_of(made: tuple[Any, ...], dataset: DatasetReference) -> bool:
    there = (
        dataset.id, dataset.domain, dataset.task, dataset.method, dataset.seed, dataset.profile, dataset.overrides, dataset.reward,
        dataset.source,
    )  # fmt: skip
    return there == made


def _record(run: Run, outcome: Outcome, device: str, seconds: float) -> Record:
    plan, manifest, dataset_id = run.plan, run.manifest, run.dataset
    values = plan.values
    head, dirty = commit()
    options = {"--algo": plan.algo, "--profile": plan.profile}
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
    if run.used is not None:
        options["--dataset-size"] = str(run.used)
    if run.seed != manifest.seed:
        options["--training-seeds"] = str(run.seed)
    finals = [Evaluation(step=step, returns=returns) for step, returns in outcome.finals]
    return Record(
        dataset=DatasetReference(
            id=dataset_id, fingerprint=manifest.fingerprint, domain=manifest.domain, task=str(manifest.task), method=manifest.method,
            seed=manifest.seed, steps=manifest.steps, profile=manifest.profile, overrides=manifest.overrides,
            reward=manifest.reward, source=None if manifest.imported is None else manifest.imported.source, used=run.used,
        ),
        algorithm=plan.algo,
        profile=plan.profile,
        overrides=plan.overrides,
        seed=run.seed,
        hyperparameters=values,
        hyperparameters_hash=config_hash(values),
        milestones=list(plan.loop.milestones),
        curve=[Evaluation(step=step, returns=returns) for step, returns in outcome.curve],
        final=finals[-1],
        late=finals[:-1],
        metrics=[TrainingMetrics(step=step, values=row) for step, row in outcome.metrics],
        seconds=seconds,
        versions=versions(),
        commit=head,
        dirty=dirty,
        machine=machine(device, torch.get_num_threads()),
        command=command_line("evaluate", options, plan.overrides, "--overwrite"),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )  # fmt: skip
