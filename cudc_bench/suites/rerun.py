"""``rerun``: makes runs again from their records alone, and compares to the last bit.

Datasets that are missing are collected again, too. All of it happens in a folder of its own, so that nothing that exists is taken for
what is to be shown; the one exception, a dataset that is here with the record's fingerprint, can be ruled out.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cudc_bench import plugins
from cudc_bench.artefacts.again import collect_commands, commands_from_nothing, mixture_steps
from cudc_bench.artefacts.ids import default_id, rooted_at
from cudc_bench.artefacts.manifest import exists, read_manifest
from cudc_bench.artefacts.provenance import commit, is_own_command, machine, source, versions
from cudc_bench.artefacts.records import DatasetReference, Record, Reran, read_record, record_files, write_record
from cudc_bench.artefacts.tiers import TIERS
from cudc_bench.errors import RunError, UsageError
from cudc_bench.execution import interrupts
from cudc_bench.execution.locks import locked
from cudc_bench.execution.progress import echo
from cudc_bench.files import check_folder, check_path, read_limited, unwritable, write_atomically
from cudc_bench.settings.config import config_hash
from cudc_bench.settings.evaluate_config import in_full

# In the scratch folder: by what it was made, whoever is at work, and all that is made. Nothing else in it is ever removed.
_STAMP, _LOCK, _MADE = "rerun.json", "rerun.lock", "made"


@dataclass(frozen=True)
class Rerun:
    """What came of making a run again.

    Attributes:
        path: of the record.
        made: the new record; None where training would have meant nothing, since the dataset came out with other data.
        collected: whether the dataset was collected again, too.
        differences: parts of sentences, one for each kind of thing that is not the same to the last bit; none if all is.
        causes: what is known to be other here than where the record was made, and may be why.
    """

    path: Path
    made: Path | None
    collected: bool
    differences: tuple[str, ...]
    causes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Case:
    """A record, and the dataset that its run is trained on again."""

    path: Path
    record: Record
    collects: bool
    dataset: str
    root: Path | None  # of that dataset, where it is not the user's own

    @property
    def asked(self) -> tuple[str, str | None, int | None]:
        """Which record of its training's it is: by the dataset, and of a learner without rewards by its task and number of labels."""
        told = self.record.zero_shot
        return (self.dataset, None, None) if told is None else (self.dataset, self.record.dataset.task, told.labels)

    @property
    def training(self) -> dict[str, Any]:
        """What decides a training but the dataset: cases that share it are trained by one call."""
        record = self.record
        reward, told = record.dataset.reward, record.zero_shot
        labels = {} if told is None else {"labels_from": None if told.source is None else told.source.id}
        return labels | {
            "algo": record.algorithm, "domain": record.dataset.domain, "profile": record.profile,
            "settings": in_full(record.hyperparameters), "training_seeds": None if record.seed == record.dataset.seed else [record.seed],
            "dataset_sizes": None if record.dataset.used is None else [record.dataset.used],
            "reward": None if reward is None else reward.reference, **_how(record.machine),
        }  # fmt: skip


def rerun(
    records: str | Path | Sequence[str | Path],
    *,
    scratch: str | Path = "rerun",
    collect: bool = False,
    reward: str | None = None,
    workers: int | None = 1,
    keep: bool = False,
) -> list[Rerun]:
    """Make runs again from nothing but their records, with all hyperparameters that these name, and compare to the last bit.

    A dataset that is here with the fingerprint that the record names is trained on; any other is collected and labelled again. What was
    interrupted goes on where it was. A record that somebody handed in and that comes out the same says so from then on.

    Args:
        records: a record or a folder of records, or several.
        scratch: a folder for all that is made; it is removed at the end if everything came out the same.
        collect: collect every dataset again, also where it is here.
        reward: the own reward function that the records' datasets were labelled by, as they name it. Records come from others, and naming
            the function is what allows it to run here.
        workers: processes on a CPU; 1 works in this process, None takes one for each core.
        keep: leave the folder as it is.

    Returns:
        What came of each record, in the order of their paths.

    Raises:
        UsageError: wrong input; nothing has been made.
        RunError: a record is damaged, or a run failed.
        Interrupted: the process was asked to leave; what it had done is kept.
    """
    paths = _paths([records] if isinstance(records, str | Path) else records)
    folder = check_folder(scratch, "the folder to make them in")
    found = {path: read_record(path) for path in paths}
    _check_own_folder(folder)
    if reward is not None and all(record.dataset.reward is None for record in found.values()):
        raise UsageError(f"no dataset of these records is labelled by {reward}; leave out --reward.")
    cases = [_case(path, record, folder / _MADE, collect, reward) for path, record in found.items()]
    with interrupts.leaving_gracefully(), locked(folder / _LOCK, f"what is made again in {folder}"):
        _begin(folder, cases)
        echo(f"making {len(cases)} runs again in {folder}; {sum(case.collects for case in cases)} of their datasets are collected, too")
        _collect(cases, workers)
        made = _train(cases, folder / _MADE, workers)
        results = {case.path: _result(case, made[case.path]) for case in cases}
        for case in cases:
            if not results[case.path].differences and case.record.submission is not None:
                _mark(case)
        if not keep and not any(result.differences for result in results.values()):
            _clear(folder)
    if not (folder / _STAMP).exists():
        with suppress(OSError):
            folder.rmdir()  # unless somebody has put something into it
    return [results[path] for path in paths]


