"""``submit``: other people's records, held against all that a record can be held against before they stand beside ours.

Nothing here runs anybody's code or trains anything again. What is shown is that a record is whole and possible, that it agrees with
itself and with the profile that it names, and that its numbers and data are nobody else's. Whether they are true only running its
command can show; tables say that nobody did.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cudc_bench import plugins
from cudc_bench.artefacts.commands import LONGEST, parse_command, settings_that_differ
from cudc_bench.artefacts.ids import parse_id
from cudc_bench.artefacts.manifest import IMPORTED_PROFILE
from cudc_bench.artefacts.provenance import knows_commit
from cudc_bench.artefacts.records import LABELS, Record, Submission, parse_record, read_content, record_path, settings_text, to_json
from cudc_bench.artefacts.tiers import TIERS
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.envs.registry import check_domain, check_tasks
from cudc_bench.errors import CudcBenchError, RunError, UsageError, nearest
from cudc_bench.files import check_folder, check_path, remove_empty_above, unwritable, write_atomically
from cudc_bench.settings.config import as_dict, build, config_hash
from cudc_bench.settings.evaluate_config import EvaluateConfig, check_milestones, in_full, plain_values
from cudc_bench.settings.profiles import PAPER_STEPS, PROFILES, Profile
from cudc_bench.text import plain

from ..numbers.table import origins
from .load import created, files, impossible, read_all

FOLDER = "submitted"  # in that of the records
_LARGEST_FILE = 32 * 2**20  # bytes; a record of the paper's size has about 100 KB
_TELLING = 5  # So many different returns are never the same by chance; fewer may be, such as those of a task that nobody solves.
_CLOCKS = timedelta(days=1)  # by how much they may differ
# What is taken of a record: entries of a mapping (a learner has about 40 hyperparameters), characters of one with its name, and rows of a
# list (at the paper's size a curve has 51 evaluations).
_MOST_ENTRIES, _LONGEST_ENTRY, _MOST_ROWS = 200, 1_000, 10_000
# Parameters of ``evaluate``: those that a dataset's id decides as well, with others that decide what a record says, and some that change
# nothing of it.
_OF_DATA = frozenset({"domain", "method", "seeds", "tasks"})
_DECISIVE = _OF_DATA | {
    "algo", "profile", "settings", "precision", "training_seeds", "steps", "dataset_id", "dataset_size", "reward",
    "labels", "labels_from",
    "overwrite", "device", "engine", "workers", "policy", "fresh", "checkpoint_every",
}  # fmt: skip


class RefusedError(UsageError):
    """Records that were not added.

    Attributes:
        problems: one line for each thing that is wrong with any of them.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        rest = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        super().__init__(f"nothing was added: {problems[0]}{rest}")
        self.problems = tuple(problems)


