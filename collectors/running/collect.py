"""``collect``: from a method's name to published Minari datasets."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from cudc_bench import plugins
from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root, default_id, parse_id
from cudc_bench.artefacts.manifest import Manifest, check_free, fingerprint
from cudc_bench.artefacts.provenance import command_line, origin, stamp
from cudc_bench.data.diagnostics import DIAGNOSTICS
from cudc_bench.data.metadata import write_metadata
from cudc_bench.data.staging import checkpoints_path, is_untidy, publish, staging, tidy
from cudc_bench.data.writer import write_episodes
from cudc_bench.envs import Domain, check_domain, domain_title, excluded_tasks
from cudc_bench.errors import UsageError
from cudc_bench.execution import CHECKPOINT_EVERY, LOG_DIR
from cudc_bench.execution.checkpoints import Checkpoints, digest
from cudc_bench.execution.progress import Advance, echo
from cudc_bench.execution.runlog import LogTarget, open_log
from cudc_bench.files import check_folder
from cudc_bench.learning.bf16 import echo_if_slower
from cudc_bench.learning.engines import engine_of, set_engine
from cudc_bench.learning.learner import check_precision
from cudc_bench.runs.execution import Execution, Work
from cudc_bench.runs.existing import dataset_stands
from cudc_bench.settings.config import config_hash
from cudc_bench.settings.profiles import resolve_profile
from cudc_bench.settings.seeds import check_seeds, format_seeds
from cudc_bench.stages import Planned

from .dataset_sink import DatasetSink
from .loop import rehearse_collection, run_collection
from .run_spec import NoThresholdError, RunSpec, echo_whose_values, resolve


def collect(
    method: str = "cudc",
    domain: str = "walker",
    seeds: Sequence[int] = (1,),
    *,
    profile: str = "auto",
    settings: Mapping[str, Any] | None = None,
    dataset_id: str | None = None,
    overwrite: bool = False,
    device: str = "auto",
    engine: str = "auto",
    workers: int | None = 1,
    log: str | None = None,
    log_dir: str | Path = LOG_DIR,
    checkpoint_every: float = CHECKPOINT_EVERY,
    fresh: bool = False,
    check_only: bool = False,
) -> list[str]:
    """Explore a domain without rewards and write one Minari dataset for each seed.

    A dataset that exists and was made by this very run is kept. A run that was interrupted is continued from its last checkpoint, with the
    same result as if it had not been; checkpoints lie in a hidden folder beside the dataset's until it is there.

    Args:
        method: a registered collector.
        domain: a registered domain.
        seeds: one dataset each; seed 1 becomes ``walker/cudc-v0``, seed 2 ``walker/cudc-seed2-v0``; profiles
            other than ``paper`` and ``cpu`` stand in the name, as in ``walker/cudc-smoke-v0``.
        profile: ``paper``, ``cpu``, ``demo``, ``smoke`` or ``auto``.
        settings: hyperparameters that differ from the profile, by name.
        dataset_id: instead of the default id; for one seed only.
        overwrite: replace datasets that exist.
        device: ``cpu``, ``cuda`` or ``auto``.
        engine: how updates are carried out: ``eager``, ``compiled``, or ``auto``, which compiles long runs on a CPU that has a compiler.
        workers: processes on a CPU; 1 works in this process, None takes one for each core.
        log: also send the lines of diagnostics to ``"tensorboard"`` or ``"wandb"`` while they are measured.
        log_dir: the folder of these logs; a run's own is ``collect/<profile>/<dataset id>`` in it.
        checkpoint_every: seconds between two checkpoints at least; they come at the ends of episodes.
        fresh: start over where a run was interrupted.
        check_only: stop before the work starts; wrong input has been refused by then.

    Returns:
        The ids of the datasets, in the order of the seeds.

    Raises:
        UsageError: wrong input, or a run with other settings was interrupted; nothing has been written.
        RunError: the run failed; what it had done until its last checkpoint is kept.
        Interrupted: the process was asked to leave; what it had done is kept.
    """
    chosen = resolve_profile(profile)
    setting = resolve(method, domain, chosen, settings)
    seeds = check_seeds(seeds)
    if dataset_id is not None and len(seeds) > 1:
        raise UsageError(f"--dataset-id names one dataset, but there are {len(seeds)} seeds; leave it out.")
    members = [(seed, default_id(domain, method, seed, chosen.name) if dataset_id is None else parse_id(dataset_id)) for seed in seeds]
    left = [member for member in members if overwrite or not _is_made(setting, *member)]
    for member in members:
        check_free(member[1], overwrite or member not in left)
    check_folder(datasets_root(), "the dataset root")
    execution = Execution.checked(
        device, workers, checkpoint_every, engine=engine, fresh=fresh, overwrite=overwrite, log=log, log_dir=log_dir
    )
    check_precision(setting.kind, method, setting.loop.precision, execution.device)
    work = Work.plan(execution, "collect", [members], left, partial(_Stack, setting, execution))
    ids = [str(one) for _, one in members]
    if check_only:
        return ids

    for member in members:
        if member not in left:
            tidy(member[1])
            echo(f"{member[1]} was made by this very run: kept")
    if not work.stacks:
        return ids
    echo_whose_values(setting)
    echo(
        f"collect {method} on {domain}: profile {chosen.name}, seeds {format_seeds(seeds)}, {setting.loop.steps:,} steps each,"
        f" {execution.device}"
    )
    echo_if_slower(setting.loop.precision, setting.config, work.stacks[0].engine, execution.device)
    work.carry_out(collect_members, unit="steps", total=setting.loop.steps, threads=chosen.threads)
    for stack in work.stacks:
        for _, one in stack.members:
            echo(f"wrote {one} to {dataset_path(one)}")
    return ids


def plan_collect(
    method: str, domain: str, seeds: Sequence[int], *, profile: str, settings: Mapping[str, Any] | None = None
) -> list[Planned]:
    """What :func:`collect` would make with the same arguments, for each seed; nothing is written.

    Raises:
        UsageError: wrong input, or something else stands at an id.
    """
    chosen = resolve_profile(profile)
    pilot = False
    try:
        setting = resolve(method, domain, chosen, settings)
    except NoThresholdError:
        pilot, setting = True, resolve(method, domain, chosen, settings, piloting=True)
    found = []
    for seed in check_seeds(seeds):
        one = default_id(domain, method, seed, chosen.name)
        done = not pilot and _is_made(setting, seed, one)
        if not pilot:
            try:
                check_free(one, done)
            except UsageError as error:
                there = str(error).partition("; ")[0]
                raise UsageError(f"{there} in {datasets_root()} and is of another run; take another root (MINARI_DATASETS_PATH).") from None
        found.append(Planned(str(one), seed, setting.loop.steps, done and not is_untidy(one), setting.overrides, pilot))
    return found


@dataclass(frozen=True)
class _Stack:
    """Members in the order of their seeds, and where their checkpoints are: with the first one's unfinished dataset."""

    setting: RunSpec
    execution: Execution
    members: list[tuple[int, DatasetId]]

    @property
    def engine(self) -> str:
        return self.execution.engine_for(self.setting.kind, self.setting.updates)

    @property
    def seeds(self) -> list[int]:
        return [seed for seed, _ in self.members]

    @property
    def name(self) -> str:
        return " and ".join(f"'{one}'" for _, one in self.members)

    @property
    def label(self) -> str:
        return f"{self.setting.method} seed {format_seeds(self.seeds)}"

    def checkpoints(self, every: float = CHECKPOINT_EVERY) -> Checkpoints:
        setting = self.setting
        decisive = {
            "method": setting.method, "domain": setting.domain, "seeds": self.seeds, "profile": setting.profile,
            "hyperparameters": setting.values, "device": self.execution.device, "engine": self.engine,
            **origin(plugins.package("collectors", setting.method)),
        }  # fmt: skip
        return Checkpoints(checkpoints_path(self.members[0][1]), decisive, every)

    def rehearse(self, members: int) -> None:
        collector = self.setting.kind(self.setting.sizes, self.setting.config, self.seeds[:members], self.execution.device)
        set_engine(collector, self.engine)
        rehearse_collection(collector, self.setting.loop, check_domain(self.setting.domain))

    def is_interrupted(self) -> bool:
        try:
            return self.checkpoints().check("", "collect")
        except UsageError:
            return False