def _paths(given: Sequence[str | Path]) -> list[Path]:
    found: list[Path] = []
    for one in given:
        path = check_path(one, "the records")
        if not path.exists():
            raise UsageError(f"there is no record at '{path}'; name files that evaluate wrote, or folders of them.")
        found += record_files(path) if path.is_dir() else [path]
    if not found:
        raise UsageError(f"there is no record in {', '.join(map(str, given)) or 'nothing'}; name files that evaluate wrote.")
    return list(dict.fromkeys(found))


def _case(path: Path, record: Record, folder: Path, collect: bool, reward: str | None) -> _Case:
    """What is to be done for a record.

    Raises:
        UsageError: it cannot be made again from itself.
    """
    data = record.dataset
    named = None if data.reward is None else data.reward.reference
    if named is not None and named != reward:
        raise UsageError(f"{path}: its dataset is labelled by the function {named}; to run it here, give --reward {named}.")
    if not collect and _is_here(record):
        return _Case(path, record, False, data.id, None)
    if data.source is not None:
        raise UsageError(
            f"{path}: its dataset '{data.id}' was imported from {data.source}, and no command can collect it; have it here"
            + (" and leave out --collect." if collect else " with the fingerprint that the record names.")
        )
    if data.method in TIERS:
        making = " && ".join(collect_commands(data))
        raise UsageError(
            f"{path}: its dataset '{data.id}' is of an online training, which is not made again here ({making}); have it here"
            + (" and leave out --collect." if collect else " with the fingerprint that the record names.")
        )
    if foreign := [part.id for part in data.parts if part.source is not None]:
        raise UsageError(
            f"{path}: its dataset '{data.id}' was mixed of {', '.join(foreign)}, which no command can collect, and others; have it here"
            + (" and leave out --collect." if collect else " with the fingerprint that the record names.")
        )
    if record.zero_shot is not None and record.zero_shot.source is not None:
        raise UsageError(f"{path}: its labels are of another dataset; have the one that it was trained on here, and leave out --collect.")
    base = default_id(data.domain, data.method, data.seed, data.profile)
    trained_on = base if record.zero_shot is not None else base.for_task(data.task)
    return _Case(path, record, True, str(trained_on), folder / config_hash(_collection(record))[:12])


def _is_here(record: Record) -> bool:
    try:
        return exists(record.dataset.id) and read_manifest(record.dataset.id).fingerprint == record.dataset.fingerprint
    except (UsageError, RunError):
        return False


def _collection(record: Record) -> dict[str, Any]:
    """What decides a collection but its seed."""
    data, known = record.dataset, record.dataset.collection
    if data.parts:
        return {"domain": data.domain, "steps": mixture_steps(data), "parts": [part.model_dump() for part in data.parts]}
    return {
        "method": data.method, "domain": data.domain, "profile": data.profile,
        "settings": data.overrides if known is None else known.hyperparameters, **_how({} if known is None else known.machine),
    }  # fmt: skip


def _collect_parts(data: DatasetReference, workers: int | None) -> list[str]:
    """The parts of a mixture, collected again under the ids that they had."""
    found = []
    for part in data.parts:
        found += plugins.load("stages", "collect")(
            part.method, data.domain, [part.seed], profile=part.profile, settings=part.hyperparameters, dataset_id=part.id,
            workers=workers, **_how(part.collected.machine),
        )  # fmt: skip
    return found


