"""``collect``: from a method's name to published Minari datasets."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch

from cudc_bench import plugins
from cudc_bench.config import config_hash
from cudc_bench.data.staging import publish, staging
from cudc_bench.data.writer import Episode, EpisodeShards, write_episodes, write_metadata
from cudc_bench.envs import Domain, check_domain, domain_title, excluded_tasks
from cudc_bench.envs.simulator import Float32, Float64
from cudc_bench.errors import UsageError
from cudc_bench.ids import DatasetId, dataset_path, datasets_root, default_id, parse_id
from cudc_bench.manifest import Manifest, check_free, fingerprint
from cudc_bench.options import LOG_DIR, check_folder, check_seeds, format_seeds
from cudc_bench.parallel import Job, run_jobs, worker_count
from cudc_bench.profiles import resolve_device, resolve_profile
from cudc_bench.progress import Advance, say
from cudc_bench.provenance import command_line, stamp
from cudc_bench.runlog import LogTarget, RunLog, check_log, open_log

from .loop import run_collection
from .setting import Setting, say_whose_values, settle


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
    workers: int | None = 1,
    log: str | None = None,
    log_dir: str | Path = LOG_DIR,
    check_only: bool = False,
) -> list[str]:
    """Explore a domain without rewards and write one Minari dataset for each seed.

    Args:
        method: a registered collector.
        domain: a registered domain.
        seeds: one dataset each; seed 1 becomes ``walker/cudc-v0``, seed 2 ``walker/cudc-seed2-v0``.
        profile: ``paper``, ``cpu``, ``demo``, ``smoke`` or ``auto``.
        settings: hyperparameters that differ from the profile, by name.
        dataset_id: instead of the default id; for one seed only.
        overwrite: replace datasets that exist.
        device: ``cpu``, ``cuda`` or ``auto``.
        workers: processes on a CPU; 1 works in this process, None takes one for each core.
        log: also send the lines of diagnostics to ``"tensorboard"`` or ``"wandb"`` while they are measured.
        log_dir: the folder of these logs; a run's own is ``collect/<profile>/<dataset id>`` in it.
        check_only: stop before the work starts; wrong input has been refused by then.

    Returns:
        The ids of the datasets, in the order of the seeds.

    Raises:
        UsageError: wrong input; nothing has been written.
        RunError: the run failed.
    """
    chosen = resolve_profile(profile)
    setting = settle(method, domain, chosen, settings)
    seeds = check_seeds(seeds)
    if dataset_id is not None and len(seeds) > 1:
        raise UsageError(f"--dataset-id names one dataset, but there are {len(seeds)} seeds; leave it out.")
    ids = [default_id(domain, method, seed) if dataset_id is None else parse_id(dataset_id) for seed in seeds]
    for one in ids:
        check_free(one, overwrite)
    check_folder(datasets_root(), "the dataset root")
    logs = check_log(log, log_dir)
    device = resolve_device(device)
    groups = [list(range(len(seeds)))] if device == "cuda" else [[index] for index in range(len(seeds))]
    count = 1 if device == "cuda" else worker_count(workers, len(groups))
    if check_only:
        return [str(one) for one in ids]

    say_whose_values(setting)
    say(f"collect {method} on {domain}: profile {chosen.name}, seeds {format_seeds(seeds)}, {setting.loop.steps:,} steps each, {device}")
    values = setting.values
    targets = [
        None if log is None else LogTarget(log, logs, "collect", chosen.name, domain, str(one), f"{method}-seed{seed}", values)
        for seed, one in zip(seeds, ids, strict=True)
    ]
    jobs = [
        Job(
            description=f"{method} seed {format_seeds([seeds[i] for i in group])}",
            total=setting.loop.steps,
            arguments={
                "setting": setting, "seeds": [seeds[i] for i in group], "ids": [ids[i] for i in group], "device": device,
                "targets": [targets[i] for i in group],
            },
        )
        for group in groups
    ]  # fmt: skip
    run_jobs(collect_members, jobs, unit="steps", workers=count, threads=chosen.threads)
    for one in ids:
        say(f"wrote {one} to {dataset_path(one)}")
    return [str(one) for one in ids]


def collect_members(
    advance: Advance, *, setting: Setting, seeds: list[int], ids: list[DatasetId], device: str, targets: list[LogTarget | None],
) -> None:  # fmt: skip
    """Collect some members in this process and publish their datasets (the job of :func:`collect`)."""
    started = time.monotonic()
    method, facts, values = setting.method, check_domain(setting.domain), setting.values
    collector = setting.kind(setting.space, setting.config, seeds, device)
    with ExitStack() as stack:
        folders = [stack.enter_context(staging(one)) for one in ids]
        sinks = [_Sink(folder, stack.enter_context(open_log(target))) for folder, target in zip(folders, targets, strict=True)]
        run_collection(collector, setting.loop, facts, list(sinks), advance)
        summaries = collector.summary()
        for seed, one, folder, sink, summary in zip(seeds, ids, folders, sinks, summaries, strict=True):
            written = write_episodes(folder / "data", iter(sink.shards))
            manifest = Manifest(
                domain=setting.domain,
                method=method,
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
                pilot=setting.pilot,
                diagnostics=sink.last | summary,
                command=_command(setting, seed, one),
                **stamp(started, device, torch.get_num_threads(), plugins.package("collectors", method)),
            )
            write_metadata(folder / "data", manifest, str(one), _description(facts, method))
            sink.close()
            publish(folder, one)


def _description(domain: Domain, method: str) -> str:
    excluded = f" Not relabelled can be: {excluded_tasks(domain)}." if domain.excluded else ""
    way = "Relabel it for a task with cudc-bench, or compute" if domain.tasks else "Compute"
    explored = f"Task-agnostic exploration of {domain_title(domain.name)} by {method}"
    return f"{explored}: the rewards are all 0. {way} rewards from infos/physics.{excluded}"


def _command(setting: Setting, seed: int, dataset_id: DatasetId) -> str:
    options = {"--domain": setting.domain, "--method": setting.method, "--seed": str(seed), "--profile": setting.profile}
    if dataset_id != default_id(setting.domain, setting.method, seed):
        options["--dataset-id"] = str(dataset_id)
    return command_line("collect", options, setting.overrides)


class _Sink:
    """Puts what one member collects into its staging folder."""

    def __init__(self, folder: Path, log: RunLog) -> None:
        self.shards = EpisodeShards(folder / "shards")
        self.last: dict[str, Any] = {}
        self._log = log
        self._diagnostics = (folder / "diagnostics.jsonl").open("w", encoding="utf-8")

    def add_episode(self, seed: int, observations: Float32, actions: Float32, infos: dict[str, Float32 | Float64]) -> None:
        self.shards.add(Episode(seed, observations, actions, infos))

    def add_diagnostics(self, row: dict[str, Any]) -> None:
        self.last = row
        self._diagnostics.write(json.dumps(row) + "\n")
        self._log.add(row["step"], {name: value for name, value in row.items() if name != "step"})

    def close(self) -> None:
        """Close the diagnostics and remove the shards."""
        self._diagnostics.close()
        self.shards.remove()
