"""``cudc-bench run`` and ``cudc-bench rerun``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from cudc_bench import plugins
from cudc_bench.cli import completion
from cudc_bench.cli.options import CheckpointEveryOption, DeviceOption, EngineOption, RewardOption, WorkersOption, parse_names
from cudc_bench.errors import RunError
from cudc_bench.execution import CHECKPOINT_EVERY
from cudc_bench.settings.seeds import parse_seeds

from .names import suite_names

if TYPE_CHECKING:
    from cudc_bench.cli.tables import Table

    from .api import Prepared


def run(
    suite: Annotated[
        str,
        typer.Argument(
            help="A suite by name, or a file of your own that ends in .toml.", autocompletion=completion.completer(lambda _: suite_names())
        ),
    ],
    methods: Annotated[
        str | None,
        typer.Option("--methods", "--method", help="Only these of its collectors, by commas.", autocompletion=completion.some_methods),
    ] = None,
    domains: Annotated[
        str | None, typer.Option("--domains", "--domain", help="Only these of its domains.", autocompletion=completion.some_domains)
    ] = None,
    tasks: Annotated[
        str | None, typer.Option("--tasks", "--task", help="Only these of its tasks.", autocompletion=completion.some_tasks)
    ] = None,
    algos: Annotated[
        str | None,
        typer.Option("--algos", "--algo", help="These offline algorithms instead of its own.", autocompletion=completion.some_algos),
    ] = None,
    seeds: Annotated[str | None, typer.Option("--seeds", "--seed", help="These seeds instead of its own, such as 1-3.")] = None,
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile",
            envvar="CUDC_BENCH_PROFILE",
            help="Instead of its own: paper, cpu, demo, smoke, or auto.",
            autocompletion=completion.profiles,
        ),
    ] = None,
    output: Annotated[str, typer.Option("--output", help="Folder of the records.")] = "results",
    report: Annotated[str, typer.Option("--report", help="Folder of the leaderboard.")] = "report",
    device: DeviceOption = "auto",
    engine: EngineOption = "auto",
    workers: WorkersOption = None,
    keep: Annotated[
        str,
        typer.Option(
            "--keep",
            help="datasets; or records: remove each dataset when all records of it are written.",
            autocompletion=completion.one_of("datasets", "records"),
        ),
    ] = "datasets",
    checkpoint_every: CheckpointEveryOption = CHECKPOINT_EVERY,
    ray: Annotated[str | None, typer.Option("--ray", help="Run on a Ray cluster: auto, local, or host:port.")] = None,
    ray_root: Annotated[str | None, typer.Option("--ray-root", help="Dataset root that all nodes share; otherwise each its own.")] = None,
    ray_cpus: Annotated[int, typer.Option("--ray-cpus", help="CPUs that each Ray task takes.")] = 1,
    ray_gpus: Annotated[float, typer.Option("--ray-gpus", help="GPUs that each Ray task takes, such as 0.5.")] = 0.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would be done and what it would cost, and do nothing.")] = False,
) -> None:
    """Run a whole study: collect, relabel, train and compare."""
    from rich.console import Console

    from cudc_bench.execution.progress import echo, warn

    from .api import check_keep, make_cluster, prepare, run_prepared, shared_root
    from .cluster import RETRIES

    check_keep(keep)
    cluster = make_cluster(ray, ray_root, ray_cpus, ray_gpus, RETRIES)
    with shared_root(cluster):
        ready = prepare(
            suite, methods=_names(methods), domains=_names(domains), tasks=_names(tasks), algos=_names(algos),
            seeds=None if seeds is None else parse_seeds(seeds), profile=profile, output=output, report=report, device=device,
            engine=engine, workers=workers, checkpoint_every=checkpoint_every, cluster=cluster,
        )  # fmt: skip
        if dry_run:
            screen = Console(highlight=False)
            screen.print(_table(ready))
            for line in _costs(ready):
                screen.print(line, markup=False, soft_wrap=True)
            return
        found = run_prepared(ready, keep, cluster)
    if found.removed:
        echo(f"removed {len(found.removed)} datasets; how to make them again is in {ready.common.folder / 'datasets'} and in each record")
    if found.leaderboard is not None:
        for problem in found.leaderboard.problems:
            warn(f"problem: {problem}")
        plugins.load("stages", "print_tables")(found.leaderboard)
        if found.leaderboard.files:
            print(ready.common.report / "index.html")
    if found.failed:
        for line in found.failed:
            warn(f"failed: {line}")
        raise RunError(f"{found.lacking} of {found.jobs} jobs are not done, see above; the same command tries them again.")
    echo(f"suite {ready.suite.name} is complete; tables, figures and the site are in {ready.common.report}: open its index.html")


def rerun(
    records: Annotated[list[str], typer.Argument(help="Records, or folders of them: one's own, or what others handed in.")],
    scratch: Annotated[str, typer.Option("--scratch", help="Folder for all that is made; removed if all comes out the same.")] = "rerun",
    collect: Annotated[bool, typer.Option("--collect", help="Collect every dataset again, also where it is here.")] = False,
    reward: RewardOption = None,
    workers: WorkersOption = None,
    keep: Annotated[bool, typer.Option("--keep", help="Leave what was made.")] = False,
) -> None:
    """Make runs again from their records alone, and compare to the last bit."""
    from pathlib import Path

    from cudc_bench.execution.progress import echo

    from .rerun import rerun as run

    found = run([Path(one) for one in records], scratch=scratch, collect=collect, reward=reward, workers=workers, keep=keep)
    other = [one for one in found if one.differences]
    for one in found:
        what = "its dataset and its run" if one.collected else "its run, on the dataset that is here,"
        if not one.differences:
            print(f"{one.path}: {what} came out the same to the last bit")
            continue
        print(f"{one.path}: not the same: {'; '.join(one.differences)}")
        for cause in one.causes:
            echo(f"  {cause}")
        if one.made is not None:
            echo(f"  the new record: {one.made}")
    if other:
        raise RunError(f"{len(other)} of {len(found)} records came out with other numbers, see above; what was made is in {scratch}.")


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else parse_names(text)


def _table(ready: Prepared) -> Table:
    """What is there and what is to do, a line for each method and domain."""
    from cudc_bench.cli.tables import Column, Table, row

    from .display import duration
    from .jobs import KINDS

    plan, done = ready.found.plan, ready.found.done
    left = plan.left(done).needs
    columns = (Column("domain"), Column("method"), *(Column(name, right=True) for name in (*KINDS, "time")))
    rows = []
    for domain, methods in dict.fromkeys((job.domain, job.methods) for job in plan.needs):
        mine = [job for job in plan.needs if (job.domain, job.methods) == (domain, methods)]
        cells = []
        for kind in KINDS:
            some = [job for job in mine if job.kind == kind]
            cells.append(f"{sum(job in left for job in some)} / {len(some)}" if some else "")
        times = [ready.estimates.seconds(job) for job in mine if job in left]
        time = "unknown" if None in times else duration(sum(one for one in times if one is not None)) if times else ""
        rows.append(row(domain, methods[0] if len(methods) == 1 else "all together", *cells, time))
    title = f"suite {ready.suite.name}, profile {ready.common.profile}: to make / all"
    return Table(columns, tuple(rows), title, shortens=False, keys=2)


def _costs(ready: Prepared) -> list[str]:
    from cudc_bench.text import size

    from .display import duration

    queue, estimates = ready.queue(), ready.estimates
    jobs = list(queue.plan.needs)
    lines = [f"{len(jobs)} jobs to do, {len(ready.found.plan.needs) - len(jobs)} done or not needed any more; datasets in {_root()}"]
    if not jobs:
        return lines
    unknown = sorted({job.algo or job.method for job in jobs if estimates.seconds(job) is None})
    if unknown:
        lines.append(f"time: nobody has measured {', '.join(unknown)} at the profile {ready.common.profile} on {ready.common.device} yet")
    else:
        sources = sorted({source for job in jobs if (source := estimates.source(job))})
        about = duration(queue.seconds_left(ready.workers, {}))
        lines.append(f"time: about {about} with {ready.workers} at a time ({'; '.join(sources) or 'short'})")
    datasets = sum(estimates.size(job) for job in jobs if job.kind in ("collect", "relabel"))
    records = sum(estimates.size(job) for job in jobs if job.kind == "evaluate")
    one = max((estimates.size(job) for job in jobs if job.kind == "collect"), default=0)
    lines.append(
        f"disk: about {size(datasets)} of datasets and {size(records)} of records; with --keep records only some datasets at a time,"
        f" of up to {size(one)}"
    )
    return lines


def _root() -> str:
    from cudc_bench.artefacts.ids import datasets_root

    return str(datasets_root())