def _how(made_on: Mapping[str, Any]) -> dict[str, str]:
    """On which device and with which engine something was made; records from before engines had one, and a GPU's is the usual one there."""
    engine = str(made_on.get("engine", "eager"))
    return {"device": str(made_on.get("device", "cpu")), "engine": engine if engine in ("eager", "compiled") else "auto"}


# ----------------------------------------------------------------------------------------------------------------------- the folder


def _check_own_folder(folder: Path) -> None:
    # Of a process that was killed at once there may be a lock and nothing else.
    if folder.exists() and any(one.name != _LOCK for one in folder.iterdir()) and not (folder / _STAMP).exists():
        raise UsageError(f"'{folder}' holds other things; name a folder with --scratch that is empty or not there yet.")


def _begin(folder: Path, cases: Sequence[_Case]) -> None:
    """Remove what was made there unless it was by this very code: it would stand for a run that never was."""
    packages: dict[str, str] = {}
    for case in cases:
        data = case.record.dataset
        for method in [part.method for part in data.parts] or [data.method] if case.collects else ():
            packages |= plugins.package("collectors", method)
        packages |= plugins.package("evaluators", case.record.algorithm)
    made_by = json.dumps({"versions": versions() | packages, "source": source()}, sort_keys=True)
    stamp = folder / _STAMP
    try:
        if stamp.exists() and read_limited(stamp).decode() == made_by:
            return
        _clear(folder)
        write_atomically(stamp, made_by)
    except OSError as error:
        raise unwritable(f"the folder {folder}", error) from None


def _clear(folder: Path) -> None:
    """Remove what was made in the scratch folder, and the stamp last: without it the folder is not ours."""
    if (folder / _MADE).exists():
        shutil.rmtree(folder / _MADE)
    (folder / _STAMP).unlink(missing_ok=True)


# ------------------------------------------------------------------------------------------------------------------------- the work


def _collect(cases: Sequence[_Case], workers: int | None) -> None:
    together: dict[Path, list[_Case]] = {}
    for case in cases:
        if case.root is not None:
            together.setdefault(case.root, []).append(case)
    for root, some in together.items():
        with rooted_at(root):
            wanted = _collection(some[0].record)
            seeds = sorted({case.record.dataset.seed for case in some})
            if some[0].record.dataset.parts:
                ids = _collect_parts(some[0].record.dataset, workers)
                bases = [plugins.load("stages", "mix")(ids, wanted["steps"], seed) for seed in seeds]
            else:
                bases = plugins.load("stages", "collect")(seeds=seeds, workers=workers, **wanted)
            for seed, base in zip(seeds, bases, strict=True):
                mine = [case.record.dataset for case in some if case.record.dataset.seed == seed and case.record.zero_shot is None]
                if tasks := sorted({data.task for data in mine if data.reward is None}):
                    plugins.load("stages", "relabel")(base, tasks)
                for own in sorted({data.reward.reference for data in mine if data.reward is not None}):
                    plugins.load("stages", "relabel")(base, reward=own)


def _train(cases: Sequence[_Case], folder: Path, workers: int | None) -> dict[Path, Path | None]:
    """The new record of each, by the old one's path; None of those whose dataset has other data than the record says."""
    made: dict[Path, Path | None] = {}
    together: dict[tuple[Path | None, str], list[_Case]] = {}
    for case in cases:
        with rooted_at(case.root):
            if read_manifest(case.dataset).fingerprint != case.record.dataset.fingerprint:
                made[case.path] = None
                continue
        together.setdefault((case.root, config_hash(case.training)), []).append(case)
    for (root, key), some in together.items():
        with rooted_at(root):
            ids = list(dict.fromkeys(case.dataset for case in some))
            output = folder / "records" / key[:12] / ("here" if root is None else root.name)
            how = some[0].training | _questions(some)
            paths = plugins.load("stages", "evaluate")(dataset_id=ids, output=output, workers=workers, policies=False, **how)
        where = {_asked_in(path): path for path in paths}
        made |= {case.path: where[case.asked] for case in some}
    return made


def _questions(cases: Sequence[_Case]) -> dict[str, Any]:
    """What one training of a learner without rewards is asked for all of its records; nothing for others."""
    told = [one for case in cases if (one := case.record.zero_shot) is not None]
    if not told:
        return {}
    tasks = sorted({case.record.dataset.task for case in cases if case.record.dataset.reward is None})
    return {"labels": sorted({one.labels for one in told}), "tasks": tasks or None}


def _asked_in(path: Path) -> tuple[str, str | None, int | None]:
    record = read_record(path)
    told = record.zero_shot
    return (record.dataset.id, None, None) if told is None else (record.dataset.id, record.dataset.task, told.labels)


