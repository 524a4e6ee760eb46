"""``import_exorl``: from other people's episode files to a published Minari dataset."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root, default_id, parse_id
from cudc_bench.artefacts.manifest import IMPORTED_PROFILE, Import, Manifest, Source, check_free, fingerprint
from cudc_bench.artefacts.provenance import command_line, stamp
from cudc_bench.artefacts.records import Name
from cudc_bench.data.layout import MAIN_FILE
from cudc_bench.data.measure import measure_coverage
from cudc_bench.data.metadata import write_metadata
from cudc_bench.data.staging import publish, staging
from cudc_bench.data.writer import Episode, write_episodes
from cudc_bench.envs import Domain, check_domain, check_tasks
from cudc_bench.errors import RunError, UsageError
from cudc_bench.execution import interrupts
from cudc_bench.execution.progress import Advance, bars, echo, warn
from cudc_bench.files import check_folder, check_path
from cudc_bench.settings.config import config_hash
from cudc_bench.settings.seeds import check_seeds

from .exorl import EpisodeFile, FileFault, Layout, RawEpisode, list_files, read_episode
from .imported import about_arrays, check_return, description


def import_exorl(
    directory: str | Path,
    method: str,
    domain: str = "walker",
    *,
    task: str | None = None,
    steps: int | None = None,
    seed: int = 1,
    source: str = "ExORL",
    dataset_id: str | None = None,
    overwrite: bool = False,
) -> str:
    """Turn a folder of ExORL's or URLB's episode files into a Minari dataset.

    Files are read one at a time, in the order of their episode indices. Each is checked; if one does not fit, the others are only checked
    from there on, so that all are named that do not, and nothing of the import stays. Simulator states become ``infos/physics``; other
    numeric arrays with a row for each step, such as skills, become ``infos/<name>``, whose row t belongs to the action that led to
    observation t.

    Args:
        directory: the folder that holds the ``.npz`` files.
        method: the name of what collected them; it need not be a registered collector.
        domain: a registered domain.
        task: whose rewards the files hold. They are kept, and the dataset becomes ``walker/walk/proto-v0``. Otherwise rewards are 0.
        steps: only the first so many steps; the last episode is cut to fit.
        seed: a number for this collection among others of the same method.
        source: who collected the files, as tables name it.
        dataset_id: instead of the default id, such as ``walker/proto-v0``.
        overwrite: replace a dataset that exists.

    Returns:
        The id of the dataset.

    Raises:
        UsageError: wrong input, or the first file does not fit, perhaps among others; nothing has been written.
        RunError: later files do not fit, or the dataset cannot be written.
    """
    started = time.monotonic()
    facts = check_domain(domain)
    check_names(method, source)
    if task is not None:
        check_tasks(facts, [task])
    (seed,) = check_seeds([seed])
    usual = default_id(domain, method, seed, IMPORTED_PROFILE)
    usual = usual if task is None else usual.for_task(task)
    one = usual if dataset_id is None else parse_id(dataset_id)
    check_free(one, overwrite)
    check_folder(datasets_root(), "the dataset root")
    folder = check_path(directory, "the directory")
    files = list_files(folder, facts)
    total = sum(file.length for file in files)
    if steps is not None and not 1 <= steps <= total:
        raise UsageError(f"--steps cannot be {steps:,}; there are {total:,} steps in '{folder}'.")
    chosen = list(_first_steps(files, total if steps is None else steps))
    total = sum(length for _, length in chosen)
    try:
        first = read_episode(files[0], facts)
        _episode(first, chosen[0][1], facts, task)
    except FileFault as fault:
        with bars([("look for more such files", total)], "steps") as (advance,):
            raise UsageError(_faults(chosen, 0, fault, facts, None, task, advance)) from None

    echo(f"import {method} on {domain} from {folder}: {len(chosen):,} files, {total:,} steps")
    for line in _remarks(files, first.layout, task):
        echo(line)
    tally = _Tally()
    # An interruption while HDF5 writes would be lost in it.
    with staging(one) as building, interrupts.leaving_gracefully(saves=False):
        with bars([(f"import {method}", total)], "steps") as (advance,):
            written = write_episodes(building / "data", _episodes(chosen, facts, first.layout, task, tally, advance))
        manifest = Manifest(
            domain=domain,
            task=task,
            method=method,
            seed=seed,
            steps=written.steps,
            episodes=written.episodes,
            profile=IMPORTED_PROFILE,
            hyperparameters={},
            hyperparameters_hash=config_hash({}),
            fields=written.fields,
            fingerprint=fingerprint(written.fields),
            imported=Import(
                source=source, files=len(chosen), sha256=tally.sums.hexdigest(), clipped=tally.clipped, ignored=list(first.layout.ignored)
            ),
            command=_command(folder, domain, method, seed, task, steps, source, one, usual),
            **stamp(time.monotonic() - started),
        )
        with bars([("measure coverage", written.steps)], "steps") as (advance,):
            coverage = measure_coverage(building / "data" / MAIN_FILE, manifest, advance)
        told = description(manifest, first.layout, f"{len(chosen):,} episode files", "in the files")
        write_metadata(building / "data", manifest, str(one), told, coverage)
        publish(building, one)
    if tally.clipped:
        echo(f"{tally.clipped:,} of {written.steps * facts.action_size:,} numbers in actions were beyond [-1, 1] by rounding: clipped")
    echo(f"wrote {one} to {dataset_path(one)}")
    return str(one)


_MOST_FAULTS = 100  # files that are named; with more of them, something else is wrong


@dataclass
class _Tally:
    """What adds up over the files of an import."""

    sums: Any = field(default_factory=hashlib.sha256)
    clipped: int = 0


def _first_steps(files: list[EpisodeFile], steps: int) -> Iterator[tuple[EpisodeFile, int]]:
    """The files that hold the first steps, and how many steps of each."""
    for file in files:
        if steps <= 0:
            return
        yield file, min(file.length, steps)
        steps -= file.length


def _episodes(
    chosen: list[tuple[EpisodeFile, int]], domain: Domain, layout: Layout, task: str | None, tally: _Tally, advance: Advance
) -> Iterator[Episode]:
    """The episodes in this project's alignment, one in memory at a time.

    Raises:
        RunError: files do not fit; the message names them.
    """
    for index, (file, length) in enumerate(chosen):
        if interrupts.requested():
            raise KeyboardInterrupt
        try:
            raw, episode = _checked(file, length, domain, layout, task, chosen[0][0])
        except FileFault as fault:
            raise RunError(f"{_faults(chosen, index, fault, domain, layout, task, advance)} Nothing was written.") from None
        yield episode
        tally.sums.update(f"{raw.sha256}  {file.path.name}\n".encode())
        tally.clipped += int(raw.clipped[1 : length + 1].sum())
        advance(length)


def _checked(
    file: EpisodeFile, length: int, domain: Domain, layout: Layout | None, task: str | None, first: EpisodeFile
) -> tuple[RawEpisode, Episode]:
    """A file's content, as it is and as an episode; its optional arrays are those of the first file, if that is known."""
    raw = read_episode(file, domain)
    if layout is not None and raw.layout != layout:
        raise FileFault(f"holds other optional arrays ({raw.layout}) than '{first.path.name}' ({layout})")
    return raw, _episode(raw, length, domain, task)


