"""Trainings, their records, and the stacks that train side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from cudc_bench import plugins
from cudc_bench.artefacts.ids import default_id, parse_id
from cudc_bench.artefacts.manifest import Manifest, PartOrigin, RewardFunction
from cudc_bench.artefacts.provenance import command_line, commit, machine, origin, versions
from cudc_bench.artefacts.records import (
    CHECKPOINTS,
    LABELS,
    Collection,
    DatasetReference,
    Evaluation,
    Record,
    TrainingMetrics,
    ZeroShot,
    read_record,
    record_path,
)
from cudc_bench.envs import check_domain
from cudc_bench.errors import RunError
from cudc_bench.execution import CHECKPOINT_EVERY
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.execution.locks import locked
from cudc_bench.files import remove_empty_above
from cudc_bench.learning.engines import set_engine
from cudc_bench.runs.execution import Execution
from cudc_bench.runs.existing import result_stands
from cudc_bench.settings.config import config_hash
from cudc_bench.settings.evaluate_config import in_full

from .datasets import load_members
from .labels import Question
from .loop import Outcome, rehearse_evaluation
from .plans import Plan


@dataclass(frozen=True)
class Answer:
    """What a learner without rewards made of a question when it was trained.

    Attributes:
        question: which.
        norm: the length of its vector before it was scaled.
        drawn: how many labels there were.
        rewarded: the share of them that are not zero.
        rule: how the vector follows.
    """

    question: Question
    norm: float
    drawn: int
    rewarded: float
    rule: str

    def told(self, run: Run, seconds: float) -> ZeroShot:
        """What the record says of it, of a run whose training took so many seconds."""
        return ZeroShot(
            labels=self.question.labels, drawn=self.drawn, source=self.question.source, rule=self.rule, norm=self.norm,
            rewarded=self.rewarded, training=run.training, records=len(run.questions), training_seconds=seconds,
        )  # fmt: skip


SIDE_BY_SIDE = 4  # trainings on one core at most; see benchmarks/README.md


@dataclass(frozen=True)
class Run:
    """One training: an algorithm on a dataset, or on the first ``used`` transitions of it, with a seed, and where its records go.

    Attributes:
        plan: the algorithm.
        dataset, manifest: labelled, or task-agnostic for a learner without rewards.
        used: how many of its transitions; None for all.
        seed: of the training.
        results: the folder of records.
        questions: what a learner without rewards is asked, once it is trained; there is a record of each.
    """

    plan: Plan
    dataset: str
    manifest: Manifest
    used: int | None
    seed: int
    results: Path
    questions: tuple[Question, ...] = ()

    @property
    def path(self) -> Path:
        """Of its record; of a learner without rewards the place where a record of it would be that is of no task."""
        return self._path(self.dataset)

    @property
    def paths(self) -> list[Path]:
        """Of all its records."""
        return [self.path_of(question) for question in self.questions] or [self.path]

    def path_of(self, question: Question) -> Path:
        """Of the record of a question."""
        return self._path(str(parse_id(self.dataset).for_task(question.task)), question.labels)

    def _path(self, dataset: str, labels: int | None = None) -> Path:
        return record_path(self.results, dataset, self.plan.algo, self.manifest.seed, self.plan.profile, self.used, self.seed, labels)

    @property
    def training(self) -> str:
        """The same for all records of this training and no others, as far as what it depends on is known."""
        made = {
            "algorithm": self.plan.algo, "hyperparameters": self.plan.values, "data": self.manifest.fingerprint, "used": self.used,
            "seed": self.seed,
        }  # fmt: skip
        return config_hash(made)[:16]

    @property
    def hidden(self) -> Path:
        """The folder of what it keeps while it works."""
        return self.results / CHECKPOINTS / self.path.relative_to(self.results).with_suffix("")

    @property
    def lock(self) -> Path:
        """Held by whoever makes its record."""
        return self.hidden.with_name(f"{self.hidden.name}.lock")

    def is_done(self) -> bool:
        """Whether this very run is recorded already, with all that it is asked.

        Raises:
            UsageError: another run stands in its place.
        """
        if not self.questions:
            return is_recorded(self.path, self.plan, self.used, self.seed, self._is_of_its_data)
        # All are looked at: what stands in the place of any is said before the training.
        found = [self._is_answered(one) for one in self.questions]
        return all(found)

    def _is_of_its_data(self, record: Record) -> bool:
        return record.dataset.fingerprint == self.manifest.fingerprint

    def _is_answered(self, question: Question) -> bool:
        def is_same(record: Record) -> bool:
            told = record.zero_shot
            there = told is not None and (told.labels, told.source, record.dataset.reward)
            return self._is_of_its_data(record) and there == (question.labels, question.source, question.reward)

        return is_recorded(self.path_of(question), self.plan, self.used, self.seed, is_same)

    def is_untidy(self) -> bool:
        """Whether something is left of its work."""
        return self.lock.exists() or Stack(Execution(), [self]).checkpoints().folder.exists()

    def tidy(self) -> None:
        """Remove what a process left that was killed just after it had written the record; nothing if somebody is writing it again."""
        if self.is_untidy():
            Stack(Execution(), [self]).tidy()


@dataclass(frozen=True)
class Stack:
    """Runs that are trained side by side, and how."""

    execution: Execution
    runs: list[Run]

    @property
    def engine(self) -> str:
        """How their updates are to be carried out."""
        return self.execution.engine_for(self.plan.kind, self.plan.loop.gradient_steps)

    @property
    def plan(self) -> Plan:
        """Of all of them."""
        return self.runs[0].plan

    @property
    def results(self) -> Path:
        """The folder of records."""
        return self.runs[0].results

    @property
    def seeds(self) -> list[int]:
        """Of the trainings."""
        return [run.seed for run in self.runs]

    @property
    def name(self) -> str:
        """What they make, as messages say it."""
        paths = [path for run in self.runs for path in run.paths]
        return f"'{paths[0]}'" if len(paths) == 1 else f"{len(paths)} records in {self.results}"

    @property
    def label(self) -> str:
        """What stands beside their progress bar."""
        names = [
            run.dataset
            + ("" if run.used is None else f" ({run.used:,})")
            + ("" if run.seed == run.manifest.seed else f" training seed {run.seed}")
            for run in self.runs
        ]
        tasks = [f"/{run.manifest.task}/" for run in self.runs]
        if asked := dict.fromkeys(one.task for run in self.runs for one in run.questions):
            return f"{self.plan.algo}: {' + '.join(names)}, asked for {', '.join(asked)}"
        if len(bases := {name.replace(task, "/") for name, task in zip(names, tasks, strict=True)}) == 1 < len(names):
            return f"{self.plan.algo}: {bases.pop()} for {', '.join(task.strip('/') for task in tasks)}"
        return f"{self.plan.algo}: {' + '.join(names) if len(names) < 3 else f'{len(names)} datasets'}"

    def checkpoints(self, every: float = CHECKPOINT_EVERY) -> Checkpoints:
        """In a folder that is named by their records."""
        plan = self.plan
        decisive = {
            "algorithm": plan.algo, "hyperparameters": plan.values, "seeds": self.seeds, "used": self.runs[0].used,
            "datasets": {run.dataset: run.manifest.fingerprint for run in self.runs}, "device": self.execution.device,
            "engine": self.engine, **origin(plugins.package("evaluators", plan.algo)),
        }  # fmt: skip
        if asked := [[one.facts for one in run.questions] for run in self.runs if run.questions]:
            decisive["questions"] = asked
        if len(self.runs) == 1:
            return Checkpoints(self.runs[0].hidden, decisive, every)
        places = [run.path.relative_to(self.results).with_suffix("").as_posix() for run in self.runs]
        return Checkpoints(self.results / CHECKPOINTS / f"stacks/{plan.algo}-{config_hash({'records': places})}", decisive, every)

    def rehearse(self, members: int) -> None:
        """See :class:`~cudc_bench.runs.memory.Rehearsing`."""
        plan, runs, seeds, device = self.plan, self.runs[:members], self.seeds[:members], self.execution.device
        facts = check_domain(runs[0].manifest.domain)
        agent = plan.kind(facts.observation_size, facts.action_size, plan.config, seeds, device)
        set_engine(agent, self.engine)
        data = load_members([run.dataset for run in runs], seeds, device, runs[0].used, labelled=not runs[0].questions)
        rehearse_evaluation(agent, data, plan.loop)

    def is_interrupted(self) -> bool:
        """Whether these very runs have been begun together and not ended."""
        return self.checkpoints().folder.exists()

    def tidy(self) -> None:
        """Remove what a process left that was killed just after it had written the records; nothing if somebody is writing one again."""
        with suppress(RunError), ExitStack() as opened:
            for run in self.runs:
                opened.enter_context(locked(run.lock, ""))
            self.checkpoints().remove()
        for path in (self.checkpoints().folder, *(run.lock for run in self.runs)):
            remove_empty_above(path, self.results / CHECKPOINTS)


def stackable(runs: Sequence[Run]) -> list[list[Run]]:
    """Runs that one stack can train: the same algorithm, domain and number of transitions, asked the same."""
    found: dict[tuple[Any, ...], list[Run]] = {}
    for run in runs:
        asked = (run.questions, run.manifest.steps) if run.questions else None
        found.setdefault((run.plan.algo, run.manifest.domain, run.used, asked), []).append(run)
    return list(found.values())


def is_recorded(path: Path, plan: Plan, used: int | None, seed: int, is_same: Callable[[Record], bool]) -> bool:
    """Whether a record is there, of this training on the same data.

    Raises:
        UsageError: another run stands in its place.
    """

    def is_of_it(record: Record) -> bool:
        made = (in_full(record.hyperparameters), record.dataset.used, record.seed)
        return made == (plan.values, used, seed) and is_same(record)

    return result_stands(path, read_record, is_of_it, lambda _: "records another run (other data or settings)")


def record_of(
    run: Run, outcome: Outcome, execution: Execution, engine: str, seconds: float, beside: int = 1, answer: Answer | None = None
) -> Record:
    """The record of a run.

    Args:
        run: which.
        outcome: what came out.
        execution: how it was to be trained.
        engine: how its updates were carried out.
        seconds: of work on it and on those beside it.
        beside: how many were trained side by side.
        answer: to which of its questions, if it was asked any.
    """
    plan, manifest = run.plan, run.manifest
    values = plan.values
    head, dirty = commit()
    finals = [Evaluation(step=step, returns=returns) for step, returns in outcome.finals]
    made = manifest if manifest.tier is not None else manifest.collected
    collection = Collection(hyperparameters=manifest.hyperparameters, versions=made.versions, machine=made.machine) if made else None
    task, reward = (manifest.task, manifest.reward) if answer is None else (answer.question.task, answer.question.reward)
    seconds /= beside
    return Record(
        dataset=DatasetReference(
            id=run.dataset, fingerprint=manifest.fingerprint, domain=manifest.domain, task=str(task), method=manifest.method,
            seed=manifest.seed, steps=manifest.steps, profile=manifest.profile, overrides=manifest.overrides,
            reward=reward, source=None if manifest.imported is None else manifest.imported.source, used=run.used,
            collection=None if manifest.imported is not None else collection, parts=_parts(manifest),
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
        seconds=round(seconds / max(1, len(run.questions)), 1),
        versions=versions(),
        commit=head,
        dirty=dirty,
        machine=machine(execution.device, torch.get_num_threads(), engine) | ({} if beside == 1 else {"beside": beside}),
        command=_command(run, execution, str(task), reward, None if answer is None else answer.question),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        zero_shot=None if answer is None else answer.told(run, round(seconds, 1)),
    )  # fmt: skip


def _parts(manifest: Manifest) -> list[PartOrigin]:
    parts = () if manifest.mixture is None else manifest.mixture.parts
    return [PartOrigin.model_validate(part.model_dump(exclude={"episodes"})) for part in parts]


def _command(run: Run, execution: Execution, task: str, reward: RewardFunction | None, question: Question | None) -> str:
    """What makes a run's record again."""
    plan, manifest = run.plan, run.manifest
    options = {"--algo": plan.algo, "--profile": plan.profile} | execution.options
    usual = default_id(manifest.domain, manifest.method, manifest.seed, manifest.profile)
    if run.dataset == str(usual if question else usual.for_task(task)) and not manifest.overrides and manifest.was_collected:
        # Written like this, the command also makes the datasets anew where they are missing.
        options |= {"--domain": manifest.domain, "--method": manifest.method, "--seed": str(manifest.seed)}
        if reward is None:
            options["--task"] = task
    else:
        options["--dataset-id"] = run.dataset
        if question is not None and reward is None:
            options["--task"] = task
    if reward is not None:
        options["--reward"] = reward.reference
    if run.used is not None:
        options["--dataset-size"] = str(run.used)
    if question is not None and question.labels != LABELS:
        options["--labels"] = str(question.labels)
    if question is not None and question.source is not None:
        options["--labels-from"] = question.source.id
    if run.seed != manifest.seed:
        options["--training-seeds"] = str(run.seed)
    return command_line("evaluate", options, plan.overrides, "--overwrite")
