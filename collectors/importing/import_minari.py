"""``import_minari``: from a dataset that Minari's own tools made to one that everything here takes."""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass

from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root, default_id, parse_id
from cudc_bench.artefacts.manifest import IMPORTED_PROFILE, Import, Manifest, check_free, fingerprint
from cudc_bench.artefacts.provenance import command_line, stamp
from cudc_bench.data.layout import MAIN_FILE
from cudc_bench.data.measure import measure_coverage
from cudc_bench.data.metadata import write_metadata
from cudc_bench.data.staging import publish, staging
from cudc_bench.data.writer import Episode, write_episodes
from cudc_bench.envs import DOMAINS, Domain, check_domain, check_tasks
from cudc_bench.errors import RunError, UsageError
from cudc_bench.execution import interrupts
from cudc_bench.execution.progress import Advance, bars, echo
from cudc_bench.files import check_folder
from cudc_bench.settings.config import config_hash
from cudc_bench.settings.seeds import check_seeds

from .exorl import FileFault, Layout
from .import_exorl import check_names
from .imported import about_arrays, check_return, description
from .minari_file import Described, MinariEpisode, describe, read_minari

_ID = re.compile(r"[A-Za-z0-9_-]{1,100}(/[A-Za-z0-9_-]{1,100}){0,7}")


def import_minari(
    dataset: str,
    method: str,
    domain: str | None = None,
    *,
    task: str | None = None,
    seed: int = 1,
    source: str = "Minari",
    dataset_id: str | None = None,
    overwrite: bool = False,
) -> str:
    """Turn a Minari dataset of a known domain into one that can be labelled, evaluated, measured and verified.

    Such are what ``minari.DataCollector`` records around one of our environments (``record_infos=True`` keeps the states, which
    labelling needs) and what ``minari.combine_datasets`` makes. The dataset itself stays as it is. Every array is checked; the first
    episode that does not fit ends the import, and nothing of it stays. Other numeric infos with a row for each observation are kept.

    Args:
        dataset: the id of the dataset, below Minari's root.
        method: the name of what collected it; it need not be a registered collector.
        domain: a registered domain; what the dataset's environment says unless given.
        task: whose rewards the dataset holds. They are kept, and the new one becomes ``walker/walk/mine-v0``. Otherwise rewards are 0.
        seed: a number for this collection among others of the same method.
        source: who collected it, as tables name it.
        dataset_id: instead of the default id, such as ``walker/mine-v0``.
        overwrite: replace a dataset that exists.

    Returns:
        The id of the new dataset.

    Raises:
        UsageError: wrong input, or the first episode does not fit; nothing has been written.
        RunError: a later episode does not fit, or the dataset cannot be written.
    """
    started = time.monotonic()
    if _ID.fullmatch(dataset) is None:
        raise UsageError(f"{dataset!a} is not the id of a Minari dataset; allowed: such as 'walker/mine-v0'.")
    check_names(method, source)
    (seed,) = check_seeds([seed])
    check_folder(datasets_root(), "the dataset root")
    described = describe(dataset, datasets_root().joinpath(*dataset.split("/")))
    facts = _domain(dataset, described, domain)
    if task is not None:
        check_tasks(facts, [task])
    usual = default_id(facts.name, method, seed, IMPORTED_PROFILE)
    usual = usual if task is None else usual.for_task(task)
    one = usual if dataset_id is None else parse_id(dataset_id)
    if str(one) == dataset:
        raise UsageError(f"'{dataset}' itself would be replaced; give --dataset-id or another --method.")
    check_free(one, overwrite)
    layout = _look(dataset, described, facts, task)

    echo(f"import {method} on {facts.name} from {dataset}: {described.episodes:,} episodes")
    for line in _remarks(layout, described, task):
        echo(line)
    tally = _Tally()
    with staging(one) as building, interrupts.leaving_gracefully(saves=False):
        with bars([(f"import {method}", described.episodes)], "episodes") as (advance,):
            episodes = _episodes(dataset, described, facts, layout, task, tally, advance)
            written = write_episodes(building / "data", episodes)
        with described.file.open("rb") as opened:
            digest = hashlib.file_digest(opened, "sha256").hexdigest()
        manifest = Manifest(
            domain=facts.name,
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
                source=source, files=1, sha256=hashlib.sha256(f"{digest}  {MAIN_FILE}\n".encode()).hexdigest(), clipped=tally.clipped,
                ignored=list(layout.ignored),
            ),
            command=_command(dataset, described, facts.name, method, seed, task, source, one, usual),
            **stamp(time.monotonic() - started),
        )  # fmt: skip
        with bars([("measure coverage", written.steps)], "steps") as (advance,):
            coverage = measure_coverage(building / "data" / MAIN_FILE, manifest, advance)
        told = description(manifest, layout, f"the Minari dataset {dataset}", "in it")
        write_metadata(building / "data", manifest, str(one), told, coverage)
        publish(building, one)
    if tally.clipped:
        echo(f"{tally.clipped:,} of {written.steps * facts.action_size:,} numbers in actions were beyond [-1, 1] by rounding: clipped")
    echo(f"wrote {one} to {dataset_path(one)}")
    return str(one)


