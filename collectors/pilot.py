"""``pilot``: measure the thresholds that the paper uses but does not print.

Variants whose k grows with the share of small rewards or small forward errors need to know what is small. The procedure is the same for
all: run the method with k fixed at its start, and take the 10 % quantile of the minibatch medians of what the rule looks at, between the
steps 50,000 and 450,000 of a run of a million (in proportion for shorter runs). That lets k reach its bound within a run, which is what
the paper says its own thresholds were set for, and looks at no result.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from cudc_bench import plugins
from cudc_bench.envs import check_domain
from cudc_bench.envs.simulator import Float32, Float64
from cudc_bench.errors import RunError, UsageError
from cudc_bench.files import check_file
from cudc_bench.manifest import Pilot
from cudc_bench.parallel import Job, run_jobs, worker_count
from cudc_bench.profiles import resolve_device, resolve_profile
from cudc_bench.progress import Advance, say
from cudc_bench.provenance import command_line, stamp
from cudc_bench.replay import Batch

from .loop import run_collection
from .setting import Setting, settle
from .thresholds import read_thresholds, settings_key, thresholds_path, write_thresholds

SEED = 0  # kept apart from the seeds of datasets
FIRST, LAST = 0.05, 0.45  # of the run
QUANTILE = 0.1


def pilot(
    methods: Sequence[str] | None = None,
    domain: str = "walker",
    *,
    profile: str = "auto",
    settings: Mapping[str, Any] | None = None,
    device: str = "auto",
    workers: int | None = 1,
) -> list[Pilot]:
    """Measure thresholds and write them into the user's file (see ``thresholds.thresholds_path``), where ``collect`` finds them.

    Args:
        methods: collectors that need a threshold; all such by default.
        domain: a registered domain.
        profile: ``paper``, ``cpu``, ``demo``, ``smoke`` or ``auto``.
        settings: hyperparameters that differ from the profile, by name. A threshold holds for the same settings only.
        device: ``cpu``, ``cuda`` or ``auto``.
        workers: processes; 1 works in this process, None takes one for each core on a CPU, and one for CUDA.

    Raises:
        UsageError: wrong input; nothing has been run.
        RunError: a run failed, or the file is damaged or cannot be written.
    """
    chosen, device = resolve_profile(profile), resolve_device(device)
    check_domain(domain)
    needy = {
        name: plugins.load("collectors", name)
        for name in ([plugins.check_name("collectors", name) for name in methods] if methods else plugins.names("collectors"))
    }
    wanting = {name for name, kind in needy.items() if kind.threshold(kind.configure(domain, chosen.collect, settings)) is not None}
    if methods and (others := [name for name in methods if name not in wanting]):
        raise UsageError(f"{', '.join(others)} needs no pilot; leave --method out for all that need one.")
    found = [settle(name, domain, chosen, settings, piloting=True) for name in needy if name in wanting]
    path = thresholds_path()
    check_file(path, "the file of thresholds")
    # What is damaged would be found when the results are added to it, with the work done.
    read_thresholds(path)
    count = worker_count(1 if device == "cuda" and workers is None else workers, len(found))
    first, last = (round(share * found[0].loop.steps) for share in (FIRST, LAST))
    say(f"pilot of {', '.join(one.method for one in found)} on {domain}: profile {chosen.name}, seed {SEED}, {last:,} steps each, {device}")
    jobs = [Job(one.method, last, {"setting": one, "first": first, "last": last, "device": device}) for one in found]
    results = run_jobs(measure, jobs, unit="steps", workers=count, threads=chosen.threads)
    write_thresholds(path, results)
    for result in results:
        say(f"{result.method} on {domain}: {result.name} = {result.value:.6g}, from {result.updates:,} updates")
    say(f"wrote {path}")
    return list(results)


def measure(advance: Advance, *, setting: Setting, first: int, last: int, device: str) -> Pilot:
    """Run one method with k fixed and measure its threshold (the job of :func:`pilot`)."""
    started = time.monotonic()
    kind, loop = setting.kind, replace(setting.loop, steps=last)
    name = kind.threshold(setting.config)
    collector = kind(setting.space, setting.config, [SEED], device)
    medians: list[torch.Tensor] = []
    update = collector.update

    def watched(batch: Batch) -> dict[str, torch.Tensor]:
        metrics: dict[str, torch.Tensor] = update(batch)
        medians.append(batch.kept["signal"].median())
        return metrics

    collector.update = watched
    run_collection(collector, loop, check_domain(setting.domain), [_Nothing()], advance)
    # The last update was in the last of the ``update_every`` steps before the end.
    skipped = len(medians) - (last - first) // loop.update_every
    values = torch.stack(medians[max(skipped, 0) :]) if medians else torch.empty(0)
    if not len(values) or int(collector.horizon.max()) != setting.config.horizon:
        raise RunError(f"the pilot of {setting.method} learnt nothing within {last:,} steps; take a longer run or fewer seed_steps.")
    return Pilot(
        name=name,
        value=float(values.double().quantile(QUANTILE)),
        method=setting.method,
        domain=setting.domain,
        profile=setting.profile,
        overrides=setting.overrides,
        key=settings_key(kind, setting.method, setting.domain, setting.loop, setting.config),
        quantile=QUANTILE,
        updates=len(values),
        seed=SEED,
        first_step=first,
        last_step=last,
        command=command_line(
            "pilot", {"--method": setting.method, "--domain": setting.domain, "--profile": setting.profile}, setting.overrides
        ),
        **stamp(started, device, torch.get_num_threads(), plugins.package("collectors", setting.method)),
    )


class _Nothing:
    """Keeps nothing of what is collected."""

    def add_episode(self, seed: int, observations: Float32, actions: Float32, infos: dict[str, Float32 | Float64]) -> None:
        pass

    def add_diagnostics(self, row: dict[str, Any]) -> None:
        pass