def _mark(case: _Case) -> None:
    """Write into a record that somebody handed in that it was made again."""
    record = case.record
    assert record.submission is not None
    found = Reran(collected=case.collects, commit=commit()[0], versions=versions(), created=datetime.now(UTC).isoformat(timespec="seconds"))
    write_record(case.path, record.model_copy(update={"submission": record.submission.model_copy(update={"reran": found})}))


# ------------------------------------------------------------------------------------------------------------------- the comparison


def _result(case: _Case, made: Path | None) -> Rerun:
    if made is None:
        again = " && ".join(commands_from_nothing(case.record))
        advice = f"; what they give here: {again}" if is_own_command(case.record.command) else ""
        differences: tuple[str, ...] = (f"the dataset came out with other data, so that nothing was trained on it{advice}",)
        return Rerun(case.path, None, case.collects, differences, tuple(_causes(case.record, None)))
    new = read_record(made)
    differences = tuple(_differences(case.record, new))
    result = Rerun(case.path, made, case.collects, differences)
    return replace(result, causes=tuple(_causes(case.record, new))) if differences else result


def _differences(record: Record, new: Record) -> Iterator[str]:
    """What two records of one run say differently, of all that a run decides."""
    then, now = in_full(record.hyperparameters), in_full(new.hyperparameters)
    if changed := [name for name in sorted(then | now) if then.get(name) != now.get(name)]:
        yield f"hyperparameters {', '.join(f'{name} ({then.get(name)}, here {now.get(name)})' for name in changed)}"
    if record.milestones != new.milestones:
        yield f"milestones ({record.milestones}, here {new.milestones})"
    for what, old, made in (("returns", record.curve, new.curve), ("final returns", record.finals, new.finals)):
        yield from _first(what, {one.step: one.returns for one in old}, {one.step: one.returns for one in made})
    # Records from before losses were kept have none to compare.
    if record.metrics:
        yield from _first("losses", {row.step: row.values for row in record.metrics}, {row.step: row.values for row in new.metrics})
    if record.zero_shot is not None and new.zero_shot is not None and record.zero_shot.norm != new.zero_shot.norm:
        yield f"the vector of its task (length {record.zero_shot.norm:.6g}, here {new.zero_shot.norm:.6g})"
    if record.conclusion.mean != new.conclusion.mean:
        yield f"the score ({record.conclusion.mean:.6g}, here {new.conclusion.mean:.6g})"


def _first(what: str, old: Mapping[int, Any], new: Mapping[int, Any]) -> Iterator[str]:
    if old.keys() != new.keys():
        yield f"the steps at which there are {what}"
        return
    different = [step for step in old if old[step] != new[step]]
    if different:
        yield f"{what} from gradient step {different[0]:,} on ({len(different)} of {len(old)} lines)"


def _causes(record: Record, new: Record | None) -> Iterator[str]:
    """What was other where a record was made than here, of what is known to decide the last bit."""
    known = record.dataset.collection
    parts = [("it was trained", record.versions, record.machine)]
    if known is not None:
        parts.append(("its dataset was collected", known.versions, known.machine))
    parts += [(f"{part.id} was collected", part.collected.versions, part.collected.machine) for part in record.dataset.parts]
    threads = record.machine.get("threads", 1) if new is None else new.machine.get("threads", 1)
    here = machine("cpu", threads)
    for what, packages, made_on in parts:
        other = [f"{name} {then} (here {versions().get(name, 'missing')})" for name, then in packages.items() if _is_other(name, then)]
        for name in ("system", "libc", "processor", "instructions"):
            if name in made_on and made_on[name] != here[name]:
                other.append(f"{name} {made_on[name]} (here {here[name]})")
        if other:
            yield f"{what} with {'; '.join(other)}"
    if new is not None:
        for name in ("threads", "engine"):
            if record.machine.get(name) != new.machine.get(name) and name in record.machine:
                yield f"{name} {record.machine[name]} (here {new.machine.get(name)})"
    if known is None and new is None and record.dataset.source is None and not record.dataset.parts:
        yield "it does not say with which hyperparameters its dataset was collected, and today's were taken"
    if (head := commit()[0]) is not None and record.commit is not None and head != record.commit:
        yield f"the code was {record.commit[:7]} (here {head[:7]})"


def _is_other(name: str, then: str) -> bool:
    return name in versions() and name != "cudc-bench" and versions()[name] != then
