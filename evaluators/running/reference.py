"""``make_references``: the floors and the ceiling of tasks, between which scores are normalised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cudc_bench.artefacts.ids import domain_namespace
from cudc_bench.artefacts.provenance import command_line, commit, machine, origin, versions
from cudc_bench.artefacts.records import CHECKPOINTS, Evaluation, TrainingMetrics
from cudc_bench.artefacts.references import Reference, ReferenceRun, read_reference, reference_path, write_reference
from cudc_bench.data.writer import EpisodeShards
from cudc_bench.envs import check_domain
from cudc_bench.errors import BrokenDownError, RunError
from cudc_bench.execution import CHECKPOINT_EVERY, LOG_DIR, interrupts
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.execution.locks import locked
from cudc_bench.execution.progress import Advance, echo
from cudc_bench.execution.runlog import LogTarget, RunLog, open_log
from cudc_bench.files import check_folder, remove_empty_above
from cudc_bench.learning.bf16 import echo_if_slower
from cudc_bench.learning.engines import engine_of
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.runs.execution import Execution, Work
from cudc_bench.runs.existing import result_stands
from cudc_bench.settings.config import config_hash
from cudc_bench.settings.profiles import resolve_profile
from cudc_bench.settings.seeds import format_seeds

from .loop import Actor, Arena, Outcome
from .online import run_online
from .training import Member, OnlineTraining, names_of

_PATIENCE = 60.0  # seconds; whoever holds the lock writes a file


@dataclass(frozen=True)
class ReferencePlan(OnlineTraining):
    """The references of one command.

    Attributes, beside those of every online training:
        results: the folder of records.
    """

    results: Path

    def path(self, task: str) -> Path:
        """Where the reference of a task goes."""
        return reference_path(self.results, self.domain, task, self.profile)

    def lock(self, task: str) -> Path:
        """Of the reference of a task, while it is put together."""
        return self.hidden(self.path(task).with_suffix(".lock"))

    def hidden(self, path: Path) -> Path:
        """What is kept for a file while it is being made lies under its name here."""
        return self.results / CHECKPOINTS / path.relative_to(self.results)


@dataclass(frozen=True)
class Stack:
    """Members that are trained side by side."""

    plan: ReferencePlan
    members: list[Member]

    @property
    def tasks(self) -> list[str]:
        """Of the members, each once."""
        return list(dict.fromkeys(one.task for one in self.members))

    @property
    def seeds(self) -> list[int]:
        """Of the members."""
        return [one.seed for one in self.members]

    @property
    def folder(self) -> Path:
        """Where they keep what they have done so far."""
        plan = self.plan
        if len(self.members) == 1:
            (one,) = self.members
            return plan.hidden(plan.path(one.task).with_name(f"reference-seed{one.seed}"))
        names = [str(plan.path(one.task).relative_to(plan.results)) + f" {one.seed}" for one in self.members]
        return plan.results / CHECKPOINTS / "stacks" / f"reference-{config_hash({'members': names})}"

    @property
    def lock(self) -> Path:
        """Held by whoever trains them."""
        return self.folder.with_name(f"{self.folder.name}.lock")

    @property
    def label(self) -> str:
        """What stands beside their progress bar."""
        return f"td3 online: {names_of(self.members)}"

    @property
    def name(self) -> str:
        """What they make, as messages say it."""
        return f"the reference of {names_of(self.members)} at {self.plan.profile}"

    def checkpoints(self, every: float = CHECKPOINT_EVERY) -> Checkpoints:
        """Where their state is kept."""
        plan = self.plan
        decisive = {
            "hyperparameters": plan.values, "domain": plan.domain, "members": [f"{one.task} seed {one.seed}" for one in self.members],
            "device": plan.device, "engine": plan.engine, **origin({}),
        }  # fmt: skip
        return Checkpoints(self.folder, decisive, every)

    def rehearse(self, members: int) -> None:
        """See :class:`~cudc_bench.runs.memory.Rehearsing`."""
        self.plan.rehearse(self.members[:members])

    def is_interrupted(self) -> bool:
        """Whether these very members have been begun and not ended."""
        return self.folder.exists()

    def tidy(self) -> None:
        """Remove what a process left that was killed just after it had written a reference; nothing if somebody is writing it again."""
        if self.folder.exists() or self.lock.exists():
            with suppress(RunError), locked(self.lock, ""):
                self.checkpoints().remove()
            remove_empty_above(self.folder, self.plan.results / CHECKPOINTS)


class RandomActions:
    """Uniformly random actions in [-1, 1] of E members, which no observation changes."""

    device = torch.device("cpu")

    def __init__(self, seeds: Sequence[int], action: int) -> None:
        self._random, self._action = MemberRandom(seeds, "random actions"), action

    def act(self, observation: Tensor) -> Tensor:
        """(E, n, S) -> (E, n, A)."""
        return self._random.uniform(observation.shape[1], self._action) * 2.0 - 1.0


@interrupts.leaving_gracefully()
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
    engine: str = "auto",
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
        engine: how updates are carried out: ``eager``, ``compiled``, or ``auto``, which compiles long runs on a CPU that has a compiler.
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
    execution = Execution.checked(
        device, workers, checkpoint_every, engine=engine, fresh=fresh, overwrite=overwrite, log=log, log_dir=log_dir
    )
    plan = ReferencePlan.checked(domain, tasks, seeds, profile, settings or {}, execution, results=check_folder(output, "the output"))
    missing = [task for task in plan.tasks if overwrite or not _done(plan, task)]
    members = [Member(task, seed) for task in plan.tasks for seed in plan.seeds]
    work = Work.plan(execution, "reference", [members], [one for one in members if one.task in missing], partial(Stack, plan))
    for stack in work.stacks if fresh else ():
        with locked(stack.lock, stack.name):
            stack.checkpoints().remove()
    for group in [members] if plan.device == "cuda" else [[one] for one in members]:
        if not {one.task for one in group} & set(missing):
            Stack(plan, group).tidy()
    echo(
        f"reference of {', '.join(plan.tasks)} on {domain}: profile {plan.profile}, TD3 online, seeds {format_seeds(plan.seeds)},"
        f" {plan.loop.steps:,} steps each, {plan.device}"
        + (f"; {len(plan.tasks) - len(missing)} made before are kept" if len(missing) < len(plan.tasks) else "")
    )
    if work.stacks:
        echo_if_slower(plan.loop.precision, plan.config, plan.engine, plan.device)
    threads = resolve_profile(profile).threads
    work.carry_out(train_members, unit="steps", total=plan.loop.steps, threads=threads, stacks=work.stacks)
    return [plan.path(task) for task in plan.tasks]


def _done(plan: ReferencePlan, task: str) -> bool:
    """Whether this very reference is there already.

    Raises:
        UsageError: another one stands in its place.
    """
    wanted = (config_hash(plan.values), plan.seeds)
    return result_stands(
        plan.path(task),
        read_reference,
        lambda there: (there.hyperparameters_hash, tuple(sorted(there.seeds))) == wanted,
        lambda there: f"is another reference (of seeds {format_seeds(there.seeds)}, or with other settings)",
    )


def _target(plan: ReferencePlan, one: Member, execution: Execution) -> LogTarget | None:
    if execution.log is None:
        return None
    place, title = f"{domain_namespace(plan.domain)}/{one.task}/seed{one.seed}", f"{one.task}-seed{one.seed}"
    return LogTarget(execution.log, execution.log_dir, "reference", plan.profile, plan.domain, place, title, plan.values)


def train_members(advance: Advance, *, stack: Stack, execution: Execution, stacks: list[Stack]) -> None:
    """Train some members in this process, and write the references of which nothing is left to do (the job of :func:`make_references`)."""
    plan, checkpoints = stack.plan, stack.checkpoints(execution.checkpoint_every)
    with ExitStack() as opened:
        opened.callback(remove_empty_above, checkpoints.folder, plan.results / CHECKPOINTS)
        opened.enter_context(locked(stack.lock, stack.name))
        if not execution.overwrite and all(_done(plan, task) for task in stack.tasks):
            return  # by another process, while this one was starting
        if _finished(checkpoints) is None:
            logs = [opened.enter_context(open_log(_target(plan, one, execution))) for one in stack.members]
            _train(advance, stack, checkpoints, logs)
        else:
            advance(plan.loop.steps)
        written = [_put_together(plan, task, stacks, execution) for task in stack.tasks]
        if all(written):
            for other in stacks:
                if set(other.tasks) <= set(stack.tasks):
                    other.checkpoints().remove()


def _train(advance: Advance, stack: Stack, checkpoints: Checkpoints, logs: Sequence[RunLog]) -> None:
    """Train a stack and measure its floors; what came out is in its last checkpoint then."""
    plan, seeds, tasks = stack.plan, stack.seeds, [one.task for one in stack.members]
    shards = [EpisodeShards(checkpoints.folder / f"{one.task}-seed{one.seed}") for one in stack.members]
    facts = check_domain(plan.domain)
    arena, agent = Arena(facts, tasks), plan.agent(seeds)
    try:
        outcomes = run_online(agent, plan.loop, facts, tasks, arena, advance, shards, logs, checkpoints)
        actors: dict[str, Actor] = {"random actions": RandomActions(seeds, facts.action_size), "untrained policy": plan.agent(seeds)}
        floors = [arena.evaluate(actor, seeds, what, 0, plan.loop.final_episodes).tolist() for what, actor in actors.items()]
    except interrupts.Interrupted as error:
        # While a floor was measured; all before it is kept.
        raise interrupts.interrupted(error.where or "at its last step") from None
    except BrokenDownError:
        checkpoints.remove()
        raise
    runs = [_run(*parts).model_dump() for parts in zip(seeds, outcomes, *floors, strict=True)]
    checkpoints.save(plan.loop.steps, {"finished": {"seconds": checkpoints.seconds, "engine": engine_of(agent), "runs": runs}})
    for one in shards:
        one.remove()


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


def _put_together(plan: ReferencePlan, task: str, stacks: Sequence[Stack], execution: Execution) -> bool:
    """Write the reference of a task if all of its trainings are at their end; whichever job is the last to finish one does it.

    Returns:
        Whether it is there now.
    """
    with locked(plan.lock(task), f"'{plan.path(task)}'", _PATIENCE):
        if not execution.overwrite and _done(plan, task):
            return True
        seconds, runs, engines = 0.0, [], set[str]()
        for stack in stacks:
            if task not in stack.tasks:
                continue
            if (there := _finished(stack.checkpoints())) is None:
                return False
            seconds += there["seconds"]
            engines.add(there["engine"])
            runs += [run for one, run in zip(stack.members, there["runs"], strict=True) if one.task == task]
        head, dirty = commit()
        options = {
            "--domain": plan.domain,
            "--task": task,
            "--seeds": format_seeds(plan.seeds),
            "--profile": plan.profile,
        } | execution.options
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
            machine=machine(plan.device, torch.get_num_threads(), " and ".join(sorted(engines))),
            command=command_line("reference", options, plan.overrides, "--overwrite"),
            created=datetime.now(UTC).isoformat(timespec="seconds"),
        )
        write_reference(plan.path(task), reference)
    return True