@dataclass(frozen=True)
class Received:
    """What was taken in.

    Attributes:
        files: the records as they are kept now, in the order in which they were handed in.
        remarks: one line for each thing that is no reason to refuse them, but that whoever takes them in should know.
    """

    files: tuple[Path, ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class _Candidate:
    path: Path
    record: Record
    place: Path


def submit(
    records: str | Path | Sequence[str | Path],
    by: str,
    *,
    url: str | None = None,
    note: str | None = None,
    output: str | Path = "results",
    overwrite: bool = False,
) -> Received:
    """Check records that somebody handed in and add copies of them to ours, marked as theirs: all of them, or none.

    They go to ``<output>/submitted/<by>/<profile>/…``, with who handed them in and the SHA-256 of each file as it was. In tables and
    statistics they are columns of their own, such as "cudc (by ann)". What is there already and the same is kept.

    Args:
        records: a record or a folder of records, or several.
        by: a short name of whoever hands them in.
        url: where more is to be found.
        note: one line that goes with them.
        output: the folder of our records.
        overwrite: replace what the same person handed in before for the same runs.

    Raises:
        RefusedError: a record is damaged, impossible, contradicts itself or its profile, or is a copy; nothing was added.
        UsageError: other wrong input.
        RunError: a file could not be written; nothing was added.
    """
    results = check_folder(output, "the output")
    stamp = _stamp(by, url, note)
    paths = [check_path(path, "the records") for path in ([records] if isinstance(records, str | Path) else records)]
    if missing := [path for path in paths if not path.exists()]:
        raise UsageError(f"there is no record at '{missing[0]}'; name files, or folders of them.")
    found = files(paths)
    if not found:
        where = ", ".join(f"'{path}'" for path in paths) or "nothing"
        raise UsageError(f"there is no record in {where}; records are *.json files.")
    problems: list[str] = []
    remarks: dict[str, list[Path]] = defaultdict(list)
    candidates = []
    for path in found:
        try:
            record = _read(path, stamp)
        except RunError as error:
            problems.append(str(error))
            continue
        wrong = list(_contradictions(record))
        problems += [f"{path}: {one}" for one in wrong]
        if not wrong:
            candidates.append(_Candidate(path, record, _place(results, record)))
            for remark in _remarks(record):
                remarks[remark].append(path)
    problems += _beside_others(candidates, results, overwrite, remarks)
    if problems:
        raise RefusedError([plain(problem) for problem in problems])
    _write({one.place: to_json(one.record) for one in candidates if not _is_there(one)}, results)
    return Received(tuple(one.place for one in candidates), tuple(_told(remarks)))


def _stamp(by: str, url: str | None, note: str | None) -> Submission:
    """All of a submission but the file that it is of."""
    wanted = {
        "by": "lower-case letters, digits, '_' and '-', at most 32 of them, as in 'ann'",
        "url": "an address that begins with https://, without spaces, of at most 300 letters",
        "note": "one line of 1 to 300 printable letters",
    }
    values = {"by": by, "url": url, "note": note}
    try:
        return Submission(by=by, url=url, note=note, sha256="0" * 64, submitted=datetime.now(UTC).isoformat(timespec="seconds"))
    except ValidationError as error:
        name = str(error.errors()[0]["loc"][0])
        raise UsageError(f"--{name} cannot be '{values[name]}'; give {wanted[name]}.") from None


def _read(path: Path, stamp: Submission) -> Record:
    size = path.stat().st_size if path.exists() else 0
    if size > _LARGEST_FILE:
        raise RunError(f"{path} is not a run record: it has {size:,} bytes, at most {_LARGEST_FILE:,} are read.")
    content = read_content(path)
    record = parse_record(content, path)
    if record.submission is not None:
        raise RunError(f"{path}: it was handed in before, by {record.submission.by}; ask for the file that evaluate wrote.")
    return record.model_copy(update={"submission": stamp.model_copy(update={"sha256": hashlib.sha256(content).hexdigest()})})


def _place(results: Path, record: Record) -> Path:
    """Where a record is kept; settings that differ from the profile's are a folder of their own."""
    assert record.submission is not None
    folder = record.profile if record.group == record.profile else f"{record.profile}-{config_hash({'group': record.group})[:8]}"
    return record_path(
        results / FOLDER / record.submission.by,
        record.labelled_id,
        record.algorithm,
        record.dataset.seed,
        folder,
        record.dataset.used,
        record.seed,
        None if record.zero_shot is None else record.zero_shot.labels,
    )


def _contradictions(record: Record) -> Iterator[str]:
    """What cannot be right about a record by itself."""
    if too_long := list(_about_size(record)):
        yield from too_long
        return
    why = impossible(record)
    if why is not None:
        yield why
        return
    if created(record) > datetime.now(UTC) + _CLOCKS:
        yield f"it was made in the future, {record.created}."
    yield from _about_data(record)
    yield from _about_command(record)
    if record.hyperparameters_hash != (right := config_hash(record.hyperparameters)):
        yield f"its hyperparameters have the hash {right}, not {record.hyperparameters_hash:.40}."
    if record.profile not in PROFILES:
        yield f"there is no profile '{record.profile}'; allowed: {', '.join(PROFILES)}.{nearest(record.profile, PROFILES)}"
        return
    profile = PROFILES[record.profile]
    try:
        lacking = [name for name in as_dict(EvaluateConfig()) if name not in in_full(record.hyperparameters)]
        if lacking:
            yield f"its hyperparameters lack {', '.join(lacking)}."
            return
        loop = build(EvaluateConfig, in_full(record.hyperparameters))
        check_milestones(loop)
        yield from _about_settings(record, profile, loop)
    except UsageError as error:
        yield f"its hyperparameters are impossible: {error}"
        return
    yield from _about_evaluations(record, loop)


def _about_data(record: Record) -> Iterator[str]:
    data = record.dataset
    try:
        parse_id(data.id)
        domain = check_domain(data.domain)
        if data.reward is None:
            check_tasks(domain, (data.task,))
    except CudcBenchError as error:
        yield str(error)
    else:
        lowest = min(value for evaluation in (*record.curve, *record.finals) for value in evaluation.returns)
        if data.reward is None and lowest < 0:
            yield f"a return of {lowest:g} is impossible: no reward of {data.domain} is negative."
    if data.source is not None and (data.profile != IMPORTED_PROFILE or data.overrides):
        yield "an imported dataset was collected at no profile, with no settings."
    if not data.goes_with_every_profile and data.profile != record.profile:
        yield f"its dataset was collected at profile {data.profile}, and it was trained at {record.profile}."
    plain_collection = data.source is None and not data.parts and data.method not in TIERS
    if plain_collection and data.domain in DOMAINS and data.profile in PROFILES and "steps" not in data.overrides:
        usual = PROFILES[data.profile].collect.get("steps", PAPER_STEPS)
        if data.steps != usual:
            yield f"its dataset has {data.steps:,} steps where profile {data.profile} has {usual:,}, and its overrides do not say so."
    if data.used is not None and data.used >= data.steps:
        yield f"it was trained on the first {data.used:,} of {data.steps:,} transitions, which are no part of them."


def _about_size(record: Record) -> Iterator[str]:
    """What is longer than any honest record has it: everything else is looked at, written and shown many times over."""
    counts = {
        "hyperparameters": record.hyperparameters, "overrides": record.overrides, "overrides of its dataset": record.dataset.overrides,
        "versions": record.versions, "entries about its machine": record.machine,
    }  # fmt: skip
    if (made := record.dataset.collection) is not None:
        counts |= {
            "hyperparameters of its dataset": made.hyperparameters, "versions behind its dataset": made.versions,
            "entries about its dataset's machine": made.machine,
        }  # fmt: skip
    for part in record.dataset.parts:
        counts |= {f"hyperparameters of {part.id:.60}": part.hyperparameters, f"overrides of {part.id:.60}": part.overrides}
    for what, values in counts.items():
        if len(values) > _MOST_ENTRIES:
            yield f"it has {len(values):,} {what}, at most {_MOST_ENTRIES:,} are taken."
        else:
            for name, value in values.items():
                if (length := len(name) + len(json.dumps(value))) > _LONGEST_ENTRY:
                    yield f"its {what} have one of {length:,} characters ({name:.30}), at most {_LONGEST_ENTRY:,} are taken."
    evaluations = [*record.curve, *record.finals]
    for what, count in (
        ("evaluations", len(evaluations)), ("lines of metrics", len(record.metrics)), ("milestones", len(record.milestones)),
        ("episodes in an evaluation", max(len(evaluation.returns) for evaluation in evaluations)),
        ("metrics in a line", max((len(line.values) for line in record.metrics), default=0)),
    ):  # fmt: skip
        if count > _MOST_ROWS:
            yield f"it has {count:,} {what}, at most {_MOST_ROWS:,} are taken."
    for what, text in (("dataset id", record.dataset.id), ("hash", record.hyperparameters_hash), ("commit", record.commit or ""),
                       ("time of creation", record.created)):  # fmt: skip
        if len(text) > _LONGEST_ENTRY:
            yield f"its {what} has {len(text):,} characters, at most {_LONGEST_ENTRY:,} are taken."
    if len(record.command) > LONGEST:
        yield f"its command has {len(record.command):,} characters, at most {LONGEST:,} are taken."


def _about_command(record: Record) -> Iterator[str]:
    """Whether its command, as the command line itself reads it and with all that it leaves to defaults, makes this record."""
    try:
        command = parse_command(record.command)
        told = command.settings
    except UsageError as error:
        yield f"{str(error).rstrip('.')}."
        return
    if command.name != "evaluate":
        yield f"its command makes no record: {record.command:.80}"
        return
    if idle := sorted(command.given - _DECISIVE):
        yield f"its command says --{idle[0].replace('_', '-')}, which has no part in what a record says; leave it out."
    data = record.dataset
    expected: dict[str, str | int | None] = {
        "domain": data.domain, "method": data.method, "seeds": data.seed, "tasks": data.task, "algo": record.algorithm,
        "profile": record.profile, "dataset_size": data.used, "reward": None if data.reward is None else data.reward.reference,
    }  # fmt: skip
    if data.reward is not None:
        del expected["tasks"]
    if "dataset_id" in command.given:
        # The dataset's own are meant then, so that what is left out is not the default.
        expected = {name: value for name, value in expected.items() if name not in _OF_DATA or name in command.given}
        expected["dataset_id"] = data.id
    elif data.source is not None or data.parts or data.overrides:
        yield "its command names no --dataset-id, and would collect another dataset."
    if (asked := record.zero_shot) is not None:
        expected["labels_from"] = None if asked.source is None else asked.source.id
        if "labels" in command.given or asked.labels != LABELS:
            expected["labels"] = asked.labels
    if "training_seeds" in command.given or record.seed != data.seed:
        expected["training_seeds"] = record.seed
    everything = {"precision": "float32"} | in_full(record.hyperparameters)
    overrides = dict(record.overrides)
    if "steps" in command.given:
        expected["steps"] = everything.get("gradient_steps")
        overrides = {name: value for name, value in overrides.items() if name not in ("gradient_steps", "milestones")}
    for problem in (*command.contradictions(expected), *settings_that_differ(told, overrides, everything)):
        yield f"{problem}."


def _about_settings(record: Record, profile: Profile, loop: EvaluateConfig) -> Iterator[str]:
    """Whether what differs from the profile is what the record says: it decides which table a record belongs to."""
    usual = _usual(record.algorithm, profile, loop)
    if record.algorithm in plugins.names("evaluators"):
        rewarded = getattr(plugins.load("evaluators", record.algorithm), "learns_from_rewards", True)
        if rewarded != (record.zero_shot is None):
            yield f"{record.algorithm} trains {'on' if rewarded else 'without'} rewards, and its record says otherwise."
    if record.algorithm in plugins.names("evaluators") and (unknown := sorted(record.hyperparameters.keys() - usual.keys())):
        yield f"{record.algorithm} has no hyperparameter called {', '.join(unknown)}."
    for name, value in record.hyperparameters.items():
        if name in usual and value != usual[name] and name not in record.overrides:
            text, plainly = settings_text({name: value}), settings_text({name: usual[name]})
            yield f"it was trained with {text} where profile {profile.name} has {plainly}, and its overrides do not say so."
    for name, value in record.overrides.items():
        if name not in record.hyperparameters or record.hyperparameters[name] != value:
            yield f"its overrides say {settings_text({name: value})}, and its hyperparameters do not."
        elif name in usual and value == usual[name]:
            yield f"its overrides name {settings_text({name: value})}, which is what profile {profile.name} has."


def _usual(algorithm: str, profile: Profile, loop: EvaluateConfig, later: bool = True) -> Mapping[str, Any]:
    """The values that a profile gives an algorithm: all of one that is installed, of others what all algorithms share."""
    if algorithm in plugins.names("evaluators"):
        return plain_values(plugins.load("evaluators", algorithm), profile, loop.gradient_steps, later=later)
    return {**profile.evaluate, **as_dict(build(EvaluateConfig, profile.evaluate), later=later)}


def _about_evaluations(record: Record, loop: EvaluateConfig) -> Iterator[str]:
    if list(record.milestones) != list(loop.milestones):
        yield f"its milestones are {_listed(record.milestones)}, and by its hyperparameters {_listed(loop.milestones)}."
    count = -(-loop.gradient_steps // loop.evaluate_every) + 1
    steps = [evaluation.step for evaluation in record.curve]
    if len(steps) != count or any(step != min(i * loop.evaluate_every, loop.gradient_steps) for i, step in enumerate(steps)):
        yield (
            f"its curve has {len(steps)} evaluations, at {_listed(steps)}; by its hyperparameters there are {count:,}: at 0, then every"
            f" {loop.evaluate_every:,} steps up to {loop.gradient_steps:,}."
        )
    episodes = sorted({len(evaluation.returns) for evaluation in record.curve})
    if episodes != [loop.evaluation_episodes]:
        yield f"evaluations of its curve have {_listed(episodes)} episodes, and by its hyperparameters {loop.evaluation_episodes:,}."
    wanted, there = min(loop.final_evaluations, count - 1), len(record.finals)
    if there != wanted:
        yield f"it has {there:,} larger evaluations at its end, and by its hyperparameters {wanted:,}."
    for size in sorted({len(evaluation.returns) for evaluation in record.finals} - {loop.final_episodes}):
        yield f"a larger evaluation at its end has {size:,} episodes, and by its hyperparameters {loop.final_episodes:,}."


def _listed(numbers: Iterable[int]) -> str:
    shown = [f"{number:,}" for number in numbers]
    return ", ".join(shown if len(shown) < 6 else [*shown[:3], "…", shown[-1]])


def _remarks(record: Record) -> Iterator[str]:
    made = origins([record])
    if record.commit is not None:
        made += " of this project" if knows_commit(record.commit) else ", which is not known here"
    yield f"made with {plain(made)}, cudc-bench {plain(record.versions.get('cudc-bench', 'unknown'))}."
    if record.group != record.profile:
        yield f"a table of its own: {plain(record.group)}."
    loop = build(EvaluateConfig, in_full(record.hyperparameters))
    # What is written down only where it is not the default is lacking in no record.
    usual = _usual(record.algorithm, PROFILES[record.profile], loop, later=False)
    if record.algorithm not in plugins.names("evaluators"):
        yield f"the algorithm {record.algorithm} is not installed here; of its settings only those that all algorithms share were checked."
    elif lacking := sorted(usual.keys() - in_full(record.hyperparameters).keys()):
        yield f"{record.algorithm} has hyperparameters here that it lacks: {', '.join(lacking)}."
    data = record.dataset
    methods = {part.method for part in data.parts if part.source is None} if data.parts else {data.method} if data.source is None else set()
    for method in sorted(methods - {*plugins.names("collectors"), *TIERS}):
        yield f"the method {method} is not installed here; nobody can collect its dataset again from here."
    if record.dataset.reward is not None:
        yield f"its rewards are those of {record.dataset.reward.reference}, which is not part of it."


def _beside_others(
    candidates: Sequence[_Candidate], results: Path, overwrite: bool, remarks: dict[str, list[Path]]
) -> Iterator[str]:  # fmt: skip
    """What is wrong with records when seen beside each other and beside all that are there."""
    places: dict[Path, Path] = {}
    for one in candidates:
        if one.path.resolve().is_relative_to(results.resolve()):
            yield f"{one.path}: it lies among the records of '{results}' already; hand in what comes from elsewhere."
        if one.place in places:
            yield f"{one.path}: it is the same run as {places[one.place]}; hand in one of them."
        elif one.place.exists() and not overwrite and not _is_there(one):
            yield f"{one.path}: '{one.place}' exists and is another; use --overwrite to replace it."
        places.setdefault(one.place, one.path)
    seen = _Seen()
    for path, record, _ in read_all([results] if candidates and results.exists() else []):
        if isinstance(record, Record) and path not in places:
            seen.add(path, record)
    for one in candidates:
        copied, shared, again = seen.add(one.path, one.record)
        if copied is not None:
            yield f"{one.path}: its returns are, to the last digit, those of {copied}."
        if shared is not None:
            yield f"{one.path}: its dataset has the fingerprint of that of {shared}; no two datasets share one."
        if again is not None and copied is None:
            remarks[f"the same run as {again}, with other returns; it stands beside it."].append(one.path)


class _Seen:
    """The records that were seen, by what no two of them should share."""

    def __init__(self) -> None:
        self._returns: dict[str, str] = {}
        self._runs: dict[tuple[Any, ...], str] = {}
        self._data: dict[str, tuple[tuple[Any, ...], str]] = {}

    def add(self, path: Path, record: Record) -> tuple[str | None, str | None, str | None]:
        """See one, and say which one before it has its very returns, its fingerprint for other data, or is the same run."""
        about = f"{path} ({_described(record)})"
        returns = [value for evaluation in (*record.curve, *record.finals) for value in evaluation.returns]
        copied = None
        if len(set(returns)) >= _TELLING:
            copied = self._returns.setdefault(hashlib.sha256(repr(returns).encode()).hexdigest(), about)
        data, shared = self._data.setdefault(record.dataset.fingerprint, (_data(record), about))
        run = (record.group, record.algorithm, record.seed, record.dataset.task, *_data(record))
        again = self._runs.setdefault(run, about)
        return _other(copied, about), None if data == _data(record) else shared, _other(again, about)


def _other(found: str | None, own: str) -> str | None:
    return None if found == own else found


def _data(record: Record) -> tuple[Any, ...]:
    """What a dataset is, whatever it is called; its rewards, and so its fingerprint, may be those of another task as well."""
    data = record.dataset
    return data.domain, data.label, data.seed, data.steps, data.source


def _described(record: Record) -> str:
    data = record.dataset
    whose = "ours" if record.submission is None else f"by {record.submission.by}"
    return f"{record.algorithm} on {data.label}, {data.domain} {data.task}, seed {data.seed}, {whose}"


def _is_there(candidate: _Candidate) -> bool:
    """Whether what would be written is there but for the time at which it was handed in."""
    try:
        there = parse_record(read_content(candidate.place), candidate.place)
    except RunError:
        return False
    new = candidate.record
    if there.submission is None or new.submission is None:
        return False
    return there == new.model_copy(update={"submission": new.submission.model_copy(update={"submitted": there.submission.submitted})})


def _write(contents: Mapping[Path, str], results: Path) -> None:
    """Write all files; if one cannot be written, what was before is put back."""
    before: dict[Path, bytes | None] = {}
    try:
        for path, content in contents.items():
            before[path] = path.read_bytes() if path.exists() else None
            write_atomically(path, content)
    except BaseException as error:
        for path, old in before.items():
            if old is not None:
                write_atomically(path, old)
                continue
            with suppress(OSError):
                path.unlink()
            remove_empty_above(path, results)
        if isinstance(error, OSError):
            raise unwritable(error.filename or results, error) from None
        raise


def _told(remarks: Mapping[str, Sequence[Path]]) -> Iterator[str]:
    for remark, paths in remarks.items():
        yield f"{paths[0]}: {remark}" if len(paths) == 1 else f"{len(paths)} records, such as {paths[0]}: {remark}"
