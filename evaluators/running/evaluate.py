"""``evaluate``: from datasets to run records."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from cudc_bench.artefacts.ids import datasets_root, default_id
from cudc_bench.artefacts.manifest import Manifest, RewardFunction, exists, read_manifest
from cudc_bench.artefacts.records import CHECKPOINTS, LabelSource, Record, record_path, write_record
from cudc_bench.envs import Domain, check_domain, check_tasks
from cudc_bench.envs.rewards import CustomReward, Measured, load_reward
from cudc_bench.errors import BrokenDownError, RunError, UsageError
from cudc_bench.execution import CHECKPOINT_EVERY, LOG_DIR, interrupts
from cudc_bench.execution.locks import locked
from cudc_bench.execution.progress import Advance, echo, warn
from cudc_bench.execution.runlog import LogTarget, open_log
from cudc_bench.files import check_folder, remove_empty_above
from cudc_bench.learning.bf16 import echo_if_slower
from cudc_bench.learning.engines import engine_of, set_engine
from cudc_bench.runs.execution import Execution, Work, begun_together
from cudc_bench.settings.profiles import resolve_profile
from cudc_bench.settings.seeds import check_seeds
from cudc_bench.stages import Planned, check_reward

from ..policies.stored import save_learner, save_policy
from .datasets import load_members
from .labels import Interview, Question, draw_labels
from .loop import Arena, Outcome, run_evaluation
from .plans import Plan, Wanted, check_label_source, check_labels, check_plans, check_sizes, make_plans, sizes_of
from .runs import SIDE_BY_SIDE, Answer, Run, Stack, is_recorded, record_of, stackable


@interrupts.leaving_gracefully()  # also between its stages
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
    labels: Sequence[int] | None = None,
    labels_from: str | None = None,
    output: str | Path = "results",
    overwrite: bool = False,
    device: str = "auto",
    engine: str = "auto",
    workers: int | None = 1,
    log: str | None = None,
    log_dir: str | Path = LOG_DIR,
    policies: bool = True,
    checkpoint_every: float = CHECKPOINT_EVERY,
    fresh: bool = False,
) -> list[Path]:
    """Train offline algorithms on relabelled datasets and write one record for each (algorithm, method, seed, task).

    A learner without rewards trains once on each task-agnostic dataset, and there is a record for each task that it is then asked for.

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
        labels: how many transitions' rewards learners without rewards are told, to answer for a task; once for each of these numbers,
            10,000 unless given. Others take no notice.
        labels_from: a dataset of the same domain that these transitions are drawn from, instead of the one that was trained on.
        output: folder of the records.
        overwrite: train again where a record exists, and label again what was labelled by another text of ``reward``, or from another base.
        device: ``cpu``, ``cuda`` or ``auto``.
        engine: how updates are carried out: ``eager``, ``compiled``, or ``auto``, which compiles long runs on a CPU that has a compiler.
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
    plans = make_plans([algo] if isinstance(algo, str) else algo, chosen, dict(settings or {}), steps)
    results = check_folder(output, "the output")
    check_folder(datasets_root(), "the dataset root")
    execution = Execution.checked(
        device, workers, checkpoint_every, engine=engine, fresh=fresh, overwrite=overwrite, log=log, log_dir=log_dir
    )
    check_plans(plans, execution.device)
    sizes = check_sizes(dataset_sizes)
    again = None if training_seeds is None else check_seeds(training_seeds)
    wanted = Wanted.checked(domain, tasks, methods, check_seeds(seeds), dataset_id, reward, profile)
    budgets = check_labels(labels)
    if labels_from is not None:
        check_label_source(labels_from, wanted.domains)
    if not any(plan.is_zero_shot for plan in plans) and (labels is not None or labels_from is not None):
        raise UsageError("--labels and --labels-from are for learners without rewards, which none of these is.")

    runs: list[Run] = []
    if rewarded := [plan for plan in plans if not plan.is_zero_shot]:
        manifests = {one: read_manifest(one) for one in wanted.ensure(execution.device, workers, overwrite)}
        for one, manifest in manifests.items():
            check_reward(manifest, one, wanted.reward)
        runs += _runs(rewarded, manifests, sizes, again, results)
    if shared := [plan for plan in plans if plan.is_zero_shot]:
        asked = wanted.ensure_bases(execution.device, workers)
        source = None if labels_from is None else LabelSource(id=labels_from, fingerprint=read_manifest(labels_from).fingerprint)
        own = None if wanted.reward is None else RewardFunction(reference=wanted.reward.reference, sha256=wanted.reward.sha256)
        manifests = {one: read_manifest(one) for one in asked}
        runs += [
            replace(run, questions=tuple(Question(task, count, own, source) for task in asked[run.dataset] for count in budgets))
            for run in _runs(shared, manifests, sizes, again, results)
        ]
    places = {id(plan): place for place, plan in enumerate(plans)}
    runs.sort(key=lambda run: places[id(run.plan)])
    groups, stack = stackable(runs), partial(Stack, execution)
    left = _left(groups, stack, overwrite)
    work = Work.plan(execution, "evaluate", groups, left, stack, partial(_beside, execution, chosen.threads))
    total = plans[0].loop.gradient_steps
    reward_reference = None if wanted.reward is None else wanted.reward.reference
    echo(
        f"evaluate {', '.join(plan.algo for plan in plans)} on {', '.join(wanted.domains)}: profile {chosen.name}, {len(runs)} runs of"
        f" {total:,} gradient steps, {execution.device}"
        + (f"; {len(runs) - len(left)} recorded before are kept" if len(left) < len(runs) else "")
    )
    for begun in work.stacks:
        echo_if_slower(begun.plan.loop.precision, begun.plan.config, begun.engine, execution.device)
    work.carry_out(evaluate_members, unit="gradient steps", total=total, threads=chosen.threads, reward=reward_reference, policies=policies)
    return [path for run in runs for path in run.paths]