def _is_made(setting: RunSpec, seed: int, dataset_id: DatasetId) -> bool:
    """Whether the dataset of that id exists and is what this run would make."""
    wanted = (setting.method, setting.domain, setting.profile, seed, config_hash(setting.values), None)
    return dataset_stands(
        dataset_id,
        lambda there: (
            there.was_collected
            and (there.method, there.domain, there.profile, there.seed, there.hyperparameters_hash, there.task) == wanted
        ),
    )


def _target(setting: RunSpec, execution: Execution, seed: int, dataset_id: DatasetId) -> LogTarget | None:
    if execution.log is None:
        return None
    title = f"{setting.method}-seed{seed}"
    return LogTarget(execution.log, execution.log_dir, "collect", setting.profile, setting.domain, str(dataset_id), title, setting.values)


def collect_members(advance: Advance, *, stack: _Stack, execution: Execution) -> None:
    """Collect some members in this process and publish their datasets (the job of :func:`collect`)."""
    setting, members = stack.setting, stack.members
    facts, values = check_domain(setting.domain), setting.values
    with ExitStack() as opened:
        folders = [opened.enter_context(staging(one, resume=not execution.fresh)) for _, one in members]
        if not execution.overwrite and all(_is_made(setting, seed, one) for seed, one in members):
            return  # by another process, while this one was starting
        journals = [
            DatasetSink(folder, opened.enter_context(open_log(_target(setting, execution, *member))))
            for folder, member in zip(folders, members, strict=True)
        ]
        collector = setting.kind(setting.sizes, setting.config, stack.seeds, execution.device)
        set_engine(collector, stack.engine)
        checkpoints = stack.checkpoints(execution.checkpoint_every)
        run_collection(collector, setting.loop, facts, journals, advance, checkpoints)
        packages, engine = plugins.package("collectors", setting.method), engine_of(collector) if setting.kind.learns else None
        summaries, state = collector.summary(), digest(collector.state_dict())
        # The checkpoints lie with the first member, so that it is the last to be published.
        for (seed, one), folder, journal, summary in reversed(list(zip(members, folders, journals, summaries, strict=True))):
            dataset = folder / "dataset"
            shutil.rmtree(dataset, ignore_errors=True)
            written = write_episodes(dataset / "data", journal.episodes())
            manifest = Manifest(
                domain=setting.domain,
                method=setting.method,
                seed=seed,
                steps=written.steps,
                episodes=written.episodes,
                profile=setting.profile,
                overrides=setting.overrides,
                hyperparameters=values,
                hyperparameters_hash=config_hash(values),
                citation=setting.kind.citation,
                fields=written.fields,
                fingerprint=fingerprint(written.fields),
                final_state=state,
                pilot=setting.pilot,
                diagnostics=journal.last | summary,
                command=_command(setting, execution, seed, one),
                **stamp(checkpoints.seconds, execution.device, torch.get_num_threads(), packages, engine),
            )
            write_metadata(dataset / "data", manifest, str(one), _description(facts, setting.method))
            journal.close()
            shutil.copyfile(folder / DIAGNOSTICS, dataset / DIAGNOSTICS)
            publish(dataset, one)


def _description(domain: Domain, method: str) -> str:
    excluded = f" Not relabelled can be: {excluded_tasks(domain)}." if domain.excluded else ""
    way = "Relabel it for a task with cudc-bench, or compute" if domain.tasks else "Compute"
    explored = f"Task-agnostic exploration of {domain_title(domain.name)} by {method}"
    return f"{explored}: the rewards are all 0. {way} rewards from infos/physics.{excluded}"


def _command(setting: RunSpec, execution: Execution, seed: int, dataset_id: DatasetId) -> str:
    options = {
        "--domain": setting.domain,
        "--method": setting.method,
        "--seed": str(seed),
        "--profile": setting.profile,
    } | execution.options
    if dataset_id != default_id(setting.domain, setting.method, seed, setting.profile):
        options["--dataset-id"] = str(dataset_id)
    return command_line("collect", options, setting.overrides)
