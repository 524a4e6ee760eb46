"""``make_references``: the floors and the ceiling of tasks, between which scores are normalised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cudc_bench.artefacts.ids import domain_namespace
from cudc_bench.artefacts.provenance import command_line, commit, machine, origin, versions
from cudc_bench.artefacts.records import Evaluation, TrainingMetrics
from cudc_bench.artefacts.references import Reference, ReferenceRun, read_reference, reference_path, write_reference
from cudc_bench.data.writer import EpisodeShards
from cudc_bench.envs import check_domain, check_tasks
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
from cudc_bench.settings.config import as_dict, build, changed, check_settings, config_hash
from cudc_bench.settings.evaluate_config import OnlineConfig
from cudc_bench.settings.profiles import resolve_device, resolve_profile
from cudc_bench.settings.seeds import check_seeds, format_seeds

from ..td3 import TD3, TD3Config
from .evaluate import CHECKPOINTS
from .loop import Actor, Arena, Outcome
from .online import run_online

_PATIENCE = 60.0  # seconds; whoever holds the lock writes a file


@dataclass(frozen=True)
class Plan:
    """The references of one command.

    Attributes:
        domain, tasks, seeds: whose.
        profile: the set of hyperparameters that they start from.
        loop, config: all hyperparameters.
        overrides: those that the user changed.
        device: where the agents learn.
        results: the folder of records.
    """

    domain: str
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    profile: str
    loop: OnlineConfig
    config: TD3Config
    overrides: dict[str, Any]
    device: str
    results: Path

    @property
    def values(self) -> dict[str, Any]:
        """All hyperparameters by name."""
        return as_dict(self.loop, self.config)

    def path(self, task: str) -> Path:
        """Where the reference of a task goes."""
        return reference_path(self.results, self.domain, task, self.profile)

    def lock(self, task: str) -> Path:
        """Of the reference of a task, while it is put together."""
        return self._hidden(self.path(task).with_suffix(".lock"))

    def checkpoints(self, members: Sequence[Member], every: float = CHECKPOINT_EVERY) -> Checkpoints:
        """Those of a stack."""
        decisive = {
            "hyperparameters": self.values, "domain": self.domain, "members": [f"{one.task} seed {one.seed}" for one in members],
            "device": self.device, **origin({}),
        }  # fmt: skip
        return Checkpoints(self.folder(members), decisive, every)

    def folder(self, members: Sequence[Member]) -> Path:
        """Where a stack keeps what it has done so far."""
        if len(members) == 1:
            return self._hidden(self.path(members[0].task).with_name(f"reference-seed{members[0].seed}"))
        names = [str(self.path(one.task).relative_to(self.results)) + f" {one.seed}" for one in members]
        return self.results / CHECKPOINTS / "stacks" / f"reference-{config_hash({'members': names})}"

    def _hidden(self, path: Path) -> Path:
        return self.results / CHECKPOINTS / path.relative_to(self.results)


@dataclass(frozen=True)
class Member:
    """One training: a task and a seed."""

    task: str
    seed: int


class RandomActions:
    """Uniformly random actions in [-1, 1] of E members, which no observation changes."""

    device = torch.device("cpu")

    def __init__(self, seeds: Sequence[int], action: int) -> None:
        self._random, self._action = MemberRandom(seeds, "random actions"), action

    def act(self, observation: Tensor) -> Tensor:
        """(E, n, S) -> (E, n, A)."""
        return self._random.uniform(observation.shape[1], self._action) * 2.0 - 1.0


@interrupts.leave_well()
def make_references(
    domain: str = "walker",
    tasks: Sequence[str] | None = None,
    seeds: Sequence[int] = (1, 2, 3),
    *,
    profile: str = "auto",
    settings: Mapping[str, Any] | None = None,
    output: str | Path = "results",
    overwrite: bool = False,
    device: str = "auto",
    workers: int | None = 1,
    log: str | None = None,
    log_dir: str | Path = LOG_DIR,
    checkpoint_every: float = CHECKPOINT_EVERY,
    fresh: bool = False,
) -> list[Path]:
    """Measure what random actions and untrained policies get on tasks, and what TD3 gets that is trained online on them.

    One reference for each task, of all seeds. The agent collects as many steps as the profile's datasets have, and learns as often as the
    profile's collectors do. A reference that exists of the same seeds and hyperparameters is kept. A run that was interrupted is continued
    where its last checkpoint was taken, with the same result as if it had not been.

    Args:
        domain: a registered domain.
        tasks: of the domain; all unless given.
        seeds: of the random actions and of the agents; a reference holds all of them.
        profile: ``paper``, ``cpu``, ``demo``, ``smoke`` or ``auto``.
        settings: hyperparameters that differ from the profile, by name; what is made with any is not the profile's reference.
        output: folder of the records.
        overwrite: make again what exists.
        device: ``cpu``, ``cuda`` or ``auto``.
        workers: processes on a CPU; 1 works in this process, None takes one for each core.
        log: also send training metrics and mean returns to ``"tensorboard"`` or ``"wandb"`` while they are measured.
        log_dir: the folder of these logs; a run's own in it is ``reference/<profile>/<domain>/<task>/seed<seed>``.
        checkpoint_every: seconds between two checkpoints at least; they lie in ``.checkpoints`` in ``output`` until the reference is there.
        fresh: start over where a run was interrupted.

    Returns:
        The paths of all references, made now or before.

    Raises:
        UsageError: wrong input, or a run with other settings was interrupted; nothing has been trained.
        RunError: the run failed; the references written before stay, and what the run had done until its last checkpoint is kept.
        Interrupted: the process was asked to leave; what it had done is kept.
    """
    plan = _plan(domain, tasks, seeds, profile, dict(settings or {}), output, device)
    logs = check_log(log, log_dir)
    threads = resolve_profile(profile).threads
    worker_count(workers, 1)
    todo = [task for task in plan.tasks if overwrite or not _done(plan, task)]
    members = [Member(task, seed) for task in plan.tasks for seed in plan.seeds]
    if plan.device == "cuda":
        # A stack that was interrupted while its references were being written goes on as a whole.
        whole = plan.folder(members).exists() and bool(todo)
        groups, count = [members if whole else [one for one in members if one.task in todo]] if todo else [], 1
    else:
        # The threads of each run, and so its result, must not depend on how many are left to do.
        groups, count = [[one] for one in members if one.task in todo], worker_count(workers, len(members))
    for group in [members] if plan.device == "cuda" else [[one] for one in members]:
        if not {one.task for one in group} & set(todo):
            _tidy(plan, group)
    for group in groups:
        if fresh:
            with locked(_lock(plan, group), _what(plan, group)):
                plan.checkpoints(group).remove()
        else:
            plan.checkpoints(group).check(_what(plan, group), "reference")
    say(
        f"reference of {', '.join(plan.tasks)} on {domain}: profile {plan.profile}, TD3 online, seeds {format_seeds(plan.seeds)},"
        f" {plan.loop.steps:,} steps each, {plan.device}"
        + (f"; {len(plan.tasks) - len(todo)} made before are kept" if len(todo) < len(plan.tasks) else "")
    )
    jobs = [
        Job(
            description=f"td3 online: {_names(group)}",
            total=plan.loop.steps,
            arguments={
                "plan": plan, "groups": groups, "group": group, "targets": [_target(plan, one, log, logs) for one in group],
                "checkpoint_every": checkpoint_every, "overwrite": overwrite,
            },
        )
        for group in groups
    ]  # fmt: skip
    if jobs:
        run_jobs(train_members, jobs, unit="steps", workers=count, threads=threads)
    return [plan.path(task) for task in plan.tasks]


def _plan(
    domain: str, tasks: Sequence[str] | None, seeds: Sequence[int], profile: str, settings: dict[str, Any], output: str | Path, device: str
) -> Plan:
    """Everything that is needed.

    Raises:
        UsageError: wrong input.
    """
    chosen = resolve_profile(profile)
    check_settings(settings, [OnlineConfig, TD3Config])
    layers = (chosen.collect, chosen.evaluate)
    loop, config = build(OnlineConfig, *layers, settings), TD3.configure(chosen.evaluate, settings)
    overrides = changed(as_dict(loop, config), as_dict(build(OnlineConfig, *layers), TD3.configure(chosen.evaluate), later=True))
    results, device = check_folder(output, "the output"), resolve_device(device)
    check_precision(TD3, "td3", loop.precision, device)
    found = check_tasks(check_domain(domain), tasks)
    return Plan(domain, found, tuple(sorted(check_seeds(seeds))), chosen.name, loop, config, overrides, device, results)


def _done(plan: Plan, task: str) -> bool:
    """Whether this very reference is there already.

    Raises:
        UsageError: another one stands in its place.
    """
    path = plan.path(task)
    if not path.exists():
        return False
    try:
        there = read_reference(path)
    except RunError as error:
        raise RunError(f"{str(error).rstrip('.')}; use --overwrite or another --output.") from None
    if (there.hyperparameters_hash, tuple(sorted(there.seeds))) == (config_hash(plan.values), plan.seeds):
        return True
    raise UsageError(
        f"{path} is another reference (of seeds {format_seeds(there.seeds)}, or with other settings); use --overwrite or another --output."
    )


def _names(group: Sequence[Member]) -> str:
    names = [f"{one.task} seed {one.seed}" for one in group]
    return " + ".join(names) if len(names) < 3 else f"{len(names)} trainings"


def _what(plan: Plan, group: Sequence[Member]) -> str:
    return f"the reference of {_names(group)} at {plan.profile}"


def _lock(plan: Plan, group: Sequence[Member]) -> Path:
    folder = plan.folder(group)
    return folder.with_name(f"{folder.name}.lock")


def _tidy(plan: Plan, group: Sequence[Member]) -> None:
    """Remove what a process left that was killed just after it had written a reference; nothing if somebody is writing it again."""
    folder = plan.folder(group)
    if folder.exists() or _lock(plan, group).exists():
        with suppress(RunError), locked(_lock(plan, group), ""):
            plan.checkpoints(group).remove()
        remove_empty_above(folder, plan.results / CHECKPOINTS)


def _target(plan: Plan, one: Member, log: str | None, folder: Path) -> LogTarget | None:
    if log is None:
        return None
    place, name = f"{domain_namespace(plan.domain)}/{one.task}/seed{one.seed}", f"{one.task}-seed{one.seed}"
    return LogTarget(log, folder, "reference", plan.profile, plan.domain, place, name, plan.values)


def train_members(
    advance: Advance, *, plan: Plan, groups: list[list[Member]], group: list[Member], targets: list[LogTarget | None],
    checkpoint_every: float, overwrite: bool,
) -> None:  # fmt: skip
    """Train some members in this process, and write the references of which nothing is left to do (the job of :func:`make_references`)."""
    checkpoints = plan.checkpoints(group, checkpoint_every)
    with ExitStack() as stack:
        stack.callback(remove_empty_above, checkpoints.folder, plan.results / CHECKPOINTS)
        stack.enter_context(locked(_lock(plan, group), _what(plan, group)))
        tasks = list(dict.fromkeys(one.task for one in group))
        if not overwrite and all(_done(plan, task) for task in tasks):
            return  # by another process, while this one was starting
        if _finished(checkpoints) is None:
            logs = [stack.enter_context(open_log(target)) for target in targets]
            shards = [EpisodeShards(checkpoints.folder / f"{one.task}-seed{one.seed}") for one in group]
            seeds = [one.seed for one in group]
            facts = check_domain(plan.domain)
            arena = Arena(facts, [one.task for one in group])
            sizes = (facts.observation_size, facts.action_size)
            agent = TD3(*sizes, plan.config, seeds, plan.device)
            try:
                outcomes = run_online(agent, plan.loop, facts, [one.task for one in group], arena, advance, shards, logs, checkpoints)
                untrained = TD3(*sizes, plan.config, seeds, plan.device)
                actors: dict[str, Actor] = {"random actions": RandomActions(seeds, facts.action_size), "untrained policy": untrained}
                floors = [arena.evaluate(actor, seeds, what, 0, plan.loop.final_episodes).tolist() for what, actor in actors.items()]
            except interrupts.Interrupted as error:
                # While a floor was measured; all before it is kept.
                raise interrupts.interrupted(error.where or "at its last step") from None
            except BrokenDownError:
                checkpoints.remove()
                raise
            runs = [_run(*parts).model_dump() for parts in zip(seeds, outcomes, *floors, strict=True)]
            checkpoints.save(plan.loop.steps, {"finished": {"seconds": checkpoints.seconds, "runs": runs}})
            for one in shards:
                one.remove()
        else:
            advance(plan.loop.steps)
        written = [_put_together(plan, task, groups, overwrite) for task in tasks]
        if all(written):
            for other in groups:
                if {one.task for one in other} <= set(tasks):
                    plan.checkpoints(other).remove()


def _run(seed: int, outcome: Outcome, random: list[float], untrained: list[float]) -> ReferenceRun:
    return ReferenceRun(
        seed=seed,
        random=random,
        untrained=untrained,
        curve=[Evaluation(step=step, returns=returns) for step, returns in outcome.curve],
        final=Evaluation(step=outcome.finals[0][0], returns=outcome.finals[0][1]),
        metrics=[TrainingMetrics(step=step, values=row) for step, row in outcome.metrics],
    )


def _finished(checkpoints: Checkpoints) -> dict[str, Any] | None:
    """What a stack measured that is at its end: ``seconds``, and its ``runs``, one for each member; None if it is not there yet."""
    found: list[dict[str, Any]] = []
    checkpoints.load(lambda _, state: found.append(state["finished"]) if "finished" in state else None)
    return found[0] if found else None


def _put_together(plan: Plan, task: str, groups: Sequence[Sequence[Member]], overwrite: bool) -> bool:
    """Write the reference of a task if all of its trainings are at their end; whichever job is the last to finish one does it.

    Returns:
        Whether it is there now.
    """
    with ExitStack() as stack:
        stack.enter_context(locked(plan.lock(task), f"'{plan.path(task)}'", _PATIENCE))
        if not overwrite and _done(plan, task):
            return True
        seconds, runs = 0.0, []
        for group in groups:
            if task not in {one.task for one in group}:
                continue
            if (there := _finished(plan.checkpoints(group))) is None:
                return False
            seconds += there["seconds"]
            runs += [run for one, run in zip(group, there["runs"], strict=True) if one.task == task]
        head, dirty = commit()
        options = {"--domain": plan.domain, "--task": task, "--seeds": format_seeds(plan.seeds), "--profile": plan.profile}
        reference = Reference(
            domain=plan.domain,
            task=task,
            profile=plan.profile,
            overrides=plan.overrides,
            hyperparameters=plan.values,
            hyperparameters_hash=config_hash(plan.values),
            runs=[ReferenceRun(**run) for run in sorted(runs, key=lambda run: run["seed"])],
            seconds=round(seconds, 1),
            versions=versions(),
            commit=head,
            dirty=dirty,
            machine=machine(plan.device, torch.get_num_threads()),
            command=command_line("reference", options, plan.overrides, "--overwrite"),
            created=datetime.now(UTC).isoformat(timespec="seconds"),
        )
        write_reference(plan.path(task), reference)
    return True