def _runs(
    plans: Sequence[Plan], manifests: Mapping[str, Manifest], sizes: list[int] | None, again: Sequence[int] | None, results: Path
) -> list[Run]:
    return [
        Run(plan, one, manifest, used, seed, results)
        for plan in plans
        for one, manifest in manifests.items()
        for used in sizes_of(sizes, one, manifest)
        for seed in again or (manifest.seed,)
    ]


def evaluate_members(advance: Advance, *, stack: Stack, execution: Execution, reward: str | None, policies: bool) -> None:
    """Train some members in this process and write their records (the job of :func:`evaluate`).

    Where one of several breaks down, each is trained alone, so that the others have the records that they would have had without it.
    """
    done = 0

    def count(steps: int) -> None:
        nonlocal done
        done += steps
        advance(steps)

    try:
        _evaluate_members(count, stack, execution, reward, policies)
    except BrokenDownError:
        if len(stack.runs) == 1:
            raise
        warn(f"{stack.label}: one of them broke down, so that each is trained alone")
        errors = []
        for run in stack.runs:
            advance(-done)
            done = 0
            try:
                _evaluate_members(count, Stack(execution, [run]), execution, reward, policies)
            except BrokenDownError as error:
                errors.append(error)
        if errors:
            raise errors[0] from None


def _evaluate_members(advance: Advance, stack: Stack, execution: Execution, reward: str | None, policies: bool) -> None:
    plan, runs, device = stack.plan, stack.runs, execution.device
    facts = check_domain(runs[0].manifest.domain)
    checkpoints = stack.checkpoints(execution.checkpoint_every)
    with ExitStack() as opened:
        for path in (checkpoints.folder, *(run.lock for run in runs)):
            opened.callback(remove_empty_above, path, stack.results / CHECKPOINTS)
        for run in runs:
            opened.enter_context(locked(run.lock, f"'{run.path}'"))
        if not execution.overwrite and all(run.is_done() for run in runs):
            return  # by another process, while this one was starting
        if execution.fresh:
            checkpoints.remove()
        agent = plan.kind(facts.observation_size, facts.action_size, plan.config, stack.seeds, device)
        set_engine(agent, stack.engine)
        data = load_members([run.dataset for run in runs], stack.seeds, device, runs[0].used, labelled=not plan.is_zero_shot)
        if agent.wants_next_action and int(data.lengths[data.lengths > 0].min()) < 2:
            raise RunError(f"{plan.algo} needs episodes of at least two steps, which {runs[0].dataset} does not have throughout.")
        custom = None if reward is None else load_reward(reward, facts)
        interview = _interview(agent, runs, facts, custom) if plan.is_zero_shot else None
        tasks = [one.task for run in runs for one in run.questions] or [str(run.manifest.task) for run in runs]
        targets = [_target(run, path, execution) for run in runs for path in run.paths]
        logs = [opened.enter_context(open_log(one)) for one in targets]
        try:
            outcomes = run_evaluation(agent, data, plan.loop, Arena(facts, custom or tasks), advance, logs, checkpoints, interview)
        except BrokenDownError:
            checkpoints.remove()
            raise
        write = partial(record_of, execution=execution, engine=engine_of(agent), seconds=checkpoints.seconds, beside=len(runs))
        if interview is None:
            for member, (run, outcome) in enumerate(zip(runs, outcomes, strict=True)):
                if policies:
                    save_policy(agent.policy, member, run.path)
                write_record(run.path, write(run, outcome))
        else:
            _write_answers(agent, interview, runs, outcomes, write, policies)
        checkpoints.remove()


def _interview(agent: Any, runs: Sequence[Run], facts: Domain, custom: CustomReward | None) -> Interview:
    """The questions of some runs, which are the same, with their labels."""
    questions = runs[0].questions
    most, tasks = max(one.labels for one in questions), list(dict.fromkeys(one.task for one in questions))
    source = questions[0].source
    samples = [draw_labels(source.id if source else run.dataset, facts, tasks, most, custom, None if source else run.used) for run in runs]
    return Interview(agent, samples, questions)


