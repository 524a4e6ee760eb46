"""``pilot``: measure the thresholds that the paper uses but does not print.

Variants whose k grows with the share of small rewards or small forward errors need to know what is small. The procedure is the same for
all: run the method with k fixed at its start, and take the 10 % quantile of the minibatch medians of what the rule looks at, between the
steps 50,000 and 450,000 of a run of a million (in proportion for shorter runs). That lets k reach its bound within a run, which is what
the paper says its own thresholds were set for, and looks at no result.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from cudc_bench import plugins
from cudc_bench.artefacts.ids import domain_slug
from cudc_bench.artefacts.manifest import Pilot
from cudc_bench.artefacts.provenance import command_line, origin, stamp
from cudc_bench.envs import check_domain
from cudc_bench.errors import BrokenDownError, UsageError
from cudc_bench.execution import CHECKPOINT_EVERY
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.execution.locks import locked
from cudc_bench.execution.parallel import worker_count
from cudc_bench.execution.progress import Advance, echo, warn
from cudc_bench.execution.runlog import open_log
from cudc_bench.files import check_file, remove_empty, unwritable
from cudc_bench.learning.bf16 import echo_if_slower
from cudc_bench.learning.engines import engine_of, set_engine
from cudc_bench.learning.learner import check_precision
from cudc_bench.learning.replay import Batch
from cudc_bench.runs.execution import Execution, Work
from cudc_bench.settings.profiles import Profile, resolve_profile

from .dataset_sink import DatasetSink
from .loop import rehearse_collection, run_collection
from .run_spec import RunSpec, resolve
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
    engine: str = "auto",
    workers: int | None = 1,
    checkpoint_every: float = CHECKPOINT_EVERY,
    fresh: bool = False,
) -> list[Pilot]:
    """Measure thresholds and write them into the user's file (see ``thresholds.thresholds_path``), where ``collect`` finds them.

    Runs that were interrupted are continued from their last checkpoints, which lie in ``.pilots`` beside that file.

    Args:
        methods: collectors that need a threshold; all such by default.
        domain: a registered domain.
        profile: ``paper``, ``cpu``, ``demo``, ``smoke`` or ``auto``.
        settings: hyperparameters that differ from the profile, by name. A threshold holds for the same settings only.
        device: ``cpu``, ``cuda`` or ``auto``.
        engine: how updates are carried out: ``eager``, ``compiled``, or ``auto``, which compiles long runs on a CPU that has a compiler.
        workers: processes; 1 works in this process, None takes one for each core on a CPU, and one for CUDA.
        checkpoint_every: seconds between two checkpoints at least; they come at the ends of episodes.
        fresh: start over where a run was interrupted.

    Raises:
        UsageError: wrong input, or a pilot with other settings was interrupted; nothing has been run.
        RunError: a run failed, or the file is damaged or cannot be written.
        Interrupted: the process was asked to leave; what it had done is kept.
    """
    chosen = resolve_profile(profile)
    execution = Execution.checked(device, workers, checkpoint_every, engine=engine, fresh=fresh)
    check_domain(domain)
    found = [resolve(name, domain, chosen, settings, piloting=True) for name in _wanting(methods, domain, chosen, settings)]
    for one in found:
        check_precision(one.kind, one.method, one.loop.precision, execution.device)
    path = thresholds_path()
    check_file(path, "the file of thresholds")
    # What is damaged would be found when the results are added to it, with the work done.
    read_thresholds(path)
    if execution.device == "cuda":
        # Not in one stack: each method is another class. So many at a time as somebody asks for.
        execution = replace(execution, workers=workers or 1)
    stacks = [_Stack(path.parent / ".pilots", one, execution) for one in found]
    work = Work(execution, stacks, worker_count(execution.workers, len(found)))
    work.check("pilot")
    last = stacks[0].last
    echo(
        f"pilot of {', '.join(one.method for one in found)} on {domain}: profile {chosen.name}, seed {SEED}, {last:,} steps each,"
        f" {execution.device}"
    )
    for stack in stacks:
        echo_if_slower(stack.setting.loop.precision, stack.setting.config, stack.engine, execution.device)
    results: list[Pilot] = work.carry_out(measure, unit="steps", total=last, threads=chosen.threads)
    write_thresholds(path, results)
    for stack in stacks:
        stack.checkpoints().remove()
    remove_empty(path.parent / ".pilots")
    for result in results:
        echo(f"{result.method} on {domain}: {result.name} = {result.value:.6g}, from {result.updates:,} updates")
    echo(f"wrote {path}")
    return results


def _wanting(methods: Sequence[str] | None, domain: str, profile: Profile, settings: Mapping[str, Any] | None) -> list[str]:
    """Those of some methods, or of all there are, that need a threshold.

    Raises:
        UsageError: one was named that needs none.
    """
    if methods:
        kinds = {name: plugins.load("collectors", name) for name in methods}
    else:
        kinds = plugins.load_sound("collectors", lambda error: warn(f"left out: {error}"))
    configured = {name: (kind, kind.configure(domain, profile.collect, settings)) for name, kind in kinds.items()}
    wanting = [name for name, (kind, config) in configured.items() if kind.measured_by_pilot(config) is not None]
    if methods and (others := [name for name in methods if name not in wanting]):
        raise UsageError(f"{', '.join(others)} needs no pilot; leave --method out for all that need one.")
    return wanting


@dataclass(frozen=True)
class _Stack:
    """One method, and where its run is kept: in a folder of its own below that of all pilots."""

    folder: Path
    setting: RunSpec
    execution: Execution

    @property
    def engine(self) -> str:
        return self.execution.engine_for(self.setting.kind, self.setting.updates)

    @property
    def first(self) -> int:
        return round(FIRST * self.setting.loop.steps)

    @property
    def last(self) -> int:
        return round(LAST * self.setting.loop.steps)

    @property
    def seeds(self) -> list[int]:
        return [SEED]

    def rehearse(self, members: int) -> None:
        collector = self.setting.kind(self.setting.sizes, self.setting.config, self.seeds[:members], self.execution.device)
        set_engine(collector, self.engine)
        rehearse_collection(collector, replace(self.setting.loop, steps=self.last), check_domain(self.setting.domain))

    @property
    def name(self) -> str:
        return f"a pilot of {self.setting.method} on {self.setting.domain}"

    @property
    def label(self) -> str:
        return self.setting.method

    def checkpoints(self, every: float = CHECKPOINT_EVERY) -> Checkpoints:
        setting = self.setting
        decisive = {
            "method": setting.method, "domain": setting.domain, "seeds": [SEED], "steps": self.last, "profile": setting.profile,
            "hyperparameters": setting.values, "device": self.execution.device, "engine": self.engine,
            **origin(plugins.package("collectors", setting.method)),
        }  # fmt: skip
        return Checkpoints(self.folder / f"{setting.method}-{domain_slug(setting.domain)}-{setting.profile}", decisive, every)

    def is_interrupted(self) -> bool:
        return self.checkpoints().folder.exists()


def measure(advance: Advance, *, stack: _Stack, execution: Execution) -> Pilot:
    """Run one method with k fixed and measure its threshold (the job of :func:`pilot`).

    What it has done is kept until all are done.
    """
    setting, device, first, last = stack.setting, execution.device, stack.first, stack.last
    kind, loop = setting.kind, replace(setting.loop, steps=last)
    name = kind.measured_by_pilot(setting.config)
    checkpoints = stack.checkpoints(execution.checkpoint_every)
    place = checkpoints.folder
    with locked(place.with_name(f"{place.name}.lock"), stack.name), open_log(None) as nowhere:
        if execution.fresh:
            checkpoints.remove()
        place.mkdir(parents=True, exist_ok=True)
        collector = kind(setting.sizes, setting.config, [SEED], device)
        set_engine(collector, stack.engine)
        medians, journal = _Medians(), DatasetSink(place, nowhere)
        try:
            run_collection(collector, loop, check_domain(setting.domain), [journal], advance, checkpoints, medians)
            journal.close()
            # The last update was in the last of the ``update_every`` steps before the end.
            skipped = len(medians.values) - (last - first) // loop.update_every
            values = torch.stack(medians.values[max(skipped, 0) :]) if medians.values else torch.empty(0)
            _check(values, setting, last, int(collector.horizon.max()))
        except BrokenDownError:
            checkpoints.remove()
            raise
        except OSError as error:
            raise unwritable(f"{stack.name} into {place}", error) from None
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
            "pilot",
            {"--method": setting.method, "--domain": setting.domain, "--profile": setting.profile} | execution.options,
            setting.overrides,
        ),
        **stamp(checkpoints.seconds, device, torch.get_num_threads(), plugins.package("collectors", setting.method), engine_of(collector)),
    )


def _check(values: torch.Tensor, setting: RunSpec, last: int, horizon: int) -> None:
    """Refuse a pilot that says nothing.

    Raises:
        BrokenDownError: it was too short, or broke down.
    """
    if not len(values) or horizon != setting.config.horizon:
        raise BrokenDownError(f"the pilot of {setting.method} learnt nothing within {last:,} steps; take a longer run or fewer seed_steps.")
    if not values.isfinite().all():
        raise BrokenDownError(f"the pilot of {setting.method} broke down: not finite is what it measures; try a smaller learning_rate.")


class _Medians:
    """The median of each minibatch of what the rule for k looks at."""

    def __init__(self) -> None:
        self.values: list[torch.Tensor] = []

    def after_update(self, batch: Batch) -> None:
        assert batch.signal is not None, "a method with such a hyperparameter says what it compares with it"
        self.values.append(batch.signal.median())

    def state_dict(self) -> dict[str, Any]:
        return {"values": torch.stack(self.values) if self.values else torch.empty(0)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.values = list(state["values"])