def _faults(
    chosen: list[tuple[EpisodeFile, int]], index: int, fault: FileFault, domain: Domain, layout: Layout | None, task: str | None,
    advance: Advance,
) -> str:  # fmt: skip
    """What is wrong with a file and with those after it; all are looked at, unless so many do not fit that the first hundred will do."""
    found, sound = [(chosen[index][0], fault)], index
    for file, length in chosen[index + 1 :]:
        if interrupts.requested():
            raise KeyboardInterrupt
        if len(found) == _MOST_FAULTS:
            break
        try:
            _checked(file, length, domain, layout, task, chosen[0][0])
            sound += 1
        except FileFault as another:
            found.append((file, another))
        advance(length)
    if len(found) == 1:
        return _message(*found[0])
    if not sound:  # it is not the files, but what they are taken for
        return f"{_message(*found[0])} None of the first {len(found)} files fits."
    for file, one in found:
        warn(_message(file, one))
    count = f"{len(found)}{' or more' if len(found) == _MOST_FAULTS else ''} of {len(chosen):,}"
    return f"{count} files do not fit, from '{found[0][0].path}' to '{found[-1][0].path.name}', each named above; fetch them again."


def _episode(raw: RawEpisode, length: int, domain: Domain, task: str | None) -> Episode:
    arrays = raw.arrays
    rewards = None
    if task is not None:
        rewards = arrays["reward"][1 : length + 1, 0].astype("float32")
        check_return(rewards, domain, task)
    infos = {name: arrays[name][: length + 1] for name in (*(["physics"] if raw.layout.physics else []), *raw.layout.extras)}
    return Episode(None, arrays["observation"][: length + 1], arrays["action"][1 : length + 1], infos, rewards)


def _remarks(files: list[EpisodeFile], layout: Layout, task: str | None) -> Iterator[str]:
    """What people should know of the files before the work starts."""
    if missing := files[-1].index - files[0].index + 1 - len(files):
        yield f"{missing:,} episodes between {files[0].index} and {files[-1].index} are missing"
    if not layout.physics:
        what = f"only the rewards of {task}, which the files hold, are there" if task else "the dataset can never be labelled for a task"
        yield f"the files hold no physics states: {what}"
    yield from about_arrays(layout, "step")


def _command(
    folder: Path, domain: str, method: str, seed: int, task: str | None, steps: int | None, source: str, one: DatasetId, usual: DatasetId
) -> str:
    options = {"--domain": domain, "--method": method, "--seed": str(seed)}
    options |= {} if task is None else {"--task": task}
    options |= {} if steps is None else {"--steps": str(steps)}
    options |= {} if source == "ExORL" else {"--source": source}
    options |= {} if one == usual else {"--dataset-id": str(one)}
    return command_line("import-exorl", options, {}, str(folder))


def check_names(method: str, source: str) -> None:
    """Check what others' data are to be called.

    Raises:
        UsageError: a manifest takes no such name.
    """
    _check("method", method, Name, "small letters, digits, '_' and '-'")
    _check("source", source, Source, "at most 32 letters, digits, spaces, '.', '_' and '-'")


def _check(what: str, value: str, kind: Any, allowed: str) -> None:
    try:
        TypeAdapter(kind).validate_python(value)
    except ValidationError:
        raise UsageError(f"the {what} cannot be {value!a}; allowed: {allowed}.") from None


def _message(file: EpisodeFile, fault: FileFault) -> str:
    return f"'{file.path}' {fault}."