@dataclass
class _Tally:
    """What adds up over the episodes of an import."""

    clipped: int = 0


def _domain(dataset: str, described: Described, given: str | None) -> Domain:
    if given is None and described.domain is None:
        raise UsageError(f"'{dataset}' does not say of which domain it is; give --domain, such as {', '.join(DOMAINS)}.")
    if given is not None and described.domain is not None and given != described.domain:
        raise UsageError(f"'{dataset}' was recorded in {described.domain[:100]!a}, not in '{given}'; leave out --domain.")
    return check_domain(given or described.domain or "")


def _look(dataset: str, described: Described, domain: Domain, task: str | None) -> Layout:
    """Check the first episode, before any work.

    Raises:
        UsageError: it does not fit.
    """
    try:
        first = next(read_minari(described, domain))
        _episode(first, domain, task)
    except FileFault as fault:
        raise UsageError(f"'{dataset}' {fault}.") from None
    return first.layout


def _episodes(
    dataset: str, described: Described, domain: Domain, layout: Layout, task: str | None, tally: _Tally, advance: Advance
) -> Iterator[Episode]:
    """The episodes as they are written, one in memory at a time.

    Raises:
        RunError: one does not fit.
    """
    try:
        for index, found in enumerate(read_minari(described, domain)):
            if interrupts.requested():
                raise KeyboardInterrupt
            if found.layout != layout:
                raise FileFault(f"holds an episode_{index} with other infos ({found.layout}) than episode_0 ({layout})")
            yield _episode(found, domain, task)
            tally.clipped += found.clipped
            advance(1)
    except FileFault as fault:
        raise RunError(f"'{dataset}' {fault}. Nothing was written.") from None


def _episode(found: MinariEpisode, domain: Domain, task: str | None) -> Episode:
    rewards = None if task is None else found.rewards
    if rewards is not None and task is not None:
        check_return(rewards, domain, task)
    return Episode(None, found.observations, found.actions, found.infos, rewards)


def _remarks(layout: Layout, described: Described, task: str | None) -> Iterator[str]:
    """What people should know before the work starts."""
    if not layout.physics:
        what = f"only the rewards of {task} are there" if task else "the new dataset can never be labelled for a task"
        yield f"no physics states are in it (DataCollector keeps them with record_infos=True): {what}"
    if described.task is not None and task is None:
        yield f"the rewards in it, of {described.task}, are left out; --task {described.task} keeps them"
    yield from about_arrays(layout, "observation")


def _command(
    dataset: str, described: Described, domain: str, method: str, seed: int, task: str | None, source: str, one: DatasetId, usual: DatasetId
) -> str:
    options = {} if described.domain else {"--domain": domain}
    options |= {"--method": method, "--seed": str(seed)}
    options |= {} if task is None else {"--task": task}
    options |= {} if source == "Minari" else {"--source": source}
    options |= {} if one == usual else {"--dataset-id": str(one)}
    return command_line("import-minari", options, {}, dataset)