def _write_answers(
    agent: Any, interview: Interview, runs: Sequence[Run], outcomes: Sequence[Outcome], write: Callable[..., Record], policies: bool
) -> None:
    """Write the records of zero-shot learners, the policies with their vectors, and what can be asked more."""
    told = interview.told()
    for member, run in enumerate(runs):
        if policies:
            save_learner(agent, member, run.path)
        for index, question in enumerate(run.questions):
            labels = interview.labelled(question)
            norm, rewards = float(told.norms[member, index]), labels.reward[member]
            answer = Answer(question, norm, rewards.numel(), float((rewards != 0).double().mean()), agent.rule)
            if norm == 0.0:
                warn(f"{run.path_of(question)}: none of the {rewards.numel():,} labels has a reward, so that its policy pursues nothing")
            if policies:
                save_policy(agent.policy_for(told.z[:, index]), member, run.path_of(question))
            write_record(run.path_of(question), write(run, outcomes[member * interview.each + index], answer=answer))


def _left(groups: Sequence[Sequence[Run]], stack: Callable[[list[Run]], Stack], overwrite: bool) -> list[Run]:
    """What is to be done of groups of runs; what a killed process left beside the records of others is removed."""
    left: list[Run] = []
    for group in groups:
        waiting = [run for run in group if overwrite or not run.is_done()]
        recorded = [run for run in group if run not in waiting]
        for run in recorded:
            run.tidy()
        for begun in begun_together(recorded, stack, SIDE_BY_SIDE):
            stack(begun).tidy()
        left += waiting
    return left


def _beside(execution: Execution, threads: int | None, run: Run) -> int:
    """How many a run may be trained with in one stack on a CPU, itself included, and have the same record as alone.

    Several threads share a product by the size of a stack, and a compiler makes another function for each size; both round by it.
    """
    kind, updates = run.plan.kind, run.plan.loop.gradient_steps
    is_exact = kind.stacks_exactly and threads == 1 and execution.engine_for(kind, updates) == "eager"
    return SIDE_BY_SIDE if is_exact else 1


def _target(run: Run, path: Path, execution: Execution) -> LogTarget | None:
    """Where the numbers of a record are sent while they are measured."""
    if execution.log is None:
        return None
    manifest, profile = run.manifest, run.plan.profile
    place = str(path.relative_to(run.results / profile).with_suffix(""))
    title = f"{path.parent.parent.name}-{manifest.method}-{path.stem}"
    return LogTarget(execution.log, execution.log_dir, "evaluate", profile, manifest.domain, place, title, run.plan.values)


def plan_evaluate(
    algo: str, domain: str, tasks: Sequence[str] | None, method: str, seeds: Sequence[int], *, profile: str,
    settings: Mapping[str, Any] | None = None, used: int | None = None, output: str | Path = "results",
    collected: Mapping[str, Any] | None = None, training_seeds: Sequence[int] | None = None, labels: Sequence[int] | None = None,
) -> list[Planned]:  # fmt: skip
    """What :func:`evaluate` would make with the same arguments, for each seed, task and training seed; nothing is written, and no dataset
    need exist.

    A record whose dataset is gone counts if it says that its dataset was collected like this.

    Args:
        algo, domain, tasks, method, seeds, profile, settings, output, training_seeds, labels: as for :func:`evaluate`.
        used: the number of transitions to train on, if not all.
        collected: hyperparameters of the collection that differ from the profile.

    Raises:
        UsageError: wrong input, or another run is recorded in such a place.
        RunError: a record is damaged.
    """
    chosen = resolve_profile(profile)
    (plan,) = make_plans([algo], chosen, dict(settings or {}), None)
    results = check_folder(output, "the output")
    found = []
    for seed in check_seeds(seeds):
        base = default_id(domain, method, seed, chosen.name)
        for task in check_tasks(check_domain(domain), tasks):
            one = base if plan.is_zero_shot else base.for_task(task)
            for count in check_labels(labels) if plan.is_zero_shot else (None,):
                questions = () if count is None else (Question(task, count),)
                for training_seed in (seed,) if training_seeds is None else check_seeds(training_seeds):
                    path = record_path(results, str(base.for_task(task)), algo, seed, chosen.name, used, training_seed, count)
                    if exists(one):
                        run = Run(plan, str(one), read_manifest(one), used, training_seed, results, questions)
                        # What a process left that was killed just after it had written the record is removed by whoever keeps that.
                        done = run.is_done() and not run.is_untidy()
                    else:
                        made = (str(one), domain, task, method, seed, chosen.name, dict(collected or {}), None, None)
                        done = is_recorded(path, plan, used, training_seed, partial(_is_of, made, count))
                    found.append(Planned(str(path), seed, plan.loop.gradient_steps, done, plan.overrides))
    return found


def _is_of(made: tuple[Any, ...], labels: int | None, record: Record) -> bool:
    dataset, told = record.dataset, record.zero_shot
    if (None if told is None else (told.labels, told.source)) != (None if labels is None else (labels, None)):
        return False
    there = (
        dataset.id, dataset.domain, dataset.task, dataset.method, dataset.seed, dataset.profile, dataset.overrides, dataset.reward,
        dataset.source,
    )  # fmt: skip
    return there == made
